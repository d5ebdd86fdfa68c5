"""The network's convolutions in plain torch: any dtype, any device, differentiable by autograd."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

__all__ = ["convolutions", "shown"]


def shown(images: Sequence[Tensor], *, log_radiance: bool) -> Tensor:
    """What the first layer sees, (N, C, h, w), channels innermost in memory."""
    x = torch.stack(list(images))
    if log_radiance:
        x = torch.cat([x[:, :3].log1p(), x[:, 3:-3], x[:, -3:].log1p()], 1)
    return x.contiguous(memory_format=torch.channels_last)


def convolutions(
    images: Sequence[Tensor],
    parameters: Sequence[Tensor],
    *,
    log_radiance: bool = False,
    region: tuple[int, int, int, int] | None = None,
    precision: str = "fp32",
    threads: int = 1,
) -> Tensor:
    """As :func:`selfcorrect.kernel.convolution.convolutions`; ``precision`` and ``threads`` are not looked at."""
    x = shown(images, log_radiance=log_radiance)
    top, left, bottom, right = region or (0, 0, *x.shape[2:])
    *hidden, (weight, bias) = zip(parameters[::2], parameters[1::2], strict=True)
    for w, b in hidden:
        x = torch.relu_(F.conv2d(x, w, b, padding=1))
    return F.conv2d(x, weight, bias, padding=1)[:, :, top:bottom, left:right]
