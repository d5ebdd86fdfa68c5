"""The compiled non-local means.

The weights are made for a strip of rows at a time, as they take (2r+1)² floats a pixel; whatever uses them (a mean, a
regression) works strip by strip.
"""

from collections.abc import Iterator

import torch
from torch import Tensor

from selfcorrect.image.exposure import LARGEST
from selfcorrect.image.windows import reflect
from selfcorrect.kernel.backend import instruction_set
from selfcorrect.kernel.compiled import functions as _cpu
from selfcorrect.kernel.nlm.strip import Strip

__all__ = ["non_local_means", "strips"]

_LANES = 16
_STRIP = 1 << 24  # weights held at a time: 64 MB


def strips(
    guide: Tensor, variance: Tensor, *, radius: int, patch_radius: int, k: float, threads: int = 1, isa: str = ""
) -> Iterator[Strip]:
    """As :func:`selfcorrect.kernel.nlm.strips`; ``isa`` is an instruction set, by default the fastest."""
    height, width, _ = guide.shape
    margin = radius + patch_radius
    planes = padded(guide.clamp(-LARGEST, LARGEST), margin), padded(variance.clamp(0, LARGEST**2), margin)
    taps, columns = (2 * radius + 1) ** 2, -(-width // _LANES) * _LANES
    rows = max(1, min(height, _STRIP // (taps * columns)))
    for first in range(0, height, rows):
        weights = torch.empty(taps, min(rows, height - first), columns)
        _cpu.nlm_weights(*planes, margin, radius, patch_radius, k, width, first, instruction_set(isa), threads, weights)
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
    """As :func:`selfcorrect.kernel.nlm.non_local_means`; ``isa`` is an instruction set, by default the fastest."""
    _, width, channels = values.shape
    planes = padded(values.clamp(-LARGEST, LARGEST), radius)
    parts = []
    for strip in strips(guide, variance, radius=radius, patch_radius=patch_radius, k=k, threads=threads, isa=isa):
        output = torch.empty(channels, strip.weights.shape[1], width)
        _cpu.nlm_average(
            planes, radius, radius, width, strip.first_row, instruction_set(isa), threads, strip.weights, output
        )
        parts.append(output)
    return torch.cat(parts, 1).permute(1, 2, 0).contiguous()


def padded(image: Tensor, margin: int) -> Tensor:
    """Planes (C, …) of an image (H, W, C), mirrored, with a vector's room at the right."""
    height, width, _ = image.shape
    rows, columns = reflect(-margin, height + margin, height), reflect(-margin, width + margin + 2 * _LANES, width)
    return image.float().permute(2, 0, 1).index_select(1, rows).index_select(2, columns).contiguous()
