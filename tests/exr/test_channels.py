"""The channel table against the names that renderers write."""

import itertools
import random

import pytest

from selfcorrect.errors import ChannelError, SettingsError
from selfcorrect.exr import channels


def three(name, letters="RGB"):
    return tuple(f"{name}.{letter}" for letter in letters)


MITSUBA = [*"ABGR", *three("albedo", "BGR"), *three("nn", "XYZ"), "dd.T", *three("position", "XYZ"), "uv.U"]
CYCLES = [
    *three("Composite.Combined", "ABGR"),
    *three("ViewLayer.Combined", "ABGR"),
    *three("ViewLayer.Denoising Albedo"),
    *three("ViewLayer.Denoising Normal", "XYZ"),
    "ViewLayer.Denoising Depth.Z",
    "ViewLayer.Depth.Z",
    *three("ViewLayer.DiffCol"),
    *three("ViewLayer.Normal", "XYZ"),
    *three("ViewLayer.CryptoObject00", "abgr"),
]
PBRT = [
    *"RGB",
    *three("Albedo"),
    *three("N", "XYZ"),
    *three("Ns", "XYZ"),
    *three("P", "XYZ"),
    "u",
    "v",
    "dzdx",
]
OLD_PBRT = [*"RGB", "Nx", "Ny", "Nz", "Nsx", "Nsy", "Nsz", *three("Albedo")]
ARNOLD = [
    *"ABGR",
    "Z",
    *three("N", "XYZ"),
    *three("N_noice", "XYZ"),
    *three("diffuse_albedo"),
    *three("specular"),
]
RENDERMAN = [*three("Ci", "rgb"), "a", "z", "zfiltered", *three("albedo", "rgb"), *three("normal", "xyz")]


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        pytest.param(
            MITSUBA,
            {
                "color": ("R", "G", "B"),
                "albedo": three("albedo"),
                "normal": three("nn", "XYZ"),
                "depth": ("dd.T",),
                "alpha": ("A",),
            },
            id="mitsuba",
        ),
        pytest.param(
            [*three("img"), *three("first_albedo"), *three("sh_normal", "XYZ"), "far.y.T"],
            {
                "color": three("img"),
                "albedo": three("first_albedo"),
                "normal": three("sh_normal", "XYZ"),
                "depth": ("far.y.T",),
            },
            id="mitsuba with prefixes of the user",
        ),
        pytest.param(
            CYCLES,
            {
                "color": three("ViewLayer.Combined"),
                "albedo": three("ViewLayer.Denoising Albedo"),
                "normal": three("ViewLayer.Denoising Normal", "XYZ"),
                "depth": ("ViewLayer.Denoising Depth.Z",),
                "alpha": ("ViewLayer.Combined.A",),
            },
            id="cycles",
        ),
        pytest.param(
            [*CYCLES, *three("ViewLayer.Noisy Image")],
            {
                "color": three("ViewLayer.Noisy Image"),
                "albedo": three("ViewLayer.Denoising Albedo"),
                "normal": three("ViewLayer.Denoising Normal", "XYZ"),
                "depth": ("ViewLayer.Denoising Depth.Z",),
                "alpha": ("ViewLayer.Combined.A",),
            },
            id="cycles with its denoiser on",
        ),
        pytest.param(
            [
                *three("VL.Combined"),
                *three("VL.Diffuse Color"),
                *three("VL.Glossy Color"),
                *three("VL.Normal", "XYZ"),
                "VL.Depth.V",
            ],
            {
                "color": three("VL.Combined"),
                "albedo": three("VL.Diffuse Color"),
                "normal": three("VL.Normal", "XYZ"),
                "depth": ("VL.Depth.V",),
            },
            id="cycles without denoising data",
        ),
        pytest.param(
            PBRT,
            {
                "color": ("R", "G", "B"),
                "albedo": three("Albedo"),
                "normal": three("Ns", "XYZ"),
                "depth": ("P.Z",),
            },
            id="pbrt",
        ),
        pytest.param(
            OLD_PBRT,
            {"color": ("R", "G", "B"), "albedo": three("Albedo"), "normal": ("Nsx", "Nsy", "Nsz")},
            id="old pbrt",
        ),
        pytest.param(
            ARNOLD,
            {
                "color": ("R", "G", "B"),
                "albedo": three("diffuse_albedo"),
                "normal": three("N", "XYZ"),
                "depth": ("Z",),
                "alpha": ("A",),
            },
            id="arnold",
        ),
        pytest.param(
            RENDERMAN,
            {
                "color": three("Ci", "rgb"),
                "albedo": three("albedo", "rgb"),
                "normal": three("normal", "xyz"),
                "depth": ("z",),
                "alpha": ("a",),
            },
            id="renderman",
        ),
        pytest.param(
            [*"RGB", *three("ALBEDO"), *three("AVG_SHADING_NORMAL", "XYZ"), "DEPTH.Z"],
            {
                "color": ("R", "G", "B"),
                "albedo": three("ALBEDO"),
                "normal": three("AVG_SHADING_NORMAL", "XYZ"),
                "depth": ("DEPTH.Z",),
            },
            id="luxcore",
        ),
        pytest.param(
            [*"RGB", "visibility.V", "depth"],
            {"color": ("R", "G", "B"), "depth": ("depth",), "visibility": ("visibility.V",)},
            id="tungsten buffers in one file",
        ),
    ],
)
def test_every_renderer(names, expected):
    for seed in range(4):
        shuffled = random.Random(seed).sample(names, len(names))
        assert channels.choose(shuffled, file="a.exr") == expected


