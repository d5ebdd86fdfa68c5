"""What the kernel reads: the guide buffers of one half, padded once, so that no border is left to handle."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

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


@dataclass(frozen=True)
class Guides:
    """The guide buffers of one half, in planes mirrored ``margin`` pixels beyond the image.

    ``planes`` is (C, H + 2·margin, W + 2·margin + slack) with the channels in the order of the paper's network
    input: y(3), albedo(3), visibility(1), normal(3), z(3). A buffer that the frame does not have has no plane.

    Guides of ``stacked`` crops of one size lie below one another, each with margins of its own: then height and width
    are those of a crop, and the first row of the next one is ``pitch`` rows further on.
    """

    planes: Tensor
    height: int
    width: int
    margin: int
    has_albedo: bool
    has_normal: bool
    has_visibility: bool
    stacked: int = 1

    @classmethod
    def of_half(
        cls,
        color: Tensor,
        denoised: Tensor,
        *,
        margin: int,
        albedo: Tensor | None = None,
        normal: Tensor | None = None,
        visibility: Tensor | None = None,
        scale: float = 1.0,
        region: tuple[int, int, int, int] | None = None,
    ) -> "Guides":
        """Guides of one half from its (H, W, C) buffers, bounded by ±1e15.

        Args:
            color, denoised, albedo, normal, visibility: the buffers.
            margin: pixels around, at least window // 2; beyond the image's border they are its mirror image.
            scale: what radiance is multiplied by.
            region: top, left, bottom, right of the pixels wanted, by default all.
        """
        top, left, bottom, right = region or (0, 0, *color.shape[:2])
        rows = mirror(top - margin, bottom + margin, color.shape[0]).to(color.device)
        columns = mirror(left - margin, right + margin + _LANES, color.shape[1]).to(color.device)

        def cut(buffer: Tensor, factor: float = 1.0) -> Tensor:
            part = buffer.index_select(0, rows).index_select(1, columns).permute(2, 0, 1)
            if factor != 1.0:
                return (part.double() * factor).clamp(-LARGEST, LARGEST).float()
            return part.float() if part.dtype == torch.float16 else part

        parts = [cut(color, scale), *(cut(b) for b in (albedo, visibility, normal) if b is not None)]
        planes = torch.cat([*parts, cut(denoised, scale)]).clamp_(-LARGEST, LARGEST)
        present = (albedo is not None, normal is not None, visibility is not None)
        return cls(planes, bottom - top, right - left, margin, *present)

    @classmethod
    def stack(cls, crops: "list[Guides]") -> "Guides":
        """Guides of one size, below one another."""
        return replace(crops[0], planes=torch.cat([c.planes for c in crops], 1), stacked=len(crops))

    @property
    def pitch(self) -> int:
        """Rows from one of the stacked crops to the next."""
        return self.height + 2 * self.margin

    @property
    def betas(self) -> int:
        """Number of Eq. 10's scales β: three for each of z, albedo and normal."""
        return 3 * (1 + self.has_albedo + self.has_normal)

    @property
    def gammas(self) -> int:
        """Number of Eq. 11's bandwidths γ: y, z, and one for each G-buffer."""
        return 2 + self.has_albedo + self.has_normal + self.has_visibility

    @property
    def inner(self) -> Tensor:
        """All planes without their margin, (C, H, W); of the first of stacked crops."""
        m = self.margin
        return self.planes[:, m : m + self.height, m : m + self.width]

    @property
    def radiance(self) -> Tensor:
        """The planes of y, (3, …)."""
        return self.planes[:3]

    @property
    def denoised(self) -> Tensor:
        """The planes of z, (3, …)."""
        return self.planes[-3:]

    def views(self, corners: Tensor, size: tuple[int, int]) -> list[Tensor]:
        """N patches (C, h, w), nothing copied; ``corners`` (N, 2) are the rows and columns of their first pixels."""
        h, w = size
        return [self.planes[:, y : y + h, x : x + w] for y, x in (corners + self.margin).tolist()]

    def patches(self, corners: Tensor, size: tuple[int, int]) -> Tensor:
        """The same patches, copied to (N, C, h, w)."""
        return torch.stack(self.views(corners, size))
