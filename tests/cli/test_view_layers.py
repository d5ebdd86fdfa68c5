"""The command on files of several view layers: all are corrected in one run, each with its own passes."""

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import BALANCED, call, refused
from helpers.exr_files import save, three
from helpers.pages import data_of, unpacked

from selfcorrect import exr
from selfcorrect.exr.view_layers import chosen, view_layers
from selfcorrect.settings import ALL_LAYERS

SIZE = (24, 30)
FEW = [*BALANCED, "--candidates", "none"]
LAYERS = ("Near", "Far")
PASSES = ("Diffuse Direct", "Emission", "Diffuse Color")


def layer(name: str, generator: np.random.Generator) -> list[tuple[str, dict[str, np.ndarray], dict[str, str]]]:
    """Parts of one view layer as Blender 5 writes them, whose light passes sum to the picture."""
    planes = {one: generator.random((3, *SIZE), dtype=np.float32) for one in PASSES}
    planes["Combined"] = planes["Diffuse Direct"] * planes["Diffuse Color"] + planes["Emission"]
    return [
        (f"{name}.{one}", dict(zip(three(f"{name}.{one}"), values, strict=True)), {}) for one, values in planes.items()
    ]


def half(path: Path, seed: int, layers: tuple[str, ...] = LAYERS) -> Path:
    """A half with these layers, and what the compositor made of them."""
    generator = np.random.default_rng(seed)
    parts = [part for name in layers for part in layer(name, generator)]
    made = dict(zip(three("Composite.Combined"), generator.random((3, *SIZE), dtype=np.float32), strict=True))
    return save(path, *parts, ("Composite.Combined", made, {}))


@pytest.fixture
def halves(tmp_path: Path) -> list[Path]:
    return [half(tmp_path / f"{name}.exr", seed) for seed, name in enumerate("ab")]


def image(path: Path, name: str) -> np.ndarray:
    file = exr.read(path)
    return np.stack([file.pixels(channel).astype(np.float64) for channel in three(name)], -1)


def mean(paths: list[Path], name: str) -> np.ndarray:
    return (image(paths[0], name) + image(paths[1], name)) / 2


def test_layers_are_those_with_a_colour(halves: list[Path]) -> None:
    assert view_layers(str(halves[0])) == [*LAYERS, "Composite"]
    a, b = map(str, halves)
    assert chosen(a, b, ALL_LAYERS) == (LAYERS, ())
    assert chosen(a, b, "far").names == ("Far",)
    assert chosen(a, b, "Composite,Near").names == ("Composite", "Near")
    assert chosen(f"{a}::Far", b, ALL_LAYERS).names == ("Far",)


def test_each_layer_is_what_it_is_alone(halves: list[Path], tmp_path: Path) -> None:
    """All in one run give the bits that each has by itself; what no layer is stays the mean of both halves."""
    out, alone = tmp_path / "out.exr", tmp_path / "alone.exr"
    result = call("frame", *halves, "-o", out, *FEW, "--aovs", "auto", "--json")
    assert result.returncode == 0, result.stderr
    for name in LAYERS:
        assert f"view layer {name}" in result.stderr
        named = [f"{path}::{name}" for path in halves]
        assert call("frame", *named, "-o", alone, *FEW, "--aovs", "auto").returncode == 0
        for one in ("Combined", "Diffuse Direct", "Emission"):
            assert np.array_equal(image(out, f"{name}.{one}"), image(alone, f"{name}.{one}")), (name, one)
        total = image(out, f"{name}.Diffuse Direct") * image(out, f"{name}.Diffuse Color")
        total += image(out, f"{name}.Emission")
        picture = image(out, f"{name}.Combined")
        assert np.all(abs(total - picture) <= 1e-5 * picture + 1e-7)
        assert not np.array_equal(picture, mean(halves, f"{name}.Combined").astype(np.float32))
    assert np.array_equal(image(out, "Composite.Combined"), mean(halves, "Composite.Combined").astype(np.float32))
    told = json.loads(result.stdout)
    assert told["layer"] == "Near"
    assert told["channels"]["color"] == three("Near.Combined")
    assert list(told["layers"]) == ["Far"]
    assert told["layers"]["Far"]["channels"]["color"] == three("Far.Combined")
    assert told["layers"]["Far"]["aovs"]["Blender's light passes"]["left"] < 1e-6
    assert told["other_channels"] == {"mean": 9, "kept": 0, "corrected": 12, "lacking": []}


