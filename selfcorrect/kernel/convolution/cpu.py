"""The compiled convolutions as one differentiable torch function."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from selfcorrect.errors import FrameError
from selfcorrect.kernel.backend import instruction_set
from selfcorrect.kernel.compiled import functions as _cpu
from selfcorrect.kernel.compiled import installed

__all__ = ["BF16", "LARGEST_WIDTH", "best_instruction_set", "convolutions", "instruction_sets", "peak"]

BF16 = ("avx512bf16", "amx")
"""The variants that work in bfloat16."""

LARGEST_WIDTH = 16  # channels of a layer: a vector of the widest processors


def instruction_sets() -> list[str]:
    """Names of the compiled variants that this processor can run, slowest first."""
    return list(_cpu.convolution_instruction_sets()) if installed() else []


def best_instruction_set(precision: str) -> str:
    """The fastest variant of this precision, "fp32" or "bf16"; single precision where the processor lacks it."""
    names = instruction_sets()
    return names[-1] if precision == "bf16" else [name for name in names if name not in BF16][-1]


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
    """As :func:`selfcorrect.kernel.convolution.convolutions`, for float32 on the CPU and at most 16 channels.

    ``isa`` is one of :func:`instruction_sets`, by default the fastest of the precision. A pixel as many pixels or more
    away from a cut as there are layers is the same bit for bit as it is in the whole image.

    Raises:
        FrameError: gradients are wanted of a region.
        SettingsError: no such instruction set on this processor.
    """
    _, height, width = images[0].shape
    train = torch.is_grad_enabled() and any(p.requires_grad for p in parameters)
    region = region or (0, 0, height, width)
    if train and region != (0, 0, height, width):
        raise FrameError(f"expected the whole image (gradients are wanted), but got the region {region}")
    views = [image if image.stride(2) == 1 else image.contiguous() for image in images]
    isa = instruction_set(isa, instruction_sets()) if isa else best_instruction_set(precision)
    apply: Callable[..., Tensor] = _Convolutions.apply  # torch leaves it untyped
    return apply(views, list(region), train, log_radiance, threads, isa, *parameters)
