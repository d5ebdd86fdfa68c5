"""Small frames with every kind of light pass, for `scripts/bench/aovs.py`: two halves and a reference, with Cycles.

    .venv-blender/bin/python scripts/render/light_passes.py -o FOLDER [--spp 64] [--reference 2048] [--size 240x160]

`--scene still-life`, of three cameras: a diffuse room with a patterned floor, a rough metal and a mirror ball, a glass
ball, a lamp to look at, a thin fog beneath a lamp, and an opening through which the world is seen. Every light is in
one of two groups, ``key`` and ``fill``, so both decompositions of the picture are whole: the light passes with their
colours, and the groups.

`--scene tufts`: blades of grass before nothing, so that alpha is noisy where they and the defocus blur end, around a
wax ball (subsurface scattering), a copper one and a lamp, with the same two groups.

`--scene shelf`: a closed white corner that a low sun (``key``) enters through slats, with two small coloured lamps and
a glowing strip (``fill``), a lacquered board, bottles of coloured glass and a rough steel block on it: sharp shadows,
most light indirect, no world and no fog.

Nothing is loaded; the scene is made by code. The halves are set up by `render_blender.py`, with seeds of their own and
of the reference's.
"""

import argparse
import math
import os
import random
import sys
import time
from pathlib import Path

import bpy

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from halves import HALVES, even, path_of, seed_of, size
from render_blender import prepare, render_half

PASSES = (
    *(f"{kind}_{part}" for kind in ("diffuse", "glossy", "transmission") for part in ("direct", "indirect", "color")),
    "emit",
    "environment",
    "z",
)
GROUPS = ("key", "fill")
VIEWS = (
    ((0.6, -5.2, 2.2), (0.0, 0.6, 0.75)),
    ((-2.4, -3.2, 1.3), (0.3, 0.5, 0.5)),
    ((3.0, -3.6, 1.7), (-0.6, 1.2, 0.7)),
)
"""Where the camera is, and what it looks at: the whole, the glass ball, and the room through the fog."""


def material(name: str, shader: str, **inputs: object) -> bpy.types.Material:
    """One closure with these inputs."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    nodes = made.node_tree.nodes
    nodes.clear()
    closure, output = nodes.new(f"ShaderNode{shader}"), nodes.new("ShaderNodeOutputMaterial")
    for key, value in inputs.items():
        closure.inputs[key].default_value = value
    socket = "Volume" if shader.startswith("Volume") else "Surface"
    made.node_tree.links.new(closure.outputs[0], output.inputs[socket])
    return made


def checkered(name: str) -> bpy.types.Material:
    """Diffuse squares of two colours: detail that the colour pass carries."""
    made = material(name, "BsdfDiffuse")
    tree = made.node_tree
    texture, place = tree.nodes.new("ShaderNodeTexChecker"), tree.nodes.new("ShaderNodeTexCoord")
    texture.inputs["Scale"].default_value = 9.0
    texture.inputs["Color1"].default_value = (0.7, 0.55, 0.35, 1)
    texture.inputs["Color2"].default_value = (0.12, 0.1, 0.2, 1)
    tree.links.new(place.outputs["Generated"], texture.inputs["Vector"])
    closure = next(node for node in tree.nodes if node.type == "BSDF_DIFFUSE")
    tree.links.new(texture.outputs["Color"], closure.inputs["Color"])
    return made


def add(shape: str, made: bpy.types.Material, **where: object) -> bpy.types.Object:
    """A primitive of this material."""
    getattr(bpy.ops.mesh, f"primitive_{shape}_add")(**where)
    placed = bpy.context.object
    placed.data.materials.append(made)
    if shape == "uv_sphere":
        bpy.ops.object.shade_smooth()
    return placed


def lamp(name: str, group: str, kind: str, energy: float, place: tuple[float, ...], **properties: object) -> None:
    """A lamp of a light group, that looks at the middle of the floor."""
    data = bpy.data.lights.new(name, kind)
    data.energy = energy
    for key, value in properties.items():
        setattr(data, key, value)
    held = bpy.data.objects.new(name, data)
    held.location = place
    target = bpy.data.objects["floor"]
    look = held.constraints.new("TRACK_TO")
    look.target, look.track_axis, look.up_axis = target, "TRACK_NEGATIVE_Z", "UP_Y"
    held.lightgroup = group
    bpy.context.scene.collection.objects.link(held)


def empty() -> bpy.types.Scene:
    """A scene with its passes on and nothing in it."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.max_bounces = 8
    scene.cycles.sample_clamp_indirect = 0.0
    layer = scene.view_layers[0]
    for name in PASSES:
        setattr(layer, f"use_pass_{name}", True)
    layer.cycles.use_pass_volume_direct = layer.cycles.use_pass_volume_indirect = True
    for group in GROUPS:
        layer.lightgroups.add(name=group)
    return scene


