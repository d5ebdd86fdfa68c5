"""What the trained networks share: convolutions with a generator of their own, and radiance as they see it."""

import torch
from torch import Tensor, nn

from selfcorrect.image.windows import reflect

__all__ = ["convolution", "start_flat", "tau", "to_multiple"]

_START_SPREAD = 0.1  # of a last layer's weights: its outputs start near the same value everywhere


def convolution(inputs: int, outputs: int, kernel: int, generator: torch.Generator) -> nn.Conv2d:
    """Zero padding, He-uniform weights and zero biases; the caller's random numbers are left alone."""
    layer: nn.Conv2d = nn.utils.skip_init(nn.Conv2d, inputs, outputs, kernel, padding=kernel // 2)
    nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu", generator=generator)
    nn.init.zeros_(_bias(layer))
    return layer


def start_flat(layer: nn.Conv2d, biases: Tensor) -> None:
    """Let a last layer start with nearly these outputs at every pixel."""
    with torch.no_grad():
        layer.weight.mul_(_START_SPREAD)
        _bias(layer).copy_(biases)


def _bias(layer: nn.Conv2d) -> Tensor:
    assert layer.bias is not None  # the convolutions here have one
    return layer.bias


def tau(radiance: Tensor) -> Tensor:
    """τ(x) = sign(x) ln(1 + |x|): what the networks see and the James–Stein loss is taken of."""
    return radiance.sign() * radiance.abs().log1p()


def to_multiple(planes: Tensor, side: int) -> Tensor:
    """Planes (…, H, W) mirrored at the bottom and the right until ``side`` divides both."""
    rows, columns = (reflect(0, -(-size // side) * side, size).to(planes.device) for size in planes.shape[-2:])
    return planes.index_select(-2, rows).index_select(-1, columns)
