"""The compiled convolutions as one differentiable torch function."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from selfcorrect.kernel import _cpu

__all__ = ["LARGEST_WIDTH", "best_instruction_set", "convolutions", "instruction_sets"]

LARGEST_WIDTH = 16  # channels of a layer: a vector of the widest processors


def instruction_sets() -> list[str]:
    """Names of the compiled variants that this processor can run, slowest first; ``amx`` works in bfloat16."""
    return list(_cpu.convolution_instruction_sets())


def best_instruction_set(precision: str) -> str:
    """The fastest variant of this precision, "fp32" or "bf16"; single precision where there are no bfloat16 tiles."""
    names = instruction_sets()
    return names[-1] if precision == "bf16" else [name for name in names if name != "amx"][-1]


class _Convolutions(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        images: list[Tensor],
        train: bool,
        log_radiance: bool,
        region: list[int],
        threads: int,
        isa: str,
        *parameters: Tensor,
    ) -> Tensor:
        weights, biases = list(parameters[::2]), list(parameters[1::2])
        _, height, width = images[0].shape
        top, left, bottom, right = region
        shape = (len(images), len(weights), height, width)
        kept = torch.empty(_cpu.convolution_kept_bytes(isa, *shape) if train else 0, dtype=torch.uint8)
        output = torch.empty(len(images), weights[-1].shape[0], bottom - top, right - left)
        _cpu.convolution_forward(
            images,
            [w.detach() for w in weights],
            [b.detach() for b in biases],
            log_radiance,
            region,
            isa,
            threads,
            kept,
            output,
        )
        ctx.save_for_backward(kept, *weights)
        ctx.options = (isa, threads)
        return output

    @staticmethod
    def backward(ctx: Any, *output_gradients: Tensor) -> Any:
        kept, *weights = ctx.saved_tensors
        isa, threads = ctx.options
        (upstream,) = output_gradients
        if upstream.stride(3) != 1:
            upstream = upstream.contiguous()
        weight_gradients = [torch.empty(w.shape) for w in weights]
        bias_gradients = [torch.empty(w.shape[0]) for w in weights]
        _cpu.convolution_backward(
            [w.detach() for w in weights], isa, threads, kept, upstream, weight_gradients, bias_gradients
        )
        pairs = zip(weight_gradients, bias_gradients, strict=True)
        return *[None] * 6, *[gradient for pair in pairs for gradient in pair]


def convolutions(
    images: Sequence[Tensor],
    parameters: Sequence[Tensor],
    *,
    log_radiance: bool = False,
    region: tuple[int, int, int, int] | None = None,
    precision: str = "fp32",
    threads: int = 1,
    isa: str = "",
) -> Tensor:
    """Convolutions 3×3, zeros around the images, ReLU between the layers; differentiable in the parameters.

    Args:
        images: N views (C, h, w) of one size, float32, C ≤ 16; they may lie anywhere in memory, and nothing is copied.
        parameters: weight (out, in, 3, 3) and bias (out) of each layer in turn, float32, at most 16 channels each.
        log_radiance: the network sees ln(1 + x) of the first and the last three channels; negative x count as 0.
        region: top, left, bottom, right of the pixels whose heads are wanted; by default all. A pixel as many pixels
            or more away from a cut as there are layers is the same bit for bit as it is in the whole image. Only
            without gradients.
        precision: "fp32", or "bf16": weights, activations and upstream gradients are rounded to bfloat16, sums are
            in float32. Processors without matrix tiles (AMX) compute in float32 then, too.
        threads: has no influence on the result.
        isa: one of :func:`instruction_sets` instead of the fastest.

    Returns:
        Raw heads (N, heads, height, width of the region).
    """
    _, height, width = images[0].shape
    views = [image if image.stride(2) == 1 else image.contiguous() for image in images]
    where = list(region or (0, 0, height, width))
    isa = isa or best_instruction_set(precision)
    train = torch.is_grad_enabled() and any(p.requires_grad for p in parameters)
    options = (train, log_radiance, where, threads, isa)
    result: Tensor = _Convolutions.apply(views, *options, *parameters)  # type: ignore[no-untyped-call]  # torch's
    return result
