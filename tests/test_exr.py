"""EXR files in and out: layouts of renderers, everything that passes through, and files that are broken."""

import json
import os
import resource
import stat
import struct
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from selfcorrect import exr, exrheader
from selfcorrect.errors import ChannelError, FileError, FrameError, SettingsError
from selfcorrect.inspection import ChannelReport

HEIGHT, WIDTH = 9, 14
SIZE = (HEIGHT, WIDTH)


def pixels(seed, dtype=np.float16, size=SIZE):
    rng = np.random.default_rng(seed)
    if dtype == np.uint32:
        return rng.integers(0, 2**32, size, dtype=np.uint32)
    return rng.normal(1.0, 2.0, size).astype(dtype)


def three(name, letters="RGB"):
    return [f"{name}.{letter}" for letter in letters]


def arrays(names, dtype=np.float16, start=0):
    return {name: pixels(start + number, dtype) for number, name in enumerate(names)}


def window(x, y, height=HEIGHT, width=WIDTH):
    return (np.array([x, y], np.int32), np.array([x + width - 1, y + height - 1], np.int32))


def save(path, *parts, **header):
    """Write parts, each (name, {channel: array}, {attribute: value}) or just a dict of channels."""
    full = [part if isinstance(part, tuple) else ("", part, {}) for part in parts]
    OpenEXR.File([OpenEXR.Part({**header, **own}, dict(channels), name) for name, channels, own in full]).write(
        str(path)
    )
    return path


def raw(attributes=(), channels=("B", "G", "R"), window=(0, 0, WIDTH - 1, HEIGHT - 1)):
    """Bytes of an uncompressed half EXR of one part; every pixel holds its channel's place in the list.

    The library writes neither every attribute nor a channel list out of order, so this does. The pixels of a
    scan line are in alphabetical order of the channels all the same, as the format has it.
    """
    listed = b"".join(name.encode() + b"\0" + struct.pack("<iB3xii", 1, 0, 1, 1) for name in channels)
    standard = {
        "channels": ("chlist", listed + b"\0"),
        "compression": ("compression", b"\0"),
        "dataWindow": ("box2i", struct.pack("<4i", *window)),
        "displayWindow": ("box2i", struct.pack("<4i", *window)),
        "lineOrder": ("lineOrder", b"\0"),
        "pixelAspectRatio": ("float", struct.pack("<f", 1)),
        "screenWindowCenter": ("v2f", bytes(8)),
        "screenWindowWidth": ("float", struct.pack("<f", 1)),
    }
    long_names = 0x400 if any(len(name) > 31 for name, _, _ in attributes) else 0
    data = struct.pack("<II", 20000630, 2 | long_names)
    every = standard | {name: (kind, value) for name, kind, value in attributes}
    for name, (kind, value) in every.items():
        data += name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value
    data += b"\0"
    row = b"".join(np.full(WIDTH, channels.index(name), "<f2").tobytes() for name in sorted(channels))
    chunks = [struct.pack("<ii", y, len(row)) + row for y in range(window[1], window[1] + HEIGHT)]
    first = len(data) + 8 * HEIGHT
    data += b"".join(struct.pack("<Q", first + number * len(chunks[0])) for number in range(HEIGHT))
    return data + b"".join(chunks)


def attributes_of(path):
    headers, _ = exrheader.parse(Path(path).read_bytes(), str(path))
    return [{name: (a.type, a.data) for name, a in header.attributes.items()} for header in headers]


def same_bits(first, second):
    return first.dtype == second.dtype and first.shape == second.shape and first.tobytes() == second.tobytes()


MITSUBA = [*"RGB", *three("albedo"), *three("nn", "XYZ"), "dd.T"]
CYCLES = [
    *three("ViewLayer.Combined", "RGBA"),
    *three("ViewLayer.Denoising Albedo"),
    *three("ViewLayer.Denoising Normal", "XYZ"),
    "ViewLayer.Denoising Depth.Z",
]


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
@pytest.mark.parametrize("layer", ["", "::ViewLayer"])
def test_cycles_in_one_part(tmp_path, dtype, layer):
    channels = arrays(CYCLES, dtype)
    half = exr.load_half(f"{save(tmp_path / 'a.exr', channels)}{layer}")
    assert half.taken == {
        "color": three("ViewLayer.Combined"),
        "albedo": three("ViewLayer.Denoising Albedo"),
        "normal": three("ViewLayer.Denoising Normal", "XYZ"),
        "depth": ["ViewLayer.Denoising Depth.Z"],
        "alpha": ["ViewLayer.Combined.A"],
    }
    for role, names in half.taken.items():
        buffer = half.buffers[role]
        assert buffer.dtype == (np.float32 if role in ("color", "alpha") else dtype)
        assert buffer.flags.c_contiguous
        assert np.array_equal(buffer, np.stack([channels[name].astype(np.float32) for name in names], axis=-1))


