"""A room for Blender, made by code: three patterned walls and a floor, for scripts that furnish it."""

import bpy


def material(name: str, colour: tuple[float, float, float], pattern: float = 0, **inputs: float) -> bpy.types.Material:
    """A principled material; ``pattern`` is the scale of a checkerboard in it."""
    made = bpy.data.materials.new(name)
    if bpy.app.version < (5, 0, 0):
        made.use_nodes = True
    nodes, links = made.node_tree.nodes, made.node_tree.links
    shader = nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (*colour, 1)
    for key, value in inputs.items():
        shader.inputs[key.replace("_", " ")].default_value = value
    if pattern:
        checks, place = nodes.new("ShaderNodeTexChecker"), nodes.new("ShaderNodeTexCoord")
        checks.inputs["Scale"].default_value = pattern
        checks.inputs["Color1"].default_value = (*colour, 1)
        checks.inputs["Color2"].default_value = (*(0.4 * c for c in colour), 1)
        links.new(place.outputs["Object"], checks.inputs["Vector"])
        links.new(checks.outputs["Color"], shader.inputs["Base Color"])
    return made


def box(of: bpy.types.Material, at: tuple[float, float, float], scale: tuple[float, float, float]) -> bpy.types.Object:
    """A cuboid of these lengths about a place."""
    bpy.ops.mesh.primitive_cube_add(size=1, location=at)
    made = bpy.context.object
    made.scale = scale
    made.data.materials.append(of)
    return made


def walled(sky: float, floor_roughness: float = 0.5) -> bpy.types.Scene:
    """Replace what Blender holds by the room, empty, dark but for the sky, and rendered without clamping."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.sample_clamp_direct = scene.cycles.sample_clamp_indirect = 0.0
    scene.world = bpy.data.worlds.new("world")
    if bpy.app.version < (5, 0, 0):
        scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs[1].default_value = sky
    wall = material("wall", (0.7, 0.6, 0.5), 1.5)
    box(material("floor", (0.3, 0.35, 0.4), 2.5, Roughness=floor_roughness), (0, 0, -0.05), (8, 8, 0.1))
    box(wall, (0, 4, 2), (8, 0.1, 4))
    box(wall, (-4, 0, 2), (0.1, 8, 4))
    box(wall, (4, 0, 2), (0.1, 8, 4))
    return scene
