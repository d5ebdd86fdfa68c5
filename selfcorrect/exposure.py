"""Radiance in the units that the methods work in, of a mean near 1, without a second copy of an image."""

import torch
from torch import Tensor

from selfcorrect.bands import bands
from selfcorrect.kernel import LARGEST

__all__ = ["Scaled", "scaled"]


class Scaled:
    """An image (H, W, 3) of radiance times a factor, bounded like the guides; made where it is read, never whole."""

    def __init__(self, image: Tensor, factor: float):
        self.shape = image.shape
        self._image, self._factor = image, factor

    def __getitem__(self, rows: slice) -> Tensor:
        return (self._image[rows].double() * self._factor).clamp(max=LARGEST).float()


def scaled(image: Tensor, factor: float) -> Tensor:
    """Radiance times a factor, in place; bounded by what float32 holds."""
    largest = torch.finfo(torch.float32).max
    for rows in bands(image.shape[0]):
        image[rows] = (image[rows].double() * factor).clamp(-largest, largest)
    return image
