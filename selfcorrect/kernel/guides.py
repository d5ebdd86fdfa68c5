"""What the kernel reads: the guide buffers of one half, padded once, so that no border is left to handle."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import reduce
from itertools import chain

import torch
import torch.nn.functional as F
from torch import Tensor

from selfcorrect.buffers import COLOR, DENOISED, INPUTS, TERMS, Buffer
from selfcorrect.errors import FrameError
from selfcorrect.image.exposure import LARGEST

__all__ = ["Guides", "mirror"]

_LANES = 16  # the widest vector reads up to this many pixels beyond the last one


def mirror(start: int, stop: int, size: int) -> Tensor:
    """Indices ``start … stop-1`` of a line of ``size`` pixels mirrored at its ends, the edge pixel repeated.

    NumPy's ``symmetric`` padding, for any distance beyond the ends.

    >>> mirror(-3, 5, 2).tolist()
    [1, 1, 0, 0, 1, 1, 0, 0]
    """
    index = torch.arange(start, stop) % (2 * size)
    return torch.where(index < size, index, 2 * size - 1 - index)


def _window(start: int, length: int, size: int, device: torch.device) -> slice | Tensor:
    """So many pixels of a line: where they are inside it, no copy is needed to have them."""
    if start >= 0 and start + length <= size:
        return slice(start, start + length)
    return mirror(start, start + length, size).to(device)


def _cut(image: Tensor, dimension: int, window: slice | Tensor) -> Tensor:
    if isinstance(window, slice):
        return image.narrow(dimension, window.start, window.stop - window.start)
    return image.index_select(dimension, window)


@dataclass(frozen=True)
class Guides:
    """The guide buffers of one half, in planes mirrored ``margin`` pixels beyond the image.

    ``planes`` is (C, H + 2·margin, W + 2·margin + slack) with the channels in the order of the network's inputs
    (:data:`selfcorrect.buffers.INPUTS`). A buffer that the frame does not have has no plane and is not in ``terms``,
    which are in the order of :data:`selfcorrect.buffers.TERMS`.

    Guides of ``stacked`` crops of one size lie below one another, each with margins of its own: then height and width
    are those of a crop, and the first row of the next one is ``pitch`` rows further on.
    """

    planes: Tensor
    height: int
    width: int
    margin: int
    terms: tuple[Buffer, ...]
    stacked: int = 1

    @classmethod
    def of_half(
        cls,
        half: Mapping[str, Tensor | None],
        *,
        margin: int,
        scale: float = 1.0,
        region: tuple[int, int, int, int] | None = None,
    ) -> "Guides":
        """Guides of one half from its (H, W, C) buffers, bounded by ±1e15.

        Args:
            half: the buffers by name, None or absent where there is none; those that Eq. 11 does not know are not
                looked at.
            margin: pixels around, at least window // 2; beyond the image's border they are its mirror image.
            scale: what radiance is multiplied by.
            region: top, left, bottom, right of the pixels wanted, by default all.

        Raises:
            FrameError: there is no radiance, noisy or denoised.
        """
        there = {name: buffer for name, buffer in half.items() if buffer is not None}
        for needed in (COLOR, DENOISED):
            if needed.name not in there:
                raise FrameError(f"expected a half with the buffer {needed.name}, but got {', '.join(there) or 'none'}")
        color = there[COLOR.name]
        top, left, bottom, right = region or (0, 0, *color.shape[:2])
        height, width = bottom - top + 2 * margin, right - left + 2 * margin + _LANES
        rows = _window(top - margin, height, color.shape[0], color.device)
        columns = _window(left - margin, width, color.shape[1], color.device)
        inputs = [term for term in INPUTS if term.name in there]
        dtype = reduce(torch.promote_types, (there[term.name].dtype for term in inputs), torch.float32)
        planes = torch.empty(sum(t.channels for t in inputs), height, width, dtype=dtype, device=color.device)
        first = 0
        for term in inputs:
            part = _cut(_cut(there[term.name], 0, rows), 1, columns).permute(2, 0, 1)
            if term.kind == "radiance" and scale != 1.0:
                part = (part.double() * scale).clamp_(-LARGEST, LARGEST).float()
            planes[first : first + term.channels] = part
            first += term.channels
        planes.clamp_(-LARGEST, LARGEST)
        terms = tuple(term for term in TERMS if term.name in there)
        return cls(planes, bottom - top, right - left, margin, terms)

    @classmethod
    def of_planes(cls, planes: Tensor, margin: int, terms: tuple[Buffer, ...]) -> "Guides":
        """Guides of planes (C, H + 2·margin, W + 2·margin) that have their margin, in the order of ``planes``."""
        height, width = (side - 2 * margin for side in planes.shape[1:])
        return cls(F.pad(planes, (0, _LANES)), height, width, margin, terms)

    @classmethod
    def stack(cls, crops: Iterable["Guides"], count: int) -> "Guides":
        """So many guides of one size, below one another; each may be made when it is asked for, and is let go."""
        crops = iter(crops)
        first = next(crops)
        channels, rows, columns = first.planes.shape
        planes = first.planes.new_empty(channels, count * rows, columns)
        for i, crop in enumerate(chain([first], crops)):
            planes[:, i * rows : (i + 1) * rows] = crop.planes
        return replace(first, planes=planes, stacked=count)

    @property
    def pitch(self) -> int:
        """Rows from one of the stacked crops to the next."""
        return self.height + 2 * self.margin

    @property
    def scaled(self) -> tuple[Buffer, ...]:
        """The terms that have a scale β in Eq. 10."""
        return tuple(term for term in self.terms if term.scale)

    @property
    def betas(self) -> int:
        """Number of Eq. 10's scales β: three for each of the terms that are scaled."""
        return 3 * len(self.scaled)

    @property
    def gammas(self) -> int:
        """Number of Eq. 11's bandwidths γ: one for each term."""
        return len(self.terms)

    def channels(self, term: Buffer) -> slice:
        """Where the term lies among the planes."""
        before = sum(other.channels for other in INPUTS[: INPUTS.index(term)] if other in self.terms)
        return slice(before, before + term.channels)

    @property
    def inner(self) -> Tensor:
        """All planes without their margin, (C, H, W); of the first of stacked crops."""
        m = self.margin
        return self.planes[:, m : m + self.height, m : m + self.width]

    @property
    def radiance(self) -> Tensor:
        """The planes of y, (3, …)."""
        return self.planes[self.channels(COLOR)]

    @property
    def denoised(self) -> Tensor:
        """The planes of z, (3, …)."""
        return self.planes[self.channels(DENOISED)]

    def views(self, corners: Tensor, size: tuple[int, int]) -> list[Tensor]:
        """N patches (C, h, w), nothing copied; ``corners`` (N, 2) are the rows and columns of their first pixels."""
        h, w = size
        return [self.planes[:, y : y + h, x : x + w] for y, x in (corners + self.margin).tolist()]

    def patches(self, corners: Tensor, size: tuple[int, int]) -> Tensor:
        """The same patches, copied to (N, C, h, w)."""
        return torch.stack(self.views(corners, size))
