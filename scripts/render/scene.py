"""The scene of the packaged frame: a still life by a window, made entirely by code.

Nothing is loaded: every texture is a NumPy array (`textures.py`) from one seeded generator, every mesh a
parametric grid.
One unit is ten centimetres, z points up, the table top is z = 0 and the camera looks along +y.

The light is chosen for what denoisers lose, that is detail which neither albedo nor normal shows: the sun through
leaded panes, the pattern that a pierced lantern throws, a mirror and polished metal that reflect the open book and
the shelves behind the camera. The lantern's bulb is small, so metal, glaze and the glass carafe make a few fireflies.

`mitsuba.set_variant` must have been called before `still_life`.
"""

from __future__ import annotations  # Mitsuba's types exist only after set_variant

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from textures import Array, Rng, blend, books, cloud, majolica, planks, print_page, wallpaper, weave

Dict = dict[str, Any]

ROOM = {"left": -12.0, "right": 12.0, "back": 4.0, "front": -24.0, "floor": -8.0, "ceiling": 17.0}
SUN = (10.0, 2.4, -6.6)  # the direction in which the sun's light travels
WINDOW_Y, WINDOW_Z = (-8.2, 1.2), (3.6, 12.0)  # the leaded window beside the table
CAMERA = (0.2, -13.0, 8.6)
LANTERN = (3.65, 1.3, 2.0)  # centre of the pierced sphere
TEXTURE_SEED = 7


# ---------------------------------------------------------------- from NumPy to Mitsuba


def bitmap(image: Array, repeat: tuple[float, float] = (1, 1)) -> Dict:
    """Texture of linear values; row 0 is v = 0."""
    pixels = np.flipud(image if image.ndim == 3 else image[..., None]).astype(np.float32)
    scale = mi.ScalarTransform3f().scale(repeat)
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(pixels)), "raw": True, "to_uv": scale}


def bumped(bsdf: Dict, height: Array, depth: float, repeat: tuple[float, float] = (1, 1)) -> Dict:
    """`bsdf` with a bump map; outermost, since only then does Mitsuba's `sh_normal` show the bump."""
    return {"type": "bumpmap", "arbitrary": bitmap(height, repeat), "scale": depth, "bsdf": bsdf}


def lacquer(colour: Dict, alpha: float) -> Dict:
    """Coloured ground under a clear glossy coat of roughness `alpha`."""
    return {"type": "roughplastic", "diffuse_reflectance": colour, "distribution": "ggx", "alpha": alpha}


def metal(name: str, alpha: float) -> Dict:
    """Two-sided rough metal; `name` as in Mitsuba's table of conductors."""
    bsdf = {"type": "roughconductor", "material": name, "alpha": alpha, "distribution": "ggx"}
    return {"type": "twosided", "bsdf": bsdf}


def matt(colour: Dict) -> Dict:
    """Two-sided diffuse surface."""
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": colour}}


def rgb(*value: float) -> Dict:
    """Colour of three linear values."""
    return {"type": "rgb", "value": list(value)}


def grid_mesh(name: str, points: Array, bsdf: Dict, keep: NDArray[np.bool_] | None = None) -> mi.Mesh:
    """Smooth mesh through `points` (rows, columns, 3), u along columns and v along rows, facing columns × rows.

    `keep` (rows − 1, columns − 1) leaves out the cells that are False.
    """
    rows, columns, _ = points.shape
    normals = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True) + 1e-12
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1))[... if keep is None else keep].ravel()
    below, above = np.stack([corner, corner + 1], -1), np.stack([corner + columns, corner + columns + 1], -1)
    faces = np.concatenate([np.column_stack([below, above[:, 1]]), np.column_stack([below[:, 0], above[:, ::-1]])])
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh(
        name, rows * columns, len(faces), has_vertex_normals=True, has_vertex_texcoords=True, props=properties
    )
    buffers = mi.traverse(mesh)
    filled = {
        "vertex_positions": points,
        "vertex_normals": normals,
        "vertex_texcoords": np.stack([u, v], -1),
        "faces": faces.astype(np.uint32),
    }
    for buffer, values in filled.items():
        buffers[buffer] = type(buffers[buffer])(values.ravel())  # mi.Float of a scalar variant is one number
    buffers.update()
    return mesh


