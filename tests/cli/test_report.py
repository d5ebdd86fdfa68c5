"""The command `report` and the flag --report: pages from real runs, and what is refused."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import BALANCED, refused, run, write_half
from helpers.pages import data_of, unpacked
from helpers.shots import arguments

from selfcorrect import cli, exr

Halves = tuple[Path, Path]


@pytest.fixture
def out(halves: Halves, tmp_path: Path) -> Path:
    """The halves, corrected, with the guard's maps."""
    assert (
        cli.main(
            ["frame", *map(str, halves), "-o", str(tmp_path / "out.exr"), *BALANCED, "--diagnostics", "error,blend"]
        )
        == 0
    )
    return tmp_path / "out.exr"


def names(page: Path) -> list[str]:
    return [layer["name"] for layer in data_of(page.read_text())["layers"]]


def test_page_of_a_frame_as_it_is_corrected(halves: Halves, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    result = run("frame", *halves, "-o", tmp_path / "out.exr", *BALANCED, "--report", page, "--json")
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert names(page) == ["noisy", "denoised", "corrected", "error.before", "error.after", "blend"]
    layers = {layer["name"]: layer for layer in data_of(page.read_text())["layers"]}
    written = exr.load_half(report["output"]).buffers["color"]
    np.testing.assert_allclose(np.moveaxis(unpacked(layers["corrected"]), 0, -1), written, rtol=2**-11, atol=1e-6)
    assert "All 3" in page.read_text()  # settings


def test_page_from_files(halves: Halves, out: Path, tmp_path: Path) -> None:
    page, reference = tmp_path / "page.html", write_half(tmp_path / "ref.exr", 9)
    result = run("report", *halves, out, "-o", page, "--reference", reference, "--threads", 1)
    assert result.returncode == 0, result.stderr
    assert "denoiser: box" in result.stderr
    assert names(page) == ["noisy", "denoised", "corrected", "reference", "error.before", "error.after", "blend"]
    assert "Error against the reference" in page.read_text()
    assert "preset balanced" in page.read_text()


def test_both_ways_show_the_same_images(halves: Halves, tmp_path: Path) -> None:
    first, second, out = (tmp_path / name for name in ("first.html", "second.html", "out.exr"))
    assert (
        run("frame", *halves, "-o", out, *BALANCED, "--diagnostics", "error,blend", "--report", first).returncode == 0
    )
    assert run("report", *halves, out, "-o", second, "--threads", 1).returncode == 0
    for one, two in zip(*(data_of(page.read_text())["layers"] for page in (first, second)), strict=True):
        assert one["name"] == two["name"]
        np.testing.assert_allclose(unpacked(one), unpacked(two), rtol=2**-11, atol=1e-6)


def test_a_frame_with_nan(halves: Halves, tmp_path: Path) -> None:
    broken = np.full((24, 30), 0.5, np.float16)
    broken[3, 4:7], broken[9, 9] = np.nan, np.inf
    a = write_half(tmp_path / "broken.exr", 3, R=broken)
    reference = write_half(tmp_path / "ref.exr", 9, G=broken)
    page, out = tmp_path / "page.html", tmp_path / "out.exr"
    result = run("frame", a, halves[1], "-o", out, *BALANCED, "--report", page)
    assert result.returncode == 0, result.stderr
    again = run("report", a, halves[1], out, "-o", tmp_path / "again.html", "--reference", reference)
    assert again.returncode == 0, again.stderr
    for one in (page, tmp_path / "again.html"):
        assert "Repairs, in pixels" in one.read_text()
        assert all(np.isfinite(unpacked(layer)).all() for layer in data_of(one.read_text())["layers"])


def test_page_of_a_shot(shot_folder: Path) -> None:
    page = shot_folder / "shot.html"
    assert cli.main(arguments(shot_folder, "--report", page)) == 0
    frames = data_of(page.read_text())["frames"]
    assert [frame["number"] for frame in frames] == [1, 2, 3, 4, 5]
    assert all(frame["layers"] and frame["thumbnail"] and frame["change"] is not None for frame in frames)
    assert set(data_of(page.read_text())["slices"]) == {"noisy", "denoised", "corrected"}
    assert "None: no NaN" in page.read_text()


def test_page_of_a_shot_that_goes_on(shot_folder: Path) -> None:
    """Frames that were there are told from their files, and one that cannot be read is told as failed."""
    assert cli.main(arguments(shot_folder, "--frame-radius", 0, last=3)) == 0
    (shot_folder / "b.0005.exr").unlink()
    page = shot_folder / "shot.html"
    assert cli.main(arguments(shot_folder, "--frame-radius", 0, "--skip-existing", "--report", page)) == 1
    frames = data_of(page.read_text())["frames"]
    assert [frame["outcome"] for frame in frames] == ["skipped"] * 3 + ["written", "failed"]
    assert [frame["change"] is not None for frame in frames] == [True] * 4 + [False]
    assert frames[0]["thumbnail"]
    assert "b.0005.exr" in page.read_text()


def test_page_of_bench(halves: Halves, tmp_path: Path) -> None:
    page = tmp_path / "bench.html"
    result = run("bench", *halves, *BALANCED, "--points", "base", "steps=2", "--report", page, "--json")
    assert result.returncode == 0, result.stderr
    assert [point["name"] for point in data_of(page.read_text())["points"]] == ["base", "steps=2"]


class TestBadInput:
    @pytest.mark.parametrize("command", ["frame", "sequence", "bench", "report"])
    @pytest.mark.parametrize("page", ["none/page.html", "page.png", "."])
    def test_where_the_page_cannot_be(self, halves: Halves, tmp_path: Path, command: str, page: str) -> None:
        out = tmp_path / "out.exr"
        more = {
            "frame": ["-o", out, *BALANCED, "--report"],
            "sequence": ["-o", tmp_path / "out.####.exr", "--frames", "1-2", *BALANCED, "--report"],
            "bench": ["--points", "fast", *BALANCED, "--report"],
            "report": [out, "-o"],
        }
        line = refused(command, *halves, *more[command], tmp_path / page)
        assert str(tmp_path / page) in line
        assert not list(tmp_path.glob("out*.exr"))

    def test_other_sizes(self, halves: Halves, out: Path, tmp_path: Path) -> None:
        other, page = write_half(tmp_path / "small.exr", 3, size=(24, 29)), tmp_path / "page.html"
        page.write_text("precious")
        line = refused("report", *halves, out, "-o", page, "--reference", other)
        assert "small.exr: expected 30x24 pixels like" in line
        assert "small.exr: expected 30x24 pixels" in refused("report", *halves, other, "-o", page)
        assert page.read_text() == "precious"

    def test_an_output_of_another_program(self, halves: Halves, tmp_path: Path) -> None:
        other = write_half(tmp_path / "other.exr", 3)
        line = refused("report", *halves, other, "-o", tmp_path / "page.html")
        assert "other.exr: expected --denoised D.exr or --denoiser NAME, as the file does not say" in line
        run_with = run(
            "report", *halves, other, "-o", tmp_path / "page.html", "--denoised", write_half(tmp_path / "d.exr", 4)
        )
        assert run_with.returncode == 0, run_with.stderr

    @pytest.mark.parametrize("text", ["", "[]", "{", '{"estimate": {"change": "x"}, "preset": [1]}', '{"estimate": 3}'])
    def test_attributes_of_anyone(self, halves: Halves, tmp_path: Path, text: str) -> None:
        source = exr.load_half(str(halves[0]))
        other = tmp_path / "other.exr"
        attributes = {"selfcorrect/run": text, "selfcorrect/settings": text}
        exr.write(other, source.file, source.buffers["color"], ["R", "G", "B"], attributes)
        result = run("report", *halves, other, "-o", tmp_path / "page.html", "--denoiser", "box")
        assert result.returncode == 0, result.stderr

    def test_no_command_runs_because_a_file_names_it(self, halves: Halves, tmp_path: Path) -> None:
        source, trace = exr.load_half(str(halves[0])), tmp_path / "trace"
        spec = f"command:{sys.executable} -c open({str(trace)!r},'w') {{color}} {{output}}"
        attributes = {"selfcorrect/run": json.dumps({"denoiser": spec})}
        exr.write(tmp_path / "evil.exr", source.file, source.buffers["color"], ["R", "G", "B"], attributes)
        line = refused("report", *halves, tmp_path / "evil.exr", "-o", tmp_path / "page.html")
        assert "--denoiser NAME, as the file was denoised by" in line
        assert "command:" in line
        assert not trace.exists()