def sky(scene: bpy.types.Scene, color: tuple[float, ...], strength: float) -> None:
    """A world of one colour, in the group ``fill``."""
    world = bpy.data.worlds.new("world")
    world.use_nodes = True
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    background.inputs["Color"].default_value = color
    background.inputs["Strength"].default_value = strength
    world.lightgroup = "fill"
    scene.world = world


def look(scene: bpy.types.Scene, place: tuple[float, ...], aim: tuple[float, ...], lens: float) -> bpy.types.Camera:
    """The scene's camera, here and turned to there."""
    data = bpy.data.cameras.new("camera")
    data.lens = lens
    camera = bpy.data.objects.new("camera", data)
    camera.location = place
    turned = camera.constraints.new("TRACK_TO")
    turned.target, turned.track_axis, turned.up_axis = bpy.data.objects.new("aim", None), "TRACK_NEGATIVE_Z", "UP_Y"
    turned.target.location = aim
    for placed in (camera, turned.target):
        scene.collection.objects.link(placed)
    scene.camera = camera
    return data


def still_life(view: int = 0) -> bpy.types.Scene:
    """The scene, with its passes on."""
    scene = empty()
    floor = add("plane", checkered("tiles"), size=8)
    floor.name = "floor"
    wall = material("wall", "BsdfDiffuse", Color=(0.55, 0.6, 0.5, 1))
    red = material("red wall", "BsdfDiffuse", Color=(0.6, 0.12, 0.08, 1))
    add("cube", wall, size=1, location=(-2.0, 3.4, 1.5), scale=(4.0, 0.1, 3.0))
    add("cube", red, size=1, location=(-3.4, 0.5, 1.5), scale=(0.1, 6.0, 3.0))
    gold = material("gold", "BsdfGlossy", Color=(0.9, 0.65, 0.3, 1), Roughness=0.25)
    mirror = material("mirror", "BsdfGlossy", Color=(0.9, 0.9, 0.9, 1), Roughness=0.05)
    glass = material("glass", "BsdfGlass", Color=(0.95, 1.0, 0.97, 1), Roughness=0.05, IOR=1.45)
    add("uv_sphere", gold, radius=0.7, location=(-1.5, 1.2, 0.7), segments=48, ring_count=24)
    add("uv_sphere", mirror, radius=0.5, location=(1.6, 1.4, 0.5), segments=48, ring_count=24)
    add("uv_sphere", glass, radius=0.55, location=(0.15, 0.2, 0.55), segments=48, ring_count=24)
    bulb = add("uv_sphere", material("bulb", "Emission", Color=(1.0, 0.5, 0.2, 1), Strength=6.0), radius=0.18,
               location=(-0.6, -0.7, 0.18))  # fmt: skip
    bulb.lightgroup = "fill"
    fog = material("fog", "VolumeScatter", Color=(0.9, 0.9, 1.0, 1), Density=0.35)
    add("cube", fog, size=1, location=(2.3, 0.6, 1.0), scale=(1.4, 1.4, 2.0))

    lamp("key", "key", "AREA", 180.0, (3.2, -2.2, 3.6), size=0.6, color=(1.0, 0.85, 0.7))
    lamp("spot", "fill", "SPOT", 220.0, (2.4, 1.0, 3.2), spot_size=math.radians(40), shadow_soft_size=0.1)
    sky(scene, (0.25, 0.4, 0.7, 1), 0.35)
    look(scene, *VIEWS[view], lens=32)
    return scene


def tufts(view: int = 0) -> bpy.types.Scene:
    """Grass, wax, copper and a lamp before nothing, out of focus at the front and the back."""
    scene = empty()
    scene.render.film_transparent = True
    floor = add("plane", material("soil", "BsdfDiffuse", Color=(0.2, 0.13, 0.08, 1)), size=3)
    floor.name = "floor"
    chance = random.Random(0)
    vertices, faces = [], []
    for _ in range(1500):
        x, y, angle = chance.uniform(-1.5, 1.5), chance.uniform(-1.5, 1.5), chance.uniform(0, 2 * math.pi)
        height, lean, wide = chance.uniform(0.25, 0.8), chance.uniform(0.0, 0.3), 0.012
        across = (wide * math.cos(angle), wide * math.sin(angle))
        tip = (x - lean * math.sin(angle), y + lean * math.cos(angle), height)
        faces.append(tuple(range(len(vertices), len(vertices) + 3)))
        vertices += [(x - across[0], y - across[1], 0.0), (x + across[0], y + across[1], 0.0), tip]
    blades = bpy.data.meshes.new("blades")
    blades.from_pydata(vertices, [], faces)
    blades.materials.append(material("grass", "BsdfDiffuse", Color=(0.2, 0.45, 0.08, 1)))
    scene.collection.objects.link(bpy.data.objects.new("blades", blades))
    wax = material("wax", "SubsurfaceScattering", Color=(0.8, 0.5, 0.35, 1), Scale=0.15)
    copper = material("copper", "BsdfGlossy", Color=(0.95, 0.5, 0.35, 1), Roughness=0.15)
    bulb = material("bulb", "Emission", Color=(1.0, 0.6, 0.3, 1), Strength=5.0)
    add("uv_sphere", wax, radius=0.4, location=(-0.5, 0.0, 0.7), segments=48, ring_count=24)
    add("uv_sphere", copper, radius=0.35, location=(0.55, 0.3, 0.75), segments=48, ring_count=24)
    add("uv_sphere", bulb, radius=0.1, location=(0.05, -0.6, 0.5)).lightgroup = "fill"
    lamp("key", "key", "AREA", 120.0, (2.5, -2.5, 3.0), size=0.4, color=(1.0, 0.9, 0.8))
    sky(scene, (0.4, 0.5, 0.7, 1), 0.5)
    camera = look(scene, (0.3, -3.6, 1.2), (0.0, 0.0, 0.55), lens=45)
    camera.dof.use_dof, camera.dof.focus_distance, camera.dof.aperture_fstop = True, 3.5, 0.5
    return scene


