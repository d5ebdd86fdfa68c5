"""`compare --shot`: errors of every frame, and of the change between two."""

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import write_half

from selfcorrect import cli, exr, metrics

LAST = 3
SIZE = (24, 30)


@pytest.fixture
def shot(tmp_path: Path) -> list[str]:
    """Names of the image, of two references and of the smooth one."""
    for number in range(1, LAST + 1):
        truth = np.random.default_rng(number).random(SIZE, np.float32)
        for i, name in enumerate(("image", "a", "b", "smooth")):
            noise = 0 if name == "smooth" else np.random.default_rng(10 * number + i).random(SIZE, np.float32) / 5
            write_half(tmp_path / f"{name}.{number:04d}.exr", 0, **dict.fromkeys("RGB", truth + noise))
    return [str(tmp_path / f"{name}.####.exr") for name in ("image", "a", "b", "smooth")]


def colours(pattern: str) -> list[np.ndarray]:
    return [exr.load_half(pattern.replace("####", f"{n:04d}")).buffers["color"] for n in range(1, LAST + 1)]


def test_every_frame_and_the_mean(shot: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    image, a, b, smooth = shot
    assert cli.main(["compare", "--shot", image, a, b, "--weight", smooth, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    x, r_a, r_b, s = map(colours, shot)
    assert [row["frame"] for row in told["frames"]] == [1, 2, 3]
    for t, row in enumerate(told["frames"]):
        assert row["relmse"] == pytest.approx(metrics.relmse(x[t], r_a[t], r_b[t], s[t]))
        assert ("temporal_error" in row) == (t > 0)
    expected = metrics.temporal_error(x[1], x[0], (r_a[1], r_a[0]), (r_b[1], r_b[0]), (s[1], s[0]))
    assert told["frames"][1]["temporal_error"] == pytest.approx(expected)
    changes = [row["temporal_error"] for row in told["frames"][1:]]
    assert told["mean"]["temporal_error"] == pytest.approx(np.mean(changes))
    assert cli.main(["compare", "--shot", image, a]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["frame", "frame", "frame", "mean"]


def test_along_the_motion_a_pan_has_no_flicker(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The error moves with what it is an error of: pixel by pixel that flickers, along the motion it does not."""
    rng = np.random.default_rng(0)
    coarse = rng.random((16, 40), np.float32)
    wide = np.kron(coarse, np.ones((4, 4), np.float32))
    for number in (1, 2):
        truth = wide[:, 10 + 3 * number :][:, :96]
        for name, pixels in (("ref", truth), ("image", truth * 1.2)):
            write_half(tmp_path / f"{name}.{number:04d}.exr", 0, size=truth.shape, **dict.fromkeys("RGB", pixels))
    names = [str(tmp_path / f"{name}.%04d.exr") for name in ("image", "ref")]
    assert cli.main(["compare", "--shot", *names, "--json"]) == 0
    change = json.loads(capsys.readouterr().out)["frames"][1]
    assert 0 <= change["temporal_error_along_motion"] < 0.3 * change["temporal_error"]


@pytest.mark.parametrize(
    ("image", "message"),
    [("none.####.exr", "expected the frames of a shot, but got no such file"), ("a.exr", "expected a place for the")],
)
def test_what_is_no_shot_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], image: str, message: str
) -> None:
    assert cli.main(["compare", "--shot", str(tmp_path / image), str(tmp_path / "ref.####.exr")]) == 2
    assert message in capsys.readouterr().err