def quad(name: str, corner: tuple[float, ...], across: tuple[float, ...], up: tuple[float, ...], bsdf: Dict) -> mi.Mesh:
    """Parallelogram that faces across × up, u along `across` and v along `up`."""
    s, t = np.array([0.0, 1.0])[None, :, None], np.array([0.0, 1.0])[:, None, None]
    return grid_mesh(name, np.array(corner) + s * np.array(across) + t * np.array(up), bsdf)


def box(low: tuple[float, float, float], high: tuple[float, float, float], bsdf: Dict) -> Dict:
    """Axis-parallel box between two corners."""
    low_, high_ = np.array(low), np.array(high)
    place = mi.ScalarTransform4f().translate(list((low_ + high_) / 2)).scale(list((high_ - low_) / 2))
    return {"type": "cube", "to_world": place, "bsdf": bsdf}


def lathe(name: str, profile: list[tuple[float, float]], foot: tuple[float, float, float], bsdf: Dict) -> mi.Mesh:
    """Surface of revolution about z: the (radius, height) polygon, rounded off by corner cutting, stood on `foot`."""
    line = np.array(profile)
    for _ in range(3):
        cut = np.stack([0.75 * line[:-1] + 0.25 * line[1:], 0.25 * line[:-1] + 0.75 * line[1:]], 1).reshape(-1, 2)
        line = np.concatenate([line[:1], cut, line[-1:]])
    angle = np.linspace(0, 2 * np.pi, 145)
    radius = np.maximum(line[:, :1], 1e-3)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), line[:, 1:] + 0 * angle], -1)
    return grid_mesh(name, points + np.array(foot), bsdf)


# ---------------------------------------------------------------- the objects


def table(rng: Rng) -> Dict:
    """Lacquered boards, bumped by their grain, glossy enough to mirror what stands on them."""
    colour, height = planks(rng)
    top = bumped(lacquer(bitmap(colour), 0.09), height, 0.006)
    return {"table": quad("table", (-9, -7, 0), (18, 0, 0), (0, 11, 0), top),
            "table_edge": box((-9, -7, -0.5), (9, 4, -0.01), matt(rgb(0.15, 0.07, 0.03)))}  # fmt: skip


def room(rng: Rng) -> Dict:
    """Papered back wall, plain walls with a hole for the window, and books behind the camera."""
    colour, height = wallpaper(rng)
    paper = bumped(lacquer(bitmap(colour, (8, 8)), 0.25), height, 0.012, (8, 8))
    left, right, back, front = ROOM["left"], ROOM["right"], ROOM["back"], ROOM["front"]
    floor, ceiling = ROOM["floor"], ROOM["ceiling"]
    plaster = matt(rgb(0.50, 0.45, 0.38))
    across, along, up = (right - left, 0, 0), (0, back - front, 0), (0, 0, ceiling - floor)
    (y0, y1), (z0, z1) = WINDOW_Y, WINDOW_Z
    return {
        "paper": quad("paper", (left, back, floor), across, up, paper),
        "books": quad("books", (right, front, floor), (left - right, 0, 0), up, matt(bitmap(books(rng)))),
        "right": quad("right", (right, back, floor), (0, front - back, 0), up, plaster),
        "floor": quad("floor", (left, front, floor), across, along, matt(rgb(0.12, 0.07, 0.04))),
        "ceiling": quad("ceiling", (left, front, ceiling), across, along, plaster),
        "left_below": box((left - 0.6, front, floor), (left, back, z0), plaster),
        "left_above": box((left - 0.6, front, z1), (left, back, ceiling), plaster),
        "left_near": box((left - 0.6, front, z0), (left, y0, z1), plaster),
        "left_far": box((left - 0.6, y1, z0), (left, back, z1), plaster),
    }


