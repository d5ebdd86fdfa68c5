"""Where Mitsuba's pixels are in the frames before and after, of moving cameras and objects: it writes no motion itself.

A sample of every pixel says which shape it met, which triangle, and where. That point is taken along to the other
frame: with the corners of its triangle in a mesh, with the transform in other shapes and in instances, and far away,
where nothing was met, not at all; and both are projected by their frame's camera. What is known of a frame for that is
its :class:`Layout`, which outlives its scene.

Sub-pixel positions of the sample cancel, since its own projection is what the motion is counted from. What cannot be
told is NaN: a shape that the other frame lacks or that has another topology there, curves, what is behind a camera.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

__all__ = ["CHANNELS", "Hits", "Layout", "hits", "layout", "motion", "projected"]

CHANNELS = ("motion.X", "motion.Y", "motion.Z", "motion.W")
"""To the frame before, x to the right and y downwards, in pixels; then to the frame after."""

_CAMERAS = ("PerspectiveCamera", "ThinLensCamera")
_TRIES = 8  # pixels of a shape that are asked for its name
_CLOSE = 1e-3  # of the distance: two rays to one point meet the same surface
_MISSED = ""

Names = list[tuple[str, Any]]


@dataclass(frozen=True)
class Mesh:
    """Triangles: corners (V, 3) in the world, and which three make one, (F, 3)."""

    vertices: np.ndarray
    faces: np.ndarray


@dataclass(frozen=True)
class Layout:
    """What motion needs to know of one frame.

    Attributes:
        camera: from the world to pixels, homogeneous, (4, 4); None where it is of a kind without a projection.
        size: width and height in pixels.
        shapes: by name a mesh, or the transform from the shape to the world, (4, 4).
    """

    camera: np.ndarray | None
    size: tuple[int, int]
    shapes: dict[str, Mesh | np.ndarray]


@dataclass(frozen=True)
class Hits:
    """What one sample of each pixel met.

    Attributes:
        position: (H, W, 3) in the world; where nothing was met, the direction.
        shape: (H, W), names; empty where nothing was met, None where it cannot be told.
        triangle: (H, W), of a mesh.
    """

    position: np.ndarray
    shape: np.ndarray
    triangle: np.ndarray

    @property
    def missed(self) -> np.ndarray:
        """(H, W), where nothing was met."""
        missed: np.ndarray = self.shape == _MISSED
        return missed


def layout(scene: Any) -> Layout:
    """Of a loaded scene."""
    sensor = scene.sensors()[0]
    shapes: dict[str, Mesh | np.ndarray] = {}
    for name, shape in _named(scene):
        known = mi.traverse(shape)
        if "vertex_positions" in known and "faces" in known:
            corners, faces = (np.array(known[name]).reshape(-1, 3) for name in ("vertex_positions", "faces"))
            shapes[name] = Mesh(corners.astype(np.float64), faces.astype(np.int64))
        elif "to_world" in known:
            shapes[name] = _matrix(known["to_world"])
    width, height = sensor.film().crop_size()
    return Layout(_camera(sensor), (int(width), int(height)), shapes)


def _named(scene: Any) -> Names:
    """The shapes by their ids, and counted where several have one: meshes that Mitsuba has merged have none."""
    counts: dict[str, int] = {}
    named = []
    for shape in scene.shapes():
        counts[shape.id()] = counts.get(shape.id(), 0) + 1
        named.append((f"{shape.id()}#{counts[shape.id()]}", shape))
    return named


def _matrix(transform: Any) -> np.ndarray:
    return np.array(transform.matrix, dtype=np.float64).reshape(4, 4)


def _camera(sensor: Any) -> np.ndarray | None:
    if sensor.class_name() not in _CAMERAS:
        return None
    known, film = mi.traverse(sensor), sensor.film()
    near, far, field = (float(np.array(known[name]).item()) for name in ("near_clip", "far_clip", "x_fov"))
    projection = mi.perspective_projection(film.size(), film.crop_size(), film.crop_offset(), field, near, far)
    shift = [float(np.array(known[f"principal_point_offset_{axis}"]).item()) for axis in "xy"]
    pixels = np.diag([*map(float, film.crop_size()), 1.0, 1.0])
    pixels[:2, 3] = [-moved * side for moved, side in zip(shift, film.crop_size(), strict=True)]
    return pixels @ _matrix(projection) @ np.linalg.inv(_matrix(sensor.world_transform()))


def hits(scene: Any, seed: int) -> Hits:
    """One sample of each pixel.

    Args:
        scene: whose film has a box filter, and whose sampler can take a single sample.
        seed: of that sample.
    """
    sensor = scene.sensors()[0]
    aov = mi.load_dict({"type": "aov", "aovs": "p:position,shape:shape_index,triangle:prim_index"})
    met = np.array(aov.render(scene, sensor=sensor, seed=seed, spp=1), dtype=np.float64)
    position, number = met[..., :3], met[..., 3].astype(np.int64)
    names, shapes = np.full(number.shape, None, dtype=object), _named(scene)
    for one in np.unique(number):
        there = np.argwhere(number == one)
        names[number == one] = _name(scene, shapes, [position[y, x] for y, x in there]) if one else _MISSED
    position[number == 0] = _directions(sensor, number.shape)[number == 0]
    return Hits(position, names, met[..., 4].astype(np.int64))


def _name(scene: Any, shapes: Names, points: list[np.ndarray]) -> str | None:
    """Of the shape that has these points: the numbers that Mitsuba writes count otherwise in each variant."""
    eye = _matrix(scene.sensors()[0].world_transform())[:3, 3]
    for point in points[:: max(len(points) // _TRIES, 1)]:
        distance = float(np.linalg.norm(point - eye))
        ray = mi.Ray3f(mi.Point3f(*eye.tolist()), mi.Vector3f(*((point - eye) / distance).tolist()))
        met = scene.ray_intersect(ray)
        if abs(float(np.array(met.t).item()) - distance) > _CLOSE * distance:
            continue
        for name, shape in shapes:
            if any(_is(pointer, shape) for pointer in (met.instance, met.shape)):
                return name
    return None


def _is(pointer: Any, shape: Any) -> bool:
    return pointer is shape if "scalar" in mi.variant() else bool(dr.all(pointer == mi.ShapePtr(shape)))


def _directions(sensor: Any, size: tuple[int, ...]) -> np.ndarray:
    """From the camera through each pixel's centre, (H, W, 3); zero of a camera without a projection."""
    camera = _camera(sensor)
    if camera is None:
        return np.zeros((*size, 3))
    y, x = np.indices(size) + 0.5
    ones = np.ones(size)
    near, far = (np.stack([x, y, depth * ones, ones], -1) @ np.linalg.inv(camera).T for depth in (0.25, 0.75))
    return far[..., :3] / far[..., 3:] - near[..., :3] / near[..., 3:]


