"""Sets of AOVs that sum to the picture: what renderers call them, and whether they do.

A set is proposed by its names and accepted by its pixels: on the noisy input, where nothing has been denoised, the sum
has to equal the picture within rounding.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from selfcorrect.exr.file import ExrFile, Pixels
from selfcorrect.exr.passes import DIVIDED, divided, rgb_passes

__all__ = ["Aov", "Decomposition", "beside", "candidates", "closing_error", "fitted", "radiance", "tolerance"]

Three = tuple[str, str, str]

_BLENDER_PLAIN = (
    "Volume Direct",
    "Volume Indirect",
    "Emission",
    "Environment",
    "VolumeDir",
    "VolumeInd",
    "Emit",
    "Env",
)
_WORLD = ("environment", "env")
"""Blender has the world in these, and in its light group, also where the film is transparent and the picture not."""

_LOBES = ("diffuse", "specular", "coat", "sheen", "transmission", "sss", "volume")
_PLAIN = ("emission", "background")
_GROUPED = ("Combined", "RGBA", "Ci", "C", "Beauty")
"""Pictures that light groups are named after: Combined_NAME in Blender, RGBA_NAME in Arnold."""

_FLOAT_TOLERANCE = 1e-5
_HALF_TOLERANCE = 2e-3
_DARKEST = 0.01  # of the mean of the picture: darker pixels count no more
_FITTED_PIXELS = 4096
_FITTED_SETS = 64
_WHOLE = 1e-3  # how far from 0 or 1 a fitted coefficient may be


@dataclass(frozen=True)
class Aov:
    """An AOV of radiance.

    Attributes:
        name: of its pass, without the layer.
        channels: full names of its R, G, B.
        color: of the colour that the renderer has divided it by; what sums to the picture is the product.
    """

    name: str
    channels: Three
    color: Three | None = None


@dataclass(frozen=True)
class Decomposition:
    """AOVs that may sum to the picture."""

    name: str
    aovs: tuple[Aov, ...]


def candidates(names: Sequence[str], color: Sequence[str]) -> list[Decomposition]:
    """Sets of two AOVs or more beside the colour that conventionally sum to it, the finest first."""
    there = _beside(names, color)
    by_pass = {name.casefold(): name for name in there}
    colors = divided(names)

    def aovs(wanted: Sequence[str]) -> tuple[Aov, ...]:
        own = [by_pass[name.casefold()] for name in wanted if name.casefold() in by_pass]
        return tuple(_aov(name, there[name], colors) for name in dict.fromkeys(own))

    lights = [light for _, pair in DIVIDED for light in pair]
    blender = aovs([*lights, *_BLENDER_PLAIN])
    found = [
        Decomposition("Blender's light passes", blender),
        Decomposition(
            "Blender's light passes before a transparent film",
            tuple(aov for aov in blender if aov.name.casefold() not in _WORLD),
        ),
    ]
    found += [
        Decomposition(f"light groups {picture}_…", aovs([name for name in there if _in_group(name, picture)]))
        for picture in _GROUPED
    ]
    found += [
        Decomposition("Arnold's lobes", aovs([*_lobes(by_pass, split=True), *_PLAIN])),
        Decomposition("Arnold's lobes, direct and indirect in one", aovs([*_lobes(by_pass, split=False), *_PLAIN])),
        Decomposition("direct and indirect light", aovs(["direct", "indirect", *_PLAIN])),
    ]
    found += [Decomposition(f"AOVs {start}_…", aovs(group)) for start, group in _by_prefix(there)]
    unique = {frozenset(one.aovs): one for one in reversed(found) if len(one.aovs) > 1}
    return [one for one in found if unique.get(frozenset(one.aovs)) is one]


def beside(names: Sequence[str], color: Sequence[str]) -> list[Aov]:
    """Every pass of R, G, B in the colour's layer but the colour itself, with the colour that it was divided by."""
    colors = divided(names)
    return [_aov(name, three, colors) for name, three in _beside(names, color).items()]


