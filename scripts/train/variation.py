"""Random cameras, materials and lights in a loaded Mitsuba scene. Everything is drawn from a generator passed in.

`mitsuba.set_variant` must have been called before anything of it is.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

__all__ = ["Camera", "Variation", "near", "original_camera", "random_camera", "sensor"]

Rng = np.random.Generator
Vector = NDArray[np.float64]

_RAYS = 256
_STEPS = 3  # of the walk from the scene's own camera
_ROOM = 100.0  # median distances beyond which a ray has left the room
_NEAREST = 0.04  # of the room's size: free space around a camera
_KEPT_OUT = (0.2, 35.0)  # of the room's size, and degrees: a camera nearer than both to a reserved one is refused
_TRIES = 200


class Camera(NamedTuple):
    """Where a view is taken from, where it looks and its field of view across, degrees."""

    origin: tuple[float, float, float]
    direction: tuple[float, float, float]
    fov: float


def original_camera(scene: Any) -> Camera:
    """The scene's own camera."""
    parameters = mi.traverse(scene.sensors()[0])
    matrix = np.array(parameters["to_world"].matrix, dtype=float).reshape(4, 4)
    direction = matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])
    return Camera(_triple(matrix[:3, 3]), _triple(direction), float(np.array(parameters["x_fov"]).ravel()[0]))


def near(first: Camera, second: Camera, size: float) -> bool:
    """Whether two cameras of a room of that size show much the same."""
    apart, angle = _KEPT_OUT
    cosine = float(np.dot(first.direction, second.direction))
    distance = float(np.linalg.norm(np.subtract(first.origin, second.origin)))
    return distance < apart * size and cosine > math.cos(math.radians(angle))


def random_camera(scene: Any, start: Camera, up: Vector, reserved: Sequence[Camera], rng: Rng) -> Camera:
    """A camera in the free space that is reached from ``start``, near none of ``reserved``.

    Its field of view is that of 128 pixels across of a frame of 160 to 800 pixels and 40 to 90 degrees.

    Raises:
        RuntimeError: none was found.
    """
    size = _room_size(scene, start, rng)
    for _ in range(_TRIES):
        origin = np.array(start.origin)
        for _ in range(_STEPS):
            direction = _directions(up, rng)
            distances = _distances(scene, origin, direction)
            inside = np.flatnonzero(distances < _ROOM * size)
            if len(inside) == 0:
                break
            chosen = int(rng.choice(inside))
            origin = origin + direction[chosen] * distances[chosen] * rng.uniform(0.1, 0.85)
        around = _distances(scene, origin, _sphere(rng))
        looks = _directions(up, rng)
        ahead = _distances(scene, origin, looks)
        fine = np.flatnonzero((ahead > 2 * _NEAREST * size) & (ahead < _ROOM * size))
        if around.min() < _NEAREST * size or len(fine) == 0:
            continue
        tangent = math.tan(math.radians(rng.uniform(40, 90)) / 2) * 128 / math.exp(rng.uniform(*np.log([160, 800])))
        camera = Camera(_triple(origin), _triple(looks[rng.choice(fine)]), math.degrees(2 * math.atan(tangent)))
        if not any(near(camera, other, size) for other in reserved):
            return camera
    raise RuntimeError("expected free space around the scene's camera, but found none")


def sensor(size: int, sampler: str) -> Any:
    """A square perspective camera with a box filter, to be placed by :meth:`Variation.place`."""
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": 30.0,
            "to_world": mi.ScalarTransform4f(),
            "near_clip": 0.001,
            "film": {
                "type": "hdrfilm",
                "width": size,
                "height": size,
                "pixel_format": "rgb",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": sampler},
        }
    )


