"""Procedural rooms, so that five scenes don't become the world: a seed gives a room as a Mitsuba dictionary.

z points up. `mitsuba.set_variant` must have been called before :func:`room`.
"""

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np
from scene import bitmap, box, bumped, grid_mesh, lacquer, lathe, matt, metal, quad, rgb
from textures import Rng, blend, books, cloud, majolica, planks, print_page, wallpaper, weave

__all__ = ["room"]

Dict = dict[str, Any]

_METALS = ("Ag", "Al", "Au", "Cu", "Cr")


def room(seed: int, size: int = 128) -> Dict:
    """A room with lights, things in it and a camera in its middle, as `mitsuba.load_dict` takes it."""
    rng = np.random.default_rng((2022, seed))
    across, along, high = rng.uniform(3.5, 9), rng.uniform(3.5, 9), rng.uniform(2.4, 4.5)
    scene: Dict = {"type": "scene"}
    scene |= _walls(across, along, high, rng)
    scene |= _lamps(across, along, high, rng)
    scene |= _things(across, along, high, rng)
    eye = mi.ScalarTransform4f().look_at([0.0, -0.2 * along, 0.6 * high], [0.0, along, 0.5 * high], [0, 0, 1])
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    scene["sensor"] = {"type": "perspective", "fov": 60, "to_world": eye, "film": film}
    return scene


def _color(rng: Rng) -> tuple[float, float, float]:
    value = rng.uniform(0, 1, 3) ** rng.uniform(0.2, 2)
    red, green, blue = (float(v) for v in value / value.max() * rng.uniform(0.08, 0.85))
    return red, green, blue


def _tiles(rng: Rng) -> tuple[Any, Any]:
    y, x = np.indices((512, 512)) * int(rng.integers(4, 24)) // 512
    return blend(((x + y) % 2).astype(float), _color(rng), _color(rng)), None


def _clouds(rng: Rng) -> tuple[Any, Any]:
    field = cloud((512, 512), float(rng.uniform(0.3, 6)), float(rng.uniform(0.3, 1.8)), rng)
    mask = (field > rng.uniform(-1, 1)).astype(float) if rng.random() < 0.4 else 0.5 + 0.4 * field
    return blend(mask, _color(rng), _color(rng)), field


# Each makes a colour texture and a height map, or None where it has none.
_PATTERNS: tuple[Callable[[Rng], tuple[Any, Any]], ...] = (
    lambda rng: planks(rng, int(rng.integers(4, 12)), 512),
    lambda rng: wallpaper(rng, 256),
    lambda rng: (books(rng, int(rng.integers(2, 6)), 512), None),
    lambda rng: (print_page(rng), None),
    lambda rng: weave(rng, int(rng.integers(24, 96)), 384),
    lambda rng: (majolica(), None),
    _tiles,
    _clouds,
    _clouds,
)


def _texture(rng: Rng, repeat: tuple[float, float]) -> tuple[Dict, Any]:
    """A colour, plain or patterned, and a height map for it."""
    if rng.random() < 0.3:
        return rgb(*_color(rng)), None
    color, height = _PATTERNS[rng.integers(len(_PATTERNS))](rng)
    return bitmap(np.clip(color, 0, 0.95), repeat), height


