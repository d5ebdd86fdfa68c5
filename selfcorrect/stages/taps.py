"""Sums over a window with weights that differ at every pixel, as the predicted kernels need them.

Gathering the window (unfold) would hold window² copies of the image: 59 MB a channel for four patches of 128×128, in
single precision. :func:`windowed_sum` walks over shifted views instead, backward too, so that nothing is held
beside the weights and their gradient. :func:`windowed_sum_reference` is the readable one.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

__all__ = ["windowed_sum", "windowed_sum_reference"]


def windowed_sum_reference(weights: Tensor, padded: Tensor, window: int) -> tuple[Tensor, Tensor]:
    """The same as :func:`windowed_sum`, by gathering every window; any dtype."""
    around = padded.unfold(2, window, 1).unfold(3, window, 1).flatten(4)
    return torch.einsum("nthw,nchwt->nchw", weights, around), weights.sum(1, keepdim=True)


def windowed_sum(weights: Tensor, padded: Tensor, window: int) -> tuple[Tensor, Tensor]:
    """``Σ_{i ∈ Ω_c} w_ci v_i`` and ``Σ_i w_ci`` at every pixel c, differentiable once in both arguments.

    Args:
        weights: (N, window², H, W), by rows of the window; float32 or float64, or bfloat16, which is summed in float32.
        padded: v with its border, (N, C, H + window − 1, W + window − 1).
        window: side of Ω, odd.

    Returns:
        (N, C, H, W) and (N, 1, H, W), float32, or float64 where the weights are.
    """
    kind = torch.float64 if weights.dtype == torch.float64 else torch.float32
    counted = torch.cat([padded.to(kind), padded.new_ones(1, dtype=kind).expand_as(padded[:, :1])], 1)
    # one plane a tap: the networks' outputs lie with the taps innermost
    apply: Callable[..., Tensor] = _WindowedSum.apply  # torch leaves it untyped
    total = apply(weights.contiguous(), counted, window)
    return total[:, :-1], total[:, -1:]


def _shifted(padded: Tensor, tap: int, window: int) -> Tensor:
    """What lies at this tap of every pixel's window, of one image (C, H + window − 1, W + window − 1)."""
    row, column = divmod(tap, window)
    reach = window - 1
    return padded[:, row : padded.shape[1] - reach + row, column : padded.shape[2] - reach + column]


class _WindowedSum(torch.autograd.Function):
    """One image at a time, so that its sums stay in the cache while all taps pass by."""

    @staticmethod
    def forward(ctx: Any, weights: Tensor, padded: Tensor, window: int) -> Tensor:
        ctx.save_for_backward(weights, padded)
        ctx.window = window
        total = padded.new_zeros(weights.shape[0], padded.shape[1], *weights.shape[2:])
        for image, taps, values in zip(total, weights, padded, strict=True):
            for tap in range(window**2):
                image.addcmul_(taps[tap].to(padded.dtype), _shifted(values, tap, window))
        return total

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        weights, padded = ctx.saved_tensors
        of_weights = torch.empty_like(weights) if ctx.needs_input_grad[0] else None
        of_padded = torch.zeros_like(padded) if ctx.needs_input_grad[1] else None
        gradient = gradient.contiguous()
        for n, upstream in enumerate(gradient):
            for tap in range(ctx.window**2):
                if of_weights is not None:
                    of_weights[n, tap] = _inner(upstream, _shifted(padded[n], tap, ctx.window))
                if of_padded is not None:
                    _shifted(of_padded[n], tap, ctx.window).addcmul_(weights[n, tap].to(padded.dtype), upstream)
        return of_weights, of_padded, None


def _inner(a: Tensor, b: Tensor) -> Tensor:
    """Σ over the channels, without a product of them all in memory."""
    total = a[0] * b[0]
    for one, other in zip(a[1:], b[1:], strict=True):
        total.addcmul_(one, other)
    return total
