"""Where the training patches lie."""

from collections.abc import Iterator

import torch
from torch import Tensor

from selfcorrect.settings import Settings

__all__ = ["batches", "grid", "overhang", "steps_count"]


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
    """How many optimiser steps :func:`batches` gives patches for."""
    if settings.steps:
        return settings.steps
    patches = len(grid(*size, patch=settings.patch, stride=settings.stride))
    return settings.epochs * -(-patches // settings.batch)


def batches(size: tuple[int, int], settings: Settings, generator: torch.Generator) -> Iterator[Tensor]:
    """Corners (N, 2) of the patches of each optimiser step.

    Epochs go through the grid in a new order each; steps draw patches at random, up to a quarter outside, so that
    border pixels are seen as often as others.
    """
    if settings.steps:
        reach = settings.patch // 4
        for _ in range(settings.steps):
            drawn = []
            for length in size:
                room = max(length - settings.patch, 0)
                drawn.append(torch.randint(-reach, room + reach + 1, (settings.batch,), generator=generator))
            yield torch.stack(drawn, 1)
        return
    corners = grid(*size, patch=settings.patch, stride=settings.stride)
    for _ in range(settings.epochs):
        for chosen in torch.randperm(len(corners), generator=generator).split(settings.batch):
            yield corners[chosen]