def blender_5(path, *layers, dtype=np.float32):
    """One part per pass, part and channels both with layer and pass in front, as Blender 5 writes them."""
    channels = arrays([name.replace("ViewLayer", layer) for layer in layers for name in CYCLES], dtype)
    passes = dict.fromkeys(name.rpartition(".")[0] for name in channels)
    parts = [(p, {n: a for n, a in channels.items() if n.rpartition(".")[0] == p}, {}) for p in passes]
    return save(path, *parts), channels


def test_cycles_in_one_part_per_pass(tmp_path):
    path, channels = blender_5(tmp_path / "a.exr", "ViewLayer")
    half = exr.load_half(path)
    assert [part.name for part in half.file.parts][:2] == ["ViewLayer.Combined", "ViewLayer.Denoising Albedo"]
    assert half.taken["albedo"] == three("ViewLayer.Denoising Albedo")
    assert half.taken["depth"] == ["ViewLayer.Denoising Depth.Z"]
    assert np.array_equal(half.buffers["normal"][..., 2], channels["ViewLayer.Denoising Normal.Z"])


def test_several_view_layers(tmp_path):
    path, channels = blender_5(tmp_path / "a.exr", "Front", "Back")
    assert exr.load_half(path).taken["color"] == three("Front.Combined")
    half = exr.load_half(f"{path}::Back")
    assert half.file.path == str(path)
    assert half.file.layer == "Back"
    assert {name.partition(".")[0] for names in half.taken.values() for name in names} == {"Back"}
    assert np.array_equal(half.buffers["color"][..., 0], channels["Back.Combined.R"])
    with pytest.raises(ChannelError, match=r"a\.exr: .* but got 'Side'; there are the layers Front, Back"):
        exr.load_half(f"{path}::Side")


def test_parts_named_like_passes(tmp_path):
    parts = [("rgba", arrays("RGBA"), {}), ("albedo", arrays("RGB", start=9), {}), ("N", arrays("XYZ"), {})]
    half = exr.load_half(save(tmp_path / "a.exr", *parts))
    assert half.taken == {
        "color": three("rgba"),
        "albedo": three("albedo"),
        "normal": three("N", "XYZ"),
        "alpha": ["rgba.A"],
    }
    assert np.array_equal(half.buffers["albedo"][..., 1], pixels(10).astype(np.float32))


@pytest.mark.parametrize(
    ("names", "taken"),
    [
        pytest.param(
            MITSUBA,
            {"color": [*"RGB"], "albedo": three("albedo"), "normal": three("nn", "XYZ"), "depth": ["dd.T"]},
            id="mitsuba",
        ),
        pytest.param(
            [*"RGB", *three("Albedo"), *three("Ns", "XYZ"), *three("N", "XYZ"), *three("P", "XYZ"), "u"],
            {"color": [*"RGB"], "albedo": three("Albedo"), "normal": three("Ns", "XYZ"), "depth": ["P.Z"]},
            id="pbrt",
        ),
        pytest.param(
            [*"RGBA", "Z", *three("N", "XYZ"), *three("denoise_albedo")],
            {
                "color": [*"RGB"],
                "albedo": three("denoise_albedo"),
                "normal": three("N", "XYZ"),
                "depth": ["Z"],
                "alpha": ["A"],
            },
            id="arnold",
        ),
        pytest.param(
            [*three("Ci", "rgb"), "a", "z", *three("albedo", "rgb"), *three("normal", "xyz")],
            {
                "color": three("Ci", "rgb"),
                "albedo": three("albedo", "rgb"),
                "normal": three("normal", "xyz"),
                "depth": ["z"],
                "alpha": ["a"],
            },
            id="renderman",
        ),
    ],
)
def test_renderers_of_one_part(tmp_path, names, taken):
    channels = arrays(names)
    half = exr.load_half(save(tmp_path / "a.exr", channels))
    assert half.taken == taken
    for role, wanted in taken.items():
        assert np.array_equal(half.buffers[role], np.stack([channels[n] for n in wanted], -1).astype(np.float32))