def test_the_order_of_colour_passes():
    passes = [("R", "G", "B"), *(three(f"L.{name}") for name in ("Noisy Image", "Beauty", "Combined"))]
    passes.append(three("Composite.Combined"))
    for first in range(len(passes)):
        names = list(itertools.chain(*reversed(passes[first:])))
        assert channels.choose(names, file="a.exr")["color"] == passes[first]


def test_denoising_passes_come_before_the_others():
    names = [*three("L.Combined"), *three("L.DiffCol"), *three("L.Normal", "XYZ"), "L.Depth.Z"]
    names += [*three("L.Denoising Albedo"), *three("L.Denoising Normal", "XYZ"), "L.Denoising Depth.Z"]
    taken = channels.choose(names, file="a.exr")
    assert taken["albedo"] == three("L.Denoising Albedo")
    assert taken["normal"] == three("L.Denoising Normal", "XYZ")
    assert taken["depth"] == ("L.Denoising Depth.Z",)


TWO_LAYERS = [
    *three("Front.Combined"),
    *three("Back.Combined"),
    *three("Back.Denoising Albedo"),
    *three("Front.Denoising Normal", "XYZ"),
]


def test_the_first_layer_of_the_file_gives_every_role():
    assert channels.layers(TWO_LAYERS) == ["Front", "Back"]
    assert channels.choose(TWO_LAYERS, file="a.exr") == {
        "color": three("Front.Combined"),
        "normal": three("Front.Denoising Normal", "XYZ"),
    }
    backwards = TWO_LAYERS[3:6] + TWO_LAYERS[:3] + TWO_LAYERS[6:]
    assert channels.choose(backwards, file="a.exr")["color"] == three("Back.Combined")


def test_a_named_layer_gives_every_role():
    assert channels.choose(TWO_LAYERS, file="a.exr", layer="Back") == {
        "color": three("Back.Combined"),
        "albedo": three("Back.Denoising Albedo"),
    }


def test_a_layer_may_be_a_pass_and_takes_the_buffers_around_it():
    names = [*CYCLES, *three("ViewLayer.Noisy Image")]
    assert channels.choose(names, file="a.exr", layer="ViewLayer.Combined") == {
        "color": three("ViewLayer.Combined"),
        "albedo": three("ViewLayer.Denoising Albedo"),
        "normal": three("ViewLayer.Denoising Normal", "XYZ"),
        "depth": ("ViewLayer.Denoising Depth.Z",),
        "alpha": ("ViewLayer.Combined.A",),
    }
    taken = channels.choose([*MITSUBA, *three("direct")], file="a.exr", layer="direct")
    assert taken["color"] == three("direct")
    assert taken["albedo"] == three("albedo")


def test_buffers_of_a_view_layer_are_not_taken_for_colour_outside_it():
    taken = channels.choose([*"RGB", *three("L.Denoising Albedo"), *three("L.Combined")], file="a.exr")
    assert taken == {"color": ("R", "G", "B")}


@pytest.mark.parametrize(
    ("role", "name", "expected"),
    [
        ("albedo", "my", three("my")),
        ("albedo", "my.R, my.G,my.B", three("my")),
        ("normal", "sn", three("sn", "XYZ")),
        ("depth", "far.Q", ("far.Q",)),
        ("visibility", "lit", ("lit.V",)),
        ("color", "my", three("my")),
    ],
)
def test_an_explicit_map(role, name, expected):
    names = [*"RGB", *three("my"), *three("sn", "XYZ"), "lit.V", "far.Q"]
    assert channels.choose(names, file="a.exr", mapping={role: name})[role] == expected


@pytest.mark.parametrize(
    ("role", "name", "expected"), [("depth", "far", "one channel"), ("albedo", "R,G", "3 channels")]
)
def test_a_name_of_the_map_that_is_not_there(role, name, expected):
    message = rf"a\.exr: expected {expected} named '{name}' for {role}, but got R, G, B, far\.Q"
    with pytest.raises(ChannelError, match=message):
        channels.choose([*"RGB", "far.Q"], file="a.exr", mapping={role: name})


