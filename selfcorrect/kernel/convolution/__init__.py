"""The network's 3×3 convolutions, one after the other: validated here, computed by one of the forms beside."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from selfcorrect.errors import FrameError
from selfcorrect.kernel.backend import choose
from selfcorrect.kernel.convolution import cpu, gpu, reference
from selfcorrect.kernel.convolution.cpu import LARGEST_WIDTH, best_instruction_set

__all__ = ["LARGEST_WIDTH", "best_instruction_set", "convolutions", "has_fast_bf16"]


def has_fast_bf16(device: torch.device) -> bool:
    """Whether torch's own convolutions in bfloat16 are fast there; else they are emulated."""
    return gpu.has_fast_bf16(device) or (device.type == "cpu" and not {*cpu.BF16}.isdisjoint(cpu.instruction_sets()))


def convolutions(
    images: Sequence[Tensor],
    parameters: Sequence[Tensor],
    *,
    log_radiance: bool = False,
    region: tuple[int, int, int, int] | None = None,
    precision: str = "fp32",
    threads: int = 1,
    backend: str | None = None,
) -> Tensor:
    """Convolutions 3×3, zeros around the images, ReLU between the layers; differentiable in the parameters.

    Args:
        images: N views (C, h, w) of one size; they may lie anywhere in memory, and the compiled form copies nothing.
        parameters: weight (out, in, 3, 3) and bias (out) of each layer in turn.
        log_radiance: the network sees ln(1 + x) of the first and the last three channels, which are ≥ 0.
        region: top, left, bottom, right of the pixels whose heads are wanted; by default all. The compiled form gives
            no gradients of a part.
        precision: "fp32", or "bf16": weights, activations and upstream gradients are rounded to bfloat16, sums are
            in float32. Processors without AVX512-BF16 or matrix tiles (AMX), and cards without tiles, compute in
            float32 then, too.
        threads: of the compiled form; no influence on the result.
        backend: as for :func:`selfcorrect.kernel.backend.choose`; layers of more than 16 channels are the reference's.

    Returns:
        Raw heads (N, heads, height, width of the region).

    Raises:
        FrameError: the images' sizes differ, the region reaches beyond them, or gradients are wanted of it.
        SettingsError: no such backend for these tensors.
    """
    if any(image.shape != images[0].shape for image in images):
        raise FrameError(f"expected images of one shape, but got {[tuple(image.shape) for image in images]}")
    inputs, height, width = images[0].shape
    if region is not None:
        top, left, bottom, right = region
        if not (0 <= top < bottom <= height and 0 <= left < right <= width):
            raise FrameError(f"expected a region inside {(0, 0, height, width)}, but got the region {region}")
    form = choose(
        backend,
        [*images, *parameters],
        fits=max(inputs, *(bias.shape[0] for bias in parameters[1::2])) <= LARGEST_WIDTH,
        limit=f"layers of at most {LARGEST_WIDTH} channels",
        gpu=True,
    )
    convolve: Callable[..., Tensor] = {"cpu": cpu, "gpu": gpu, "reference": reference}[form].convolutions
    return convolve(images, parameters, log_radiance=log_radiance, region=region, precision=precision, threads=threads)
