"""What passes through from a file to its corrected one: pixels, parts, tiles, compressions, attributes."""

import os
import struct

import numpy as np
import OpenEXR
import pytest
from helpers.exr_files import (
    MITSUBA,
    SIZE,
    arrays,
    assert_passed_through,
    attributes_of,
    pixels,
    raw,
    rewrite,
    save,
    three,
    window,
)

from selfcorrect import exr
from selfcorrect.exr import header as exrheader


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_a_file_passes_through(tmp_path, dtype):
    channels = {**arrays(MITSUBA, dtype), "A": pixels(70, dtype), "crypto00.r": pixels(71, np.uint32)}
    channels["dd.T"] = pixels(72, np.float32)
    header = {"dataWindow": window(-3, 5), "displayWindow": window(0, 0, 30, 20), "pixelAspectRatio": 1.5}
    source = save(tmp_path / "a.exr", channels, owner="Ada", **header)
    assert rewrite(source, tmp_path / "out.exr") == 0
    assert_passed_through(source, tmp_path / "out.exr", but="RGB")
    assert attributes_of(tmp_path / "out.exr")[0]["selfcorrect/seed"] == ("string", b"7")


def test_bits_of_special_values_pass_through(tmp_path):
    bits = np.resize(np.array([0x7E01, 0xFE55, 0x0001, 0x7C00, 0xFC00, 0x8000], np.uint16), SIZE)
    source = save(tmp_path / "a.exr", {**arrays("RGB"), "A": bits.view(np.float16)})
    rewrite(source, tmp_path / "out.exr")
    assert_passed_through(source, tmp_path / "out.exr", but="RGB")


def test_parts_pass_through(tmp_path):
    channels = {"ViewLayer.Cryptomatte.R": pixels(3, np.uint32)}
    parts = [
        ("ViewLayer.Depth", {"ViewLayer.Depth.Z": pixels(1, np.float32)}, {"owner": "Ada"}),
        (
            "ViewLayer.Combined",
            arrays(three("ViewLayer.Combined", "RGBA")),
            {"compression": OpenEXR.PIZ_COMPRESSION, "view": "left"},
        ),
        ("ViewLayer.Cryptomatte", channels, {"compression": OpenEXR.ZIPS_COMPRESSION, "depth": 3}),
    ]
    source, target = save(tmp_path / "a.exr", *parts), tmp_path / "out.exr"
    names = three("ViewLayer.Combined")
    rewrite(source, target, names)
    assert_passed_through(source, target, but=names)
    assert "selfcorrect/seed" in attributes_of(target)[0]


def test_channels_of_another_part_pass_through_though_they_have_the_same_names(tmp_path):
    source = save(tmp_path / "a.exr", ("rgba", arrays("RGB"), {}), ("albedo", arrays("RGB", start=9), {}))
    names = three("rgba")
    rewrite(source, tmp_path / "out.exr", names)
    assert_passed_through(source, tmp_path / "out.exr", but=names)


def tiles(across, down, mode=OpenEXR.ONE_LEVEL):
    description = OpenEXR.TileDescription()
    description.xSize, description.ySize, description.mode = across, down, mode
    return {"type": OpenEXR.tiledimage, "tiles": description}


@pytest.mark.parametrize("order", [OpenEXR.INCREASING_Y, OpenEXR.DECREASING_Y, OpenEXR.RANDOM_Y])
def test_tiles_pass_through(tmp_path, order):
    header = {**tiles(5, 4), "lineOrder": order, "dataWindow": window(-7, 2), "displayWindow": window(0, 0)}
    source = save(tmp_path / "a.exr", arrays(MITSUBA), **header)
    rewrite(source, tmp_path / "out.exr")
    assert_passed_through(source, tmp_path / "out.exr", but="RGB")


