"""Where the training patches lie."""

import math
import sys
from collections.abc import Iterator

import torch
from torch import Tensor

from selfcorrect.kernel.guides import Guides
from selfcorrect.settings import Settings

__all__ = ["batches", "crops", "grid", "most_steps", "overhang", "steps_count"]

_MOST_PIXELS = 2**21  # to train on: README has what fewer cost


def grid(height: int, width: int, *, patch: int, stride: int) -> Tensor:
    """First pixels of ⌈height/stride⌉·⌈width/stride⌉ patches on a grid centred on the image, (N, 2) int64.

    The first and last patches may reach beyond the image (Back et al. 2022, published code).

    >>> grid(64, 130, patch=128, stride=64).tolist()
    [[-32, -63], [-32, 1], [-32, 65]]
    """

    def starts(size: int) -> Tensor:
        count = -(-size // stride)
        first = (size - (count - 1) * stride - patch) // 2
        return first + stride * torch.arange(count)

    return torch.cartesian_prod(starts(height), starts(width))


def overhang(size: tuple[int, int], settings: Settings) -> int:
    """How far beyond the image the patches of :func:`batches` may reach, pixels."""
    if settings.steps:
        return max(settings.patch - min(size), 0) + settings.patch // 4
    corners = grid(*size, patch=settings.patch, stride=settings.stride)
    return max(0, int((corners + settings.patch - torch.tensor(size)).max()), int(-corners.min()))


def steps_count(size: tuple[int, int], settings: Settings) -> int:
    """How many optimiser steps training takes."""
    if settings.steps:
        return min(settings.steps, most_steps(size, settings))
    patches = len(grid(*size, patch=settings.patch, stride=settings.stride))
    return settings.epochs * -(-patches // settings.batch)


def most_steps(size: tuple[int, int], settings: Settings) -> int:
    """How many steps a frame of this size can bear, at least 1.

    The network can overfit the noise of a small frame, and that of the witness with it, which the guard then takes for
    a gain: on 128×128 pixels 400 steps of four 64×64 patches, 400 visits to each pixel, made frames twice worse, and
    the guard believed it. So the settings bound how often a pixel is visited.
    """
    if not settings.visits:
        return sys.maxsize
    return max(settings.visits * size[0] * size[1] // (settings.batch * settings.patch**2), 1)


def crops(size: tuple[int, int], settings: Settings, generator: torch.Generator) -> list[tuple[int, int, int, int]]:
    """Regions (top, left, bottom, right) of one size that patches are drawn from; empty for the whole image.

    A network of so few weights learns from a bounded number of pixels, however large the frame: steps on a frame of
    more than two million pixels get crops that hold as many, one in each cell of a grid, at random inside it.
    """
    side = 2 * settings.patch
    if not settings.steps or settings.rate_from_variance or size[0] * size[1] <= _MOST_PIXELS or min(size) < side:
        return []
    share = math.sqrt(_MOST_PIXELS / (size[0] * size[1]))
    counts = [max(1, int(length * share) // side) for length in size]
    found = []
    for i in range(counts[0]):
        for j in range(counts[1]):
            at = []
            for index, count, length in zip((i, j), counts, size, strict=True):
                first, beyond = index * length // count, (index + 1) * length // count
                at.append(int(torch.randint(first, max(beyond - side, first) + 1, (1,), generator=generator)))
            found.append((at[0], at[1], at[0] + side, at[1] + side))
    return found


def batches(guides: Guides, settings: Settings, generator: torch.Generator) -> Iterator[Tensor]:
    """Corners (N, 2) of the patches of each optimiser step.

    Epochs go through the grid in a new order each. Steps draw patches at random, without end; those of a whole image
    up to a quarter outside, so that border pixels are seen as often as others.
    """
    size = (guides.height, guides.width)
    if settings.steps:
        reach = 0 if guides.stacked > 1 else settings.patch // 4
        while True:
            drawn = []
            for length in size:
                room = max(length - settings.patch, 0)
                drawn.append(torch.randint(-reach, room + reach + 1, (settings.batch,), generator=generator))
            if guides.stacked > 1:
                drawn[0] += guides.pitch * torch.randint(guides.stacked, (settings.batch,), generator=generator)
            yield torch.stack(drawn, 1)
    corners = grid(*size, patch=settings.patch, stride=settings.stride)
    for _ in range(settings.epochs):
        for chosen in torch.randperm(len(corners), generator=generator).split(settings.batch):
            yield corners[chosen]