class Variation:
    """A scene whose materials and lights can be drawn anew, always from what they were when it was loaded."""

    def __init__(self, scene: Any):
        self.parameters = mi.traverse(scene)
        ends = ("reflectance.value", "reflectance.data", "alpha", "alpha.value", "radiance.value")
        ends += ("sun_direction", "specular_reflectance.value")
        names: list[str] = self.parameters.keys()
        drawn = [name for name in names if name.endswith(ends)]
        self.original = {name: type(self.parameters[name])(self.parameters[name]) for name in drawn}

    def draw(self, rng: Rng) -> None:
        """Draw every material and light; one scene in four keeps its own."""
        if rng.random() < 0.25:
            return self.restore()
        for name, value in self.original.items():
            self.parameters[name] = self._drawn(name, value, rng)
        self.parameters.update()

    def restore(self) -> None:
        """Every material and light as the scene has it."""
        for name, value in self.original.items():
            self.parameters[name] = value
        self.parameters.update()

    def _drawn(self, name: str, value: Any, rng: Rng) -> Any:
        kind = name.rsplit(".", 2)[-2:] if "." in name else [name]
        match kind:
            case [*_, "radiance", "value"]:
                return _scaled(value, float(np.exp(rng.normal(0, 0.7))) * np.exp(rng.normal(0, 0.15, 3)))
            case ["specular_reflectance", "value"]:
                return _scaled(value, rng.uniform(0.7, 1.0, 3))
            case [*_, "reflectance" | "diffuse_reflectance", "value"]:
                return _like(value, _albedo(rng)) if rng.random() < 0.6 else value
            case [*_, "data"]:
                return _texture(value, rng) if rng.random() < 0.6 else value
            case [*_, "sun_direction"]:
                return _turned(value, rng)
        return type(value)(float(np.exp(rng.uniform(*np.log([0.03, 0.5]))))) if rng.random() < 0.5 else value

    @staticmethod
    def place(sensor: Any, camera: Camera, up: Vector) -> None:
        """Put a sensor of :func:`sensor` where a camera is."""
        parameters = mi.traverse(sensor)
        target = np.add(camera.origin, camera.direction)
        parameters["to_world"] = mi.Transform4f().look_at(*(mi.Point3f(*_triple(p)) for p in (camera.origin, target)),
                                                          mi.Vector3f(*_triple(up)))  # fmt: skip
        parameters["x_fov"] = camera.fov
        parameters.update()


def _albedo(rng: Rng) -> Vector:
    """A reflectance: brightness evenly between dark and bright, saturation mostly low."""
    color = rng.uniform(0, 1, 3) ** rng.uniform(0.2, 2)
    return np.asarray(color / color.max() * rng.uniform(0.05, 0.9))


def _like(value: Any, color: Vector) -> Any:
    """A colour as a parameter of the type of ``value``, which may be grey."""
    numbers = [float(c) for c in color]
    return type(value)(*numbers) if len(np.array(value).ravel()) == 3 else type(value)(float(np.mean(color)))


def _scaled(value: Any, factor: Vector) -> Any:
    numbers = np.array(value, dtype=float).ravel()
    return _like(value, numbers * factor if len(numbers) == 3 else np.full(3, numbers[0] * factor.mean()))


def _texture(value: Any, rng: Rng) -> Any:
    """A bitmap with its channels exchanged, contrast changed and a tint."""
    pixels = np.array(value)
    if pixels.shape[-1] == 3:
        pixels = pixels[..., rng.permutation(3)]
        pixels = pixels * (_albedo(rng) / 0.5 if rng.random() < 0.5 else 1)
    if rng.random() < 0.2:
        pixels = 1 - pixels
    return mi.TensorXf(np.clip(pixels, 0.02, 0.95) ** float(np.exp(rng.normal(0, 0.4))))


def _turned(value: Any, rng: Rng) -> Any:
    """The sun's direction, turned a little about every axis."""
    direction = np.array(value, dtype=float).ravel()
    turned = direction / np.linalg.norm(direction) + rng.normal(0, 0.2, 3)
    return type(value)(*_triple(turned / np.linalg.norm(turned)))


def _room_size(scene: Any, start: Camera, rng: Rng) -> float:
    """Median distance of what is seen from a camera, to all sides."""
    distances = _distances(scene, np.array(start.origin), _sphere(rng))
    return float(np.median(distances[np.isfinite(distances)]))


def _sphere(rng: Rng) -> Vector:
    directions = rng.normal(size=(_RAYS, 3))
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def _directions(up: Vector, rng: Rng) -> Vector:
    """Directions not far from level, as cameras look."""
    directions = _sphere(rng)
    level = directions - directions @ up[:, None] * up
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    tilted = level + rng.normal(0, 0.3, (_RAYS, 1)) * up
    return np.asarray(tilted / np.linalg.norm(tilted, axis=1, keepdims=True))


def _distances(scene: Any, origin: Vector, directions: Vector) -> Vector:
    """How far rays go, infinite where they hit nothing."""
    at = mi.Point3f(*_triple(origin))
    if not dr.is_array_v(mi.Float):  # a scalar variant, one ray at a time
        hits = [scene.ray_intersect_preliminary(mi.Ray3f(at, mi.Vector3f(*_triple(to)))) for to in directions]
        return np.array([hit.t if hit.is_valid() else math.inf for hit in hits], dtype=float)
    to = mi.Vector3f(np.ascontiguousarray(directions.T.astype(np.float32)))
    hit = scene.ray_intersect_preliminary(mi.Ray3f(at, to))
    return np.array(dr.select(hit.is_valid(), hit.t, math.inf), dtype=float)


def _triple(vector: Any) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in vector)
    return x, y, z