def leaded_panes() -> Dict:
    """Diamond lattice of thin bars in the window; its shadow is the finest detail on the table."""
    objects: Dict = {}
    (y0, y1), (z0, z1) = WINDOW_Y, WINDOW_Z
    lead = matt(rgb(0.08, 0.08, 0.09))
    for index, offset in enumerate(np.arange(y0 - (z1 - z0), y1 + (z1 - z0), 0.95)):
        for side in (-1, 1):
            place = (mi.ScalarTransform4f().translate([ROOM["left"] - 0.3, float(offset), (z0 + z1) / 2])
                     .rotate([1, 0, 0], side * 38).scale([0.05, 0.065, float(z1 - z0)]))  # fmt: skip
            objects[f"lead_{index}_{side}"] = {"type": "cube", "to_world": place, "bsdf": lead}
    return objects


def daylight() -> Dict:
    """Sun through the leaded panes, and a tall bright window with glazing bars further along the wall.

    The sun has no extent: specular paths never meet it, so it makes no fireflies. The tall window is itself the
    emitter, so that most of the light is cheap to sample.
    """
    left, y, z = ROOM["left"], (-16.0, -7.0), (1.5, 12.5)
    middle = [left + 0.05, sum(y) / 2, sum(z) / 2]
    half = [(z[1] - z[0]) / 2, (y[1] - y[0]) / 2, 1]
    pane = mi.ScalarTransform4f().translate(middle).rotate([0, 1, 0], 90).scale(half)
    sky = {"type": "area", "radiance": rgb(36, 43, 51), "sampling_weight": 2.0}
    bar = matt(rgb(0.05, 0.04, 0.03))
    return {
        "sun": {"type": "directional", "direction": list(SUN), "irradiance": rgb(27, 22.5, 16), "sampling_weight": 2.0},
        "pane": {"type": "rectangle", "to_world": pane, "emitter": sky},
        "bar_upright": box((left, middle[1] - 0.2, z[0]), (left + 0.3, middle[1] + 0.2, z[1]), bar),
        "bar_low": box((left, y[0], 4.9), (left + 0.3, y[1], 5.3), bar),
        "bar_high": box((left, y[0], 8.7), (left + 0.3, y[1], 9.1), bar),
    }


def lantern() -> Dict:
    """Pierced copper globe on a foot, with a small bulb in it whose light falls through the holes."""
    latitude = np.linspace(-1.32, 1.32, 361)[:, None]
    longitude = np.linspace(0, 2 * np.pi, 961)[None]
    globe = np.stack([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude),
                      np.sin(latitude) + 0 * longitude], -1)  # fmt: skip
    y, x = (latitude[1:] + latitude[:-1]) / 2, (longitude[:, 1:] + longitude[:, :-1]) / 2
    diamonds = np.abs(np.sin(11 * x)) + np.abs(np.sin(9 * y)) < 0.62
    dots = np.cos(22 * x) * np.cos(18 * y) > 0.8
    to_camera = (np.array(CAMERA) - LANTERN) / np.linalg.norm(np.array(CAMERA) - LANTERN)
    faces_camera = globe[1:, 1:] @ to_camera > np.cos(0.1)  # closed there: the bare bulb would outshine the picture
    holes = (diamonds | dots) & (np.abs(y) < 1.1) & ~faces_camera
    foot = (LANTERN[0], LANTERN[1], 0.0)
    copper = metal("Cu", 0.3)
    pierced = {
        "type": "twosided",
        "outside": copper["bsdf"],
        "inside": {"type": "diffuse", "reflectance": rgb(0.3, 0.2, 0.1)},
    }
    base = [(1.0, 0.0), (0.95, 0.2), (0.9, 0.35), (0.35, 0.65), (0.3, 0.9)]
    cap = [(0.45, 3.25), (0.3, 3.5), (0.08, 3.6), (0.08, 3.9), (0.01, 3.95)]
    light = {"type": "area", "radiance": rgb(8000, 4600, 1900)}
    return {
        "lantern_globe": grid_mesh("lantern_globe", np.array(LANTERN) + 1.35 * globe, pierced, ~holes),
        "lantern_base": lathe("lantern_base", base, foot, copper),
        "lantern_cap": lathe("lantern_cap", cap, foot, copper),
        "bulb": {"type": "sphere", "center": list(LANTERN), "radius": 0.09, "emitter": light},
    }


