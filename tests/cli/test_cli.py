"""The command: what it writes, prints and refuses; in a process of its own once for each kind of end."""

import json
import os
import shutil
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from helpers.commands import BALANCED, BOX, call, refused, run, write_half
from helpers.onnx_models import NCHW, sum_of

from selfcorrect import Settings, exr

PAPER = ["--preset", "paper"]
FAST = [
    "--patch",
    "32",
    "--stride",
    "16",
    "--epochs",
    "1",
    "--window",
    "5",
    *PAPER,
    *BOX,
]


def test_frame_writes_a_corrected_image_and_passes_the_rest_through(halves: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "out.exr"
    result = run("frame", *halves, "-o", out, *FAST, "--json", "--seed", "3")
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert report["output"] == str(out)
    assert (
        report["settings"]
        == Settings.preset(report["preset"], patch=32, stride=16, epochs=1, window=5, seed=3).to_dict()
    )
    assert report["channels"]["albedo"] == ["albedo.R", "albedo.G", "albedo.B"]
    assert report["size"] == {"width": 30, "height": 24}
    assert {"read", "denoise", "train", "infer", "write", "total"} <= set(report["seconds"])
    assert "color: R, G, B" in result.stderr
    before, after = exr.read(str(halves[0])), exr.read(str(out))
    assert after.channel_names == before.channel_names
    other = exr.read(str(halves[1]))
    for name in set(before.channel_names) - {"R", "G", "B"}:
        kept = before.pixels(name)
        mean = ((kept.astype(float) + other.pixels(name)) / 2).astype(kept.dtype)
        np.testing.assert_array_equal(after.pixels(name), mean if name[0] in "Aa" else kept)
    assert report["other_channels"] == {"mean": 4, "kept": 4, "corrected": 0, "lacking": []}
    assert "other channels: 4 the mean of both halves, 4 as in half a" in result.stderr
    assert not np.array_equal(after.pixels("R"), before.pixels("R"))
    header = after.parts[0].header
    assert header["owner"] == "a renderer"
    assert json.loads(header["selfcorrect/settings"]) == report["settings"]
    assert [p.name for p in tmp_path.iterdir() if "tmp" in p.name] == []


@pytest.mark.parametrize("named", [True, False])
def test_a_default_without_oidn_is_told_of(
    named: bool, halves: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for package in ("mitsuba_oidn", "onnxruntime"):
        monkeypatch.setitem(sys.modules, package, None)
    flags = [*FAST[: -len(BOX)], *(["--denoiser", "joint-bilateral"] if named else [])]
    result = call("frame", *halves, "-o", tmp_path / "out.exr", *flags)
    assert result.returncode == 0, result.stderr
    told = [line for line in result.stderr.splitlines() if "oidn is not installed" in line]
    assert len(told) == (0 if named else 1)
    assert named or told[0].endswith("run: pip install 'selfcorrect[oidn]'")


@pytest.mark.parametrize(
    ("flags", "stages"),
    [
        ([], "deep-combiner,core"),
        (["--stages", "core"], "core"),
        (["--set", "stages=core"], "core"),
        (PAPER, "core"),
        (["--denoiser", "nlm"], "core"),
    ],
)
def test_a_weak_denoisers_images_are_combined_first(
    flags: list[str], stages: str, halves: tuple[Path, Path], tmp_path: Path
) -> None:
    given = [*BALANCED, "--epochs", "1", "--denoiser", "joint-bilateral", *flags]
    result = call("frame", *halves, "-o", tmp_path / "out.exr", "--json", *given)
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert report["settings"]["stages"] == stages
    assert ("deep-combiner" in report["seconds"]) == ("combiner" in stages)


def test_same_seed_writes_the_same_pixels(halves: tuple[Path, Path], tmp_path: Path) -> None:
    for name in ("one", "two"):
        assert call("frame", *halves, "-o", tmp_path / f"{name}.exr", *FAST).returncode == 0
    one, two = (exr.read(str(tmp_path / f"{name}.exr")) for name in ("one", "two"))
    np.testing.assert_array_equal(one.pixels("R"), two.pixels("R"))


def test_denoised_halves_of_the_user_are_taken(halves: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "out.exr"
    given = [write_half(tmp_path / f"d{i}.exr", 10 + i) for i in range(2)]
    flags = [f for f in FAST if f not in ("--denoiser", "box")]
    result = call("frame", *halves, "-o", out, "--denoised-a", given[0], "--denoised-b", given[1], *flags, "--json")
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["denoiser"] == "given"


def test_repairs_are_counted_in_the_log(tmp_path: Path) -> None:
    broken = np.full((24, 30), 0.5, np.float16)
    broken[3, 4:7] = np.nan
    broken[9, 9] = -1
    a, b = write_half(tmp_path / "a.exr", 1, R=broken), write_half(tmp_path / "b.exr", 2)
    result = call("frame", a, b, "-o", tmp_path / "out.exr", *FAST)
    assert result.returncode == 0, result.stderr
    assert "color: 3 pixels were NaN or infinite, 1 negative; repaired" in result.stderr
    assert np.isfinite(exr.read(str(tmp_path / "out.exr")).pixels("R")).all()


def test_estimate_and_its_maps(halves: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "out.exr"
    result = call("frame", *halves, "-o", out, *BALANCED, "--diagnostics", "error,blend", "--json")
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert report["preset"] == Settings.default()
    known = {"noisy", "denoised", "corrected", "change", "standard_error", "improved", "independent"}
    assert set(report["estimate"]) == known
    assert "relMSE ≈ " in result.stderr
    after = exr.read(str(out))
    assert json.loads(after.parts[0].header["selfcorrect/run"])["estimate"] == report["estimate"]
    blend = after.pixels("selfcorrect.blend")
    assert 0 <= blend.min() <= blend.max() <= 1
    assert after.pixels("selfcorrect.error.after").mean() <= after.pixels("selfcorrect.error.before").mean()


def test_no_guard_takes_the_corrected_image_as_it_is(halves: tuple[Path, Path], tmp_path: Path) -> None:
    result = call("frame", *halves, "-o", tmp_path / "out.exr", *BALANCED, "--no-guard", "--json")
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["estimate"] is None


def test_identical_halves_are_warned_of(halves: tuple[Path, Path], tmp_path: Path) -> None:
    shutil.copy(halves[0], tmp_path / "copy.exr")
    result = call("frame", halves[0], tmp_path / "copy.exr", "-o", tmp_path / "out.exr", *BALANCED)
    assert result.returncode == 0, result.stderr
    assert "warning: the halves are identical" in result.stderr


def test_inspect(halves: tuple[Path, Path]) -> None:
    text = call("inspect", halves[0])
    assert text.returncode == 0, text.stderr
    assert "nn.X" in text.stdout
    assert "data window" in text.stdout
    report = json.loads(call("inspect", halves[0], "--json").stdout)
    assert report["taken"]["color"] == ["R", "G", "B"]


def test_compare(halves: tuple[Path, Path]) -> None:
    same = json.loads(call("compare", halves[0], halves[0], "--json").stdout)
    assert same["relmse"] == 0
    assert same["flip"] == 0
    result = call("compare", *halves, halves[0], "--weight", halves[1])
    assert result.returncode == 0, result.stderr
    for word in ("relMSE", "PSNR", "SSIM", "FLIP", "mean radiance ratio"):
        assert word in result.stdout


def test_demo_corrects_the_packaged_frame(tmp_path: Path) -> None:
    result = call("demo", "-o", tmp_path / "new", *FAST[:-4], "--denoiser", "joint-bilateral", "--json")
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert set(report["relmse"]) == {"noisy", "denoised", "corrected"}
    assert (tmp_path / "new" / "corrected.exr").is_file()


class TestBadInput:
    def test_halves_of_different_size(self, halves: tuple[Path, Path], tmp_path: Path) -> None:
        other = write_half(tmp_path / "small.exr", 3, size=(24, 29))
        line = refused("frame", halves[0], other, "-o", tmp_path / "out.exr", *FAST)
        assert "small.exr: expected 30x24 pixels" in line

    def test_halves_of_different_windows(self, halves: tuple[Path, Path], tmp_path: Path) -> None:
        """What a renderer that crops to what is seen may write: as large, but elsewhere."""
        window = (np.array([2, 1], np.int32), np.array([31, 24], np.int32))
        source = OpenEXR.File(str(halves[1]), separate_channels=True)
        moved = {name: channel.pixels for name, channel in source.channels().items()}
        other = str(tmp_path / "moved.exr")
        OpenEXR.File({"dataWindow": window, "displayWindow": window}, moved).write(other)
        line = refused("frame", halves[0], other, "-o", tmp_path / "out.exr")
        assert "moved.exr: expected the data window (0, 0, 29, 23)" in line
        assert "but got (2, 1, 31, 24); render both halves without cropping" in line

    def test_missing_colour(self, halves: tuple[Path, Path], tmp_path: Path) -> None:
        other = write_half(tmp_path / "no-red.exr", 3, R=None)
        assert "no-red.exr" in refused("frame", halves[0], other, "-o", tmp_path / "out.exr", *FAST)

    def test_missing_albedo_in_one_half(self, halves: tuple[Path, Path], tmp_path: Path) -> None:
        lacking = dict.fromkeys(["albedo.R", "albedo.G", "albedo.B"])
        other = write_half(tmp_path / "plain.exr", 3, **lacking)
        line = refused("frame", halves[0], other, "-o", tmp_path / "out.exr", *FAST)
        assert "plain.exr: expected albedo channels" in line

    def test_no_exr(self, halves: tuple[Path, Path], tmp_path: Path) -> None:
        (tmp_path / "text.exr").write_text("no picture")
        assert "text.exr" in refused("frame", halves[0], tmp_path / "text.exr", "-o", tmp_path / "out.exr")

    def test_missing_file(self, halves: tuple[Path, Path], tmp_path: Path) -> None:
        assert "none.exr" in refused("frame", halves[0], tmp_path / "none.exr", "-o", tmp_path / "out.exr")

    def test_truncated(self, halves: tuple[Path, Path], tmp_path: Path) -> None:
        (tmp_path / "cut.exr").write_bytes(halves[1].read_bytes()[:-200])
        assert "cut.exr" in refused("frame", halves[0], tmp_path / "cut.exr", "-o", tmp_path / "out.exr")

    def test_giant_data_window(self, halves: tuple[Path, Path], tmp_path: Path) -> None:
        data = bytearray(halves[1].read_bytes())
        at = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
        data[at : at + 16] = np.array([0, 0, 2**30, 2**30], "<i4").tobytes()
        (tmp_path / "giant.exr").write_bytes(data)
        assert "giant.exr" in refused("frame", halves[0], tmp_path / "giant.exr", "-o", tmp_path / "out.exr")

    def test_the_same_file_twice(self, halves: tuple[Path, Path], tmp_path: Path) -> None:
        line = refused("frame", halves[0], halves[0], "-o", tmp_path / "out.exr", *FAST)
        assert "same file twice" in line
        os.link(halves[0], tmp_path / "link.exr")
        assert "link.exr" in refused("frame", halves[0], tmp_path / "link.exr", "-o", tmp_path / "out.exr", *FAST)

    def test_unwritable_output(self, halves: tuple[Path, Path], tmp_path: Path) -> None:
        for out in (tmp_path / "none" / "out.exr", tmp_path, tmp_path / "out.png", halves[0] / "out.exr"):
            assert str(out) in refused("frame", *halves, "-o", out, *FAST)

    @pytest.mark.parametrize(
        ("flags", "word"),
        [
            (["--preset", "nonsense"], "nonsense"),
            (["--nonsense", "1"], "--nonsense"),
            (["--window", "4"], "window"),
            (["--window", "x"], "--window"),
            (["--denoiser", "nonsense"], "nonsense"),
            (["--denoiser", "onnx:none.onnx"], "none.onnx"),
            (["--denoiser", "none.py:Class"], "none.py"),
            (["--device", "nonsense"], "nonsense"),
            (["--device", "cuda"], "cuda"),
            (["--device", "cuda:7"], "cuda:7"),
            (["--device", "meta"], "meta"),
            (["--threads", "0"], "--threads"),
            (["--map", "albedo"], "ROLE=CHANNEL"),
            (["--map", "albedo=Nonsense"], "Nonsense"),
            (["--map", "nonsense=R"], "nonsense"),
            (["--diagnostics", "nonsense"], "nonsense"),
            (["--diagnostics", "blend"], "guard"),
            (["--denoised-a", "none.exr"], "both denoised halves"),
        ],
    )
    def test_flags(self, halves: tuple[Path, Path], tmp_path: Path, flags: list[str], word: str) -> None:
        assert word in refused("frame", *halves, "-o", tmp_path / "out.exr", *FAST, *flags)

    def test_an_onnx_model_with_the_wrong_inputs(self, halves: tuple[Path, Path], tmp_path: Path) -> None:
        model = sum_of(tmp_path / "wrong.onnx", {"depth": NCHW, "motion": NCHW})
        line = refused("frame", *halves, "-o", tmp_path / "out.exr", *FAST, "--denoiser", f"onnx:{model}")
        assert "wrong.onnx" in line
        assert "depth" in line
        assert "expected" in line

    def test_no_command(self) -> None:
        assert "COMMAND" in refused(how=run)

    def test_an_existing_output_survives(self, halves: tuple[Path, Path], tmp_path: Path) -> None:
        out = tmp_path / "out.exr"
        out.write_bytes(b"precious")
        refused("frame", halves[0], tmp_path / "none.exr", "-o", out, *FAST)
        failing = f"command:{sys.executable} -c raise(SystemExit(3)) {{color}} {{output}}"
        line = refused("frame", *halves, "-o", out, *FAST, "--denoiser", failing)
        assert "3" in line
        assert out.read_bytes() == b"precious"
        assert sorted(p.name for p in tmp_path.iterdir()) == ["a.exr", "b.exr", "out.exr"]


def test_a_half_that_changes_meanwhile_is_refused(halves: tuple[Path, Path], tmp_path: Path) -> None:
    """What passes through is read again at the end: it must be of the same file."""
    (tmp_path / "late.py").write_text(
        "import pathlib\n"
        "class Late:\n"
        "    name, features = 'late', frozenset()\n"
        "    def denoise(self, color, albedo, normal):\n"
        f"        pathlib.Path({str(halves[0])!r}).touch()\n"
        "        return color\n"
    )
    out = tmp_path / "out.exr"
    options = ["--steps", "1", "--patch", "16", "--window", "5", "--denoiser", f"{tmp_path / 'late.py'}:Late"]
    line = refused("frame", *halves, "-o", out, *options)
    assert "a.exr: expected the file that was read" in line
    assert not out.exists()


def test_a_frame_beyond_maxmem_is_refused_before_the_work(halves: tuple[Path, Path], tmp_path: Path) -> None:
    line = refused("frame", *halves, "-o", tmp_path / "out.exr", *BALANCED, "--maxmem", "100M")
    assert "a.exr: expected --maxmem of at least" in line
    assert "6 apples" in refused("frame", *halves, "-o", tmp_path / "out.exr", "--maxmem", "6 apples")
    assert call("frame", *halves, "-o", tmp_path / "out.exr", *BALANCED, "--maxmem", "2G").returncode == 0
