"""Exposure that a denoiser can work in: a mean near 1, whatever the units of the frame.

A network learnt no radiance of 1e-9: OIDN made such frames 200 times as bright. Only powers of two are used, which
change no digit, and a frame that is within the range that denoisers are used to is left as it is.
"""

import math
from collections.abc import Sequence

import torch

from selfcorrect.image.bands import bands

__all__ = ["exponent", "shifted"]

_USUAL = 8  # 2⁻⁸ … 2⁸: means that need no change
_LARGEST = torch.finfo(torch.float32).max


def exponent(images: Sequence[torch.Tensor]) -> int | None:
    """The power of two that brings the mean of images (H, W, 3) near 1; 0 where it is near enough, None for black.

    The mean is that of roots, squared, which a few bright pixels do not move.
    """
    roots = [half[rows].double().abs().sqrt().mean() for half in images for rows in bands(half.shape[0], 1024)]
    root = float(torch.stack(roots).mean())
    if root == 0:
        return None
    power = round(2 * math.log2(root))
    return -power if abs(power) > _USUAL else 0


def shifted(image: torch.Tensor, power: int) -> torch.Tensor:
    """The image times 2 to the power, bounded by what float32 holds."""
    if not power:
        return image
    result = torch.empty_like(image, dtype=torch.float32)
    for rows in bands(image.shape[0]):
        result[rows] = (image[rows].double() * 2.0**power).clamp(-_LARGEST, _LARGEST)
    return result
