"""Where the full buffer's denoised image may stand in for the halves' own."""

import torch
import torch.nn.functional as F
from torch import Tensor

from selfcorrect.image.bands import widened
from selfcorrect.image.exposure import Radiance

__all__ = ["trust_in_full"]

_DISAGREEMENT = 0.5  # (max − min) / (max + min) of the denoised halves: one of them has left a firefly
_DARKEST = 0.01  # radiance; below, the halves of a pixel are always alike


def trust_in_full(denoised: tuple[Radiance, Radiance], denoised_full: Radiance, rows: slice) -> Tensor:
    """How far the full buffer's denoised image may stand in for the halves' own, (rows, W, 1), 0 … 1.

    It is the better input, but a firefly that the denoiser has left in one half is in the full buffer too; with their
    own images only one of the corrected halves has it. So not where the halves differ by more than a factor of three,
    unless the full buffer sides with the darker one.
    """
    wide, inner = widened(rows, 4, denoised_full.shape[0])
    a, b, full = (image[wide].double().mean(-1) for image in (*denoised, denoised_full))
    middle, half = (a + b) / 2, (a - b).abs() / 2
    left_in_one = half > _DISAGREEMENT * middle.clamp(min=_DARKEST / 10)
    sides_with_darker = (2 * (middle - full) / half.clamp(min=torch.finfo(torch.float64).tiny)).clamp(0, 1)
    doubt = torch.where(left_in_one, 1 - sides_with_darker, 0.0)[None, None]
    around = F.max_pool2d(doubt, 5, 1, 2)
    return 1 - F.avg_pool2d(around, 5, 1, 2, count_include_pad=False)[0, 0, inner, :, None]