def mirror() -> Dict:
    """Round mirror on the wall that shows the open book and the shelves behind the camera, in a gilded frame."""
    centre = (-2.0, ROOM["back"] - 0.12, 3.1)
    turn = mi.ScalarTransform4f().translate(list(centre)).rotate([1, 0, 0], 90)
    ring = np.linspace(0, 2 * np.pi, 145)
    tube = np.linspace(0, 2 * np.pi, 33)[:, None]
    radius = 1.6 + (0.17 + 0.02 * np.cos(48 * ring)) * np.cos(tube)
    frame = np.stack([radius * np.cos(ring), 0.17 * np.sin(tube) + 0 * ring, radius * np.sin(ring)], -1)
    return {
        "mirror": {"type": "disk", "to_world": turn.scale(1.6), "bsdf": {"type": "conductor", "material": "Ag"}},
        "mirror_frame": grid_mesh("mirror_frame", np.array(centre) + frame, metal("Au", 0.2)),
    }


def carafe() -> mi.Mesh:
    """Thick glass carafe; what the bulb sends through it arrives as a caustic."""
    outer = [(0.01, 0.0), (0.75, 0.0), (0.95, 0.15), (1.05, 0.9), (0.85, 1.7), (0.35, 2.2), (0.3, 2.9), (0.5, 3.3)]
    inner = [(0.44, 3.3), (0.24, 2.9), (0.28, 2.15), (0.77, 1.65), (0.96, 0.9), (0.86, 0.3), (0.6, 0.18), (0.01, 0.18)]
    return lathe("carafe", outer + inner, (-3.5, 0.2, 0.01), {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0})


def bowl() -> mi.Mesh:
    """Glazed majolica bowl."""
    profile = [(0.01, 0.1), (0.7, 0.1), (0.7, 0.0), (0.85, 0.0), (0.8, 0.18), (1.3, 0.45), (1.75, 1.0), (1.85, 1.3),
               (1.75, 1.32), (1.6, 1.0), (1.2, 0.55), (0.01, 0.35)]  # fmt: skip
    return lathe("bowl", profile, (0.2, 0.4, 0.01), lacquer(bitmap(majolica()), 0.1))


def oranges(rng: Rng) -> Dict:
    """Fruit with dimpled peel in the bowl, and one on the table."""
    dimples = -np.clip(cloud((256, 512), 1, 0.25, rng), 0.5, 3)
    objects: Dict = {}
    heap = [(-0.5, 0.1, 1.15), (0.75, 0.0, 1.15), (0.2, 1.1, 1.2), (0.15, 0.35, 1.95)]
    for index, centre in enumerate([*heap, (1.75, -2.0, 0.68)]):
        peel = lacquer(rgb(0.85, 0.22 + 0.06 * float(rng.random()), 0.02), 0.22)
        turn = ([0.6, 0.0, 0.8], float(rng.uniform(0, 360)))
        tilt = mi.ScalarTransform4f().translate(list(centre)).rotate(*turn).scale(0.68)
        objects[f"orange_{index}"] = {"type": "sphere", "to_world": tilt, "bsdf": bumped(peel, dimples, 0.03)}
    return objects


