"""What odd files do to the command: one line that names them, nothing else; and the frames beside them go on."""

import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
import torch
from helpers.commands import BALANCED
from helpers.exr_files import raw
from helpers.shots import Run, arguments

from selfcorrect import cli, exr, files
from selfcorrect.errors import printable
from selfcorrect.exr import header

Captured = pytest.CaptureFixture[str]


def refused(capfd: Captured, *given: object) -> str:
    capfd.readouterr()
    assert cli.main([*map(str, given)]) == 2
    out, err = capfd.readouterr()
    assert out == ""
    (line,) = [line for line in err.splitlines() if line.startswith("selfcorrect: error: ")]
    return line


@pytest.mark.parametrize(
    ("attribute", "outcome"),
    [
        (("framesPerSecond", "rational", struct.pack("<iI", 24, 0)), "failed"),
        (("chromaticities", "int", struct.pack("<i", 3)), "failed"),
        (("multiView", "int", struct.pack("<i", 1)), "written"),  # no list of views is none
    ],
)
def test_an_odd_attribute_ends_one_frame_at_most(
    attribute: tuple[str, str, bytes], outcome: str, shot_folder: Path, sequence: Run
) -> None:
    (shot_folder / "a.0002.exr").write_bytes(raw([attribute]))
    (shot_folder / "b.0002.exr").write_bytes(raw())
    code, log, frames = sequence(arguments(shot_folder, last=3))
    assert code == (outcome == "failed")
    assert [f["outcome"] for f in frames] == ["written", outcome, "written"]
    assert "0002.exr" in frames[1].get("reason", "0002.exr")
    assert "Traceback" not in log


@pytest.mark.parametrize("run", [3.0, "[" * 100_000, "{", "[]"])
def test_an_odd_output_is_made_again(run: Any, shot_folder: Path, sequence: Run) -> None:
    given = arguments(shot_folder, "--skip-existing", last=2)
    channels = {name: np.zeros((4, 5), np.float16) for name in "RGB"}
    OpenEXR.File({"selfcorrect/run": run}, channels).write(str(shot_folder / "out" / "x.0001.exr"))
    code, log, frames = sequence(given)
    assert code == 0
    assert [f["outcome"] for f in frames] == ["written", "written"]
    assert "expected an output of selfcorrect sequence, but got another file" in log


