"""Writing EXR files: values, layouts, links, and what is refused."""

import os
import resource
import stat

import numpy as np
import pytest
from helpers.exr_files import MITSUBA, SIZE, arrays, assert_passed_through, pixels, rewrite, same_bits, save

from selfcorrect import exr
from selfcorrect.errors import ChannelError, FileError, FrameError


def test_values_beyond_half_are_clipped_and_counted(tmp_path):
    color = np.zeros((*SIZE, 3), np.float32)
    color[0, 0] = [65504, 65505, 1e9]
    color[1, 1] = [-70000, np.inf, -np.inf]
    source = save(tmp_path / "half.exr", arrays("RGB"))
    assert exr.write(tmp_path / "out.exr", exr.read(source), color, "RGB", {}) == 5
    written = exr.load_half(tmp_path / "out.exr").buffers["color"]
    assert written[0, 0].tolist() == [65504, 65504, 65504]
    assert written[1, 1].tolist() == [-65504, 65504, -65504]
    source = save(tmp_path / "float.exr", arrays("RGB", np.float32))
    assert exr.write(tmp_path / "out.exr", exr.read(source), color, "RGB", {}) == 0
    assert np.array_equal(exr.load_half(tmp_path / "out.exr").buffers["color"], color)


def test_extra_channels(tmp_path):
    source, target = save(tmp_path / "a.exr", arrays(MITSUBA)), tmp_path / "out.exr"
    extra = {
        "error.R": pixels(40, np.float32),
        "weight.V": pixels(41, np.float64),
        "ids.V": pixels(42, np.uint32),
        "half.V": pixels(43)[::-1],
    }
    rewrite(source, target, extra=extra)
    assert_passed_through(source, target, but="RGB", added=extra)
    file = exr.read(target)
    assert same_bits(file.pixels("weight.V"), extra["weight.V"].astype(np.float32))
    for name in ("error.R", "ids.V", "half.V"):
        assert same_bits(file.pixels(name), extra[name])


@pytest.mark.parametrize("view", [np.asfortranarray, lambda a: a[::-1], lambda a: a[:, ::-1]])
def test_colour_of_any_memory_layout(tmp_path, view):
    file = exr.read(save(tmp_path / "a.exr", arrays("RGB", np.float32)))
    color = view(np.stack([pixels(seed, np.float32) for seed in range(3)], -1))
    exr.write(tmp_path / "out.exr", file, color, "RGB", {})
    assert np.array_equal(exr.load_half(tmp_path / "out.exr").buffers["color"], color)


def test_writing_over_the_input(tmp_path):
    path = save(tmp_path / "a.exr", arrays(MITSUBA))
    untouched = save(tmp_path / "b.exr", arrays(MITSUBA))
    rewrite(path, path)
    assert_passed_through(untouched, path, but="RGB")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.exr", "b.exr"]


def test_a_link_stays_a_link_and_the_mask_of_the_user_counts(tmp_path):
    (tmp_path / "store").mkdir()
    source = save(tmp_path / "a.exr", arrays("RGB"))
    (tmp_path / "out.exr").symlink_to(tmp_path / "store" / "real.exr")
    before = os.umask(0o027)
    try:
        rewrite(source, tmp_path / "out.exr")
    finally:
        os.umask(before)
    assert (tmp_path / "out.exr").is_symlink()
    assert stat.S_IMODE((tmp_path / "store" / "real.exr").stat().st_mode) == 0o640


@pytest.fixture
def file(tmp_path):
    return exr.read(save(tmp_path / "a.exr", arrays("RGB")))


COLOR = np.ones((*SIZE, 3), np.float32)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("out.png", r"out\.png: expected an output whose name ends in \.exr, but got 'out\.png'"),
        ("none/out.exr", r"out\.exr: expected a folder at .*none, but got none; create it first"),
        ("folder.exr", r"folder\.exr: expected a file to write, but got a folder; add a file name"),
        ("a.exr/out.exr", r"out\.exr: expected a folder at .*a\.exr, but got none"),
        (
            "/proc/out.exr",
            r"/proc/out\.exr: expected a folder to write to, but got: .*; choose another output",
        ),
        (f"{'n' * 300}.exr", r"n\.exr: expected a .*File name too long"),
    ],
)
def test_outputs_that_cannot_be(tmp_path, file, name, message):
    (tmp_path / "folder.exr").mkdir()
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(FileError, match=message):
        exr.write(tmp_path / name, file, COLOR, "RGB", {})
    assert sorted(tmp_path.rglob("*")) == before


def test_a_full_disk_leaves_the_old_file_and_nothing_else(tmp_path, file):
    """A limit on the size of files stands in for the disk: the write fails half way."""
    target = tmp_path / "out.exr"
    target.write_bytes(b"precious")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))
    try:
        with pytest.raises(FileError, match=r"out\.exr: expected a folder to write to, but got: File too large"):
            exr.write(target, file, COLOR, "RGB", {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert target.read_bytes() == b"precious"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.exr", "out.exr"]


def test_what_does_not_fit_the_source(tmp_path, file):
    target = tmp_path / "out.exr"
    target.write_bytes(b"precious")
    with pytest.raises(FrameError, match=r"a\.exr: expected \(9, 14\) pixels for 'R', but got \(8, 14\)"):
        exr.write(target, file, COLOR[1:], "RGB", {})
    with pytest.raises(FrameError, match=r"expected \(9, 14\) pixels for 'more', but got \(9, 13\)"):
        exr.write(target, file, COLOR, "RGB", {}, extra={"more": COLOR[:, 1:, 0]})
    with pytest.raises(ChannelError, match=r"a\.exr: expected channel 'X', but got B, G, R"):
        exr.write(target, file, COLOR, ["X", "Y", "Z"], {})
    with pytest.raises(FileError, match=r"out\.exr: expected a writable image, but got: .*empty string"):
        exr.write(target, file, COLOR, "RGB", {}, extra={"": COLOR[..., 0]})
    assert target.read_bytes() == b"precious"


def test_reading_and_writing_leave_no_file_open(tmp_path, file):
    before = len(os.listdir("/proc/self/fd"))
    for name in ("1.exr", "2.exr"):
        exr.write(tmp_path / name, exr.read(tmp_path / "a.exr"), COLOR, "RGB", {})
        with pytest.raises(FileError):
            exr.read(tmp_path / "none.exr")
    assert len(os.listdir("/proc/self/fd")) == before
