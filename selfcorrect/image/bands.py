"""Maps of a whole image that are never whole in memory: made a band of rows at a time, kept as means over tiles.

A function of a band takes a slice of rows and gives maps (K, rows, W). Bands are as high as a number of tiles, so that
no tile lies in two of them, and low: what a band takes stays in the processor's caches, and in memory that the process
has already. At 8K bands of 128 rows took 24 MB for each map, which the system handed out and took back every time.
"""

from collections.abc import Callable, Iterator
from typing import TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from selfcorrect.image.threads import in_threads

__all__ = ["TILE", "average", "bands", "enlarged", "enlarged_rows", "in_bands", "shares", "tile_means", "widened"]

TILE = 16  # pixels; the side of tiles where none is given
_BAND = 32  # rows; a power of two, as every side is

Pixels = Callable[[slice], Tensor]
Made = TypeVar("Made")


def bands(height: int, rows: int | None = None) -> Iterator[slice]:
    """Slices of rows that cover an image once.

    >>> list(bands(50))
    [slice(0, 32, None), slice(32, 50, None)]
    """
    step = rows or _BAND
    for top in range(0, height, step):
        yield slice(top, min(top + step, height))


def in_bands(height: int, work: Callable[[slice], Made], rows: int | None = None) -> list[Made]:
    """What ``work`` gives for each of :func:`bands`, in their order; as many bands at once as torch has threads."""
    return in_threads(work, bands(height, rows))


def widened(rows: slice, reach: int, height: int) -> tuple[slice, slice]:
    """The rows with ``reach`` more on each side, inside the image; and where the rows lie in those.

    >>> widened(slice(128, 200), 2, 201)
    (slice(126, 201, None), slice(2, 74, None))
    """
    wide = slice(max(rows.start - reach, 0), min(rows.stop + reach, height))
    return wide, slice(rows.start - wide.start, rows.stop - wide.start)


def tile_means(height: int, pixels: Pixels, side: int = TILE, *, band: int | None = None) -> Tensor:
    """Means (K, h, w) over tiles of the maps, ``band`` rows at a time; tiles at the far border are smaller."""

    def means(rows: slice) -> Tensor:
        return F.avg_pool2d(pixels(rows), side, ceil_mode=True, count_include_pad=False)

    return torch.cat(in_bands(height, means, max(side, band or _BAND)), 1)


def average(means: Tensor, size: tuple[int, int], side: int = TILE) -> list[float]:
    """Means of K maps over all pixels of an image of this size, from those over its tiles."""
    count = shares(means, size, side)
    weighted = (means * count).sum((1, 2)) / count.sum()
    values: list[float] = weighted.tolist()
    return values


def shares(means: Tensor, size: tuple[int, int], side: int = TILE) -> Tensor:
    """How full each tile of maps (K, h, w) is, (h, w): less than 1 at the far border of an image of this size."""
    count = torch.ones_like(means[0])
    count[-1] *= 1 - (len(count) * side - size[0]) / side
    count[:, -1] *= 1 - (count.shape[1] * side - size[1]) / side
    return count


def enlarged_rows(means: Tensor, size: tuple[int, int], rows: slice) -> Tensor:
    """Rows of what tile means (K, h, w) are bilinearly enlarged to, (K, rows, W)."""
    last = means.shape[1] - 1
    at = torch.arange(rows.start, rows.stop, dtype=means.dtype, device=means.device)
    at = ((at + 0.5) * (means.shape[1] / size[0]) - 0.5).clamp(min=0)
    above = at.long()
    share = (at - above)[:, None]
    lines = means[:, above] * (1 - share) + means[:, (above + 1).clamp(max=last)] * share
    return F.interpolate(lines[None], size=(len(at), size[1]), mode="bilinear")[0]


def enlarged(means: Tensor, size: tuple[int, int]) -> Tensor:
    """The whole of it, (K, H, W) float32."""
    image = torch.empty(means.shape[0], *size, device=means.device)

    def enlarge(rows: slice) -> None:
        image[:, rows] = enlarged_rows(means, size, rows).clamp(max=torch.finfo(image.dtype).max)

    in_bands(size[0], enlarge)
    return image
