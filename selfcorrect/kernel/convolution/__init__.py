"""The compiled convolutions as one differentiable torch function."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from selfcorrect.errors import FrameError
from selfcorrect.kernel import _cpu

__all__ = ["LARGEST_WIDTH", "best_instruction_set", "convolutions", "instruction_sets", "peak"]

LARGEST_WIDTH = 16  # channels of a layer: a vector of the widest processors


def instruction_sets() -> list[str]:
    """Names of the compiled variants that this processor can run, slowest first; ``amx`` works in bfloat16."""
    return list(_cpu.convolution_instruction_sets())


def best_instruction_set(precision: str) -> str:
    """The fastest variant of this precision, "fp32" or "bf16"; single precision where there are no bfloat16 tiles."""
    names = instruction_sets()
    return names[-1] if precision == "bf16" else [name for name in names if name != "amx"][-1]


def peak(isa: str, rounds: int) -> float:
    """Do nothing but multiply-adds on one thread, as fast as this variant can; returns how many they were."""
    return _cpu.convolution_peak(isa, rounds)


class _Convolutions(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, images: list[Tensor], region: list[int], train: bool, *options: Any) -> Tensor:
        log_radiance, threads, isa, *parameters = options
        widths = [images[0].shape[0], *(bias.shape[0] for bias in parameters[1::2])]
        flat = torch.cat([p.detach().reshape(-1) for p in parameters])  # each tensor handed over costs microseconds
        _, height, width = images[0].shape
        top, left, bottom, right = region
        size = _cpu.convolution_kept_bytes(isa, len(images), len(widths) - 1, height, width) if train else 0
        kept = torch.empty(size, dtype=torch.uint8)
        output = torch.empty(len(images), widths[-1], bottom - top, right - left)
        _cpu.convolution_forward(images, flat, widths, log_radiance, region, isa, threads, kept, output)
        ctx.save_for_backward(kept, flat)
        ctx.options = (widths, isa, threads)
        ctx.shapes = [p.shape for p in parameters]
        return output

    @staticmethod
    def backward(ctx: Any, *output_gradients: Tensor) -> Any:
        kept, flat = ctx.saved_tensors
        (upstream,) = output_gradients
        if upstream.stride(3) != 1:
            upstream = upstream.contiguous()
        gradient = torch.empty_like(flat)
        _cpu.convolution_backward(flat, *ctx.options, kept, upstream, gradient)
        pieces = gradient.split([shape.numel() for shape in ctx.shapes])
        return *[None] * 6, *(piece.view(shape) for piece, shape in zip(pieces, ctx.shapes, strict=True))


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

    Raises:
        FrameError: the region reaches beyond the images, or gradients are wanted of it.
    """
    _, height, width = images[0].shape
    train = torch.is_grad_enabled() and any(p.requires_grad for p in parameters)
    top, left, bottom, right = whole = (0, 0, height, width)
    if region is not None and region != whole:
        top, left, bottom, right = region
        if train or not (0 <= top < bottom <= height and 0 <= left < right <= width):
            expected = "the whole image (gradients are wanted)" if train else f"a region inside {whole}"
            raise FrameError(f"expected {expected}, but got the region {region}")
    views = [image if image.stride(2) == 1 else image.contiguous() for image in images]
    apply: Callable[..., Tensor] = _Convolutions.apply  # torch leaves it untyped
    return apply(
        views,
        [top, left, bottom, right],
        train,
        log_radiance,
        threads,
        isa or best_instruction_set(precision),
        *parameters,
    )
