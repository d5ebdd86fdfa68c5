"""EXR files read: the layouts of every renderer, in one file or in several."""

import numpy as np
import pytest
from helpers.exr_files import (
    CYCLES,
    HEIGHT,
    MITSUBA,
    SIZE,
    arrays,
    assert_passed_through,
    blender_5,
    pixels,
    raw,
    rewrite,
    same_bits,
    save,
    three,
    window,
)

from selfcorrect import exr
from selfcorrect.errors import ChannelError, FrameError, SettingsError


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


@pytest.mark.shared
def test_the_references_have_colour_only(shared):
    half = exr.load_half(shared / "frames" / "staircase_ref_A.exr")
    assert half.taken == {"color": ["R", "G", "B"]}
    assert half.file.size == (480, 256)