def motion(met: Hits, here: Layout, others: tuple[Layout | None, Layout | None]) -> np.ndarray:
    """The channels :data:`CHANNELS` of a frame, (H, W, 4); NaN where they cannot be told.

    Args:
        met: of the frame.
        here: its layout.
        others: of the frame before and of the frame after, as far as there are.
    """
    result = np.full((*met.triangle.shape, 4), np.nan)
    start = projected(here, met.position, met.missed)
    for side, other in enumerate(others):
        if other is not None and other.size == here.size:
            end = projected(other, _taken_along(met, here, other), met.missed)
            result[..., 2 * side : 2 * side + 2] = end - start
    return result


def _taken_along(met: Hits, here: Layout, other: Layout) -> np.ndarray:
    """The points of a frame in another one, (H, W, 3)."""
    moved = np.full_like(met.position, np.nan)
    names = {name for name in met.shape.flat if name is not None}
    for name in names:
        chosen = met.shape == name
        points = met.position[chosen]
        if name == _MISSED:
            moved[chosen] = points
            continue
        before, after = here.shapes.get(name), other.shapes.get(name)
        if isinstance(before, Mesh) and isinstance(after, Mesh):
            if np.array_equal(before.faces, after.faces):
                moved[chosen] = _on_triangles(points, met.triangle[chosen], before, after)
        elif isinstance(before, np.ndarray) and isinstance(after, np.ndarray):
            matrix = after @ np.linalg.inv(before)
            moved[chosen] = points @ matrix[:3, :3].T + matrix[:3, 3]
    return moved


def _on_triangles(points: np.ndarray, triangles: np.ndarray, before: Mesh, after: Mesh) -> np.ndarray:
    """Points (N, 3) at the same barycentric coordinates of the triangles of another mesh."""
    corners = before.faces[triangles]
    a, b, c = before.vertices[corners].swapaxes(0, 1)
    edges = np.stack([b - a, c - a], -1)
    u, v = (np.linalg.pinv(edges) @ (points - a)[..., None])[..., 0].T[..., None]
    a, b, c = after.vertices[corners].swapaxes(0, 1)
    return a + u * (b - a) + v * (c - a)


def projected(of: Layout, points: np.ndarray, far: np.ndarray) -> np.ndarray:
    """Where a frame's camera sees points (H, W, 3), or directions where they are ``far``, (H, W, 2) in pixels."""
    if of.camera is None:
        return np.full((*points.shape[:2], 2), np.nan)
    homogeneous = np.concatenate([points, np.where(far, 0.0, 1.0)[..., None]], -1)
    x, y, _, w = np.moveaxis(homogeneous @ of.camera.T, -1, 0)
    w = np.where(w > 0, w, np.nan)  # behind the camera
    return np.stack([x / w, y / w], -1)
