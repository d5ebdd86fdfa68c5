"""Motion that `scripts/render` writes for Mitsuba: it leads to the same surface in the frames before and after."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.render_scripts import done

from selfcorrect import exr
from selfcorrect.history.motion import fetched, warped

pytestmark = pytest.mark.mitsuba

SIZE = (72, 120)
SCENE = """<scene version="3.0.0">
<default name="turn" value="0"/><default name="slide" value="0"/>
<integrator type="path"><integer name="max_depth" value="2"/></integrator>
<sensor type="perspective"><float name="fov" value="50"/><float name="principal_point_offset_x" value="0.1"/>
  <transform name="to_world"><lookat origin="0,1,6" target="0,0.3,0" up="0,1,0"/>
    <rotate y="1" angle="$turn"/></transform>
  <film type="hdrfilm"><integer name="width" value="120"/><integer name="height" value="72"/></film>
  <sampler type="SAMPLER"/>
</sensor>
<emitter type="constant"/>
<bsdf type="diffuse" id="checks"><texture name="reflectance" type="checkerboard">
  <rgb name="color0" value="0.1,0.2,0.3"/><rgb name="color1" value="0.9,0.7,0.5"/>
  <transform name="to_uv"><scale x="5" y="5"/></transform></texture></bsdf>
<shape type="cube" id="turns"><transform name="to_world"><scale value="0.8"/><rotate y="1" angle="$turn"/>
  <rotate y="1" angle="$turn"/><rotate y="1" angle="$turn"/><translate x="-1.3"/></transform><ref id="checks"/></shape>
<shape type="sphere" id="slides"><transform name="to_world"><scale value="0.8"/><translate x="$slide"/></transform>
  <ref id="checks"/></shape>
<shape type="shapegroup" id="group"><shape type="rectangle"><ref id="checks"/></shape></shape>
<shape type="instance" id="rises"><transform name="to_world"><scale value="0.5"/><translate x="1.3" y="1" z="-1"/>
  <translate y="$slide"/></transform><ref id="group"/></shape>
<shape type="rectangle" id="floor"><transform name="to_world"><scale value="5"/><rotate x="1" angle="-90"/>
  <translate y="-0.9"/></transform><ref id="checks"/></shape>
</scene>"""
MOVING = ["-D", "turn={3 * frame}", "-D", "slide={0.8 + 0.15 * frame}"]


def rendered(folder: Path, *more: object, frames: str = "1-2", sampler: str = "independent", spp: int = 8) -> Any:
    """By number, half a of the frames of the shot."""
    folder.mkdir(exist_ok=True)
    scene = folder / "scene.xml"
    scene.write_text(SCENE.replace("SAMPLER", sampler))
    command = [scene, "-o", folder, "--spp", spp, "--frames", frames, "--variant", "scalar_rgb", *more]
    done("render/render_mitsuba", *command)
    files = sorted(folder.glob("scene_a.*.exr"))
    return {int(file.name.split(".")[1]): exr.load_half(file, shot=True) for file in files}


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Two frames; the camera turns around, one object turns, one slides and an instance rises."""
    return rendered(tmp_path_factory.mktemp("moving") / "shot", *MOVING)


@pytest.mark.parametrize(("here", "there", "side"), [(2, 1, 0), (1, 2, 2)])
def test_it_leads_to_the_same_surface(moving: Any, here: int, there: int, side: int) -> None:
    """Albedo fetched along it fits, and along no other signs, nor along none."""
    assert moving[here].taken["motion"] == ["motion.X", "motion.Y", "motion.Z", "motion.W"]
    albedo, other = (torch.from_numpy(moving[n].buffers["albedo"]) for n in (here, there))
    motion = torch.from_numpy(moving[here].buffers["motion"])[..., side : side + 2]
    assert motion.shape == (*SIZE, 2)
    assert motion.isfinite().all()
    assert motion.abs().mean() > 0.5

    def difference(*signs: float) -> float:
        return float((warped(other, motion * torch.tensor(signs)) - albedo).abs().mean())

    right, *wrong = (difference(x, y) for x, y in ((1, 1), (1, -1), (-1, 1), (-1, -1), (0, 0)))
    assert right < 0.7 * min(wrong)
    assert right < 0.5 * wrong[-1]


def test_a_sample_is_projected_into_its_own_pixel(tmp_path: Path) -> None:
    """Whatever the camera, and of every kind of shape."""
    import mitsuba as mi
    from mitsuba_motion import hits, layout, motion, projected
    from render_mitsuba import load_scene

    mi.set_variant("scalar_rgb")
    path = tmp_path / "scene.xml"
    path.write_text(SCENE.replace("SAMPLER", "independent"))
    scene = load_scene(path, {"turn": "6", "slide": "1.1"}, (60, 36))
    met, here = hits(scene, 0), layout(scene)
    assert {name.partition("#")[0] for name in met.shape.flat} == {"", "slides", "rises"}  # the others are merged
    assert None not in met.shape
    pixels = np.stack(np.indices((36, 60))[::-1], -1)
    inside = projected(here, met.position, met.missed) - pixels
    assert inside.min() > -0.001
    assert inside.max() < 1.001
    assert inside.std() > 0.2
    assert np.abs(motion(met, here, (here, here))).max() < 1e-4


def test_there_and_back_is_where_it_began(moving: Any) -> None:
    """On every surface, unless it is covered in the other frame."""
    motion = {n: torch.from_numpy(moving[n].buffers["motion"]) for n in (1, 2)}
    there = motion[1][..., 2:]
    missed = (there + fetched(motion[2][..., :2], there)).norm(dim=-1)
    assert (missed < 0.3).float().mean() > 0.85


def test_what_stands_still_has_none(tmp_path: Path) -> None:
    """Nor what a sampler that takes no single sample would have mixed."""
    for frame in rendered(tmp_path / "still", sampler="ldsampler", spp=8).values():
        motion = frame.buffers["motion"]
        assert np.abs(motion).max() < 1e-2
        assert np.isfinite(motion).all()


def test_it_is_as_long_as_geometry_says() -> None:
    """The camera looks along z from a distance of 4 at an object that moves by a tenth in x and y."""
    import mitsuba as mi
    from mitsuba_motion import hits, layout, motion

    mi.set_variant("scalar_rgb")
    film = {"type": "hdrfilm", "width": 40, "height": 20, "rfilter": {"type": "box"}}

    def scene(number: int, kind: str) -> Any:
        at = mi.ScalarTransform4f().translate([0.1 * number, 0.1 * number, 0]).scale(0.7)
        towards = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
        sensor = {"type": "perspective", "fov": 90, "to_world": towards, "film": film}
        return mi.load_dict({"type": "scene", "one": {"type": kind, "to_world": at}, "sensor": sensor})

    for kind in ("rectangle", "disk"):
        scenes = [scene(number, kind) for number in range(3)]
        layouts = [layout(one) for one in scenes]
        found = motion(hits(scenes[1], 0), layouts[1], (layouts[0], layouts[2]))
        assert found[10, 20] == pytest.approx([-0.5, 0.5, 0.5, -0.5], abs=1e-4)  # 40 pixels are 8 wide at that distance
        assert found[0, 0] == pytest.approx([0, 0, 0, 0], abs=1e-4)  # nothing is there, far away
        alone = motion(hits(scenes[1], 0), layouts[1], (None, layouts[2]))
        assert np.isnan(alone[..., :2]).all()
        assert np.array_equal(alone[..., 2:], found[..., 2:])