def test_any_exception_is_that_of_its_frame(shot_folder: Path, sequence: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def odd(sources: Any, **how: Any) -> Any:
        if "0002" in sources.a:
            raise KeyError("odd")
        return load(sources, **how)

    load = files.load
    monkeypatch.setattr("selfcorrect.files.load", odd)
    code, _, frames = sequence(arguments(shot_folder, last=3))
    assert code == 1
    assert [f["outcome"] for f in frames] == ["written", "failed", "written"]
    assert "a.0002.exr" in frames[1]["reason"]


def test_a_file_of_another_size_is_refused_by_its_header(
    halves: tuple[Path, Path], tmp_path: Path, capfd: Captured, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some kilobytes that hold a hundred million pixels."""
    bomb = tmp_path / "bomb.exr"
    wide = (0, 0, 11_999, 9_999)
    bomb.write_bytes(raw(window=wide)[:4096])
    monkeypatch.setattr("selfcorrect.exr.load.read", lambda _: pytest.fail("pixels were read"))
    out = ("-o", tmp_path / "out.exr", *BALANCED)
    for more in ([], ["--maxmem", "2G"]):
        line = refused(capfd, "frame", halves[0], bomb, *out, *more)
        assert "bomb.exr: expected 30x24 pixels like" in line
        denoised = ["--denoised-a", bomb, "--denoised-b", halves[1]]
        assert "bomb.exr: expected 30x24 pixels like" in refused(capfd, "frame", *halves, *denoised, *out, *more)


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory: …\nat …")])
def test_too_little_memory_is_one_line(
    error: Exception, halves: tuple[Path, Path], tmp_path: Path, capfd: Captured, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> torch.Tensor:
        raise error

    monkeypatch.setattr("selfcorrect.cli.runner.correct", full)
    line = refused(capfd, "frame", *halves, "-o", tmp_path / "out.exr", *BALANCED)
    assert "expected enough memory for this frame" in line
    assert not (tmp_path / "out.exr").exists()


def test_names_from_a_file_begin_no_line_and_move_no_cursor(tmp_path: Path, capfd: Captured) -> None:
    name = "a\nopenjd_fail: \x1b[31mboo\u202e.R"
    channels = {n: np.zeros((4, 5), np.float16) for n in (*"RGB", name)}
    OpenEXR.File({}, channels).write(str(tmp_path / "a.exr"))
    assert cli.main(["inspect", str(tmp_path / "a.exr")]) == 0
    shown = capfd.readouterr().out
    assert "\\nopenjd_fail: \\x1b[31mboo\\u202e" in shown
    assert not any(line.startswith("openjd_fail") for line in shown.splitlines())
    line = refused(
        capfd, "frame", tmp_path / "a.exr", tmp_path / "none.exr", "-o", tmp_path / "o.exr", "--map", "albedo=x"
    )
    assert "\x1b" not in line


def test_what_is_printable_stays() -> None:
    assert printable("µ → ± 画像 'x'") == "µ → ± 画像 'x'"
    assert printable("a\tb\r\x9b\u2028\udcff") == "a\\tb\\r\\x9b\\u2028\\udcff"


def test_a_state_that_cannot_be_written_loses_no_image(
    shot_folder: Path, sequence: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("selfcorrect.shot.run.save_state", full)
    state = shot_folder / "state.safetensors"
    code, _, frames = sequence(arguments(shot_folder, "--save-state", state, last=2))
    assert code == 1
    assert [f["outcome"] for f in frames] == ["failed", "failed"]
    assert "No space left" in frames[0]["reason"]
    assert "x.0001.exr is written" in frames[0]["reason"]
    for frame in (1, 2):
        assert np.isfinite(exr.read(str(shot_folder / "out" / f"x.000{frame}.exr")).pixels("R")).all()


def test_nothing_can_be_told_but_the_picture_is_written(
    halves: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Full(io.StringIO):
        def write(self, _: str) -> int:
            raise OSError(28, "No space left on device")

    for name, stream in (("full", Full()), ("none", None)):
        monkeypatch.setattr("sys.stderr", stream)
        assert cli.main(["frame", *map(str, halves), "-o", str(tmp_path / f"{name}.exr"), *BALANCED]) == 0
    monkeypatch.undo()
    for name in ("full", "none"):
        assert np.isfinite(exr.read(str(tmp_path / f"{name}.exr")).pixels("R")).all()


def bomb_of(folder: Path) -> Path:
    """13 kB that decompress to 12000×10000 pixels, as zeros in HTJ2K do; its chunks are never looked at."""
    data = raw([("compression", "compression", b"\x0a")], window=(0, 0, 11_999, 9_999))
    _, tables = header.parse(data, "")
    chunks = struct.pack("<40Q", *[tables + 320 + 300 * number for number in range(40)])
    path = folder / "bomb.exr"
    path.write_bytes(data[:tables] + chunks + bytes(40 * 300))
    return path


def test_inspect_tells_what_the_header_says_of_pixels_that_are_too_many(
    halves: tuple[Path, Path], tmp_path: Path, capfd: Captured, monkeypatch: pytest.MonkeyPatch
) -> None:
    bomb = bomb_of(tmp_path)
    assert bomb.stat().st_size < 13_000
    plain = json.loads(shown(capfd, "inspect", halves[0], "--json")[0])
    monkeypatch.setattr("selfcorrect.exr.inspection.read", lambda _: pytest.fail("pixels were read"))
    out, err = shown(capfd, "inspect", bomb)
    assert "12000×10000 pixels, scanlineimage, HTJ2K256" in out
    assert out.splitlines()[2:] == ["  B: float16", "  G: float16", "  R: float16", "color: R, G, B"]
    assert err.endswith("bomb.exr: its pixels are not read: by its header they take 0.7G; --maxmem 1.1G reads them\n")
    told = json.loads(shown(capfd, "inspect", halves[0], "--maxmem", "100M", "--json")[0])
    assert [channel["mean"] for channel in told["parts"][0]["channels"]] == [None] * 11
    unread = dict.fromkeys(("nan", "inf", "minimum", "maximum", "mean"))
    for part in plain["parts"]:
        part["channels"] = [channel | unread for channel in part["channels"]]
    assert told == plain, "all else is as it is of the pixels"


def shown(capfd: Captured, *given: object) -> tuple[str, str]:
    capfd.readouterr()
    assert cli.main([*map(str, given)]) == 0
    out, err = capfd.readouterr()
    return out, err


def test_compare_stays_within_maxmem(halves: tuple[Path, Path], capfd: Captured) -> None:
    assert "relMSE" in shown(capfd, "compare", *halves, "--maxmem", "1G")[0]
    line = refused(capfd, "compare", *halves, "--maxmem", "100M")
    assert "a.exr: expected --maxmem of at least 0.4G to compare the pixels" in line
    shot = [str(half).replace(".exr", ".####.exr") for half in halves]
    for half in halves:
        half.rename(str(half).replace(".exr", ".0001.exr"))
    assert "expected --maxmem of at least" in refused(capfd, "compare", "--shot", *shot, "--maxmem", "100M")


def test_compare_judges_giants_alike_by_their_headers(
    tmp_path: Path, capfd: Captured, monkeypatch: pytest.MonkeyPatch
) -> None:
    bomb = bomb_of(tmp_path)
    monkeypatch.setattr("selfcorrect.exr.load.read", lambda _: pytest.fail("pixels were read"))
    line = refused(capfd, "compare", bomb, bomb, "--maxmem", "6G")
    assert "bomb.exr: expected --maxmem of at least 31.7G to compare" in line


def test_inspect_and_compare_judge_headers_before_pixels(
    halves: tuple[Path, Path], tmp_path: Path, capfd: Captured, monkeypatch: pytest.MonkeyPatch
) -> None:
    bomb = bomb_of(tmp_path)
    monkeypatch.setattr("selfcorrect.exr.inspection.read", lambda _: pytest.fail("pixels were read"))
    damaged = tmp_path / "damaged.exr"
    damaged.write_bytes(raw(window=(0, 0, 39_999, 49_999))[:4096])
    assert "expected a file that can hold the 40000×50000 pixels" in refused(capfd, "inspect", damaged)
    monkeypatch.setattr("selfcorrect.exr.load.read", lambda _: pytest.fail("pixels were read"))
    for more in ([bomb], [halves[1], bomb], [halves[1], "--weight", bomb]):
        assert "bomb.exr: expected 30x24 pixels like" in refused(capfd, "compare", halves[0], *more)


@pytest.mark.parametrize("companion", ["albedo", "denoImg"])
def test_a_giant_beside_a_half_is_refused_by_its_header(
    companion: str, halves: tuple[Path, Path], tmp_path: Path, capfd: Captured
) -> None:
    for letter, half in zip("AB", halves, strict=True):
        (tmp_path / f"x_randImg{letter}.exr").write_bytes(raw())
        assert half.exists()
    (tmp_path / f"x_{companion}A.exr").write_bytes(raw(window=(0, 0, 11_999, 9_999))[:4096])
    given = (tmp_path / "x_randImgA.exr", tmp_path / "x_randImgB.exr", "-o", tmp_path / "out.exr", *BALANCED)
    line = refused(capfd, "frame", *given)
    assert f"x_{companion}A.exr: expected 14x9 pixels" in line
    assert "but got 12000x10000" in line
    assert "expected --maxmem of at least" in refused(capfd, "frame", *given, "--maxmem", "1G")
