"""Render frames of few bright outliers, with references, with Blender as a Python module.

    .venv-blender/bin/python scripts/render/outliers.py -o FOLDER [--scenes lattice …] [--spp 16 64] [--reference 256]

Rooms made by code, in which little of a frame is most of its error: a small lamp behind a lattice, a bumpy metal that
glints, glass balls that throw caustics, panes of glass before patterned walls, two mirrors that face each other, a
night sky of stars over a lit floor; and one of nothing but matt walls, near-converged at many samples. Named as
``scripts/bench/quality.py`` reads them: ``SCENE_016spp_A.exr`` and ``_B.exr`` are halves, ``SCENE_ref_A.exr`` and
``_B.exr`` two independent references. Files that are there are left out.
"""

import argparse
import math
import os
import random
import sys
from collections.abc import Callable
from pathlib import Path

import bpy

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from blender_rooms import box, material, walled
from halves import even, seed_of, size
from render_blender import prepare, render_half


def ball(of: bpy.types.Material, at: tuple[float, float, float], radius: float) -> None:
    bpy.ops.mesh.primitive_uv_sphere_add(radius=radius, segments=64, ring_count=32, location=at)
    bpy.context.object.data.materials.append(of)
    bpy.ops.object.shade_smooth()


def lamp(at: tuple[float, float, float], side: float, watts: float) -> bpy.types.Object:
    """A square lamp that shines down."""
    bpy.ops.object.light_add(type="AREA", location=at)
    made = bpy.context.object
    made.data.size, made.data.energy = side, watts
    return made


def room(sky: float = 0.05) -> None:
    """The room and a camera; ``sky`` is the world's radiance."""
    scene = walled(sky)
    bpy.ops.object.camera_add(location=(0, -5, 1.8), rotation=(math.radians(84), 0, 0))
    bpy.context.object.data.lens = 28
    scene.camera = bpy.context.object


def lattice() -> None:
    room()
    bars = material("bars", (0.2, 0.15, 0.1))
    for i in range(-5, 6):
        box(bars, (0.3 * i, 2, 1.8), (0.12, 0.05, 3.6))
        box(bars, (0, 2, 1.8 + 0.3 * i), (3.6, 0.05, 0.12))
    lamp((0, 3, 2.2), 0.15, 200).rotation_euler = (math.radians(90), 0, 0)


def glints() -> None:
    room()
    metal = material("metal", (0.9, 0.8, 0.6), Metallic=1, Roughness=0.08)
    nodes, links = metal.node_tree.nodes, metal.node_tree.links
    noise, bump = nodes.new("ShaderNodeTexNoise"), nodes.new("ShaderNodeBump")
    noise.inputs["Scale"].default_value = 60
    links.new(noise.outputs[0], bump.inputs["Height"])
    links.new(bump.outputs["Normal"], nodes["Principled BSDF"].inputs["Normal"])
    ball(metal, (-1, 0.5, 0.9), 0.9)
    box(metal, (1.5, 1, 0.5), (1.6, 1.6, 1))
    lamp((1, -2, 3.6), 0.2, 150)


def caustics() -> None:
    room()
    glass = material("glass", (1, 1, 1), Roughness=0, IOR=1.5, Transmission_Weight=1)
    for at, radius in (((-1.2, 0.5, 0.7), 0.7), ((0.8, 0, 0.5), 0.5), ((2, 1.5, 0.9), 0.9)):
        ball(glass, at, radius)
    lamp((0, 1, 3.8), 0.6, 200)


def panes() -> None:
    room()
    glass = material("glass", (0.9, 1, 0.95), Roughness=0.05, IOR=1.5, Transmission_Weight=1)
    for i in range(4):
        box(glass, (1.6 * i - 2.4, 1.5 - 0.4 * i, 1.2), (1.3, 0.06, 2.4))
    lamp((0, -1, 3.6), 0.8, 200)


def mirrors() -> None:
    room()
    silver = material("silver", (0.95, 0.95, 0.95), Metallic=1, Roughness=0.0)
    box(silver, (-2.5, 1, 1.5), (0.05, 4, 2.5)).rotation_euler = (0, 0, math.radians(-15))
    box(silver, (2.5, 1, 1.5), (0.05, 4, 2.5)).rotation_euler = (0, 0, math.radians(15))
    box(material("red", (0.7, 0.1, 0.1), 6), (0.3, 1, 0.5), (1, 1, 1))
    lamp((0, 0, 3.6), 0.4, 150)


def stars() -> None:
    room(0.0)
    draw = random.Random(0)
    bpy.ops.object.select_all(action="DESELECT")
    for what in bpy.data.objects:
        if what.type == "MESH" and what.location.z > 1:
            what.scale.z, what.location.z = 1.0, 0.5  # low walls, under the sky
    for _ in range(150):
        star = material("star", (0, 0, 0), Emission_Strength=10 ** draw.uniform(0.5, 3))
        star.node_tree.nodes["Principled BSDF"].inputs["Emission Color"].default_value = (1, 0.9, 0.8, 1)
        ball(star, (draw.uniform(-25, 25), 30, draw.uniform(3, 25)), 0.03)
    lamp((-1, 0, 2.5), 0.5, 20)


def matt() -> None:
    room(0.5)
    box(material("green", (0.1, 0.5, 0.2), 6), (-1, 1, 0.6), (1.2, 1.2, 1.2))
    ball(material("grey", (0.5, 0.5, 0.5)), (1, 0.5, 0.8), 0.8)
    lamp((0, 0, 3.8), 3, 100)


SCENES: dict[str, Callable[[], None]] = {
    build.__name__: build for build in (lattice, glints, caustics, panes, mirrors, stars, matt)
}


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--scenes", nargs="*", choices=list(SCENES), default=list(SCENES), metavar="SCENE")
    parser.add_argument("--spp", type=even, nargs="*", default=[16, 64], help="of both halves together")
    parser.add_argument("--reference", type=int, default=256, metavar="N", help="samples of each reference; 0: none")
    parser.add_argument("--size", type=size, default=(240, 160), metavar="WxH")
    parser.add_argument("--filter", choices=("box", "keep"), default="box", help="of pixels; keep: Blender's own")
    parser.add_argument("--threads", type=int, default=0, help="0: all")
    return parser.parse_args()


def main() -> None:
    options = arguments()
    wanted = [(spp // 2, f"{spp:03d}spp") for spp in options.spp]
    if options.reference:
        wanted.append((options.reference, "ref"))
    for name in options.scenes:
        SCENES[name]()
        scene = bpy.context.scene
        if options.threads:
            scene.render.threads_mode, scene.render.threads = "FIXED", options.threads
        for samples, label in wanted:
            prepare(scene, samples, options.size, keep_filter=options.filter == "keep")
            for i, half in enumerate("AB"):
                path = options.output / f"{name}_{label}_{half}.exr"
                if not path.exists():
                    render_half(scene, 1, seed_of(samples, 1, "ab"[i]), path)
                    print(path, flush=True)


if __name__ == "__main__":
    main()
