"""What comes in, as finite tensors: NaN and infinite pixels filled from their neighbours, and counted."""

from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from selfcorrect.errors import FrameError

__all__ = ["Repairs", "as_tensor", "check_finite", "repair", "repaired"]

_MOST_REPAIRED = 0.5  # share of a radiance channel's pixels: with more, what is filled in is no render


class Repairs(NamedTuple):
    """How many pixels of a buffer were changed on the way in."""

    non_finite: int
    negative: int


def repaired(image: Any, what: str) -> Tensor:
    """An (H, W, 3) array as float32, filled where it is not finite; negative values stay.

    Raises:
        FrameError: it has another shape or no floating-point numbers; ``what`` names it.
    """
    return repair(as_tensor(image, what, 3, half=False), radiance=False)[0]


def as_tensor(array: Any, what: str, channels: int, *, half: bool) -> Tensor:
    """An array as (H, W, channels) float32; where ``half``, float16 stays what it is.

    Raises:
        FrameError: it has another shape or no floating-point numbers; ``what`` names it.
    """
    if isinstance(array, Tensor):
        tensor = array.detach()
    else:
        values = np.asarray(array)
        tensor = torch.from_numpy(np.array(values, dtype=values.dtype.newbyteorder("="), order="C"))
    if not tensor.is_floating_point():
        raise FrameError(f"expected {what} as floating-point numbers, but got {tensor.dtype}")
    if tensor.ndim == 2 and channels == 1:
        tensor = tensor[:, :, None]
    if tensor.ndim != 3 or tensor.shape[2] != channels or 0 in tensor.shape:
        raise FrameError(f"expected {what} of shape (H, W, {channels}), but got {tuple(tensor.shape)}")
    if tensor.dtype == torch.float64:
        # what float32 cannot hold must not turn into an infinity that the render does not have
        largest = torch.finfo(torch.float32).max
        tensor = torch.where(tensor.isfinite(), tensor.clamp(-largest, largest), tensor)
    return tensor if half and tensor.dtype == torch.float16 else tensor.float()


def check_finite(image: Tensor, what: str) -> None:
    """Raise a FrameError where a channel of radiance (H, W, 3) holds too few finite values to be filled from."""
    pixels = image.shape[0] * image.shape[1]
    for channel, broken in zip("RGB", (~image.isfinite()).sum((0, 1)).tolist(), strict=True):
        if broken > _MOST_REPAIRED * pixels:
            raise FrameError(
                f"expected finite radiance at {1 - _MOST_REPAIRED:.0%} of the pixels or more in channel {channel} of "
                f"{what}, but got NaN or infinity at {broken} of {pixels}; render it again"
            )


def repair(image: Tensor, *, radiance: bool) -> tuple[Tensor, Repairs]:
    """The image filled where it is not finite, radiance clipped at 0; a tensor that needs no change is not copied."""
    finite = image.isfinite()
    broken = int((~finite.all(-1)).sum())
    if broken:
        image = _fill(image.float(), finite).to(image.dtype)
    negative = int((image < 0).any(-1).sum()) if radiance else 0
    if negative:
        image = image.clamp(min=0)
    return image, Repairs(broken, negative)


def _fill(image: Tensor, known: Tensor) -> Tensor:
    """Fill unknown values from those of the channel around them, nearer ones first (push-pull); all unknown gives 0."""
    weight = known.to(image.dtype).permute(2, 0, 1)[None]
    value = torch.where(known, image, 0.0).permute(2, 0, 1)[None]
    filled = _push_pull(value, weight)[0].permute(1, 2, 0)
    return torch.where(known, image, filled)


def _push_pull(value: Tensor, weight: Tensor) -> Tensor:
    """``value`` is already zero where ``weight`` is; returns it with the gaps filled from coarser levels."""
    if min(value.shape[-2:]) == max(value.shape[-2:]) == 1 or bool(weight.all()):
        return value
    coarse_weight = F.avg_pool2d(weight, 2, ceil_mode=True, count_include_pad=False)
    coarse_value = F.avg_pool2d(value, 2, ceil_mode=True, count_include_pad=False)
    known = coarse_weight > 0
    coarse = torch.where(known, coarse_value / coarse_weight.clamp(min=1e-12), 0.0)
    filled = F.interpolate(_push_pull(coarse, known.to(weight.dtype)), size=value.shape[-2:], mode="nearest")
    return torch.where(weight > 0, value, filled)
