"""The scripts that render the two halves, with the real renderers, and what those really write."""

import argparse
import itertools
import json
import re
import subprocess
from pathlib import Path
from typing import Any

import halves
import numpy as np
import pytest
import torch
from helpers.commands import BALANCED, call
from helpers.exr_files import assert_passed_through, rewrite, three
from helpers.render_scripts import BLENDER, BLENDER_TAKEN, CHECKOUT, done, refused

from selfcorrect import exr, files
from selfcorrect.errors import SettingsError
from selfcorrect.exr.aovs import plan
from selfcorrect.history.motion import warped
from selfcorrect.independence import doubts
from selfcorrect.shot import framerange


def color(path: Path) -> Any:
    return exr.load_half(path).buffers["color"]


def assert_halves(folder: Path, name: str, frames: list[int], taken: dict[str, list[str]]) -> None:
    """Both halves of every frame and nothing else; independent, of uncorrelated pixels, with the buffers named."""
    pairs = [[folder / f"{name}_{half}.{frame:04d}.exr" for half in "ab"] for frame in frames]
    assert sorted(folder.glob("*.exr")) + sorted(folder.glob(".*")) == sorted(itertools.chain(*pairs))
    for a, b in pairs:
        loaded = files.load(files.Sources(str(a), str(b)))
        assert {role: names for role, names in loaded.origin.taken.items()} == taken
        assert doubts(loaded.frame) == []
        assert loaded.frame.size[0] * loaded.frame.size[1] > 4096  # the fewest pixels that doubts() judges
        noise = color(a) - color(b)
        assert np.count_nonzero(noise) > 0.2 * noise.size
    means = [color(a).mean() for a, _ in pairs]
    assert len(set(means)) == len(frames)


class TestHalves:
    @pytest.mark.parametrize(
        ("text", "frames"),
        [
            ("5", [5]),
            ("5-5", [5]),
            ("1-4", [1, 2, 3, 4]),
            ("1-7x3", [1, 4, 7]),
            ("7-20:5, 1-3,2", [7, 12, 17, 1, 2, 3]),
            ("-2-0", [-2, -1, 0]),
        ],
    )
    def test_frames(self, text: str, frames: list[int]) -> None:
        assert halves.parse_frames(text) == framerange.parse_frames(text) == frames  # the other one is the command's

    @pytest.mark.parametrize("text", ["", "a", "4-1", "1-", "1-4x0", "1..4", "1,,2"])
    def test_no_frames(self, text: str) -> None:
        with pytest.raises(argparse.ArgumentTypeError, match="expected frames such as"):
            halves.parse_frames(text)
        with pytest.raises(SettingsError):
            framerange.parse_frames(text)

    @pytest.mark.parametrize("frame", [None, 7, -7, 12345])
    def test_names(self, frame: int | None) -> None:
        path = halves.path_of(Path("shot"), "room", "b", frame)
        assert str(path) == ("shot/room_b.exr" if frame is None else framerange.fill("shot/room_b.####.exr", frame))

    def test_no_seed_comes_twice(self) -> None:
        seeds = [halves.seed_of(s, frame, half) for s in range(4) for frame in range(250) for half in "ab"]
        assert len(set(seeds)) == len(seeds)
        assert min(seeds) >= 0
        assert max(seeds) < 2**31

    def test_a_file_appears_only_when_it_is_whole(self, tmp_path: Path) -> None:
        path = tmp_path / "new" / "a.exr"

        def interrupted() -> None:
            with halves.published(path) as temporary:
                temporary.write_bytes(b"half of it")
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            interrupted()
        assert list(path.parent.iterdir()) == []
        with halves.published(path) as temporary:
            temporary.write_bytes(b"all")
        assert [p.name for p in path.parent.iterdir()] == ["a.exr"]


