"""Radiance in the units that the methods work in, of a mean near 1, without a second copy of an image."""

from typing import Any, Protocol

import torch
from torch import Tensor

from selfcorrect.image.bands import average, in_bands, tile_means
from selfcorrect.image.channels import channel_mean

__all__ = ["LARGEST", "Radiance", "Scaled", "scale_", "scale_to_one"]

LARGEST = 1e15  # keeps squared differences in a window finite in float32


class Radiance(Protocol):
    """An image (H, W, 3) that is read a band of rows at a time: a tensor, or something that is made when it is read."""

    @property
    def shape(self) -> torch.Size:
        """(H, W, 3)."""
        ...

    def __getitem__(self, rows: Any, /) -> Tensor:
        """These rows."""
        ...


class Scaled:
    """An image (H, W, 3) of radiance times a factor, bounded like the guides; made where it is read, never whole."""

    def __init__(self, image: Tensor, factor: float):
        self.shape = image.shape
        self._image, self._factor = image, factor

    def __getitem__(self, rows: slice) -> Tensor:
        return (self._image[rows].double() * self._factor).clamp_(max=LARGEST).float()


def scale_(image: Tensor, factor: float) -> Tensor:
    """Radiance times a factor, in place; bounded by what float32 holds."""
    largest = torch.finfo(torch.float32).max

    def scale(rows: slice) -> None:
        image[rows] = (image[rows].double() * factor).clamp_(-largest, largest)

    in_bands(image.shape[0], scale)
    return image


def scale_to_one(halves: tuple[Radiance, Radiance]) -> float:
    """What brings the mean of two denoised halves near 1: by the mean of roots, which few bright pixels hardly move."""
    height, width = halves[0].shape[:2]

    def roots(rows: slice) -> Tensor:
        return torch.stack([channel_mean(half[rows].double()).clamp(min=0).sqrt() for half in halves])

    root = sum(average(tile_means(height, roots), (height, width))) / 2
    return 1 / root**2 if root > 0 else 1.0
