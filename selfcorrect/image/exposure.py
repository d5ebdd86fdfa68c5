"""Radiance in the units that the methods work in, of a mean near 1, without a second copy of an image."""

from typing import Any, Protocol

import torch
from torch import Tensor

from selfcorrect.image.bands import bands

__all__ = ["LARGEST", "Radiance", "Scaled", "scale_"]

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
        return (self._image[rows].double() * self._factor).clamp(max=LARGEST).float()


def scale_(image: Tensor, factor: float) -> Tensor:
    """Radiance times a factor, in place; bounded by what float32 holds."""
    largest = torch.finfo(torch.float32).max
    for rows in bands(image.shape[0]):
        image[rows] = (image[rows].double() * factor).clamp(-largest, largest)
    return image