def test_layers_that_are_not_named_stay_the_mean(halves: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "out.exr"
    result = call("frame", *halves, "-o", out, *FEW, "--layers", "FAR", "--diagnostics", "blend", "--json")
    assert result.returncode == 0, result.stderr
    assert np.array_equal(image(out, "Near.Combined"), mean(halves, "Near.Combined").astype(np.float32))
    assert not np.array_equal(image(out, "Far.Combined"), mean(halves, "Far.Combined").astype(np.float32))
    assert "layers" not in json.loads(result.stdout)


def test_each_layer_has_a_page(halves: list[Path], tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    assert call("frame", *halves, "-o", tmp_path / "out.exr", *FEW, "--report", page).returncode == 0
    first, second = (data_of(path.read_text()) for path in (page, tmp_path / f"page.{LAYERS[1]}.html"))
    shown = [next(layer for layer in data["layers"] if layer["name"] == "corrected") for data in (first, second)]
    for layer, name in zip(shown, LAYERS, strict=True):
        written = image(tmp_path / "out.exr", f"{name}.Combined")
        np.testing.assert_allclose(np.moveaxis(unpacked(layer), 0, -1), written, rtol=2**-11, atol=1e-6)
    assert f"out.exr::{LAYERS[1]}" in (tmp_path / f"page.{LAYERS[1]}.html").read_text()


def test_diagnostics_are_of_each_layer(halves: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "out.exr"
    result = call("frame", *halves, "-o", out, *FEW, "--diagnostics", "blend")
    assert result.returncode == 0, result.stderr
    names = [name for name in exr.read(out).channel_names if "selfcorrect" in name]
    assert names == ["Near.Combined.Far.selfcorrect.blend", "Near.Combined.selfcorrect.blend"]


def test_a_layer_of_half_a_alone_is_left(halves: list[Path], tmp_path: Path) -> None:
    half(halves[1], 1, ("Near",))
    out = tmp_path / "out.exr"
    result = call("frame", *halves, "-o", out, *FEW)
    assert result.returncode == 0, result.stderr
    assert "view layer Far: in half a only, and so as in half a" in result.stderr
    assert np.array_equal(image(out, "Far.Combined"), image(halves[0], "Far.Combined"))


def test_refusals(halves: list[Path], tmp_path: Path) -> None:
    command = ("frame", *halves, "-o", tmp_path / "out.exr", *FEW)
    told = refused(*command, "--layers", "Near,nothing")
    assert "a.exr: expected a view layer 'nothing' with a colour for --layers, but got Near, Far, Composite" in told
    assert "expected names of view layers with --layers, but got ','" in refused(*command, "--layers", ",")
    one = (f"{halves[0]}::Near", halves[1])
    told = refused("frame", *one, "-o", tmp_path / "out.exr", *FEW, "--layers", "Far")
    assert "expected a layer after :: or --layers Far, but got both" in told
    half(halves[1], 1, ("Near",))
    assert "b.exr: expected a view layer 'Far'" in refused(*command, "--layers", "Far")
    assert not (tmp_path / "out.exr").exists()


def test_denoised_images_have_the_same_layers(halves: list[Path], tmp_path: Path) -> None:
    """Those of all layers serve all; those of one layer serve that one, and more cannot be asked of them."""
    given = ["--denoised-a", halves[1], "--denoised-b", halves[0]]
    few = [flag for flag in FEW if flag not in ("--denoiser", "box")]
    out = tmp_path / "out.exr"
    result = call("frame", *halves, "-o", out, *few, *given)
    assert result.returncode == 0, result.stderr
    assert "view layer Far" in result.stderr
    single = [
        save(tmp_path / f"d{name}.exr", dict(zip("RGB", np.ones((3, *SIZE), np.float32), strict=True))) for name in "ab"
    ]
    given = ["--denoised-a", single[0], "--denoised-b", single[1]]
    result = call("frame", *halves, "-o", out, *few, *given)
    assert result.returncode == 0, result.stderr
    assert "view layers Far: not corrected" in result.stderr
    told = refused("frame", *halves, "-o", out, *few, *given, "--layers", "Near,Far")
    assert "da.exr: expected the view layers of --layers Near,Far, but got none named Near, Far" in told
    assert call("frame", *halves, "-o", out, *few, *given, "--layers", "Far").returncode == 0


def test_a_shot_corrects_all_layers(tmp_path: Path) -> None:
    """The first frame of a shot is what the frame is alone; later ones go on from their own layer's network."""
    for number in (1, 2):
        for seed, name in enumerate("ab"):
            half(tmp_path / f"{name}.{number:04d}.exr", 10 * number + seed)
    names = [str(tmp_path / f"{name}.####.exr") for name in ("a", "b", "out")]
    command = ["sequence", *names[:2], "-o", names[2], "--frames", "1-2", *FEW, "--aovs", "auto"]
    result = call(*command, "--frame-radius", "0", "--json")
    assert result.returncode == 0, result.stderr
    assert "frame 2, view layer Far: " in result.stderr
    told = [json.loads(line) for line in result.stdout.splitlines()]
    assert [list(frame["layers"]) for frame in told] == [["Far"], ["Far"]]
    assert told[1]["layers"]["Far"]["start"]["warm_loss"] is not None
    first = [tmp_path / f"{name}.0001.exr" for name in "ab"]
    assert call("frame", *first, "-o", tmp_path / "alone.exr", *FEW, "--aovs", "auto").returncode == 0
    for name in LAYERS:
        assert np.array_equal(
            image(tmp_path / "out.0001.exr", f"{name}.Combined"), image(tmp_path / "alone.exr", f"{name}.Combined")
        )
        total = image(tmp_path / "out.0002.exr", f"{name}.Diffuse Direct") * image(
            tmp_path / "out.0002.exr", f"{name}.Diffuse Color"
        )
        total += image(tmp_path / "out.0002.exr", f"{name}.Emission")
        picture = image(tmp_path / "out.0002.exr", f"{name}.Combined")
        assert np.all(abs(total - picture) <= 1e-5 * picture + 1e-7)
    again = call(*command, "--frame-radius", "0", "--skip-existing")
    assert again.stderr.count("skipped") == 2
    assert "skipped" not in call(*command, "--frame-radius", "0", "--skip-existing", "--layers", "Near").stderr


def test_a_shots_layers_have_their_own_neighbours(tmp_path: Path) -> None:
    for number in (1, 2):
        for seed, name in enumerate("ab"):
            half(tmp_path / f"{name}.{number:04d}.exr", 10 * number + seed)
    names = [str(tmp_path / f"{name}.####.exr") for name in ("a", "b", "out")]
    result = call("sequence", *names[:2], "-o", names[2], "--frames", "1-2", *FEW, "--frame-radius", "1")
    assert result.returncode == 0, result.stderr
    assert result.stderr.count("history") >= 4 or "optical flow" in result.stderr