def fitted(file: ExrFile, color: Sequence[str], taken: Sequence[str] = ()) -> Decomposition | None:
    """AOVs of any names that sum to the colour: those with coefficient 1 in a least-squares fit whose others are 0.

    Args:
        file: the noisy render.
        color: full names of its colour.
        taken: passes to leave out, since a set that sums has them already.
    """
    aovs = [
        aov
        for aov in beside(file.channel_names, color)
        if aov.name not in taken and all(_is_float(file, channel) for channel in aov.channels)
    ]
    if not 1 < len(aovs) <= _FITTED_SETS:
        return None
    target = np.stack([file.pixels(name).astype(np.float64) for name in color], -1).ravel()
    step = max(target.size // _FITTED_PIXELS, 1)
    columns = np.stack([radiance(file, aov).reshape(-1)[::step] for aov in aovs], -1)
    target = target[::step]
    known = np.isfinite(target) & np.isfinite(columns).all(-1)
    if not known.any():
        return None
    weight = 1 / (np.abs(target[known]) + _DARKEST * np.abs(target[known]).mean() + 1e-30)
    fit = np.linalg.lstsq(columns[known] * weight[:, None], target[known] * weight, rcond=None)[0]
    if not np.all((np.abs(fit) < _WHOLE) | (np.abs(fit - 1) < _WHOLE)):
        return None
    lit = tuple(aov for aov, share in zip(aovs, fit, strict=True) if share > 0.5)
    return Decomposition("AOVs found by their sum", lit) if len(lit) > 1 else None


def radiance(file: ExrFile, aov: Aov) -> Pixels:
    """What an AOV adds to the picture, (H, W, 3) float64: light times its colour."""
    light = np.stack([file.pixels(name).astype(np.float64) for name in aov.channels], -1)
    if aov.color is None:
        return light
    color = np.stack([file.pixels(name).astype(np.float64) for name in aov.color], -1)
    with np.errstate(all="ignore"):
        product: Pixels = light * color
    return product


def closing_error(file: ExrFile, color: Sequence[str], aovs: Sequence[Aov]) -> float:
    """How far the sum of AOVs is from the colour: the root of the mean of the squared relative error.

    Pixels darker than 0.01 of the mean count relative to that; those that are not finite are left out.
    """
    target = np.stack([file.pixels(name).astype(np.float64) for name in color], -1)
    total = np.zeros_like(target)
    for aov in aovs:
        total += radiance(file, aov)
    with np.errstate(all="ignore"):
        known = np.isfinite(target) & np.isfinite(total)
    if not known.any():
        return float("inf")
    level = float(np.abs(target[known]).mean())
    if level == 0:
        return 0.0 if not total[known].any() else float("inf")
    relative = (total[known] - target[known]) / (np.abs(target[known]) + _DARKEST * level)
    return float(np.sqrt(np.mean(relative**2)))


def tolerance(file: ExrFile, color: Sequence[str], aovs: Sequence[Aov]) -> float:
    """What rounding explains of :func:`closing_error`: more where a channel has half floats."""
    names = [*color, *(name for aov in aovs for name in (*aov.channels, *(aov.color or ())))]
    half = any(file.pixels(name).dtype == np.float16 for name in names)
    return _HALF_TOLERANCE if half else _FLOAT_TOLERANCE


def _beside(names: Sequence[str], color: Sequence[str]) -> dict[str, Three]:
    """Passes of R, G, B in the colour's layer, without it → full names; not the colour itself."""
    above = color[0].rpartition(".")[0]
    layer = above.rpartition(".")[0]
    start = f"{layer}." if layer else ""
    return {
        name.removeprefix(start): three
        for name, three in rgb_passes(names).items()
        if name.startswith(start) and name not in ("", above) and "." not in name.removeprefix(start)
    }


def _aov(name: str, three: Three, colors: dict[str, str]) -> Aov:
    r, g, b = (colors.get(channel) for channel in three)
    return Aov(name, three, (r, g, b) if r and g and b else None)


def _in_group(name: str, picture: str) -> bool:
    return name.casefold().startswith(f"{picture}_".casefold())


def _lobes(there: dict[str, str], *, split: bool) -> Iterator[str]:
    """Each lobe as its direct and indirect light, or as one; the other where the file has not the one."""
    for lobe in _LOBES:
        halves = [f"{lobe}_direct", f"{lobe}_indirect"]
        parts = [name for name in halves if name in there]
        yield from parts if parts and (split or lobe not in there) else [lobe]


def _by_prefix(there: dict[str, Three]) -> Iterator[tuple[str, list[str]]]:
    """Groups of passes with the same beginning up to the first underscore."""
    groups: dict[str, list[str]] = {}
    for name in there:
        start, underscore, _ = name.partition("_")
        if underscore and start:
            groups.setdefault(start, []).append(name)
    yield from ((start, group) for start, group in groups.items() if start not in _GROUPED)


def _is_float(file: ExrFile, name: str) -> bool:
    return file.pixels(name).dtype.kind == "f"
