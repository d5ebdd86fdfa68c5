"""AOVs that sum to the corrected picture. Tensors in, tensors out.

Each AOV k of a sum Σ_k t_k = t is denoised by the denoiser of the picture, from each half and from both: z_k^a, z_k^b
and z_k. Three steps make of it what sums:

1. The guard (:mod:`selfcorrect.guard`) blends the noisy mean in as far as the halves confirm it: x_k. Passes that
   hardly have noise, such as emission and the environment, are better than what a denoiser makes of them.
2. What x_k misses is estimated. Its scale is known without a reference, since the halves are independent: of the
   squared difference between x_k^a and y_k^b, what is not the variance of y_k^b is the error of x_k^a. Where in the image that
   error lies is taken from the noise and the radiance of the pass, v_k = ρ_k m_k, with ρ_k of tiles.
3. The corrected picture c is better known than the sum of the passes; the gap is divided among them by their errors,
   the minimum-variance estimate under the constraints:

       minimise Σ_k (o_k − x_k)² / v_k   subject to   Σ_k o_k = c,   o_k ≥ 0.

   Its solution is o_k = max(x_k + λ v_k, 0), with one λ a pixel and colour channel.

Nothing appears where both halves of a pass are exactly 0 for a pixel and its neighbours, but where the picture has
light that no pass has: the sum comes first.

Measured with `scripts/bench/aovs.py`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from selfcorrect.buffers import COLOR, FEATURES
from selfcorrect.frame import Frame, checked, mean, prefiltered
from selfcorrect.guard import Evidence, guard
from selfcorrect.image.bands import average, bands, enlarged_rows, tile_means, widened
from selfcorrect.image.exposure import Scaled, scale_, scale_to_one
from selfcorrect.image.repair import Repairs

__all__ = ["AovSum", "Corrected", "correct_alone", "correct_aovs", "denoiser_of", "error_scale", "reconciled"]

Pair = tuple[Any, Any]
Denoise = Callable[[Pair], tuple[tuple[Tensor, Tensor], Tensor]]
"""From noisy halves to denoised halves and the denoised mean."""

_EMPTY = 1  # pixels around one that have to be 0 for it to be none of the pass
_SMOOTH = 1  # pixels around one that its noise is known from
_SIDE = 64  # of the tiles of ρ
_DARK_SHARE = 1e-3  # of x² in m: what noise would not be seen for want of samples
_LEAST = 1e-9  # of x² in v: any light can be taken away where the sum is less


@dataclass(frozen=True)
class AovSum:
    """AOVs whose noisy halves sum to the picture's.

    Attributes:
        name: what the log calls it.
        halves: noisy halves of each AOV by its name, (H, W, 3) linear radiance each, of products where the renderer has
            divided by a colour. A mapping that reads them when they are asked for keeps memory low.
        remainder: the AOVs are only a part of the picture; what they leave of it takes part, and is not given back.
        colors: (H, W, 3) colour by the name of each AOV that will be divided by it; where it is 0, so is the AOV.
    """

    name: str
    halves: Mapping[str, Pair]
    remainder: bool = False
    colors: Mapping[str, Tensor] = field(default_factory=dict)


class Corrected(NamedTuple):
    """AOVs that sum.

    Attributes:
        images: by name, (H, W, 3) float32 linear radiance ≥ 0.
        repairs: by name, how many pixels were changed on the way in.
        gap: the root of the mean of the squared gap that was divided, relative to that of the picture.
        closing: the same of what is left.
    """

    images: dict[str, Tensor]
    repairs: dict[str, Repairs]
    gap: float
    closing: float


@dataclass(frozen=True)
class _Part:
    """An AOV that is to be reconciled: x (H, W, 3), changed in place, m, ρ over tiles, and its colour."""

    x: Tensor
    m: Tensor
    rho: Tensor
    color: Tensor | None = None

    def variance(self, rows: slice) -> Tensor:
        """v at rows of the image."""
        size = (self.x.shape[0], self.x.shape[1])
        rho = enlarged_rows(self.rho, size, rows).permute(1, 2, 0)
        return rho * self.m[rows].double() + _LEAST * self.x[rows].double() ** 2

    def anywhere(self, rows: slice) -> Tensor:
        """What divides light that no pass has: alike, but for a pass whose colour is 0."""
        like = self.x[rows].double()
        return torch.ones_like(like) if self.color is None else (self.color[rows] > 0).double()


def denoiser_of(frame: Frame, denoiser: Callable[..., Any]) -> Denoise:
    """Denoise AOVs as the picture of a frame was: with its G-buffers, prefiltered once for all of them."""
    if getattr(denoiser, "dual", False):

        def both(color: Pair) -> tuple[tuple[Tensor, Tensor], Tensor]:
            denoised = Frame(color=color, **_features(frame)).denoise(denoiser)
            assert denoised.denoised is not None
            return denoised.denoised, mean(denoised.denoised)

        return both
    guides = [
        prefiltered(denoiser, *(None if pair is None else choose(pair) for pair in (frame.albedo, frame.normal)))
        for choose in (lambda pair: pair[0], lambda pair: pair[1], mean)
    ]

    def each(color: Pair) -> tuple[tuple[Tensor, Tensor], Tensor]:
        images = [denoiser(image, **beside) for image, beside in zip((*color, mean(color)), guides, strict=True)]
        a, b, full = (image.clamp(min=0) for image in images)
        return (a, b), full

    return each


def correct_aovs(image: Any, frame: Frame, sums: AovSum, denoise: Denoise) -> Corrected:
    """Denoise the AOVs of a sum and make them sum to the corrected picture.

    Args:
        image: the corrected picture, (H, W, 3) linear radiance ≥ 0, NumPy or torch.
        frame: the frame it was made of.
        sums: the AOVs.
        denoise: see :func:`denoiser_of`.

    Raises:
        FrameError: an AOV is of another size than the frame, or hardly finite.
    """
    target = checked(COLOR, (image,), ["the corrected picture"], frame.size)[0][0].cpu()
    scale = scale_to_one(frame.color)
    parts, repairs = dict[str, _Part](), dict[str, Repairs]()
    left = [half.clone() for half in frame.color] if sums.remainder else []
    for name in sums.halves:
        what = [f"{name} of half {half}" for half in "ab"]
        (a, b), repairs[name] = checked(COLOR, tuple(sums.halves[name]), what, frame.size)
        for rest, half in zip(left, (a, b), strict=False):
            rest.sub_(half)
        parts[name] = _part((a, b), denoise, scale, sums.colors.get(name))
    if sums.remainder:
        parts[""] = _part((left[0].clamp_(min=0), left[1].clamp_(min=0)), denoise, scale, None)
    gap, closing = _reconcile_(list(parts.values()), target)
    return Corrected({name: part.x for name, part in parts.items() if name}, repairs, gap, closing)


def _part(halves: tuple[Tensor, Tensor], denoise: Denoise, scale: float, color: Tensor | None) -> _Part:
    """An AOV denoised and blended, and what is known of its error."""
    size = (halves[0].shape[0], halves[0].shape[1])
    if not any(bool(half.any()) for half in halves):
        return _Part(torch.zeros(*size, 3), torch.zeros(*size, 3), torch.zeros(3, 1, 1, dtype=torch.float64), color)
    denoised, full = denoise(halves)
    y = (Scaled(halves[0], scale), Scaled(halves[1], scale))
    z = (Scaled(denoised[0], scale), Scaled(denoised[1], scale))
    evidence = Evidence(y, z)
    for rows in bands(size[0]):
        evidence.add(rows, (y[0][rows], y[1][rows]))
    noisy = mean(halves)
    guarded = guard(evidence, Scaled(full, scale), [Scaled(noisy, scale)], scale=scale, out=torch.empty_like(full))
    x = scale_(guarded.image, 1 / scale).clamp_(min=0)

    def blended(i: int, rows: slice) -> Tensor:
        alpha = enlarged_rows(guarded.alpha, size, rows)[0][:, :, None]
        start = denoised[i][rows].double()
        return start + alpha * (halves[i][rows].double() - start)

    m = torch.empty_like(x)
    for rows in bands(size[0]):
        m[rows] = magnitude(halves, x, rows)
    rho = error_scale(halves, blended, m)
    _clear_(x, m, halves, color)
    return _Part(x, m, rho, color)


def magnitude(halves: tuple[Tensor, Tensor], x: Tensor, rows: slice) -> Tensor:
    """m at rows of an image, (rows, W, 3): the variance of the noisy mean around a pixel, and a little of x²."""
    wide, inner = widened(rows, _SMOOTH, x.shape[0])
    noise = ((halves[0][wide].double() - halves[1][wide].double()) / 2) ** 2
    side = 2 * _SMOOTH + 1
    around = F.avg_pool2d(noise.permute(2, 0, 1), side, 1, _SMOOTH, count_include_pad=False).permute(1, 2, 0)[inner]
    return around + _DARK_SHARE * x[rows].double() ** 2


def error_scale(halves: tuple[Tensor, Tensor], blended: Callable[[int, slice], Tensor], m: Tensor) -> Tensor:
    """ρ of every tile and colour channel, (3, h, w): the error of the full image over what m says of it.

    Of a half, E(x^a − y^b)² − E(y^a − y^b)² / 2 is the squared error, bias² + V; half of E(x^a − x^b)² is V. The full
    image has the bias and half of V.
    """
    size = (m.shape[0], m.shape[1])

    def squares(rows: slice) -> Tensor:
        y = [half[rows].double() for half in halves]
        x = [blended(i, rows) for i in (0, 1)]
        between = (y[0] - y[1]) ** 2
        crossed = ((x[0] - y[1]) ** 2 + (x[1] - y[0]) ** 2) / 2
        spread = (x[0] - x[1]) ** 2
        # fireflies count for what is usual: relative to the noise around them
        weight = 1 / (m[rows].double() + 1e-12)
        parts = [weight * (crossed - between / 2 - spread / 2), weight * spread, weight * m[rows].double()]
        return torch.cat([part.permute(2, 0, 1) for part in parts])

    tiles = tile_means(size[0], squares, _SIDE)
    whole = torch.tensor(average(tiles, size, _SIDE), dtype=torch.float64)[:, None, None]
    bias = (tiles[:3] + whole[:3]).clamp(min=0) / 2
    return (bias + tiles[3:6] / 4) / tiles[6:].clamp(min=1e-12)


def _clear_(x: Tensor, m: Tensor, halves: tuple[Tensor, Tensor], color: Tensor | None) -> None:
    """Nothing where a pass is exactly 0 in both halves around a pixel, or where its colour is."""
    for rows in bands(x.shape[0]):
        wide, inner = widened(rows, _EMPTY, x.shape[0])
        lit = ((halves[0][wide] > 0) | (halves[1][wide] > 0)).any(-1, keepdim=True).float()
        there = F.max_pool2d(lit.permute(2, 0, 1), 2 * _EMPTY + 1, 1, _EMPTY).permute(1, 2, 0)[inner] > 0
        if color is not None:
            there = there & (color[rows] > 0)
        for image in (x, m):
            image[rows] = torch.where(there, image[rows], 0.0)


def _features(frame: Frame) -> dict[str, Pair]:
    pairs = {buffer.name: getattr(frame, buffer.name) for buffer in FEATURES}
    return {name: pair for name, pair in pairs.items() if pair is not None}


def _reconcile_(parts: Sequence[_Part], target: Tensor) -> tuple[float, float]:
    """Make parts sum to the target, in place; the gap that was there and the one that is left, relative to it."""
    before = after = level = 0.0
    for rows in bands(target.shape[0]):
        wanted = target[rows].double()
        x = torch.stack([part.x[rows].double() for part in parts])
        v = torch.stack([part.variance(rows) for part in parts])
        nowhere = (v.sum(0) <= 0) & (wanted > 0)
        if bool(nowhere.any()):
            v = torch.where(nowhere, torch.stack([part.anywhere(rows) for part in parts]), v)
        before += float(((wanted - x.sum(0)) ** 2).sum())
        level += float((wanted**2).sum())
        for part, values in zip(parts, reconciled(x, v, wanted), strict=True):
            part.x[rows] = values.float()
        left = wanted - torch.stack([part.x[rows].double() for part in parts]).sum(0)
        after += float((left**2).sum())
    return (math.sqrt(before / level), math.sqrt(after / level)) if level > 0 else (0.0, 0.0)


def correct_alone(frame: Frame, name: str, halves: Pair, denoise: Denoise) -> Tensor:
    """An AOV that is no part of the picture: denoised, and blended as far as the halves confirm it, (H, W, 3)."""
    (a, b), _ = checked(COLOR, tuple(halves), [f"{name} of half {half}" for half in "ab"], frame.size)
    return _part((a, b), denoise, scale_to_one((a, b)), None).x


def reconciled(x: Tensor, v: Tensor, target: Tensor) -> Tensor:
    """o of the minimum above.

    Args:
        x: (K, …) ≥ 0.
        v: (K, …) ≥ 0; above 0 where x is.
        target: (…) ≥ 0.

    Returns:
        (K, …) ≥ 0 that sum to ``target`` wherever any v is above 0.
    """
    free = v > 0
    result = x
    for _ in range(len(x)):
        room = torch.where(free, v, 0.0)
        gap = target - torch.where(free, x, 0.0).sum(0)
        step = gap / room.sum(0).clamp(min=torch.finfo(v.dtype).tiny)
        result = torch.where(free, x + room * step, 0.0)
        if not bool((result < 0).any()):
            break
        free = free & (result > 0)
    return result.clamp(min=0)
