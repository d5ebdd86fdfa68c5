"""What a file is said to hold."""

import json

import numpy as np
from helpers.exr_files import HEIGHT, MITSUBA, SIZE, WIDTH, arrays, blender_5, pixels, save, three, window

from selfcorrect import exr
from selfcorrect.exr.inspection import ChannelReport


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