def test_an_explicit_map_within_the_layer():
    names = [*TWO_LAYERS, *three("Back.tint")]
    taken = channels.choose(names, file="a.exr", layer="Back", mapping={"albedo": "tint"})
    assert taken["albedo"] == three("Back.tint")


def test_an_explicit_colour_decides_where_the_others_are():
    taken = channels.choose(TWO_LAYERS, file="a.exr", mapping={"color": "Back.Combined"})
    assert taken == {"color": three("Back.Combined"), "albedo": three("Back.Denoising Albedo")}


def test_an_unknown_role_in_the_map():
    with pytest.raises(SettingsError, match=r"expected a role of color, albedo, .* but got 'colour'"):
        channels.choose(["R", "G", "B"], file="a.exr", mapping={"colour": "R"})


@pytest.mark.parametrize(
    "names",
    [["Y"], ["R", "G"], three("albedo"), [*three("diffuse"), *three("specular")], ["Z"], ["X", "Y", "Z"]],
    ids=["grey", "no blue", "albedo alone", "two unknown passes", "depth", "xyz"],
)
def test_no_colour_is_an_error_that_says_what_is_there(names):
    with pytest.raises(ChannelError) as caught:
        channels.choose(names, file="shot.exr")
    message = str(caught.value)
    assert message.startswith("shot.exr: expected a colour pass (R, Noisy Image.R, Beauty.R, Combined.R")
    assert f"but got {', '.join(names)};" in message
    assert "\n" not in message


def test_a_long_list_of_channels_is_cut_in_the_message():
    with pytest.raises(ChannelError, match=r"c0, c1, .*, c11 and 88 more;"):
        channels.choose([f"c{number}" for number in range(100)], file="a.exr")


def test_an_unknown_layer_is_an_error_that_lists_the_layers():
    with pytest.raises(ChannelError, match=r"a\.exr: .* but got 'Bakc'; there are the layers Front, Back"):
        channels.choose(TWO_LAYERS, file="a.exr", layer="Bakc")
    with pytest.raises(ChannelError, match=r"but got 'x'; there are the channels R, G, B"):
        channels.choose(["R", "G", "B"], file="a.exr", layer="x")


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        pytest.param([("main", ["R", "G"])], [["R", "G"]], id="the only part adds nothing"),
        pytest.param(
            [("L.Combined", ["L.Combined.R"]), ("L.Depth", ["L.Depth.V"])],
            [["L.Combined.R"], ["L.Depth.V"]],
            id="blender 5",
        ),
        pytest.param(
            [("L.Combined-left", ["L.Combined.R"]), ("L.Combined-right", ["L.Combined.R"])],
            [["left.L.Combined.R"], ["right.L.Combined.R"]],
            id="blender 5 in stereo",
        ),
        pytest.param(
            [("L.Combined-left", ["L.Combined.R"]), ("L.Depth-left", ["L.Depth.V"])],
            [["L.Combined.R"], ["L.Depth.V"]],
            id="blender 5, one eye",
        ),
        pytest.param(
            [("rgba", ["R", "A"]), ("albedo", ["R"]), ("N", ["N.X"]), ("", ["id"])],
            [["rgba.R", "rgba.A"], ["albedo.R"], ["N.X"], ["id"]],
            id="parts named like passes",
        ),
    ],
)
def test_full_names(parts, expected):
    assert channels.full_names(parts) == expected


def test_views_in_one_part():
    names = [f"L.{p}.{view}.{c}" for p in ("Combined", "Denoising Albedo") for view in ("left", "right") for c in "RGB"]
    (full,) = channels.full_names([("", names)], ["left", "right"])
    assert full[0] == "left.L.Combined.R"
    assert channels.layers(full) == ["left.L", "right.L"]
    for layer, view in ((None, "left"), ("left.L", "left"), ("right.L", "right"), ("right", "right")):
        assert channels.choose(full, file="a.exr", layer=layer) == {
            "color": three(f"{view}.L.Combined"),
            "albedo": three(f"{view}.L.Denoising Albedo"),
        }
    (full,) = channels.full_names(
        [("", [*"RGB", "right.R", "right.G", "right.B", "N.X", "N.right.X"])], ["left", "right"]
    )
    assert full == [*"RGB", "right.R", "right.G", "right.B", "N.X", "right.N.X"]


def test_parts_named_like_passes_give_their_roles():
    parts = [("rgba", [*"RGBA"]), ("albedo", [*"RGB"]), ("N", [*"XYZ"]), ("depth", ["Z"])]
    names = list(itertools.chain(*channels.full_names(parts)))
    assert channels.choose(names, file="a.exr") == {
        "color": three("rgba"),
        "albedo": three("albedo"),
        "normal": three("N", "XYZ"),
        "depth": ("depth.Z",),
        "alpha": ("rgba.A",),
    }
