"""Build the small Blender scene of scripts/openjd/README.md: a textured room corner and a moving camera, 24 frames.

    python scripts/blender/build_shot.py shot.blend

Runs with Blender as a Python module (`pip install bpy`) or as
`blender -b --python scripts/blender/build_shot.py -- FILE`; everything is procedural.
Noisy because of a small lamp behind a lattice and glossy spheres, detailed because of bricks, checks and bump; 240×135
pixels, 32 samples.
"""

import argparse
import math
import sys
from pathlib import Path
from typing import Any

import bpy

FRAMES = 24


def material(name: str, texture: str, colors: tuple[tuple[float, ...], ...], scale: float, **surface: float) -> Any:
    """A material whose colour and bump come from a procedural texture."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    nodes, links = made.node_tree.nodes, made.node_tree.links
    shader = nodes["Principled BSDF"]
    for socket, value in surface.items():
        shader.inputs[socket].default_value = value
    image = nodes.new(f"ShaderNodeTex{texture}")
    image.inputs["Scale"].default_value = scale
    sockets = [socket for socket in image.inputs if socket.type == "RGBA"]
    for socket, color in zip(sockets, colors, strict=True):
        socket.default_value = (*color, 1)
    place = nodes.new("ShaderNodeTexCoord")
    bump = nodes.new("ShaderNodeBump")
    bump.inputs["Strength"].default_value = 0.3
    links.new(place.outputs["Object"], image.inputs["Vector"])
    links.new(image.outputs["Color"], shader.inputs["Base Color"])
    links.new(image.outputs["Color"], bump.inputs["Height"])
    links.new(bump.outputs["Normal"], shader.inputs["Normal"])
    return made


def plane(location: tuple[float, ...], rotation: tuple[float, ...], surface: Any) -> None:
    bpy.ops.mesh.primitive_plane_add(size=8, location=location, rotation=rotation)
    bpy.context.object.data.materials.append(surface)


def furnish() -> None:
    """Floor, two walls, spheres and boxes."""
    checks = material("checks", "Checker", ((0.7, 0.65, 0.55), (0.12, 0.1, 0.2)), 3, Roughness=0.4)
    bricks = material("bricks", "Brick", ((0.5, 0.14, 0.08), (0.32, 0.1, 0.07), (0.6, 0.58, 0.5)), 2.5, Roughness=0.9)
    tiles = material("tiles", "Brick", ((0.2, 0.4, 0.5), (0.25, 0.5, 0.45), (0.8, 0.8, 0.8)), 8, Roughness=0.15)
    metal = material("metal", "Checker", ((0.9, 0.7, 0.4), (0.85, 0.8, 0.75)), 10, Metallic=1, Roughness=0.25)
    plane((0, 0, 0), (0, 0, 0), checks)
    plane((0, 4, 4), (math.pi / 2, 0, 0), bricks)
    plane((-4, 0, 4), (math.pi / 2, 0, math.pi / 2), tiles)
    for number in range(5):
        angle = number * 1.3
        spot = (2 * math.cos(angle), 2 * math.sin(angle), 0.5)
        if number % 2:
            bpy.ops.mesh.primitive_cube_add(size=1, location=spot, rotation=(0, 0, angle))
        else:
            bpy.ops.mesh.primitive_uv_sphere_add(radius=0.5, location=spot, segments=48, ring_count=24)
            bpy.ops.object.shade_smooth()
        bpy.context.object.data.materials.append((metal, bricks, tiles, checks, metal)[number])
    for number in range(7):
        bpy.ops.mesh.primitive_cube_add(location=(2.5, number - 3, 4), scale=(0.05, 0.35, 1.5))


def light(scene: Any) -> None:
    """A small lamp behind the lattice, a faint sky."""
    lamp = bpy.data.lights.new("lamp", "AREA")
    lamp.energy, lamp.size = 900, 0.4
    holder = bpy.data.objects.new("lamp", lamp)
    holder.location, holder.rotation_euler = (5, 0, 5.5), (0, math.radians(50), 0)
    scene.collection.objects.link(holder)
    scene.world = bpy.data.worlds.new("sky")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.1, 0.13, 0.2, 1)


def camera(scene: Any) -> None:
    """A camera on an arc around an empty object, one keyframe at either end."""
    eye = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
    target = bpy.data.objects.new("target", None)
    target.location = (-0.5, 0.8, 1)
    for thing in (eye, target):
        scene.collection.objects.link(thing)
    eye.constraints.new("TRACK_TO").target = target
    for frame, spot in ((1, (2.5, -7.5, 3)), (FRAMES, (5.5, -5.5, 2.4))):
        eye.location = spot
        eye.keyframe_insert("location", frame=frame)
    scene.camera = eye
    scene.frame_end = FRAMES


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", metavar="FILE", type=Path, help="the scene to write, such as shot.blend")
    own = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    path = parser.parse_args(own).file.resolve()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.max_bounces = 32, 6
    scene.render.resolution_x, scene.render.resolution_y = 240, 135
    furnish()
    light(scene)
    camera(scene)
    path.parent.mkdir(parents=True, exist_ok=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(path))


if __name__ == "__main__":
    main()
