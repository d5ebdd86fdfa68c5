"""The one table of a frame's buffers: everything that goes through them reads it here.

A new buffer is a row in :data:`BUFFERS`, its name in :class:`selfcorrect.frame.Frame` and
:class:`selfcorrect.frame.Half`, and its channel names in :data:`selfcorrect.exr.channels.TABLE`.
"""

from dataclasses import dataclass
from typing import Literal

__all__ = ["BUFFERS", "COLOR", "DENOISED", "FEATURES", "INPUTS", "MOTION", "TERMS", "Buffer"]


@dataclass(frozen=True)
class Buffer:
    """One buffer of a half, (H, W, channels).

    Attributes:
        name: the field of a frame that holds the pair of both halves.
        symbol: in the papers' equations.
        channels: of a pixel.
        kind: linear radiance ≥ 0, which takes part in exposure; a feature, a G-buffer as the renderer wrote it; or
            motion, where neighbouring frames of a shot show a pixel's surface, in pixels, NaN where it is unknown.
        place: among the network's inputs, ascending; None where the network does not see it.
        scale: whether Eq. 10 has a scale β for it, three channels.
        distance: how Eq. 11 measures it, d² or ln(1 + d²); None where it does not.
        first_bandwidth: what γ is before any training with the residual initialisation.
    """

    name: str
    symbol: str
    channels: int
    kind: Literal["radiance", "feature", "motion"]
    place: int | None
    scale: bool
    distance: Literal["squared", "logarithmic"] | None
    first_bandwidth: float = 0.0


COLOR = Buffer("color", "y", 3, "radiance", 0, scale=False, distance="logarithmic", first_bandwidth=3.0)
DENOISED = Buffer("denoised", "z", 3, "radiance", 4, scale=True, distance="logarithmic", first_bandwidth=1.0)
MOTION = Buffer("motion", "m", 4, "motion", None, scale=False, distance=None)
"""To the frame before, x to the right and y downwards, then to the frame after: where a pixel's surface is there."""

BUFFERS = (
    COLOR,
    DENOISED,
    Buffer("albedo", "ρ", 3, "feature", 1, scale=True, distance="squared", first_bandwidth=0.2),
    Buffer("normal", "n", 3, "feature", 3, scale=True, distance="squared", first_bandwidth=0.4),
    Buffer("depth", "d", 1, "feature", None, scale=False, distance=None),
    Buffer("visibility", "v", 1, "feature", 2, scale=False, distance="squared", first_bandwidth=0.2),
    MOTION,
)
"""Every buffer, in the order of the network's outputs: the scales β, then the bandwidths γ."""

FEATURES = tuple(buffer for buffer in BUFFERS if buffer.kind == "feature")
"""The G-buffers."""

TERMS = tuple(buffer for buffer in BUFFERS if buffer.distance is not None)
"""Those of Eq. 11, in the order of their bandwidths."""

INPUTS = tuple(sorted(TERMS, key=lambda buffer: buffer.place or 0))
"""Those that the network sees, in the order of its inputs (Back et al. 2022: y, ρ, v, n, z)."""
