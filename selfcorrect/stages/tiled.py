"""Trained networks on whole images, tile by tile: their memory does not grow with the frame.

A tile's network sees as much around it as reaches its outputs, so that tiles are equal to the whole but for rounding:
the convolutions may sum in an order that depends on their size. ``tests/test_trained_stages.py`` holds radiance near 1
to 1e-6 in single precision; found was 1e-7. In bfloat16 a weight may round to its neighbour, by 2⁻⁸ of itself, which
with the 25 weights of the tests' network moves a pixel by 2⁻⁸ / 25 = 1.6e-4: seen in 5 of 12288 values; the test holds
the largest difference to two such, and 99.9 % of all to 1e-4.
"""

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor

from selfcorrect.image.exposure import LARGEST, scaled
from selfcorrect.image.tiles import Region, tiles
from selfcorrect.image.windows import reflect
from selfcorrect.kernel.convolution import best_instruction_set
from selfcorrect.stages.deep_combiner import DeepCombiner, combined
from selfcorrect.stages.james_stein import WINDOW
from selfcorrect.stages.neural_james_stein import (
    ALIGNMENT,
    REACH,
    VarianceNetwork,
    relative_weights,
    shrunk,
    smoothed_variance,
)

__all__ = ["SIDE", "combine", "cut", "neural_james_stein"]

SIDE = 192  # of the tiles, pixels; the weights of a tile, four buffers and what lies around are 0.2 GB


@torch.no_grad()
def combine(
    network: DeepCombiner,
    noisy: Sequence[Tensor],
    denoised: Sequence[Tensor],
    features: Tensor,
    *,
    scale: float = 1.0,
    precision: str = "fp32",
    side: int = SIDE,
) -> Tensor:
    """The deep combiner's image, (H, W, 3).

    Args:
        network: trained, of as many pairs as there are images.
        noisy: y of each pair, linear radiance, (H, W, 3).
        denoised: z of each pair.
        features: (7, H, W), see :func:`selfcorrect.stages.deep_combiner.feature_planes`.
        scale: what brings the radiance to a mean near 1.
        precision: "fp32", or "bf16" for convolutions in bfloat16 where the processor has matrix tiles.
        side: of the tiles, pixels.
    """

    def radiance(images: Sequence[Tensor], region: Region, reach: int = 0) -> Tensor:
        parts = [cut(image.permute(2, 0, 1), region, reach).double() * scale for image in images]
        return torch.stack(parts).clamp_(-LARGEST, LARGEST).float()

    size, pad = (features.shape[1], features.shape[2]), network.window // 2
    result = torch.empty_like(noisy[0])
    for region in tiles(size, side):
        around, inside = _around(region, network.reach, size)
        shown = radiance(noisy, around), radiance(denoised, around), cut(features, around)
        with _autocast(features, precision):
            weights = network.weights(*(planes[None] for planes in shown))[(..., *inside)]
        residual = radiance(noisy, region, pad) - radiance(denoised, region, pad)
        tile = combined(weights, residual[None], radiance(denoised, region)[None], network.window)
        result[_slices(region)] = tile[0].permute(1, 2, 0)
    return scaled(result, 1 / scale)


@torch.no_grad()
def neural_james_stein(
    network: VarianceNetwork,
    x: Tensor,
    variance: Tensor,
    y_a: Tensor,
    y_b: Tensor,
    *,
    precision: str = "fp32",
    side: int = SIDE,
) -> Tensor:
    """θ of the neural James–Stein combiner, (H, W, 3); arguments as for its network and :func:`combine`.

    The tiles' share is σ² and α; what is shrunk is the whole image, by its own relative weight.
    """
    planes = [image.permute(2, 0, 1).float() for image in (x, variance, y_a, y_b)]
    size = (x.shape[0], x.shape[1])
    q = relative_weights(planes[0][None])
    weighted = q[0] * planes[1]
    smoothed, alpha = torch.empty_like(planes[0]), torch.empty_like(planes[0][:1])
    aligned = (-(-size[0] // ALIGNMENT) * ALIGNMENT, -(-size[1] // ALIGNMENT) * ALIGNMENT)
    for region in tiles(size, -(-side // ALIGNMENT) * ALIGNMENT):
        around, inside = _around(region, REACH, aligned)
        with _autocast(x, precision):
            weights, share = network(*(cut(each, around)[None] for each in planes))
        at = (slice(None), *_slices(region))
        smoothed[at] = smoothed_variance(weights[(..., *inside)], cut(weighted, region, WINDOW // 2)[None])[0]
        alpha[at] = share[(0, slice(None), *inside)]
    y = alpha * planes[2] + (1 - alpha) * planes[3]
    return shrunk(planes[0][None], y[None], smoothed[None], q)[0].permute(1, 2, 0).contiguous()


def cut(planes: Tensor, region: Region, reach: int = 0) -> Tensor:
    """A region of planes (…, H, W) and ``reach`` pixels around it; beyond the image it is mirrored."""
    top, left, bottom, right = region
    rows = reflect(top - reach, bottom + reach, planes.shape[-2]).to(planes.device)
    columns = reflect(left - reach, right + reach, planes.shape[-1]).to(planes.device)
    return planes.index_select(-2, rows).index_select(-1, columns)


def _around(region: Region, reach: int, size: tuple[int, int]) -> tuple[Region, tuple[slice, slice]]:
    """The region with ``reach`` or a little more on every side, in an image of this size, and where it lies in that."""
    top, left, bottom, right = region
    first, begin = max(top - reach, 0), max(left - reach, 0)
    last, end = (
        min(-(-(beyond + reach) // ALIGNMENT) * ALIGNMENT, pixels)
        for beyond, pixels in zip((bottom, right), size, strict=True)
    )
    inside = slice(top - first, bottom - first), slice(left - begin, right - begin)
    return (first, begin, last, end), inside


def _slices(region: Region) -> tuple[slice, slice]:
    top, left, bottom, right = region
    return slice(top, bottom), slice(left, right)


def _autocast(image: Tensor, precision: str) -> AbstractContextManager[object]:
    """Bfloat16 where it is asked for and fast: other processors emulate it."""
    if precision == "bf16" and image.device.type == "cpu" and best_instruction_set("bf16") == "amx":
        return torch.autocast("cpu", torch.bfloat16)
    return nullcontext()