def test_files_of_the_reference_implementation(tmp_path):
    for number, word in enumerate(["randImg", "albedo", "normal", "visibility", "denoImg"]):
        for offset, letter in ((0, "A"), (500, "B")):
            save(tmp_path / f"x_{word}{letter}.exr", arrays("RGB", np.float32, 100 * number + offset))
    half = exr.load_half(tmp_path / "x_randImgB.exr")
    assert half.taken == {
        "color": ["R", "G", "B"],
        "albedo": ["x_albedoB.exr:R", "x_albedoB.exr:G", "x_albedoB.exr:B"],
        "normal": ["x_normalB.exr:R", "x_normalB.exr:G", "x_normalB.exr:B"],
        "visibility": ["x_visibilityB.exr:R"],
        "denoised": ["x_denoImgB.exr:R", "x_denoImgB.exr:G", "x_denoImgB.exr:B"],
    }
    assert np.array_equal(half.buffers["color"][..., 2], pixels(502, np.float32))
    assert np.array_equal(half.buffers["visibility"], pixels(800, np.float32)[..., None])
    assert np.array_equal(half.buffers["denoised"][..., 1], pixels(901, np.float32))


@pytest.mark.parametrize(
    ("color", "others", "taken"),
    [
        pytest.param(
            "shot_RGB_IMAGEPIPELINE_0.0003.exr",
            {
                "shot_ALBEDO.0003.exr": "RGB",
                "shot_AVG_SHADING_NORMAL.0003.exr": "RGB",
                "shot_DEPTH.0003.exr": "Z",
                "shot_ALBEDO.0004.exr": "RGB",
            },
            {
                "color": [*"RGB"],
                "albedo": [f"shot_ALBEDO.0003.exr:{c}" for c in "RGB"],
                "normal": [f"shot_AVG_SHADING_NORMAL.0003.exr:{c}" for c in "RGB"],
                "depth": ["shot_DEPTH.0003.exr:Z"],
            },
            id="luxcore",
        ),
        pytest.param(
            "colorB.exr",
            {"albedoB.exr": "RGB", "albedoA.exr": "RGB", "normal.exr": "XYZ", "depth.exr": "Y", "visibilityB.exr": "Y"},
            {
                "color": [*"RGB"],
                "albedo": [f"albedoB.exr:{c}" for c in "RGB"],
                "normal": [f"normal.exr:{c}" for c in "XYZ"],
                "depth": ["depth.exr:Y"],
                "visibility": ["visibilityB.exr:Y"],
            },
            id="tungsten",
        ),
    ],
)
def test_files_beside_each_other(tmp_path, color, others, taken):
    files = {color: "RGB"} | others
    for number, (name, letters) in enumerate(files.items()):
        save(tmp_path / name, arrays(letters, start=10 * number))
    half = exr.load_half(tmp_path / color)
    assert {role: half.taken[role] for role in sorted(half.taken)} == {role: taken[role] for role in sorted(taken)}
    first = half.taken["albedo"][0].partition(":")[0]
    assert np.array_equal(half.buffers["albedo"][..., 2], pixels(10 * list(files).index(first) + 2).astype(np.float32))
    rewrite(tmp_path / color, tmp_path / "out.exr")
    assert_passed_through(tmp_path / color, tmp_path / "out.exr", but="RGB")


def test_a_buffer_in_the_file_comes_before_a_file_beside_it(tmp_path):
    save(tmp_path / "albedo.exr", arrays("RGB", start=50))
    save(tmp_path / "normal.exr", arrays("XYZ", start=60))
    half = exr.load_half(save(tmp_path / "colorA.exr", arrays([*"RGB", *three("albedo")])))
    assert half.taken["albedo"] == three("albedo")
    assert half.taken["normal"] == ["normal.exr:X", "normal.exr:Y", "normal.exr:Z"]


def test_channels_out_of_order(tmp_path):
    names = ["R", "nn.Z", "B", "nn.X", "G", "nn.Y"]
    (tmp_path / "a.exr").write_bytes(raw(channels=names))
    half = exr.load_half(tmp_path / "a.exr")
    assert half.file.channel_names == names
    assert half.buffers["color"][3, 4].tolist() == [0, 4, 2]
    assert half.buffers["normal"][3, 4].tolist() == [3, 5, 1]


