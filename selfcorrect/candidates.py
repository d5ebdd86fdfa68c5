"""Further denoised images of a frame, as candidates for the guard: only those that the frame has use for.

A denoiser has more than one way to go about a frame, and which is best differs from frame to frame. A few crops tell,
before the whole frame is denoised again, what is not worth it. They hold less evidence than the frame: what they leave
open is for the guard to decide, which has all of it.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from selfcorrect.frame import Candidate, Frame, mean, prefiltered
from selfcorrect.guard import CERTAIN, Evidence
from selfcorrect.image.bands import average, tile_means
from selfcorrect.image.channels import channel_mean
from selfcorrect.image.exposure import Scaled, scale_to_one
from selfcorrect.image.tiles import Region

__all__ = ["WORTH", "promises", "with_candidate", "with_candidates"]

Denoiser = Callable[..., Any]

WORTH = 0.01
"""Share of the error: a smaller gain is not worth a denoising of the whole frame."""

_SIDE = 128  # of a crop, pixels: a multiple of the guard's largest tile
_CROPS = (3, 2)  # at most so many by so many


def promises(frame: Frame, denoisers: Mapping[str, Denoiser]) -> dict[str, float]:
    """The most that each denoiser's image can take off the error, as a share of it, 0 … 1, for all that crops tell.

    Args:
        frame: with its denoised halves.
        denoisers: by name; as for :meth:`selfcorrect.Frame.denoise`, but for those that need both halves at once.
    """
    regions = _crops(frame.size)
    z = [_stacked(half, regions) for half in frame.candidates[0].halves]
    y = [_stacked(half, regions) for half in frame.color]
    scale = scale_to_one((z[0], z[1]))

    def scaled(images: list[Tensor]) -> tuple[Scaled, Scaled]:
        return Scaled(images[0], scale), Scaled(images[1], scale)

    found = {}
    for name, denoiser in denoisers.items():
        g = [torch.cat([_denoised(frame, i, denoiser, region) for region in regions]) for i in (0, 1)]
        evidence = Evidence(scaled(y), scaled(z))
        evidence.add(slice(0, len(g[0])), (scaled(g)[0][:], scaled(g)[1][:]))
        found[name] = _most(evidence)
    return found


def _most(evidence: Evidence) -> float:
    """What one weight for all pixels takes off the halves' error, were n at the end of its confidence interval."""

    def errors(rows: slice) -> Tensor:
        """n, d, and the error of the denoised halves: of both directions, by Eq. 6."""
        y, z, weight = evidence.y(rows), evidence.z(rows), [evidence.weight(i, rows) for i in (0, 1)]
        crossed = sum(weight[i] * channel_mean((z[i] - y[1 - i]) ** 2) for i in (0, 1))
        noise = (weight[0] + weight[1]) / 2 * channel_mean((y[0] - y[1]) ** 2)
        return torch.cat([evidence.both(rows), (crossed - noise)[None]])

    tiles = tile_means(evidence.size[0], errors)
    n, d, error = average(tiles, evidence.size)
    n += CERTAIN * float(tiles[0].std()) / math.sqrt(tiles[0].numel())
    if n <= 0 or d <= 0:
        return 0.0
    alpha = min(n / d, 1.0)
    gain = alpha * (2 * n - alpha * d)
    return min(gain / error, 1.0) if error > 0 else 1.0


def with_candidates(frame: Frame, denoisers: Mapping[str, Denoiser], *, every: bool) -> tuple[Frame, dict[str, float]]:
    """The frame with the images of further denoisers as candidates; and what each promised.

    Args:
        frame: with its denoised halves.
        denoisers: by name.
        every: take all of them; otherwise those that may be worth a denoising of the whole frame.
    """
    found = promises(frame, denoisers)
    for name, promise in found.items():
        if every or promise > WORTH:
            frame = with_candidate(frame, name, denoisers[name])
    return frame, found


def with_candidate(frame: Frame, name: str, denoiser: Denoiser) -> Frame:
    """The frame with one candidate more: its halves and their mean, denoised by another denoiser."""
    colors = (mean(frame.color), *frame.color)
    full, a, b = (
        torch.as_tensor(denoiser(color, **aids)).clamp(min=0)
        for color, aids in zip(colors, frame.aids_for(denoiser), strict=True)
    )
    return frame.with_candidate(Candidate(name, (a, b), full))


def _crops(size: tuple[int, int]) -> list[Region]:
    """Regions of one size, spread evenly; the whole of a frame that is hardly larger."""
    if min(size) < 2 * _SIDE:
        return [(0, 0, *size)]
    corners = [
        [(length - _SIDE) * (2 * i + 1) // (2 * count) for i in range(count)]
        for length, count in zip(size, _CROPS[:: 1 if size[0] > size[1] else -1], strict=True)
    ]
    return [(top, left, top + _SIDE, left + _SIDE) for top in corners[0] for left in corners[1]]


def _stacked(image: Tensor, regions: list[Region]) -> Tensor:
    return torch.cat([_cut(image, region) for region in regions])


def _cut(image: Tensor, region: Region) -> Tensor:
    top, left, bottom, right = region
    return image[top:bottom, left:right].contiguous()


def _denoised(frame: Frame, half: int, denoiser: Denoiser, region: Region) -> Tensor:
    """A crop of one half, denoised."""
    buffers = frame.halves[half]
    albedo, normal = (None if b is None else _cut(b, region) for b in (buffers.albedo, buffers.normal))
    color = _cut(buffers.color, region)
    return torch.as_tensor(denoiser(color, **prefiltered(denoiser, albedo, normal))).clamp(min=0)
