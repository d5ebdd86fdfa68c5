"""Trained networks on whole images, tile by tile: their memory does not grow with the frame.

A tile's network sees as much around it as reaches its outputs, so that tiles are equal to the whole but for rounding:
the convolutions may sum in an order that depends on their size. ``tests/stages/test_tiled.py`` holds radiance near 1
to 1e-6 in single precision; found was 1e-7. In bfloat16 a weight may round to its neighbour, by 2⁻⁸ of itself, which
with the 25 weights of the tests' network moves a pixel by 2⁻⁸ / 25 = 1.6e-4: seen in 5 of 12288 values; the test holds
the largest difference to two such, and 99.9 % of all to 1e-4.
"""

from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor

from selfcorrect.image.tiles import Region
from selfcorrect.image.windows import reflect
from selfcorrect.kernel.convolution import has_fast_bf16

__all__ = ["ALIGNMENT", "SIDE", "around", "autocast", "cut", "slices"]

SIDE = 192  # of the tiles, pixels; the weights of a tile's taps, four buffers and what lies around are 0.2 GB
ALIGNMENT = 4  # pixels; two poolings by 2


def cut(planes: Tensor, region: Region, reach: int = 0) -> Tensor:
    """A region of planes (…, H, W) and ``reach`` pixels around it; beyond the image it is mirrored."""
    top, left, bottom, right = region
    rows = reflect(top - reach, bottom + reach, planes.shape[-2]).to(planes.device)
    columns = reflect(left - reach, right + reach, planes.shape[-1]).to(planes.device)
    return planes.index_select(-2, rows).index_select(-1, columns)


def around(region: Region, reach: int, size: tuple[int, int]) -> tuple[Region, tuple[slice, slice]]:
    """The region with ``reach`` or a little more on every side, in an image of this size, and where it lies in that."""
    top, left, bottom, right = region
    first, begin = max(top - reach, 0), max(left - reach, 0)
    last, end = (
        min(-(-(beyond + reach) // ALIGNMENT) * ALIGNMENT, pixels)
        for beyond, pixels in zip((bottom, right), size, strict=True)
    )
    inside = slice(top - first, bottom - first), slice(left - begin, right - begin)
    return (first, begin, last, end), inside


def slices(region: Region) -> tuple[slice, slice]:
    """Its rows and columns."""
    top, left, bottom, right = region
    return slice(top, bottom), slice(left, right)


def autocast(image: Tensor, precision: str) -> AbstractContextManager[object]:
    """Bfloat16 where it is asked for and fast."""
    if precision == "bf16" and has_fast_bf16(image.device):
        return torch.autocast(image.device.type, torch.bfloat16)
    return nullcontext()