def test_an_explicit_map(tmp_path):
    path = save(tmp_path / "a.exr", arrays([*"RGB", *three("sn", "XYZ"), "far.Q"]))
    half = exr.load_half(path, mapping={"normal": "sn", "depth": "far.Q"})
    assert half.taken["normal"] == three("sn", "XYZ")
    assert half.taken["depth"] == ["far.Q"]
    with pytest.raises(ChannelError, match=r"a\.exr: expected 3 channels named 'alb' for albedo"):
        exr.load_half(path, mapping={"albedo": "alb"})
    with pytest.raises(SettingsError, match="expected a role"):
        exr.load_half(path, mapping={"noise": "R"})


def test_what_a_file_says_of_itself(tmp_path):
    header = {"dataWindow": window(3, -2), "displayWindow": window(0, 0, 40, 50)}
    channels = {**arrays([*"RGB"]), "Z": pixels(5, np.float32), "id": pixels(6, np.uint32)}
    file = exr.read(save(tmp_path / "a.exr", channels, **header))
    assert file.size == SIZE
    assert file.data_window == (3, -2, 16, 6)
    assert file.display_window == (0, 0, 49, 39)
    assert file.channel_names == ["B", "G", "R", "Z", "id"]
    for name, array in channels.items():
        assert same_bits(file.pixels(name), array)
        assert not file.pixels(name).flags.writeable
    with pytest.raises(ChannelError, match=r"a\.exr: expected channel 'A', but got B, G, R, Z, id"):
        file.pixels("A")


def test_missing_colour(tmp_path):
    for names in (["Y"], three("albedo")):
        with pytest.raises(ChannelError, match=r"a\.exr: expected a colour pass \(R, .*, but got "):
            exr.load_half(save(tmp_path / "a.exr", arrays(names)))


def test_colour_of_integers(tmp_path):
    path = save(tmp_path / "a.exr", arrays("RGB", np.uint32))
    with pytest.raises(ChannelError, match=r"a\.exr: expected colour channel 'R' as half or float, but got uint32"):
        exr.load_half(path)


def test_buffers_of_another_window(tmp_path):
    path = save(tmp_path / "colorA.exr", arrays("RGB"))
    small = {name: pixels(1, size=(HEIGHT, 5)) for name in "RGB"}
    save(tmp_path / "albedoA.exr", small)
    message = r"albedoA\.exr: expected channel 'R' \(albedo\) with .* \(0, 0, 13, 8\), but got \(0, 0, 4, 8\)"
    with pytest.raises(FrameError, match=message):
        exr.load_half(path)
    save(tmp_path / "albedoA.exr", arrays("RGB"), dataWindow=window(1, 0), displayWindow=window(0, 0))
    with pytest.raises(FrameError, match=r"but got \(1, 0, 14, 8\)"):
        exr.load_half(path)


# What passes through


def assert_passed_through(source, target, *, but=(), added=()):
    """Every channel, type, window and attribute is the same to the bit, but those named."""
    before, after = exr.read(source), exr.read(target)
    assert len(before.parts) == len(after.parts)
    assert set(before.channel_names) | set(added) == set(after.channel_names)
    for name in before.channel_names:
        if name in but:
            assert before.pixels(name).dtype == after.pixels(name).dtype
        else:
            assert same_bits(before.pixels(name), after.pixels(name)), name
    for first, second in zip(attributes_of(source), attributes_of(target), strict=True):
        ours = {name for name in second if name.startswith("selfcorrect/")}
        assert {k: v for k, v in second.items() if k not in {*ours, "channels", "type", *but}} == {
            k: v for k, v in first.items() if k not in {"channels", "type", *but}
        }
        if not added:
            assert sorted_channels(second) == sorted_channels(first)


def sorted_channels(attributes):
    """The channel list in the order that the format asks for, with every field of each channel."""
    data, found = attributes["channels"][1], []
    while data[0]:
        end = data.index(b"\0") + 17
        found.append(data[:end])
        data = data[end:]
    return sorted(found)


def rewrite(source, target, names=("R", "G", "B"), **more):
    file = exr.read(source)
    color = np.stack([pixels(90 + number, np.float32, file.pixels(names[0]).shape) for number in range(3)], -1)
    clipped = exr.write(target, file, color, names, {"selfcorrect/seed": "7"}, **more)
    after = exr.read(target)
    for number, name in enumerate(names):
        expected = color[..., number].astype(file.pixels(name).dtype)
        assert same_bits(after.pixels(name), expected)
    return clipped


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
    """Compressed and uncompressed files go different ways through the library, and keep different things."""
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


# What is refused when writing


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


# What is refused when reading


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


