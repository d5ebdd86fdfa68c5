"""Motion passes: what renderers call them, and how they are read as :data:`selfcorrect.buffers.MOTION`.

Inside there is one convention: pixels, x to the right, y downwards as rows go, from a pixel to the place of its surface
in the frame before and in the frame after. :data:`CONVENTIONS` says what each renderer writes. Read without being named
are only those whose unit no setting changes. The others count by the shutter or by a scale of the user's: they are read
where ``--map motion=PASS`` names them, and have to be set up as the table says. A pass that is not what it was taken
for harms nothing but itself: where it does not fit, optical flow is used (:mod:`selfcorrect.history.motion`).

3D velocities (RenderMan's ``dPdtime``, Blender's ``Position`` differences) say nothing of the camera and are not read.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from selfcorrect.buffers import MOTION

__all__ = ["CONVENTIONS", "COUNTS", "Convention", "alternatives", "read"]

Axes = tuple[tuple[int, int], tuple[int, int]]
COUNTS = (4, 2)
"""How many channels a motion pass may have."""

_XYZW = (".X", ".Y", ".Z", ".W")
_PLAIN = (_XYZW, (".R", ".G", ".B", ".A"), (".R", ".G"), (".X", ".Y"))


@dataclass(frozen=True)
class Convention:
    """What the channels of a motion pass mean.

    Attributes:
        name: the pass, case aside; empty where the components name it.
        components: endings that make full channel names, the alternatives in order of preference.
        back: x and y to the frame before: the place of the component and its sign; None where it is not told.
        fore: the same to the frame after.
        found: read without being named.
        writer: who writes it.
        source: who says so, and how it has to be set up.
    """

    name: str
    components: tuple[tuple[str, ...], ...]
    back: Axes | None
    fore: Axes | None
    found: bool
    writer: str
    source: str


_UPWARDS = ((0, 1), (1, -1))  # two components, y upwards as compositing packages have it
_RENDERMAN = tuple(
    tuple(f"{pass_}.{axis}" for pass_ in ("motionBack", "motionFore") for axis in axes) for axes in ("xy", "rg")
)

CONVENTIONS = (
    Convention(
        "Vector", (_XYZW,), ((0, 1), (1, -1)), ((2, -1), (3, 1)), True, "Blender Cycles",
        "measured: albedo reprojected by it fits (tests/scripts); the manual names no signs; motion blur has to be off",
    ),
    Convention(
        "", _RENDERMAN, ((0, 1), (1, 1)), ((2, 1), (3, 1)), True, "RenderMan",
        "what its denoiser takes, in raster space: pixels, rows downwards; no file of it was seen here",
    ),
    Convention(
        "motion", (_XYZW,), ((0, 1), (1, 1)), ((2, 1), (3, 1)), True, "scripts/render, for Mitsuba",
        "as it is inside; measured: albedo reprojected by it fits (tests/scripts)",
    ),
    Convention(
        "motionvector", ((".R", ".G"), (".X", ".Y")), None, _UPWARDS, False, "Arnold",
        "pixels from the shutter's start to its end: of a frame where the shutter begins on it and is 1 long, with "
        "Instantaneous Shutter",
    ),
    Convention(
        "Velocity", ((".R", ".G"),), None, _UPWARDS, False, "V-Ray",
        "from this frame to the next; Clamp Velocity off, and Max Velocity 1, else it is a share of that",
    ),
    Convention(
        "MotionVectors", ((".R", ".G"),), None, _UPWARDS, False, "Redshift, Karma",
        "Output Raw Vectors on, else it is a share of Max Motion; Filtering off; shutter as for Arnold",
    ),
    Convention("", _PLAIN[:2], ((0, 1), (1, 1)), ((2, 1), (3, 1)), False, "the user's own, four", "as it is inside"),
    Convention("", _PLAIN[2:], None, ((0, 1), (1, 1)), False, "the user's own, two", "to the next, rows downwards"),
)  # fmt: skip


def alternatives(name: str) -> tuple[tuple[str, ...], ...]:
    """Endings of the channels of a pass that the user has named; without its layer or with it."""
    known = [row.components for row in CONVENTIONS if row.name and row.name.casefold() == _last(name)]
    return known[0] if known else _PLAIN


def read(names: Sequence[str], channels: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Motion as it is inside, (H, W, 4), of the channels of a pass, (H, W, 2 or 4); what is not told is NaN.

    Args:
        names: full names of the channels, which say whose convention it is.
        channels: as the file has them.
    """
    convention = _convention(names)
    motion = np.full((*channels.shape[:2], MOTION.channels), np.nan, channels.dtype)
    for first, axes in ((0, convention.back), (2, convention.fore)):
        for axis, (place, sign) in enumerate(axes or ()):
            motion[..., first + axis] = sign * channels[..., place]
    return motion


def _convention(names: Sequence[str]) -> Convention:
    pass_ = _last(names[0].rpartition(".")[0])
    for row in CONVENTIONS:
        there = {row.name.casefold()} if row.name else {c.rpartition(".")[0].casefold() for c in row.components[0][:1]}
        if pass_ in there and len(names) == len(row.components[0]):
            return row
    return next(row for row in reversed(CONVENTIONS) if not row.name and len(row.components[0]) == len(names))


def _last(name: str) -> str:
    return name.casefold().rpartition(".")[2]