def shelf(view: int = 0) -> bpy.types.Scene:
    """Bottles on a lacquered board, in slatted sun and the light of two lamps."""
    scene = empty()
    floor = add("plane", material("lacquer", "BsdfPrincipled", Roughness=0.2, **{"Base Color": (0.3, 0.12, 0.06, 1)}),
                size=4)  # fmt: skip
    floor.name = "floor"
    white = material("plaster", "BsdfDiffuse", Color=(0.75, 0.73, 0.7, 1))
    add("cube", white, size=1, location=(0.0, 1.6, 1.2), scale=(4.0, 0.1, 2.4))
    add("cube", white, size=1, location=(-2.0, 0.0, 1.2), scale=(0.1, 4.0, 2.4))
    add("cube", white, size=1, location=(0.0, 0.0, 2.4), scale=(4.0, 4.0, 0.1))
    for i in range(9):  # the slats, and beside them the open side that the sun comes through
        add("cube", white, size=1, location=(2.0, -1.8 + 0.4 * i, 1.2), scale=(0.05, 0.22, 2.4))
    for i, color in enumerate(((0.25, 0.8, 0.35, 1), (0.9, 0.55, 0.15, 1), (0.3, 0.5, 0.95, 1))):
        glass = material(f"bottle {i}", "BsdfGlass", Color=color, Roughness=0.02, IOR=1.45)
        add("cylinder", glass, radius=0.18, depth=0.8, location=(-0.9 + 0.7 * i, 0.5 - 0.25 * i, 0.41), vertices=48)
    steel = material("steel", "BsdfGlossy", Color=(0.7, 0.72, 0.75, 1), Roughness=0.4)
    add("cube", steel, size=0.5, location=(-1.2, -0.5, 0.25), rotation=(0.0, 0.0, 0.5))
    add("uv_sphere", checkered("ball"), radius=0.3, location=(1.0, -0.5, 0.3), segments=48, ring_count=24)
    strip = material("strip", "Emission", Color=(0.5, 0.8, 1.0, 1), Strength=4.0)
    add("cube", strip, size=1, location=(0.0, 1.5, 1.7), scale=(2.4, 0.05, 0.05)).lightgroup = "fill"
    lamp("sun", "key", "SUN", 12.0, (6.0, -1.5, 2.4), angle=0.01, color=(1.0, 0.9, 0.75))
    lamp("left", "fill", "POINT", 15.0, (-1.5, -1.2, 1.6), shadow_soft_size=0.04, color=(1.0, 0.4, 0.3))
    lamp("right", "fill", "POINT", 10.0, (1.4, 0.9, 1.5), shadow_soft_size=0.04, color=(0.5, 0.7, 1.0))
    look(scene, (0.2, -3.4, 1.3), (0.0, 0.3, 0.6), lens=30)
    return scene


SCENES = {"still-life": still_life, "tufts": tufts, "shelf": shelf}


def main() -> None:
    parser = argparse.ArgumentParser(description="Render a frame with every kind of light pass.")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--spp", type=even, default=64, metavar="N", help="of both halves together (default: 64)")
    parser.add_argument("--reference", type=int, default=2048, metavar="N", help="samples of the reference; 0: none")
    parser.add_argument("--size", type=size, default=(240, 160), metavar="WxH")
    parser.add_argument("--scene", default="still-life", choices=SCENES)
    parser.add_argument("--view", type=int, default=0, choices=range(len(VIEWS)), help="camera of still-life")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=0, help="of Cycles; 0: all")
    options = parser.parse_args(sys.argv[1:])
    scene = SCENES[options.scene](options.view)
    if options.threads:
        scene.render.threads_mode, scene.render.threads = "FIXED", options.threads
    jobs = [(half, options.spp // 2) for half in HALVES]
    jobs += [("ref", options.reference)] if options.reference else []
    for half, samples in jobs:
        prepare(scene, samples, options.size)
        path = path_of(options.output, "passes", half, None)
        started = time.perf_counter()
        render_half(scene, 1, seed_of(options.seed, 1, half), path)
        print(f"{path}: {samples} spp, {time.perf_counter() - started:.1f} s", flush=True)


if __name__ == "__main__":
    main()
