"""A small frame with every kind of light pass, for `scripts/bench/aovs.py`: two halves and a reference, with Cycles.

    .venv-blender/bin/python scripts/render/light_passes.py -o FOLDER [--spp 64] [--reference 2048] [--size 240x160]

A diffuse room with a patterned floor, a rough metal and a mirror ball, a glass ball, a lamp to look at, a thin fog
beneath a lamp, and an opening through which the world is seen. Every light is in one of two groups, ``key`` and
``fill``, so both decompositions of the picture are whole: the light passes with their colours, and the groups.

Nothing is loaded; the scene is made by code. The halves are set up by `render_blender.py`, with seeds of their own and
of the reference's.
"""

import argparse
import math
import os
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


def still_life(view: int = 0) -> bpy.types.Scene:
    """The scene, with its passes on."""
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
    world = bpy.data.worlds.new("world")
    world.use_nodes = True
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    background.inputs["Color"].default_value = (0.25, 0.4, 0.7, 1)
    background.inputs["Strength"].default_value = 0.35
    world.lightgroup = "fill"
    scene.world = world

    data = bpy.data.cameras.new("camera")
    data.lens = 32
    camera = bpy.data.objects.new("camera", data)
    camera.location, aim = VIEWS[view]
    look = camera.constraints.new("TRACK_TO")
    look.target, look.track_axis, look.up_axis = bpy.data.objects.new("aim", None), "TRACK_NEGATIVE_Z", "UP_Y"
    look.target.location = aim
    for placed in (camera, look.target):
        scene.collection.objects.link(placed)
    scene.camera = camera
    return scene


def main() -> None:
    parser = argparse.ArgumentParser(description="Render a frame with every kind of light pass.")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--spp", type=even, default=64, metavar="N", help="of both halves together (default: 64)")
    parser.add_argument("--reference", type=int, default=2048, metavar="N", help="samples of the reference; 0: none")
    parser.add_argument("--size", type=size, default=(240, 160), metavar="WxH")
    parser.add_argument("--view", type=int, default=0, choices=range(len(VIEWS)), help="of the camera")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=0, help="of Cycles; 0: all")
    options = parser.parse_args(sys.argv[1:])
    scene = still_life(options.view)
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
