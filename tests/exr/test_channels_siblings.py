"""The files that renderers lay side by side, and the channels of each."""

import pytest

from selfcorrect.errors import ChannelError
from selfcorrect.exr import channels


@pytest.mark.parametrize(
    ("color", "there", "expected"),
    [
        (
            "room_randImgA.exr",
            [
                "room_albedoA.exr",
                "room_normalA.exr",
                "room_visibilityA.exr",
                "room_denoImgA.exr",
                "room_albedoB.exr",
            ],
            {
                "albedo": "room_albedoA.exr",
                "normal": "room_normalA.exr",
                "visibility": "room_visibilityA.exr",
                "denoised": "room_denoImgA.exr",
            },
        ),
        (
            "colorB.exr",
            ["albedoA.exr", "albedo.exr", "normalB.exr"],
            {"albedo": "albedo.exr", "normal": "normalB.exr"},
        ),
        (
            "colorA.exr",
            ["albedoA.exr", "albedo.exr", "depth.exr"],
            {"albedo": "albedoA.exr", "depth": "depth.exr"},
        ),
        (
            "a_RGB.0001.exr",
            ["a_ALBEDO.0001.exr", "a_ALBEDO.0002.exr", "a_AVG_SHADING_NORMAL.0001.exr", "b_DEPTH.0001.exr"],
            {"albedo": "a_ALBEDO.0001.exr", "normal": "a_AVG_SHADING_NORMAL.0001.exr"},
        ),
        (
            "RGB_IMAGEPIPELINE_0.exr",
            ["ALBEDO.exr", "DEPTH.exr"],
            {"albedo": "ALBEDO.exr", "depth": "DEPTH.exr"},
        ),
        ("room_randImgA.exr", ["room_albedoB.exr", "randImgA.exr"], {}),
        ("colorful.exr", ["albedoful.exr", "albedo.exr"], {}),
        ("beauty.exr", ["albedo.exr"], {}),
    ],
)
def test_siblings(tmp_path, color, there, expected):
    for name in [color, *there]:
        (tmp_path / name).touch()
    found = channels.siblings(tmp_path / color)
    assert found == {role: tmp_path / name for role, name in expected.items()}


@pytest.mark.parametrize(
    ("names", "role", "expected"),
    [
        (["A", "B", "G", "R"], "albedo", ("R", "G", "B")),
        (["B", "G", "R"], "normal", ("R", "G", "B")),
        (["X", "Y", "Z"], "normal", ("X", "Y", "Z")),
        (["Normal.X", "Normal.Y", "Normal.Z", "R", "G", "B"], "normal", ("Normal.X", "Normal.Y", "Normal.Z")),
        (["any.B", "any.G", "any.R"], "denoised", ("any.R", "any.G", "any.B")),
        (["B", "G", "R"], "visibility", ("R",)),
        (["Z", "Y", "X"], "visibility", ("X",)),
        (["Y"], "depth", ("Y",)),
    ],
)
def test_channels_of_a_sibling(names, role, expected):
    assert channels.sibling_channels(names, role, file="b.exr") == expected


def test_a_sibling_without_its_buffer():
    with pytest.raises(ChannelError, match=r"b\.exr: expected albedo channels R, G, B or X, Y, Z, but got Y"):
        channels.sibling_channels(["Y"], "albedo", file="b.exr")
