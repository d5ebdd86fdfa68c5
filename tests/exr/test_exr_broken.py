"""EXR files that are broken: refused in one line, whatever the damage."""

import os
import struct

import numpy as np
import OpenEXR
import pytest
from helpers.exr_files import HEIGHT, MITSUBA, SIZE, WIDTH, arrays, raw, save

from selfcorrect import exr
from selfcorrect.errors import FileError


def patched(data, name, kind, value):
    """The file with an attribute's value overwritten by one of the same length."""
    place = data.index(name + b"\0" + kind + b"\0") + len(name) + len(kind) + 2 + 4
    return data[:place] + value + data[place + len(value) :]


def giant(x, y, x_max, y_max):
    return patched(raw(), b"dataWindow", b"box2i", struct.pack("<4i", x, y, x_max, y_max))


def deep():
    data = raw([("type", "string", b"deepscanline")])
    return data[:4] + struct.pack("<I", 2 | 0x800) + data[8:]


def listed(channel, *, sampling=1, kind=1):
    return channel + b"\0" + struct.pack("<iB3xii", kind, 0, sampling, sampling)


def mipmap():
    data = raw([("tiles", "tiledesc", struct.pack("<IIB", 8, 8, 1))])
    return data[:4] + struct.pack("<I", 2 | 0x200) + data[8:]