def test_reading_and_writing_leave_no_file_open(tmp_path, file):
    before = len(os.listdir("/proc/self/fd"))
    for name in ("1.exr", "2.exr"):
        exr.write(tmp_path / name, exr.read(tmp_path / "a.exr"), COLOR, "RGB", {})
        with pytest.raises(FileError):
            exr.read(tmp_path / "none.exr")
    assert len(os.listdir("/proc/self/fd")) == before


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


# What a file is said to hold


def test_inspect(tmp_path):
    red = pixels(0, np.float32)
    red[0, :3] = [np.nan, np.inf, -np.inf]
    red[1, 1] = np.nan
    channels = {
        **arrays(MITSUBA),
        "R": red,
        "id": pixels(3, np.uint32),
        "none.V": np.full(SIZE, np.nan, np.float16),
    }
    header = {"dataWindow": window(3, -2), "displayWindow": window(0, 0, 40, 50)}
    path = save(tmp_path / "colorA.exr", channels, **header)
    save(tmp_path / "albedoA.exr", arrays("RGB"))
    save(tmp_path / "visibility.exr", arrays("RGB"))
    seen = exr.inspect(path)
    assert seen.path == str(path)
    assert seen.layers == ("",)
    assert seen.taken["normal"] == ("nn.X", "nn.Y", "nn.Z")
    assert seen.siblings == {"visibility": str(tmp_path / "visibility.exr")}
    assert seen.problem is None
    (part,) = seen.parts
    assert (part.storage, part.compression) == ("scanlineimage", "ZIP")
    assert part.data_window == (3, -2, 16, 6)
    assert part.display_window == (0, 0, 49, 39)
    reports = {report.name: report for report in part.channels}
    assert list(reports) == exr.read(path).channel_names
    finite = red[np.isfinite(red)].astype(np.float64)
    assert reports["R"] == ChannelReport("R", "float32", 2, 2, finite.min(), finite.max(), finite.mean())
    assert reports["id"].dtype == "uint32"
    assert (reports["id"].nan, reports["id"].inf) == (0, 0)
    assert reports["id"].maximum == channels["id"].max()
    assert reports["none.V"] == ChannelReport("none.V", "float16", WIDTH * HEIGHT, 0, None, None, None)


def test_inspect_in_words_and_as_json(tmp_path):
    red = np.full(SIZE, 0.5, np.float32)
    red[0, :3] = [np.nan, np.inf, np.nan]
    none = np.full(SIZE, np.nan, np.float16)
    save(tmp_path / "normal.exr", arrays("XYZ"))
    path = save(tmp_path / "color.exr", {"R": red, "G": red, "B": red, "Z": none})
    seen = exr.inspect(path)
    assert seen.lines() == [
        str(path),
        "part '': 14×9 pixels, scanlineimage, ZIP, data window (0, 0, 13, 8), display window (0, 0, 13, 8)",
        "  B: float32, 0.5 … 0.5, mean 0.5, 2 NaN, 1 infinite",
        "  G: float32, 0.5 … 0.5, mean 0.5, 2 NaN, 1 infinite",
        "  R: float32, 0.5 … 0.5, mean 0.5, 2 NaN, 1 infinite",
        "  Z: float16, no finite pixel, 126 NaN",
        "color: R, G, B",
        "depth: Z",
        f"normal: {tmp_path / 'normal.exr'}",
    ]
    told = json.loads(json.dumps(seen.to_dict(), allow_nan=False))
    assert told["parts"][0]["data_window"] == [0, 0, 13, 8]
    assert told["parts"][0]["channels"][3]["mean"] is None
    assert told["taken"] == {"color": ["R", "G", "B"], "depth": ["Z"]}


def test_inspect_without_colour_says_why(tmp_path):
    seen = exr.inspect(save(tmp_path / "a.exr", arrays(["Y"])))
    assert seen.taken == {}
    assert seen.lines()[-1] == seen.problem
    assert seen.problem.startswith(f"{tmp_path}/a.exr: expected a colour pass")


def test_inspect_of_layers(tmp_path):
    path, _ = blender_5(tmp_path / "a.exr", "Front", "Back")
    assert exr.inspect(path).layers == ("Front", "Back")
    assert exr.inspect(f"{path}::Back").taken["albedo"] == tuple(three("Back.Denoising Albedo"))
    assert [part.name for part in exr.inspect(path).parts][-1] == "Back.Denoising Depth"


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


@pytest.mark.shared
def test_the_references_have_colour_only(shared):
    half = exr.load_half(shared / "frames" / "staircase_ref_A.exr")
    assert half.taken == {"color": ["R", "G", "B"]}
    assert half.file.size == (480, 256)