def _material(rng: Rng, *, solid: bool = False) -> Dict:
    """A random surface; glass only for what is ``solid``."""
    side = float(np.exp(rng.uniform(0, np.log(6))))
    repeat = (side, side)
    color, height = _texture(rng, repeat)
    alpha = float(np.exp(rng.uniform(*np.log([0.03, 0.4]))))
    match int(rng.integers(10 if solid else 8)):
        case 0 | 1 | 2 | 3:
            material = matt(color)
        case 4 | 5 | 6:
            material = lacquer(color, alpha)
        case 7:
            return metal(str(rng.choice(_METALS)), alpha)
        case 8:
            return {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
        case _:
            return {"type": "conductor", "material": str(rng.choice(_METALS))}
    if height is not None and rng.random() < 0.5:
        return bumped(material, height, float(rng.uniform(0.002, 0.02)), repeat)
    return material


def _walls(across: float, along: float, high: float, rng: Rng) -> Dict:
    """Six sides that face inwards; where there is a window, the left one is four strips around it."""
    x, y = across / 2, along / 2
    sides = {
        "floor": quad("floor", (-x, -y, 0), (across, 0, 0), (0, along, 0), _material(rng)),
        "ceiling": quad("ceiling", (-x, y, high), (across, 0, 0), (0, -along, 0), matt(rgb(*_color(rng)))),
        "back": quad("back", (-x, y, 0), (across, 0, 0), (0, 0, high), _material(rng)),
        "front": quad("front", (x, -y, 0), (-across, 0, 0), (0, 0, high), _material(rng)),
        "right": quad("right", (x, y, 0), (0, -along, 0), (0, 0, high), _material(rng)),
    }
    left = _material(rng)
    if rng.random() < 0.4:
        return sides | {"left": quad("left", (-x, -y, 0), (0, along, 0), (0, 0, high), left)}
    low, top = 0.3 * high, 0.85 * high
    near, far = -y * rng.uniform(0.2, 0.8), y * rng.uniform(0.2, 0.8)
    strips = [(-y, y, 0, low), (-y, y, top, high), (-y, near, low, top), (far, y, low, top)]
    for number, (first, last, bottom, up) in enumerate(strips):
        sides[f"left_{number}"] = box((-x - 0.2, first, bottom), (-x, last, up), left)
    for number, bar in enumerate(np.linspace(near, far, int(rng.integers(2, 9)))):
        grey = matt(rgb(0.3, 0.3, 0.3))
        sides[f"bar_{number}"] = box((-x - 0.15, bar - 0.02, low), (-x - 0.1, bar + 0.02, top), grey)
    sun = rng.normal(0, 0.3, 3) + np.array([1.0, 0.0, -0.6])
    sides["sun"] = {"type": "directional", "direction": [float(v) for v in sun],
                    "irradiance": rgb(*(rng.uniform(2, 30) * np.array([1.0, 0.9, 0.75])))}  # fmt: skip
    sides["sky"] = {"type": "constant", "radiance": rgb(*(rng.uniform(0.5, 3) * np.array([0.7, 0.85, 1.0])))}
    return sides


def _lamps(across: float, along: float, high: float, rng: Rng) -> Dict:
    """Panels under the ceiling and small bright bulbs, whose light through glass makes fireflies."""
    lamps: Dict = {}
    for number in range(int(rng.integers(1, 3))):
        side = float(rng.uniform(0.15, 1.0))
        place = mi.ScalarTransform4f().translate(
            [float(rng.uniform(-0.3, 0.3) * across), float(rng.uniform(-0.3, 0.3) * along), high - 0.05]
        )
        light = {"type": "area", "radiance": rgb(*(np.exp(rng.normal(1.5, 0.7)) / side**2 * rng.uniform(0.7, 1, 3)))}
        lamps[f"panel_{number}"] = {"type": "rectangle", "to_world": place.rotate([1, 0, 0], 180).scale(side / 2),
                                    "emitter": light}  # fmt: skip
    for number in range(int(rng.integers(0, 3))):
        centre = [float(rng.uniform(-0.4, 0.4) * across), float(rng.uniform(-0.4, 0.4) * along), 0.7 * high]
        radius = float(rng.uniform(0.03, 0.12))
        glow = rgb(*(np.exp(rng.normal(0, 0.7)) / radius**2 * np.array([1.0, 0.75, 0.45])))
        lamps[f"bulb_{number}"] = {"type": "sphere", "center": centre, "radius": radius,
                                   "emitter": {"type": "area", "radiance": glow}}  # fmt: skip
    return lamps


def _things(across: float, along: float, high: float, rng: Rng) -> Dict:
    """Tables, boxes, balls, vases and cloths about the room."""
    things: Dict = {}
    for number in range(int(rng.integers(14, 26))):
        x, y = float(rng.uniform(-0.45, 0.45) * across), float(rng.uniform(-0.45, 0.45) * along)
        z = 0.0 if rng.random() < 0.5 else float(rng.uniform(0.2, 0.6) * high)
        width = float(np.exp(rng.uniform(*np.log([0.1, 0.7]))))
        name = f"thing_{number}"
        match int(rng.integers(5)):
            case 0:
                ball = mi.ScalarTransform4f().translate([x, y, z + width]).rotate([0, 0, 1], float(rng.uniform(0, 360)))
                things[name] = {"type": "sphere", "to_world": ball.scale(width / 2), "bsdf": _material(rng, solid=True)}
            case 1 | 2:
                turn = (
                    mi.ScalarTransform4f().translate([x, y, z + width / 2]).rotate([0, 0, 1], float(rng.uniform(0, 90)))
                )
                shape = [float(v) for v in width * rng.uniform(0.2, 1.2, 3)]
                things[name] = {"type": "cube", "to_world": turn.scale(shape), "bsdf": _material(rng)}
            case 3:
                heights = np.linspace(0, 2 * width, 8)
                profile = [
                    (0.01, 0.0),
                    *((float(r), float(h)) for r, h in zip(width * rng.uniform(0.1, 0.8, 8), heights, strict=True)),
                ]
                things[name] = lathe(name, profile, (x, y, z), _material(rng, solid=True))
            case _:
                u, v = np.meshgrid(*2 * [np.linspace(-1, 1, 40)])
                waves = 0.1 * width * cloud((40, 40), 1, 2.0, rng)
                points = np.stack([x + width * u, y + width * v, z + 0.3 * width + waves], -1)
                things[name] = grid_mesh(name, points, _material(rng))
    return things