@pytest.mark.parametrize("compression", ["NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "HTJ2K32"])
def test_a_lossless_compression_passes_through(tmp_path, compression):
    kind = getattr(OpenEXR, f"{compression}_COMPRESSION")
    source = save(tmp_path / "a.exr", arrays(MITSUBA), compression=kind, lineOrder=OpenEXR.DECREASING_Y)
    rewrite(source, tmp_path / "out.exr")
    assert_passed_through(source, tmp_path / "out.exr", but="RGB")


def test_floats_cut_to_24_bits_pass_through(tmp_path):
    source = save(tmp_path / "a.exr", arrays(["R", "G", "B", "Z"], np.float32), compression=OpenEXR.PXR24_COMPRESSION)
    file = exr.read(source)
    exr.write(tmp_path / "out.exr", file, np.ones((*SIZE, 3), np.float32), "RGB", {})
    assert_passed_through(source, tmp_path / "out.exr", but="RGB")


@pytest.mark.parametrize("compression", ["B44", "B44A", "DWAA", "DWAB"])
def test_a_lossy_compression_is_not_applied_twice(tmp_path, compression):
    kind = getattr(OpenEXR, f"{compression}_COMPRESSION")
    channels = {**arrays("RGBA"), "crypto.R": pixels(5, np.uint32)}
    source = save(tmp_path / "a.exr", channels, compression=kind)
    rewrite(source, tmp_path / "out.exr")
    assert_passed_through(source, tmp_path / "out.exr", but=["R", "G", "B", "compression"])
    assert exr.read(tmp_path / "out.exr").parts[0].header["compression"] == OpenEXR.ZIP_COMPRESSION


def test_the_mark_of_linear_channels_passes_through(tmp_path):
    channels = {name: OpenEXR.Channel(name, pixels(1), 1, 1, name in "AG") for name in "RGBA"}
    source = save(tmp_path / "a.exr", channels)
    assert exr.read(source).parts[0].linear == {"A", "G"}
    rewrite(source, tmp_path / "out.exr")
    assert_passed_through(source, tmp_path / "out.exr", but="RGB")


pack = struct.pack
ATTRIBUTES = [
    ("aFloat", "float", pack("<f", 0.1)),
    ("aNegativeZero", "float", pack("<f", -0.0)),
    ("aNaN", "float", pack("<I", 0x7FC12345)),
    ("anInt", "int", pack("<i", -(2**31))),
    ("aDouble", "double", pack("<d", 0.1)),
    ("aString", "string", "käthe 日本".encode()),
    ("anEmptyString", "string", b""),
    ("aLatinString", "string", "Käthe".encode("latin-1")),
    ("aStringWithNul", "string", b"a\0b"),
    ("aV2i", "v2i", pack("<2i", 1, -2)),
    ("aV2f", "v2f", pack("<2f", 0.1, 0.2)),
    ("aV2d", "v2d", pack("<2d", 0.1, 0.2)),
    ("aV3i", "v3i", pack("<3i", 1, 2, 3)),
    ("aV3f", "v3f", pack("<3f", 0.1, 0.2, 0.3)),
    ("aV3d", "v3d", pack("<3d", 0.1, 0.2, 0.3)),
    ("anM33f", "m33f", pack("<9f", *np.arange(9) / 7)),
    ("anM33d", "m33d", pack("<9d", *np.arange(9) / 7)),
    ("worldToCamera", "m44f", pack("<16f", *np.arange(16) / 7)),
    ("anM44d", "m44d", pack("<16d", *np.arange(16) / 7)),
    ("aBox2i", "box2i", pack("<4i", 1, 2, 3, 4)),
    ("aBox2f", "box2f", pack("<4f", 0.1, 0.2, 0.3, 0.4)),
    ("chromaticities", "chromaticities", pack("<8f", 0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)),
    ("framesPerSecond", "rational", pack("<iI", 24000, 1000)),
    ("timeCode", "timecode", pack("<II", 0x12345678, 0x9ABCDEF0)),
    ("aTimeCode", "timecode", pack("<II", 0xFFFFFFFF, 0xFFFFFFFF)),
    ("keyCode", "keycode", pack("<7i", 1, 2, 3, 4, 5, 4, 64)),
    ("envmap", "envmap", b"\1"),
    ("preview", "preview", pack("<II", 2, 1) + bytes(range(8))),
    ("multiView", "stringvector", pack("<i", 4) + b"left" + pack("<i", 5) + b"right"),
    ("aLatinList", "stringvector", pack("<i", 1) + b"\xe4"),
    ("anEmptyList", "stringvector", b""),
    ("floats", "floatvector", pack("<3f", 0.1, 0.2, 0.3)),
    ("noFloats", "floatvector", b""),
    ("aChannelList", "chlist", b"Q\0" + pack("<iB3xii", 1, 1, 1, 1) + b"\0"),
    ("aTileDescription", "tiledesc", pack("<IIB", 8, 8, 0)),
    ("someBytes", "bytes", pack("<I", 4) + b"hint" + b"\1\2\3"),
    ("ofAnotherProgram", "itsOwnType", b"\1\2\0\3"),
    ("displayWindow", "box2i", pack("<4i", -1, -2, 30, 40)),
    ("screenWindowCenter", "v2f", pack("<2f", 0.1, -3)),
    ("screenWindowWidth", "float", pack("<f", 0.7)),
    ("pixelAspectRatio", "float", pack("<f", 1.3)),
    ("name", "string", "mäin".encode("latin-1")),
    ("a" * 200, "string", b"a long name"),
]


@pytest.mark.parametrize("compression", [0, 3], ids=["uncompressed", "zip"])
@pytest.mark.parametrize("attribute", ATTRIBUTES, ids=[name[:20] for name, _, _ in ATTRIBUTES])
def test_an_attribute_passes_through(tmp_path, attribute, compression):
    """Compressed and uncompressed files take different paths through the library, and keep different things."""
    source, target = tmp_path / "a.exr", tmp_path / "out.exr"
    source.write_bytes(raw([attribute]))
    if compression:
        plain = exr.read(source)
        parts = [OpenEXR.Part({"compression": OpenEXR.ZIP_COMPRESSION}, arrays("RGB"), "")]
        OpenEXR.File(parts).write(str(source))
        with_attribute = splice(source.read_bytes(), attribute)
        source.write_bytes(with_attribute)
        assert exr.read(source).size == plain.size
    rewrite(source, target)
    assert_passed_through(source, target, but="RGB")
    assert attributes_of(target)[0][attribute[0]] == attribute[1:]


def splice(data, attribute):
    """Put an attribute into the header of a file of one part, in place of one of that name."""
    name, kind, value = attribute
    (header,), tables = exrheader.parse(data, "")
    old = header.attributes.get(name)
    start, end = 8, 8
    if old:
        start = old.offset - 4 - len(old.type) - 1 - len(name) - 1
        end = old.offset + len(old.data)
    new = name.encode() + b"\0" + kind.encode() + b"\0" + pack("<i", len(value)) + value
    longer = len(new) - (end - start)
    offsets = np.frombuffer(data, "<u8", 1, tables) + longer
    version = pack("<I", struct.unpack_from("<I", data, 4)[0] | (0x400 if len(name) > 31 else 0))
    return data[:4] + version + data[8:start] + new + data[end:tables] + offsets.tobytes() + data[tables + 8 :]


def test_attributes_pass_through_parts(tmp_path):
    shared = {"timeCode": OpenEXR.TimeCode(1, 2, 3, 4, *[0] * 14), "chromaticities": (0.6, 0.3) * 4}
    parts = [
        ("a", arrays("RGB"), {**shared, "owner": "Ada"}),
        ("b", arrays("XYZ"), {**shared, "owner": "Bob"}),
    ]
    source = save(tmp_path / "a.exr", *parts)
    names = three("a")
    rewrite(source, tmp_path / "out.exr", names)
    assert_passed_through(source, tmp_path / "out.exr", but=names)


def test_attributes_of_an_earlier_run_are_replaced(tmp_path):
    first, second = tmp_path / "1.exr", tmp_path / "2.exr"
    source = save(tmp_path / "a.exr", arrays("RGB"))
    file, color = exr.read(source), np.ones((*SIZE, 3), np.float32)
    exr.write(first, file, color, "RGB", {"our/settings": "old", "our/note": "kept"}, extra={"error": color[..., 0]})
    again = exr.read(first)
    exr.write(second, again, color, "RGB", {"our/settings": "new"}, extra={"error": 2 * color[..., 0]})
    found = attributes_of(second)[0]
    assert found["our/settings"] == ("string", b"new")
    assert found["our/note"] == ("string", b"kept")
    assert np.all(exr.read(second).pixels("error") == 2)


def test_a_file_name_that_is_not_unicode_in_an_attribute(tmp_path):
    file = exr.read(save(tmp_path / "a.exr", arrays("RGB")))
    exr.write(tmp_path / "out.exr", file, np.ones((*SIZE, 3)), "RGB", {"our/input": os.fsdecode(b"k\xe4.exr")})
    assert attributes_of(tmp_path / "out.exr")[0]["our/input"] == ("string", b"k\\udce4.exr")


@pytest.mark.shared
def test_the_development_frames(shared, tmp_path):
    for path in sorted((shared / "frames").glob("*_064spp_A.exr")):
        half = exr.load_half(path)
        assert half.taken == {
            "color": ["R", "G", "B"],
            "albedo": three("albedo"),
            "normal": three("nn", "XYZ"),
            "depth": ["dd.T"],
        }
        assert half.buffers["color"].shape == (*half.file.size, 3)
        assert half.buffers["depth"].shape == (*half.file.size, 1)
        target = tmp_path / path.name
        exr.write(target, half.file, half.buffers["color"], half.taken["color"], {"selfcorrect/settings": "{}"})
        assert_passed_through(path, target)
