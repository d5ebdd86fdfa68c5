"""Non-local means with variance cancellation: one door to the compiled kernel (Rousselle et al. 2012).

The weights are made for a strip of rows at a time, as they take (2r+1)² floats a pixel; whatever uses them (a mean, a
regression) works strip by strip. ``nlm_reference.py`` is the readable form.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from selfcorrect.errors import FrameError, SettingsError
from selfcorrect.image.exposure import LARGEST
from selfcorrect.image.windows import reflect
from selfcorrect.kernel import _cpu
from selfcorrect.kernel.cross_bilateral.cpu import instruction_sets

__all__ = ["Strip", "non_local_means", "strips"]

_LANES = 16
_STRIP = 1 << 24  # weights held at a time: 64 MB


@dataclass(frozen=True)
class Strip:
    """Weights of the windows of some rows: (taps, rows, columns), the columns rounded up to a vector."""

    first_row: int
    weights: Tensor


def strips(
    guide: Tensor, variance: Tensor, *, radius: int, patch_radius: int, k: float, threads: int = 1, isa: str = ""
) -> Iterator[Strip]:
    """Weights exp(−max(0, d²)) of the (2·radius+1)² pixels around each pixel, strip by strip.

    d² is the mean over channels and the patch of ((u_p − u_q)² − (v_p + min(v_p, v_q))) / (1e-10 + k² (v_p + v_q)) with
    u the guide and v its variance: what noise alone explains does not count. The border is mirrored without repeating
    the edge pixel.

    Args:
        guide: u, (H, W, C).
        variance: v, of each pixel of the guide, (H, W, C) ≥ 0.
        radius: of the window, 0 … 15.
        patch_radius: of the patches, 0 … 7.
        k: the larger, the stronger the filter; > 0.
        threads: of the compiled kernel.
        isa: one of :func:`selfcorrect.kernel.cross_bilateral.cpu.instruction_sets`; by default the widest.

    Raises:
        FrameError: the shapes differ.
        SettingsError: a number is out of range.
    """
    if guide.shape != variance.shape or guide.ndim != 3:
        raise FrameError(f"expected guide and variance of one shape, but got {guide.shape} and {variance.shape}")
    if not 0 <= radius <= 15 or not 0 <= patch_radius <= 7 or not k > 0:
        raise SettingsError(
            f"expected a radius to 15, a patch radius to 7 and k > 0, but got {radius}, {patch_radius} and {k}"
        )
    height, width, _ = guide.shape
    margin = radius + patch_radius
    planes = padded(guide.clamp(-LARGEST, LARGEST), margin), padded(variance.clamp(0, LARGEST**2), margin)
    taps, columns = (2 * radius + 1) ** 2, -(-width // _LANES) * _LANES
    rows = max(1, min(height, _STRIP // (taps * columns)))
    for first in range(0, height, rows):
        weights = torch.empty(taps, min(rows, height - first), columns)
        _cpu.nlm_weights(
            *planes, margin, radius, patch_radius, k, width, first, isa or instruction_sets()[-1], threads, weights
        )
        yield Strip(first, weights)


def non_local_means(
    values: Tensor,
    guide: Tensor,
    variance: Tensor,
    *,
    radius: int,
    patch_radius: int,
    k: float,
    threads: int = 1,
    isa: str = "",
) -> Tensor:
    """Means of ``values`` (H, W, C ≤ 4) with the weights of :func:`strips`."""
    if values.shape[:2] != guide.shape[:2] or not 1 <= values.shape[2] <= 4:
        raise FrameError(f"expected values of shape {tuple(guide.shape[:2])} + (1 … 4,), but got {tuple(values.shape)}")
    _, width, channels = values.shape
    planes = padded(values.clamp(-LARGEST, LARGEST), radius)
    parts = []
    for strip in strips(guide, variance, radius=radius, patch_radius=patch_radius, k=k, threads=threads, isa=isa):
        output = torch.empty(channels, strip.weights.shape[1], width)
        _cpu.nlm_average(
            planes,
            radius,
            radius,
            width,
            strip.first_row,
            isa or instruction_sets()[-1],
            threads,
            strip.weights,
            output,
        )
        parts.append(output)
    return torch.cat(parts, 1).permute(1, 2, 0).contiguous()


def padded(image: Tensor, margin: int) -> Tensor:
    """Planes (C, …) of an image (H, W, C), mirrored, with a vector's room at the right."""
    height, width, _ = image.shape
    rows, columns = reflect(-margin, height + margin, height), reflect(-margin, width + margin + 2 * _LANES, width)
    return image.float().permute(2, 0, 1).index_select(1, rows).index_select(2, columns).contiguous()
