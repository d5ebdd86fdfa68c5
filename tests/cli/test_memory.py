"""Memory: the real command stays under what is told of it, and a frame that does not fit is refused at once."""

import json
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from helpers.commands import BALANCED, call

from selfcorrect import Settings
from selfcorrect.cli.memory import GIB, fits, needs, parse_size, reduced, scratch_within
from selfcorrect.errors import FileError, SettingsError
from selfcorrect.exr import header as exrheader
from selfcorrect.files import Sources

SIZE = (1000, 2100)  # more than two million pixels: trained on crops, in several strips of tiles
QUICK = [
    "--steps",
    "1",
    "--batch",
    "1",
    "--patch",
    "16",
    "--window",
    "3",
    "--network-layers",
    "2",
    "--filters",
    "2",
    "--inference",
    "halves",
]


def write_half(path: Path, seed: int, size: tuple[int, int], dtype: type) -> str:
    generator = np.random.default_rng(seed)
    names = ["R", "G", "B", "albedo.R", "albedo.G", "albedo.B", "nn.X", "nn.Y", "nn.Z"]
    channels = {name: generator.random(size, dtype=np.float32).astype(dtype) for name in names}
    OpenEXR.File({"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage}, channels).write(str(path))
    return str(path)


def sources(folder: Path, size: tuple[int, int] = (30, 40), dtype: type = np.float16) -> Sources:
    folder.mkdir(exist_ok=True)
    folder.mkdir(exist_ok=True)
    return Sources(*(write_half(folder / f"{half}.exr", seed, size, dtype) for seed, half in enumerate("ab")))


def peak(folder: Path, *arguments: str) -> tuple[int, str]:
    """Bytes at the peak of a command whose denoiser takes nothing beside its images, and what it told.

    By the kernel's account of the program: that of getrusage begins at what the process that starts it holds.
    """
    (folder / "same.py").write_text(
        "class Same:\n"
        "    name, features, reads_only = 'same', frozenset({'albedo', 'normal'}), True\n"
        "    def denoise(self, color, albedo, normal):\n"
        "        return color.clone()\n"
    )
    code = (
        "import re, sys; from pathlib import Path; from selfcorrect import cli\n"
        "code = cli.main(sys.argv[1:])\n"
        "print(re.search(r'VmHWM:\\s*(\\d+)', Path('/proc/self/status').read_text())[1]); sys.exit(code)"
    )
    denoiser = ["--denoiser", f"{folder / 'same.py'}:Same", "--threads", "1"]
    command = [sys.executable, "-c", code, *arguments, *QUICK, *denoiser]
    result = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert result.returncode == 0, result.stderr
    return int(result.stdout) * 1024, result.stderr


def test_the_command_takes_no_more_than_is_told(tmp_path: Path) -> None:
    frame, settings = sources(tmp_path, SIZE), Settings.preset("balanced", patch=16, steps=1, candidates="none")
    told = max(needs(frame, settings))
    assert 0.4 * told < peak(tmp_path, "frame", frame.a, frame.b, "-o", str(tmp_path / "out.exr"))[0] < told


def test_aovs_are_counted(tmp_path: Path) -> None:
    frame, settings = sources(tmp_path, SIZE), Settings.preset("balanced", candidates="none")
    without, named = needs(frame, settings), needs(replace(frame, aovs="auto"), settings)
    assert without.aovs == 0
    assert named.aovs > without.read
    assert named._replace(aovs=0) == without


def eight_k(folder: Path, dtype: type) -> Sources:
    """Files whose headers say that they are of 8K."""
    frame = sources(folder, dtype=dtype)
    for path in (frame.a, frame.b):
        data = bytearray(Path(path).read_bytes())
        (header,), _ = exrheader.parse(bytes(data), path)
        struct.pack_into("<4i", data, header.attributes["dataWindow"].offset, 0, 0, 7679, 4319)
        Path(path).write_bytes(data)
    return frame


def test_eight_k_fits_in_six_gibibytes(tmp_path: Path) -> None:
    """With what OIDN takes where nothing bounds it, 1.5 GiB; of floats, with what it can do with.

    Without further candidates: the command leaves them out where there is no room (the next test).
    """
    settings = Settings.preset("balanced", candidates="none")
    assert scratch_within(6 * GIB, eight_k(tmp_path, np.float16), settings) > 1.5 * GIB
    half = needs(Sources(str(tmp_path / "a.exr"), ""), settings)
    assert scratch_within(6 * GIB, eight_k(tmp_path, np.float32), settings) > 1.0 * GIB
    full = needs(Sources(str(tmp_path / "a.exr"), ""), settings)
    assert full.correct - half.correct == 7680 * 4320 * 2 * 12, "two G-buffers of both halves"


def test_candidates_are_left_out_where_there_is_no_room(tmp_path: Path) -> None:
    frame, small = eight_k(tmp_path, np.float16), sources(tmp_path / "small", dtype=np.float16)
    settings = Settings.preset("balanced")
    assert settings.candidates == "auto"
    assert not fits(6 * GIB, frame, settings)
    assert fits(12 * GIB, frame, settings)
    assert fits(6 * GIB, small, settings)


def test_a_shot_takes_fewer_neighbours_where_there_is_no_room(tmp_path: Path) -> None:
    frame, settings = eight_k(tmp_path, np.float16), Settings.preset("balanced")
    most = {radius: max(needs(frame, replace(settings, frame_radius=radius), shot=True)) for radius in (0, 1, 2)}
    assert most[0] < most[1] < most[2]
    assert max(needs(frame, settings)) < most[0], "the next frame is read and the last one written meanwhile"
    assert reduced(64 * GIB, frame, settings, shot=True) == ({}, [])
    without = {r: max(needs(frame, replace(settings, frame_radius=r, candidates="none"), shot=True)) for r in (0, 1)}
    for radius, bytes_ in without.items():
        changes, lines = reduced(int(bytes_ + 0.7 * GIB), frame, settings, shot=True)
        assert changes == {"candidates": "none", "frame_radius": radius}
        assert lines[1] == f"--frame-radius {radius}: --maxmem has no room for more neighbours"


def test_a_shot_takes_no_more_than_is_told(tmp_path: Path) -> None:
    """Seven frames, each with three neighbours on either side; the peak of the whole command."""
    size = (500, 1050)
    for number in range(1, 8):
        for i, half in enumerate("ab"):
            write_half(tmp_path / f"{half}.{number:04d}.exr", 10 * number + i, size, np.float16)
    names = [str(tmp_path / f"{name}.####.exr") for name in ("a", "b", "out")]
    taken, log = peak(tmp_path, "sequence", *names[:2], "-o", names[2], "--frames", "3-5")
    assert "history of 4 frames" in log or "no history" in log
    first = Sources(*(str(tmp_path / f"{half}.0003.exr") for half in "ab"))
    settings = Settings.preset("balanced", patch=16, steps=1, candidates="none")
    told = max(needs(first, settings, shot=True))
    assert 0.4 * told < taken < told


def test_a_frame_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    frame, settings = sources(tmp_path), Settings.preset("balanced")
    with pytest.raises(SettingsError, match=r"a.exr: expected --maxmem of at least 1\.0G .*, but got 0\.5G"):
        scratch_within(parse_size("512M"), frame, settings)
    with pytest.raises(FileError, match="expected an OpenEXR file"):
        needs(Sources(str(tmp_path / "none.exr"), frame.b), settings)
    (tmp_path / "empty.exr").touch()
    with pytest.raises(FileError, match="an empty file"):
        needs(Sources(str(tmp_path / "empty.exr"), frame.b), settings)


@pytest.mark.parametrize("layer", ["", "::left", "::right.ViewLayer"])
def test_a_stereo_file_in_one_part_is_counted_as_it_is_read(tmp_path: Path, layer: str) -> None:
    """Blender 4 puts the view behind the pass; only with the views that the header names is there a colour."""
    names = [
        f"ViewLayer.{name}.{view}.{letter}"
        for view in ("left", "right")
        for name, letters in (("Combined", "RGB"), ("Denoising Albedo", "RGB"), ("Denoising Depth", "Z"))
        for letter in letters
    ]
    for seed, half in enumerate("ab"):
        generator = np.random.default_rng(seed)
        channels = {name: generator.random((24, 30), dtype=np.float32).astype(np.float16) for name in names}
        header = {"type": OpenEXR.scanlineimage, "multiView": ["left", "right"]}
        OpenEXR.File(header, channels).write(str(tmp_path / f"{half}.exr"))
    a, b = (f"{tmp_path}/{half}.exr{layer}" for half in "ab")
    plain = sources(tmp_path / "plain", (24, 30))
    stereo, mono = (needs(each, Settings()) for each in (Sources(a, b), plain))
    features = {"stereo": 3 * 2 + 1 * 2, "mono": 3 * 2 + 3 * 2}  # bytes of a pixel
    assert mono.denoise - stereo.denoise == 24 * 30 * (2 * (features["mono"] - features["stereo"]) + 12)
    result = call("frame", a, b, "-o", tmp_path / "out.exr", *BALANCED, "--maxmem", "4G", "--json")
    assert result.returncode == 0, result.stderr
    view = "right" if "right" in layer else "left"
    assert json.loads(result.stdout)["channels"]["color"] == [f"{view}.ViewLayer.Combined.{c}" for c in "RGB"]


@pytest.mark.parametrize(("text", "size"), [("6G", 6 * GIB), ("800M", 800 * 2**20), ("1.5gib", 3 * GIB // 2), ("9", 9)])
def test_sizes(text: str, size: int) -> None:
    assert parse_size(text) == size


@pytest.mark.parametrize("text", ["", "G", "6 apples", "-1G", "1e9"])
def test_what_is_no_size_is_refused(text: str) -> None:
    with pytest.raises(SettingsError, match="expected a size such as 6G"):
        parse_size(text)