MITSUBA_SCENE = """<scene version="3.0.0">
<default name="angle" value="0"/><default name="frame" value="0"/>
<integrator type="path"><integer name="max_depth" value="4"/></integrator>
<sensor type="perspective">
  <transform name="to_world"><lookat origin="0,2,4" target="0,0,0" up="0,1,0"/>
    <rotate y="1" angle="$angle"/><translate y="$frame"/></transform>
  <film type="hdrfilm"><integer name="width" value="30"/><integer name="height" value="20"/>
    <rfilter type="gaussian"><float name="stddev" value="1"/></rfilter></film>
</sensor>
<emitter type="constant"><rgb name="radiance" value="0.1"/></emitter>
<shape type="rectangle"><transform name="to_world"><scale value="0.3"/><rotate x="1" angle="90"/>
  <translate x="1" y="3"/></transform><emitter type="area"><rgb name="radiance" value="40"/></emitter></shape>
<shape type="sphere"><bsdf type="diffuse"><rgb name="reflectance" value="0.5,0.2,0.1"/></bsdf></shape>
<shape type="rectangle"><transform name="to_world"><scale value="20"/><rotate x="1" angle="-90"/>
  <translate y="-1"/></transform><bsdf type="diffuse"/></shape>
</scene>"""
MITSUBA_TAKEN = {"color": [*"RGB"], "albedo": three("albedo"), "normal": three("nn", "XYZ"), "depth": ["dd.T"]}
SCALAR = ["--variant", "scalar_rgb"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mitsuba") / "room.xml"
    path.write_text(MITSUBA_SCENE)
    return path


@pytest.fixture(scope="module")
def shot(scene: Path) -> Path:
    folder = scene.parent / "shot"
    done("render/render_mitsuba", scene, "-o", folder, "--spp", 4, "--frames", "1,3", "--size", "96x64", *SCALAR)
    return folder


@pytest.mark.mitsuba
def test_halves_from_mitsuba(shot: Path) -> None:
    assert_halves(shot, "room", [1, 3], MITSUBA_TAKEN)  # the scene's own filter is wide: a box was forced


@pytest.mark.mitsuba
def test_a_frame_of_mitsuba_passes_through(shot: Path, tmp_path: Path) -> None:
    rewrite(shot / "room_a.0001.exr", tmp_path / "out.exr")
    assert_passed_through(shot / "room_a.0001.exr", tmp_path / "out.exr", but="RGB")


@pytest.mark.mitsuba
def test_a_single_frame_with_parameters(scene: Path, tmp_path: Path) -> None:
    for name, more in {"x": [], "y": [], "z": ["-D", "angle={40 * sin(pi * frame / 2)}"], "s": ["--seed", 1]}.items():
        done("render/render_mitsuba", scene, "-o", tmp_path, "--spp", 2, "--name", name, *more, *SCALAR)
    x, y, z, s = (color(tmp_path / f"{name}_a.exr") for name in "xyzs")
    assert x.shape == (20, 30, 3)
    assert np.array_equal(x, y)
    assert not np.array_equal(x, s)
    assert abs(x - z).mean() > 0.02 * x.mean()  # the lamp is seen from another side


@pytest.mark.mitsuba
def test_a_scene_finds_the_files_beside_it(scene: Path, tmp_path: Path) -> None:
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "patch.obj").write_text("v -1 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    mesh = '<shape type="obj"><string name="filename" value="models/patch.obj"/></shape></scene>'
    (tmp_path / "near.xml").write_text(MITSUBA_SCENE.replace("</scene>", mesh))
    done("render/render_mitsuba", tmp_path / "near.xml", "-o", tmp_path, "--spp", 2, *SCALAR)
    assert color(tmp_path / "near_a.exr").shape == (20, 30, 3)


@pytest.mark.mitsuba
def test_samples_in_several_passes(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import mitsuba
    import render_mitsuba

    mitsuba.set_variant("scalar_rgb")
    loaded = render_mitsuba.load_scene(scene, {})
    one = np.array(render_mitsuba.render(loaded, 32, 5))
    monkeypatch.setattr(render_mitsuba, "PATHS_PER_PASS", 600 * 10)
    four = np.array(render_mitsuba.render(loaded, 32, 5))
    assert not np.array_equal(one, four)
    assert abs(four - one).mean() < 0.05 * one.mean()
    assert four.mean() == pytest.approx(one.mean(), rel=0.005)


@pytest.mark.parametrize(
    ("flags", "word"),
    [
        (["--spp", "3"], "expected an even number of samples"),
        (["--frames", "4-1"], "expected frames such as 1-240"),
        (["--size", "4"], "expected a size such as 1920x1080"),
        (["-D", "angle"], "expected -D NAME=TEXT, but got 'angle'"),
        (["-D", "angle={open('x')}"], r"expected arithmetic over frame in {…}, but got {open\('x'\)}"),
        (["-D", "angel=1"], "room.xml: .*angel"),
        (["--variant", "scalar"], "expected a variant of"),
    ],
)
@pytest.mark.mitsuba
def test_what_a_user_of_mitsuba_can_fix(scene: Path, tmp_path: Path, flags: list[str], word: str) -> None:
    line = refused("render/render_mitsuba", scene, "-o", tmp_path, "--spp", 2, *SCALAR, *flags)
    assert re.search(word, line), line
    assert list(tmp_path.iterdir()) == []


LAYERS = """
scene.view_layers[0].name = "Front"
scene.view_layers.new("Back")
for layer in scene.view_layers:
    layer.use_pass_cryptomatte_object = layer.use_pass_z = layer.use_pass_normal = layer.use_pass_vector = True
scene.render.film_transparent = scene.render.use_multiview = True
"""
LIT = """
scene.view_layers[0].name = 'Front'
scene.view_layers.new('Back').samples = 1
for layer in scene.view_layers:
    for kind in ('diffuse', 'glossy', 'transmission'):
        for part in ('direct', 'indirect', 'color'):
            setattr(layer, f'use_pass_{kind}_{part}', True)
    layer.use_pass_emit = layer.use_pass_environment = True
    layer.cycles.use_pass_volume_direct = layer.cycles.use_pass_volume_indirect = True
"""
DRIVEN = "scene.driver_add('cycles.seed').driver.expression = '7'"
KEYED = "scene.keyframe_insert('cycles.seed', frame=1)"


@pytest.fixture(scope="module")
def blend(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("blender") / "room.blend"
    done("blender/build_shot", path)
    return path


def changed(blend: Path, code: str) -> Path:
    """A copy of the scene after some Python."""
    copy = blend.with_name("changed.blend")
    lines = f"import bpy\nbpy.ops.wm.open_mainfile(filepath={str(blend)!r})\nscene = bpy.context.scene\n{code}\n"
    lines += f"bpy.ops.wm.save_as_mainfile(filepath={str(copy)!r})"
    subprocess.run([BLENDER, "-c", lines], check=True, capture_output=True, timeout=300)
    return copy


@pytest.mark.blender
def test_halves_from_blender(blend: Path, tmp_path: Path) -> None:
    before = blend.read_bytes()
    done("render/render_blender", blend, "-o", tmp_path, "--spp", 4, "--frames", "1,24", "--size", "96x64")
    # the file's own settings are Blender's: its denoiser, a wide filter and adaptive sampling
    assert_halves(tmp_path, "room", [1, 24], BLENDER_TAKEN)
    assert blend.read_bytes() == before
    first = exr.load_half(tmp_path / "room_a.0001.exr", shot=True)
    assert len(first.file.parts) == 5
    assert first.taken["motion"] == three("ViewLayer.Vector", "XYZW")
    assert first.file.parts[0].header["cycles.ViewLayer.samples"] == "2"


@pytest.mark.blender
def test_view_layers_and_eyes(blend: Path, tmp_path: Path) -> None:
    layered = changed(blend, LAYERS)
    done("render/render_blender", layered, "-o", tmp_path, "--spp", 2, "--name", "eyes", "--size", "32x18")
    path = tmp_path / "eyes_a.exr"
    assert exr.inspect(path).layers == ("left.Front", "right.Front", "left.Back", "right.Back")
    seen = {}
    for wanted, layer in {"": "left.Front", "::right": "right.Front", "::right.Back": "right.Back"}.items():
        half = exr.load_half(f"{path}{wanted}")
        expected = {role: [f"{layer}.{n.partition('.')[2]}" for n in names] for role, names in BLENDER_TAKEN.items()}
        assert half.taken == expected | {"alpha": [f"{layer}.Combined.A"]}
        seen[layer] = half.buffers["depth"]
    assert not np.array_equal(seen["left.Front"], seen["right.Front"])
    names = three("right.Front.Combined")
    rewrite(path, tmp_path / "out.exr", names)
    assert_passed_through(path, tmp_path / "out.exr", but=names)
    assert "cryptomatte" in " ".join(exr.read(tmp_path / "out.exr").parts[0].header)


@pytest.mark.blender
def test_view_layers_are_corrected_together(blend: Path, tmp_path: Path) -> None:
    """Each with its own light passes, which sum to it."""
    layered = changed(blend, LIT)
    done("render/render_blender", layered, "-o", tmp_path, "--spp", 4, "--name", "lit", "--size", "48x32")
    a, b, out = (tmp_path / f"{name}.exr" for name in ("lit_a", "lit_b", "out"))
    result = call("frame", a, b, "-o", out, *BALANCED, "--candidates", "none", "--aovs", "auto", "--json")
    assert result.returncode == 0, result.stderr
    told = json.loads(result.stdout)
    assert (told["layer"], list(told["layers"])) == ("Front", ["Back"])
    file = exr.read(out)
    for layer in ("Front", "Back"):
        picture = three(f"{layer}.Combined")
        assert f"view layer {layer}" in result.stderr
        (group,) = plan(file, file, picture, "auto").groups
        assert max(group.closing) < 1e-5
        noisy = (exr.read(a).pixels(picture[1]) + exr.read(b).pixels(picture[1])) / 2
        assert not np.allclose(file.pixels(picture[1]), noisy)


@pytest.mark.blender
def test_a_driven_seed_is_freed(blend: Path, tmp_path: Path) -> None:
    driven = changed(blend, DRIVEN)
    done("render/render_blender", driven, "-o", tmp_path, "--spp", 2, "--size", "32x18", "--name", "x")
    assert not np.array_equal(color(tmp_path / "x_a.exr"), color(tmp_path / "x_b.exr"))


@pytest.mark.parametrize(
    ("code", "word"),
    [
        pytest.param(KEYED, "expected a seed that can be set", id="keyframes on the seed"),
        pytest.param("scene.render.engine = 'BLENDER_WORKBENCH'", "expected a scene rendered with Cycles", id="engine"),
        pytest.param("scene.camera = None", "no camera", id="camera"),
    ],
)
@pytest.mark.blender
def test_what_a_user_of_blender_can_fix(blend: Path, tmp_path: Path, code: str, word: str) -> None:
    line = refused("render/render_blender", changed(blend, code), "-o", tmp_path, "--spp", 2, "--size", "32x18")
    assert word in line
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> dict[int, exr.HalfFile]:
    """Frames 5 and 6 of a shot whose camera and objects move."""
    folder = tmp_path_factory.mktemp("moving")
    command = [BLENDER, CHECKOUT / "scripts/render/ghosts.py", "-o", folder, "--frames", "5-6", "--spp", "8"]
    command += ["--reference", "0", "--size", "144x84", "--threads", "1"]
    subprocess.run(list(map(str, command)), check=True, capture_output=True, timeout=300)
    return {n: exr.load_half(folder / f"ghosts_a.{n:04d}.exr", shot=True) for n in (5, 6)}


@pytest.mark.blender
@pytest.mark.parametrize(("here", "there", "side"), [(6, 5, 0), (5, 6, 2)])
def test_motion_from_blender_leads_to_the_same_surface(
    moving: dict[int, exr.HalfFile], here: int, there: int, side: int
) -> None:
    """Its signs: albedo fetched along them fits, and along no others, nor along none."""
    albedo, other = (torch.from_numpy(moving[n].buffers["albedo"]) for n in (here, there))
    motion = torch.from_numpy(moving[here].buffers["motion"])[..., side : side + 2]
    assert motion.abs().mean() > 0.5

    def difference(*signs: float) -> float:
        return float((warped(other, motion * torch.tensor(signs)) - albedo).abs().mean())

    right, *wrong = (difference(x, y) for x, y in ((1, 1), (1, -1), (-1, 1), (-1, -1), (0, 0)))
    assert right < 0.85 * min(wrong)
    assert right < 0.6 * wrong[-1]