BROKEN = {
    "empty": (b"", "expected an OpenEXR file, but got an empty file"),
    "text": (b"not an image\n" * 40, "expected an OpenEXR file, but got a file that begins with b'not '"),
    "png": (
        b"\x89PNG\r\n\x1a\n" + bytes(99),
        r"expected an OpenEXR file, but got a file that begins with b'\\x89PNG'",
    ),
    "four bytes": (raw()[:4], "expected a complete OpenEXR header, but got one that is truncated"),
    "half a header": (raw()[:150], "expected a complete OpenEXR header, but got one that is truncated"),
    "half a table": (
        raw()[: raw().index(struct.pack("<ii", 0, 84)) - 20],
        "expected a file that can hold the 14×9 pixels of its data window, but got 36. bytes",
    ),
    "half the pixels": (raw()[:-400], "expected 9 chunks of pixels, but got 5: the file is truncated"),
    "one byte less": (raw()[:-1], "expected intact pixels in all of 1 parts, but got them in 0"),
    "interrupted": (
        raw()[: raw().index(struct.pack("<ii", 0, 84)) - 8]
        + bytes(8)
        + raw()[raw().index(struct.pack("<ii", 0, 84)) :],
        "expected 9 chunks of pixels, but got 8: .* render was interrupted",
    ),
    "giant": (
        giant(0, 0, 2**30, 2**30),
        "expected a data window of 1 to 2147483648 pixels, but got 1073741825×1073741825",
    ),
    "wide": (
        giant(0, 0, 2**29, HEIGHT - 1),
        "expected a data window of 1 to .* but got 536870913×9",
    ),
    "high": (
        giant(0, 0, 1, 2**29),
        "expected a file that can hold the 2×536870913 pixels of its data window, but got",
    ),
    "whole plane": (giant(-(2**31), -(2**31), 2**31 - 1, 2**31 - 1), "but got 4294967296×4294967296"),
    "turned window": (giant(5, 5, 1, 1), "expected a data window of 1 to .* but got -3×-3"),
    "a little large": (giant(0, 0, WIDTH - 1, HEIGHT), "expected 10 chunks of pixels, but got 9"),
    "deep": (deep(), "expected flat pixels, but got deep ones"),
    "mip map": (mipmap(), "expected an image of one resolution, but got a mip or rip map"),
    "subsampled": (
        raw().replace(listed(b"G"), listed(b"G", sampling=2)),
        "expected channel 'G' at full resolution, but got it subsampled by 2×2",
    ),
    "unknown type": (
        raw().replace(listed(b"G"), listed(b"G", kind=7)),
        "'G' as uint, half or float, but got 7",
    ),
    "unknown compression": (
        patched(raw(), b"compression", b"compression", b"\x63"),
        "expected a known compression, but got number 99",
    ),
    "no channels": (raw(channels=()), "expected channels, but got none"),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_broken_files(tmp_path, capfd, kind):
    data, message = BROKEN[kind]
    path = tmp_path / "bad.exr"
    path.write_bytes(data)
    with pytest.raises(FileError, match=rf"bad\.exr: .*{message}") as caught:
        exr.read(path)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_giant_windows_of_compressed_files(tmp_path):
    source = save(tmp_path / "a.exr", arrays(MITSUBA), compression=OpenEXR.ZIP_COMPRESSION).read_bytes()
    for edge in (40_000, 2**20):
        wide = struct.pack("<4i", 0, 0, edge, HEIGHT - 1)
        (tmp_path / "b.exr").write_bytes(patched(source, b"dataWindow", b"box2i", wide))
        with pytest.raises(FileError, match=rf"b\.exr: expected a file that can hold the {edge + 1}×9 pixels"):
            exr.read(tmp_path / "b.exr")


@pytest.mark.parametrize("compression", ["ZIP", "PIZ", "DWAA", "B44", "PXR24", "ZSTD", "HTJ2K32"])
def test_a_constant_image_is_not_taken_for_a_giant_one(tmp_path, compression):
    black = np.zeros((1080, 1920), np.float32)
    kind = getattr(OpenEXR, f"{compression}_COMPRESSION")
    path = save(tmp_path / "a.exr", {name: black for name in [*"RGBA", "Z"]}, compression=kind)
    assert np.array_equal(exr.read(path).pixels("R"), black)


def test_files_that_are_not_there(tmp_path):
    with pytest.raises(FileError, match=r"none\.exr: expected an OpenEXR file, but got: No such file"):
        exr.read(tmp_path / "none.exr")
    with pytest.raises(FileError, match="expected an OpenEXR file, but got a folder"):
        exr.read(tmp_path)
    with pytest.raises(FileError, match=r"a\.exr: expected an OpenEXR file, but got: No such file"):
        exr.read(f"{tmp_path}/a.exr::Layer")


@pytest.mark.parametrize("compression", ["NO", "ZIP", "PIZ", "DWAA"])
def test_no_cut_of_a_file_is_taken_for_a_whole_one(tmp_path, capfd, compression):
    """Of two parts too: the library drops the part that is cut and says nothing."""
    kind = getattr(OpenEXR, f"{compression}_COMPRESSION")
    parts = [("rgba", arrays("RGB"), {}), ("depth", arrays(["Z"]), {})]
    data = save(tmp_path / "a.exr", *parts, compression=kind).read_bytes()
    path = tmp_path / "cut.exr"
    for length in [*range(0, len(data), 37), *range(len(data) - 40, len(data))]:
        path.write_bytes(data[:length])
        with pytest.raises(FileError, match=r"cut\.exr: expected"):
            exr.read(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("compression", ["NO", "RLE", "ZIP", "PIZ", "PXR24", "B44", "DWAA", "ZSTD"])
def test_damaged_bytes_never_escape_as_anything_but_an_error(tmp_path, capfd, compression):
    """Some damage cannot be seen, as the format has no checksums; the process lives and stays silent."""
    rng = np.random.default_rng(5)
    kind = getattr(OpenEXR, f"{compression}_COMPRESSION")
    parts = [("rgba", arrays("RGB"), {"owner": "Ada"}), ("depth", arrays(["Z"]), {})]
    data = save(tmp_path / "a.exr", *parts, compression=kind).read_bytes()
    path, refused = tmp_path / "bad.exr", 0
    for trial in range(150):
        damaged = bytearray(data)
        for place in rng.integers(4, len(data) if trial % 2 else 900, 2):
            damaged[place] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            exr.read(path)
        except FileError:
            refused += 1
    assert refused > 10
    assert capfd.readouterr() == ("", "")


def test_what_others_print_meanwhile_is_not_swallowed_afterwards(tmp_path, capfd):
    (tmp_path / "bad.exr").write_bytes(raw()[:-1])
    with pytest.raises(FileError):
        exr.read(tmp_path / "bad.exr")
    os.write(2, b"still here")
    print("here too")
    assert capfd.readouterr() == ("here too\n", "still here")


def test_reading_with_stderr_closed(tmp_path):
    path = save(tmp_path / "a.exr", arrays("RGB"))
    stderr = os.dup(2)
    os.close(2)
    try:
        size = exr.read(path).size
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
    assert size == SIZE
