"""Render a shot that tempts a temporal denoiser to ghost, with references, with Blender as a Python module.

    .venv-blender/bin/python scripts/render/ghosts.py -o FOLDER [--frames 1-12] [--spp 32] [--reference 256]

A room with patterned walls, made by code: a camera that pans, a box that slides and one that turns and throws a shadow,
a plane mirror and a glass ball (what they show moves otherwise than they do), and a lamp that is dimmed from frame 6 to
frame 7 to a third. Named as ``scripts/bench/shot.py`` reads them: ``ghosts_a.####.exr`` and ``ghosts_b.####.exr`` (half
of the samples each, with the pass Vector) and two independent references, ``ghosts_ref_a.####.exr`` and
``ghosts_ref_b.####.exr``. Files that are there are left out.
"""

import argparse
import math
import os
import sys
from pathlib import Path

import bpy

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from blender_rooms import box, material, walled
from halves import even, parse_frames, seed_of, size
from render_blender import prepare, render_half

LAST, DIMMED = 12, 7
NAME = "ghosts"


def moved(what: bpy.types.ID, path: str, values: dict[int, object]) -> None:
    """Keyframes: frame → value; Blender's own interpolation between them."""
    for frame, value in values.items():
        setattr(what, path, value)
        what.keyframe_insert(data_path=path, frame=frame)


def build() -> None:
    """Replace what Blender holds by the scene; the same one every time."""
    scene = walled(0.1, floor_roughness=0.2)
    mirror = box(material("silver", (0.95, 0.95, 0.95), Metallic=1, Roughness=0.0), (-2, 3, 1.4), (2.2, 0.05, 2.2))
    mirror.rotation_euler = (0, 0, math.radians(25))
    bpy.ops.mesh.primitive_uv_sphere_add(radius=0.6, segments=48, ring_count=24, location=(0.6, 0.8, 0.6))
    bpy.context.object.data.materials.append(material("glass", (1, 1, 1), Roughness=0, IOR=1.5, Transmission_Weight=1))
    bpy.ops.object.shade_smooth()
    slides = box(material("red", (0.7, 0.1, 0.1), 6), (0, 0, 0.4), (0.8, 0.8, 0.8))
    moved(slides, "location", {1: (-1.8, -0.5, 0.4), LAST: (0.2, 0.3, 0.4)})
    turns = box(material("green", (0.1, 0.5, 0.2), 6), (2.2, 1.5, 0.9), (0.5, 1.6, 1.8))
    moved(turns, "rotation_euler", {1: (0, 0, 0), LAST: (0, 0, math.radians(70))})
    bpy.ops.object.light_add(type="AREA", location=(1.5, -1, 3.6))
    lamp = bpy.context.object.data
    lamp.size = 0.5
    moved(lamp, "energy", {DIMMED - 1: 150.0, DIMMED: 50.0})
    bpy.ops.object.camera_add(location=(0, -5, 1.8))
    camera = bpy.context.object
    camera.data.lens = 28
    scene.camera = camera
    moved(camera, "rotation_euler", {1: (math.radians(84), 0, math.radians(3)), LAST: (math.radians(84), 0, -0.05)})


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--frames", type=parse_frames, default=list(range(1, LAST + 1)), metavar="RANGE")
    parser.add_argument("--spp", type=even, default=32, help="of both halves together")
    parser.add_argument("--reference", type=int, default=256, metavar="N", help="samples of each reference; 0: none")
    parser.add_argument("--size", type=size, default=(192, 112), metavar="WxH")
    parser.add_argument("--threads", type=int, default=0, help="0: all")
    return parser.parse_args()


def main() -> None:
    options = arguments()
    build()
    scene = bpy.context.scene
    if options.threads:
        scene.render.threads_mode, scene.render.threads = "FIXED", options.threads
    # references last: what needs none can be looked at before
    for samples, label in ((options.spp // 2, ""), (options.reference, "ref_")):
        prepare(scene, samples, options.size, shot=True)
        for frame in options.frames if samples else ():
            for half in "ab":
                path = options.output / f"{NAME}_{label}{half}.{frame:04d}.exr"
                if not path.exists():
                    render_half(scene, frame, seed_of(samples, frame, half), path)
                    print(path, flush=True)


if __name__ == "__main__":
    main()
