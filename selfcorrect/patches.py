"""Where the training patches lie."""

import torch
from torch import Tensor

__all__ = ["grid"]


def grid(height: int, width: int, *, patch: int, stride: int) -> Tensor:
    """First pixels of ⌈height/stride⌉·⌈width/stride⌉ patches on a grid centred on the image, (N, 2) int64.

    The first and last patches may reach beyond the image (Back et al. 2022, published code).

    >>> grid(64, 130, patch=128, stride=64).tolist()
    [[-32, -63], [-32, 1], [-32, 65]]
    """

    def starts(size: int) -> Tensor:
        count = -(-size // stride)
        first = (size - (count - 1) * stride - patch) // 2
        return first + stride * torch.arange(count)

    return torch.cartesian_prod(starts(height), starts(width))
