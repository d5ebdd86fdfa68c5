"""The compiled kernel as differentiable torch _cpu."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from selfcorrect.buffers import TERMS
from selfcorrect.kernel.backend import instruction_set
from selfcorrect.kernel.compiled import functions as _cpu
from selfcorrect.kernel.cross_bilateral.window import Window
from selfcorrect.kernel.guides import Guides

__all__ = ["cross_bilateral", "cross_bilateral_loss"]


class _Options(NamedTuple):
    window: Window
    isa: str
    threads: int


def _arguments(guides: Guides, raw: Tensor, corners: Tensor, options: _Options) -> tuple[Any, ...]:
    return (
        guides.planes,
        sum(1 << TERMS.index(term) for term in guides.terms),
        raw.detach(),
        (corners + guides.margin).contiguous(),
        options.window.side,
        options.window.every,
        options.window.combination == "eq3",
        options.isa,
        options.threads,
    )


class _CrossBilateral(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, raw: Tensor, guides: Guides, corners: Tensor, options: _Options) -> Tensor:
        ctx.save_for_backward(raw)
        ctx.call = (guides, corners, options)
        output = raw.new_empty((raw.shape[0], 3, raw.shape[2], raw.shape[3]))
        _cpu.forward(*_arguments(guides, raw, corners, options), output)
        return output

    @staticmethod
    def backward(ctx: Any, *output_gradients: Tensor) -> Any:
        (raw,) = ctx.saved_tensors
        guides, corners, options = ctx.call
        gradient = torch.empty_like(raw)
        _cpu.backward(*_arguments(guides, raw, corners, options), output_gradients[0].contiguous(), gradient)
        return gradient, None, None, None


class _CrossBilateralLoss(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, raw: Tensor, guides: Guides, corners: Tensor, target: Tensor, weight: Tensor, options: _Options
    ) -> Tensor:
        gradient = torch.empty_like(raw)
        row_loss = torch.empty(raw.shape[0] * raw.shape[2], dtype=torch.float64)
        _cpu.loss(*_arguments(guides, raw, corners, options), target, weight, gradient, row_loss)
        count = raw.shape[0] * raw.shape[2] * raw.shape[3] * 3
        ctx.save_for_backward(gradient)
        ctx.count = count
        return (row_loss.sum() / count).to(raw.dtype)

    @staticmethod
    def backward(ctx: Any, *output_gradients: Tensor) -> Any:
        (gradient,) = ctx.saved_tensors
        return gradient * (output_gradients[0] / ctx.count), None, None, None, None, None


def cross_bilateral(
    guides: Guides, raw: Tensor, corners: Tensor, window: Window, *, threads: int = 1, isa: str = ""
) -> Tensor:
    """Eq. 10, like :func:`selfcorrect.kernel.cross_bilateral.reference.cross_bilateral`, for float32 on the CPU.

    ``isa`` is one of :func:`selfcorrect.kernel.backend.instruction_sets`, by default the fastest.
    """
    options = _Options(window, instruction_set(isa), threads)
    apply: Callable[..., Tensor] = _CrossBilateral.apply  # torch leaves it untyped
    return apply(raw, guides, corners, options)


def cross_bilateral_loss(
    guides: Guides,
    raw: Tensor,
    corners: Tensor,
    target: Tensor,
    weight: Tensor,
    window: Window,
    *,
    threads: int = 1,
    isa: str = "",
) -> Tensor:
    """One half of Eq. 8, value and gradient in one visit of each pixel."""
    options = _Options(window, instruction_set(isa), threads)
    apply: Callable[..., Tensor] = _CrossBilateralLoss.apply  # torch leaves it untyped
    return apply(raw, guides, corners, target, weight, options)
