"""Border of an image: mirrored, with the edge pixel repeated."""

import torch

__all__ = ["mirrored"]


def mirrored(image: torch.Tensor, *, top: int = 0, bottom: int = 0, left: int = 0, right: int = 0) -> torch.Tensor:
    """Pad an image (H, W, C) as ``numpy.pad(mode="symmetric")`` does; the border may exceed the image."""
    if not (top or bottom or left or right):
        return image
    height, width = image.shape[:2]
    rows = image.index_select(0, _indices(height, top, bottom))
    return rows.index_select(1, _indices(width, left, right))


def _indices(size: int, before: int, after: int) -> torch.Tensor:
    """Indices of a mirrored axis: the period is twice its size, the second half running backwards."""
    phase = torch.arange(-before, size + after) % (2 * size)
    return torch.minimum(phase, 2 * size - 1 - phase)