def open_book(rng: Rng) -> Dict:
    """Two printed pages that swell from the spine, on a dark cover."""
    page = np.concatenate([print_page(rng), print_page(rng)], axis=1)
    s, t = np.linspace(-1, 1, 97)[None], np.linspace(0, 1, 3)[:, None]
    angle = np.deg2rad(14)

    def place(x: Array, y: Array, z: Array) -> Array:
        turned = np.stack([x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle), z], -1)
        return np.asarray(turned + np.array([-2.2, -4.0, 0.02]))

    def swell(s: Array) -> Array:
        return np.asarray(0.1 + 0.75 * np.sqrt(np.abs(s)) * (1.05 - np.abs(s)) * 0.7)

    paper = blend((cloud((64, 4), 1, 0, rng) > 0).astype(float), (0.2, 0.18, 0.15), (0.68, 0.63, 0.52))
    front = np.array([0.02, 1.0])[:, None]
    ends, sides = np.array([[-2.0, 2.0]] * 2), np.array([[-0.1] * 2, [2.6] * 2])
    return {
        "pages": grid_mesh("pages", place(1.9 * s + 0 * t, 2.5 * t + 0 * s, swell(s) + 0 * t), matt(bitmap(page))),
        "edges": grid_mesh("edges", place(1.9 * s + 0 * front, 0 * s * front, swell(s) * front), matt(bitmap(paper))),
        "cover": grid_mesh("cover", place(ends, sides, 0 * ends), matt(rgb(0.2, 0.02, 0.03))),
    }


def runner(rng: Rng) -> mi.Mesh:
    """Woven cloth under the bowl."""
    colour, height = weave(rng)
    cloth = bumped(matt(bitmap(colour)), height, 0.03)
    return quad("runner", (-2.7, -2.9, 0.012), (6.2, 0.3, 0), (-0.25, 4.9, 0), cloth)


def polished_balls() -> Dict:
    """One ball of silver and one of brushed gold: they show the whole room once more."""
    return {
        "silver": {"type": "sphere", "center": [3.3, -2.5, 0.7], "radius": 0.7, "bsdf": metal("Ag", 0.06)},
        "gold": {"type": "sphere", "center": [2.35, -3.6, 0.42], "radius": 0.42, "bsdf": metal("Au", 0.2)},
    }


def necklace() -> Dict:
    """String of silver and coral beads on the bare wood in front."""
    coral, silver = lacquer(rgb(0.55, 0.05, 0.04), 0.06), metal("Ag", 0.08)
    angle = np.linspace(-0.2, 1.9 * np.pi, 46)
    x = 1.2 + 0.95 * np.cos(angle) * (1 + 0.15 * np.sin(3 * angle))
    y = -4.5 + 0.5 * np.sin(angle) + 0.1 * np.cos(2 * angle)
    return {f"bead_{index}": {"type": "sphere", "center": [float(x[index]), float(y[index]), 0.08], "radius": 0.08,
                              "bsdf": coral if index % 3 else silver}
            for index in range(len(angle))}  # fmt: skip


def camera(size: int) -> Dict:
    """Square perspective view; box filter, so that the noise of neighbours is independent."""
    return {
        "type": "perspective",
        "fov": 36,
        "to_world": mi.ScalarTransform4f().look_at(list(CAMERA), [0.0, -0.6, 1.0], [0, 0, 1]),
        "film": {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb", "rfilter": {"type": "box"}},
        "sampler": {"type": "independent"},
    }


def still_life(size: int) -> Dict:
    """The whole scene as a dictionary for `mitsuba.load_dict`, without an integrator; `size` in pixels."""
    rng = np.random.default_rng(TEXTURE_SEED)
    makers: list[Callable[[Rng], Dict]] = [table, room, oranges, open_book]
    scene: Dict = {"type": "scene", "sensor": camera(size)}
    for maker in makers:
        scene |= maker(rng)
    scene |= {"runner": runner(rng), "carafe": carafe(), "bowl": bowl()}
    return scene | leaded_panes() | daylight() | lantern() | mirror() | polished_balls() | necklace()
