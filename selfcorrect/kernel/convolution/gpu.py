"""The network's convolutions on CUDA: torch's own, which are cuDNN's, in bfloat16 where that is asked for and fast."""

from collections.abc import Sequence
from contextlib import nullcontext

import torch
import torch.nn.functional as F
from torch import Tensor

from selfcorrect.kernel.convolution import reference

__all__ = ["convolutions", "has_fast_bf16"]


def has_fast_bf16(device: torch.device) -> bool:
    """Whether the device computes in bfloat16 rather than emulates it: compute capability 8.0, Ampere."""
    return device.type == "cuda" and torch.cuda.get_device_capability(device) >= (8, 0)


def convolutions(
    images: Sequence[Tensor],
    parameters: Sequence[Tensor],
    *,
    log_radiance: bool = False,
    region: tuple[int, int, int, int] | None = None,
    precision: str = "fp32",
    threads: int = 1,
) -> Tensor:
    """As :func:`selfcorrect.kernel.convolution.convolutions`; ``threads`` is not looked at.

    In bfloat16 the last layer is computed in single precision from rounded activations: by the compiled form for the
    CPU the heads are not rounded either.
    """
    x = reference.shown(images, log_radiance=log_radiance)
    bf16 = precision == "bf16" and has_fast_bf16(x.device)
    top, left, bottom, right = region or (0, 0, *x.shape[2:])
    *hidden, (weight, bias) = zip(parameters[::2], parameters[1::2], strict=True)
    with torch.autocast(x.device.type, torch.bfloat16) if bf16 else nullcontext():
        for w, b in hidden:
            x = torch.relu_(F.conv2d(x, w, b, padding=1))
    return F.conv2d(x.float(), weight, bias, padding=1)[:, :, top:bottom, left:right]
