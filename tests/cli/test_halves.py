"""What is said where one file or a folder is given instead of two halves: a line says what to give."""

import shlex
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from helpers.commands import BALANCED, call, refused, write_half


def test_one_file(tmp_path: Path) -> None:
    for command in ("frame", "bench"):
        line = refused(command, write_half(tmp_path / "a.exr", 1))
        assert "a.exr: expected half a and half b, but got one file; render the frame twice" in line


def test_one_file_of_two_layers(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    names = [f"half {half}.{channel}" for half in "AB" for channel in "RGB"]
    channels = {name: generator.random((20, 24), dtype=np.float32) for name in names}
    file, out = tmp_path / "both.exr", tmp_path / "out.exr"
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels).write(str(file))
    line = refused("frame", file, "-o", out)
    told = line.partition("such as ")[2].partition("; if none")[0]
    assert shlex.split(told) == [f"{file}::half A", f"{file}::half B"]
    result = call("frame", *shlex.split(told), "-o", out, *BALANCED)
    assert result.returncode == 0, result.stderr


def test_no_such_file(tmp_path: Path) -> None:
    assert "none.exr" in refused("frame", tmp_path / "none.exr", "-o", tmp_path / "out.exr")


def test_a_folder_of_one_frame(tmp_path: Path) -> None:
    folder = tmp_path / "a folder"
    folder.mkdir()
    halves = [str(write_half(folder / f"room_{half}.exr", seed)) for seed, half in enumerate("AB")]
    line = refused("frame", folder)
    command = shlex.split(line.partition("run: selfcorrect ")[2])
    assert command == ["frame", *halves, "-o", "OUT.exr"]
    command[-1] = str(tmp_path / "out.exr")
    assert call(*command, *BALANCED).returncode == 0


def test_a_folder_of_a_shot(tmp_path: Path) -> None:
    for frame in (3, 4, 5):
        for seed, half in enumerate("ab"):
            write_half(tmp_path / f"shot_{half}.{frame:04d}.exr", 10 * frame + seed)
    line = refused("frame", tmp_path, "-o", "x.exr")
    told = shlex.split(line.partition("run: selfcorrect ")[2])
    pattern = [str(tmp_path / f"shot_{half}.####.exr") for half in "ab"]
    assert told == ["sequence", *pattern, "-o", "OUT.####.exr", "--frames", "3-5"]


@pytest.mark.parametrize(
    ("names", "message"), [([], "there is no EXR file in it"), (["one.exr"], "name two of its files, such as ")]
)
def test_a_folder_without_halves(names: list[str], message: str, tmp_path: Path) -> None:
    for name in names:
        write_half(tmp_path / name, 1)
    assert message in refused("frame", tmp_path)


def test_no_output(tmp_path: Path) -> None:
    halves = [write_half(tmp_path / f"{half}.exr", seed) for seed, half in enumerate("ab")]
    assert "expected --output" in refused("frame", *halves)
