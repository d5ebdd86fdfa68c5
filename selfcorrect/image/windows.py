"""Means over windows, the border mirrored without repeating the edge pixel (NumPy's ``reflect``), of any image size."""

import math

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d

__all__ = ["box_mean", "gaussian_mean", "reflect", "reflected"]


def reflect(start: int, stop: int, size: int) -> Tensor:
    """Indices ``start … stop-1`` of a line of ``size`` pixels mirrored at its end pixels.

    >>> reflect(-3, 5, 3).tolist()
    [1, 2, 1, 0, 1, 2, 1, 0]
    """
    if size == 1:
        return torch.zeros(stop - start, dtype=torch.int64)
    index = torch.arange(start, stop) % (2 * size - 2)
    return torch.where(index < size, index, 2 * size - 2 - index)


def reflected(planes: Tensor, radius: int) -> Tensor:
    """Planes (…, H, W) with ``radius`` mirrored pixels more on every side; the radius may exceed the image."""
    rows, columns = (reflect(-radius, size + radius, size).to(planes.device) for size in planes.shape[-2:])
    return planes.index_select(-2, rows).index_select(-1, columns)


def box_mean(planes: Tensor, window: int) -> Tensor:
    """Mean over window×window pixels of planes (C, H, W), window odd.

    By rows and then by columns: a running sum would be cheaper still, but after one firefly of 1e20 it has forgotten
    what the other pixels were.
    """
    padded = reflected(planes, window // 2)[None]
    return avg_pool2d(avg_pool2d(padded, (window, 1), stride=1), (1, window), stride=1)[0]


def gaussian_mean(planes: Tensor, sigma: float) -> Tensor:
    """Gaussian-weighted mean of planes (C, H, W), cut off at three standard deviations (in pixels)."""
    radius = math.ceil(3 * sigma)
    offsets = torch.arange(-radius, radius + 1, dtype=planes.dtype, device=planes.device)
    weights = torch.exp(-(offsets**2) / (2 * sigma**2))
    weights = weights / weights.sum()
    padded = reflected(planes, radius)[:, None]
    return conv2d(conv2d(padded, weights.reshape(1, 1, -1, 1)), weights.reshape(1, 1, 1, -1))[:, 0]
