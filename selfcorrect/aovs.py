"""AOVs that sum to the corrected picture. Tensors in, tensors out.

Each AOV k of a sum is denoised by the denoiser of the picture, from each half and from both: z_k^a, z_k^b and z_k.
Three steps make of them what sums:

1. The guard (:mod:`selfcorrect.guard`) blends the noisy mean in as far as the halves confirm it: x_k. Passes that
   hardly have noise, such as emission and the environment, are better than what a denoiser makes of them.
2. The corrected picture c and Σ_k x_k leave a gap. Whose it is, the halves tell: with the gap h^a of half a alone and
   an AOV's share of it by its radiance, s_k^a = h^a x_k^a / Σ_j x_j^a, the witness y_k^b is unbiased, and

       n_k = w (y_k^b - x_k^a)·s_k^a,   d_k = w ‖s_k^a‖²,   w = 1 / (mean_rgb(x_k^a)² + 0.01)

   averaged over tiles and both directions give α_k = n_k / d_k, the part of its share that an AOV really misses. It
   plays the variance's part in what follows: v_k = α_k x_k, relative to the picture's radiance in the pixel.
3. The gap is divided, the minimum-variance estimate under the constraints:

       minimise Σ_k (o_k - x_k)² / v_k   subject to   Σ_k o_k = c,   o_k ≥ 0.

   Its solution is o_k = max(x_k + λ v_k, 0), with one λ a pixel and colour channel.

Nothing appears where both halves of a pass are exactly 0 for a pixel and its neighbours, or where its colour is 0, but
where the picture has light that no pass has: the sum comes first.

Measured with `scripts/bench/aovs.py`, beside the ratio method and beside denoising each AOV alone.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from selfcorrect.buffers import COLOR, FEATURES
from selfcorrect.frame import Frame, checked, mean
from selfcorrect.guard import Evidence, guard
from selfcorrect.image.bands import average, bands, enlarged_rows, tile_means, widened
from selfcorrect.image.exposure import Scaled, scale_, scale_to_one
from selfcorrect.image.repair import Repairs

__all__ = ["AovSum", "Corrected", "Denoise", "correct_alone", "correct_aovs", "denoiser_of", "reconciled"]

Pair = tuple[Any, Any]
Denoise = Callable[[Pair], tuple[tuple[Tensor, Tensor], Tensor]]
"""From noisy halves to denoised halves and the denoised mean."""

_EMPTY = 1  # pixels around one that have to be 0 for it to be none of the pass
_SIDE = 32  # of the tiles of α
_COMMON = 0.3  # of the frame's evidence that every tile is given
_LEAST_SHARE = 0.1  # is added to α: any AOV may miss something
_LARGEST_SHARE = 1.5
_LARGEST_HALF = 60000.0  # what is kept as half floats


@dataclass(frozen=True)
class AovSum:
    """AOVs whose noisy halves sum to the picture's.

    Attributes:
        name: what the log calls it.
        halves: noisy halves of each AOV by its name, (H, W, 3) linear radiance each, of products where the renderer has
            divided by a colour. A mapping that makes them when they are asked for keeps memory low.
        remainder: the AOVs are only a part of the picture; what they leave of it takes part, and is not given back.
        colors: (H, W, 3) colour by the name of each AOV that will be divided by it.
        whole: they sum to the frame's picture; else, as where some of a set are known already, to what is left of it,
            and their gap is divided by radiance alone.
    """

    name: str
    halves: Mapping[str, Pair]
    remainder: bool = False
    colors: Mapping[str, Tensor] = field(default_factory=dict)
    whole: bool = True


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


def denoiser_of(frame: Frame, denoiser: Callable[..., Any]) -> Denoise:
    """Denoise AOVs as the picture of a frame was: with its G-buffers, prefiltered once for all of them."""
    if getattr(denoiser, "dual", False):

        def both(color: Pair) -> tuple[tuple[Tensor, Tensor], Tensor]:
            denoised = Frame(color=color, **_features(frame)).denoise(denoiser)
            assert denoised.denoised is not None
            return denoised.denoised, mean(denoised.denoised)

        return both
    aids = tuple(frame.aids_for(denoiser))

    def each(color: Pair) -> tuple[tuple[Tensor, Tensor], Tensor]:
        images = [denoiser(image, **beside) for image, beside in zip((mean(color), *color), aids, strict=True)]
        full, a, b = (image.clamp(min=0) for image in images)
        return (a, b), full

    return each


def correct_aovs(image: Any, frame: Frame, sums: AovSum, denoise: Denoise) -> Corrected:
    """Denoise the AOVs of a sum and make them sum to the corrected picture.

    Args:
        image: the corrected picture, (H, W, 3) linear radiance ≥ 0, NumPy or torch.
        frame: the denoised frame that it was made of.
        sums: the AOVs.
        denoise: see :func:`denoiser_of`.

    Returns:
        The AOVs. The same input gives the same bits.

    Raises:
        FrameError: an AOV is of another size than the frame, or hardly finite.
    """
    target = checked(COLOR, (image,), ["the corrected picture"], frame.size)[0][0].cpu()
    scale = scale_to_one(frame.candidates[0].halves)
    parts, repairs = dict[str, _Part](), dict[str, Repairs]()
    for name, (halves, counts) in _noisy(frame, sums):
        parts[name] = _part(halves, denoise, scale, sums.colors.get(name))
        if name:
            repairs[name] = counts
    if sums.whole:
        gaps, totals = _gaps(frame, list(parts.values()), scale)
        for name, (halves, _) in _noisy(frame, sums):
            parts[name].share = _share(parts[name], halves, gaps, totals, scale)
    gap, closing = _reconcile_(list(parts.values()), target)
    return Corrected({name: part.x for name, part in parts.items() if name}, repairs, gap, closing)


def correct_alone(frame: Frame, name: str, halves: Pair, denoise: Denoise) -> Tensor:
    """An AOV that is no part of the picture: denoised, and blended as far as the halves confirm it, (H, W, 3)."""
    (a, b), _ = _checked(frame, name, halves)
    return _part((a, b), denoise, scale_to_one((a, b)), None).x


def reconciled(x: Tensor, v: Tensor, target: Tensor) -> Tensor:
    """The o of step 3.

    Args:
        x: (K, …) ≥ 0.
        v: (K, …) ≥ 0; above 0 where x is.
        target: (…) ≥ 0.

    Returns:
        (K, …) ≥ 0 that sum to ``target`` wherever any v is above 0.
    """
    free = v > 0
    result = x
    for _ in range(len(x)):  # what would be negative is 0 and leaves the rest to the others, each AOV once at most
        room = torch.where(free, v, 0.0)
        gap = target - torch.where(free, x, 0.0).sum(0)
        result = torch.where(free, x + gap * (room / room.sum(0).clamp(min=torch.finfo(v.dtype).tiny)), 0.0)
        if not bool((result < 0).any()):
            break
        free = free & (result > 0)
    result = result.clamp(min=0)
    total = result.sum(0)  # what was rounded beside large x that leave little
    return result * torch.where(total > 0, target / total.clamp(min=torch.finfo(v.dtype).tiny), 1.0)


@dataclass
class _Part:
    """An AOV on the way.

    Attributes:
        x: step 1, (H, W, 3); made to sum in place.
        halves: the same of each half, half floats of the frame's scale.
        color: what it will be divided by.
        share: α of step 2, over tiles, (1, h, w).
    """

    x: Tensor
    halves: tuple[Tensor, Tensor]
    color: Tensor | None
    share: Tensor

    def variance(self, rows: slice) -> Tensor:
        """v at rows of the image."""
        share = enlarged_rows(self.share, (self.x.shape[0], self.x.shape[1]), rows).permute(1, 2, 0)
        return share * self.x[rows].double()

    def anywhere(self, rows: slice) -> Tensor:
        """What divides light that no pass has: alike, but for a pass whose colour is 0."""
        like = self.x[rows].double()
        return torch.ones_like(like) if self.color is None else (self.color[rows] > 0).double()


def _noisy(frame: Frame, sums: AovSum) -> Iterator[tuple[str, tuple[tuple[Tensor, Tensor], Repairs]]]:
    """Every AOV's halves in turn, and, without a name, what they leave of the picture."""
    left = [half.clone() for half in frame.color] if sums.remainder else []
    for name in sums.halves:
        (a, b), counts = _checked(frame, name, sums.halves[name])
        for rest, half in zip(left, (a, b), strict=False):
            rest.sub_(half)
        yield name, ((a, b), counts)
    if left:
        yield "", ((left[0].clamp_(min=0), left[1].clamp_(min=0)), Repairs(0, 0))


def _checked(frame: Frame, name: str, halves: Pair) -> tuple[tuple[Tensor, Tensor], Repairs]:
    what = [f"{name} of half {half}" for half in "ab"]
    (a, b), counts = checked(COLOR, tuple(halves), what, frame.size)
    return (a, b), counts


def _part(halves: tuple[Tensor, Tensor], denoise: Denoise, scale: float, color: Tensor | None) -> _Part:
    """Step 1: an AOV denoised and blended, as a whole and of each half."""
    size = (halves[0].shape[0], halves[0].shape[1])
    alike = torch.ones(1, 1, 1, dtype=torch.float64)
    if not any(bool(half.any()) for half in halves):
        dark = torch.zeros(*size, 3, dtype=torch.float16)
        return _Part(torch.zeros(*size, 3), (dark, dark), color, alike)
    denoised, full = denoise(halves)
    y = (Scaled(halves[0], scale), Scaled(halves[1], scale))
    z = (Scaled(denoised[0], scale), Scaled(denoised[1], scale))
    evidence = Evidence(y, z)
    for rows in bands(size[0]):
        evidence.add(rows, (y[0][rows], y[1][rows]))
    noisy = Scaled(mean(halves), scale)
    guarded = guard(evidence, Scaled(full, scale), [noisy], scale=scale, out=torch.empty_like(full))
    x = scale_(guarded.image, 1 / scale).clamp_(min=0)
    kept = (torch.empty(*size, 3, dtype=torch.float16), torch.empty(*size, 3, dtype=torch.float16))
    for rows in bands(size[0]):
        alpha = enlarged_rows(guarded.alpha, size, rows)[0][:, :, None]
        there = _there(halves, color, rows)
        x[rows] = torch.where(there, x[rows], 0.0)
        for i, half in enumerate(kept):
            start = z[i][rows].double()
            blended = start + alpha * (y[i][rows].double() - start)
            half[rows] = torch.where(there, blended, 0.0).clamp(0, _LARGEST_HALF)
    return _Part(x, kept, color, alike)


def _there(halves: tuple[Tensor, Tensor], color: Tensor | None, rows: slice) -> Tensor:
    """Where a pass may have light, at rows of the image: not where it is exactly 0 around, or its colour is."""
    wide, inner = widened(rows, _EMPTY, halves[0].shape[0])
    lit = ((halves[0][wide] > 0) | (halves[1][wide] > 0)).any(-1, keepdim=True).float()
    there = F.max_pool2d(lit.permute(2, 0, 1), 2 * _EMPTY + 1, 1, _EMPTY).permute(1, 2, 0)[inner] > 0
    return there if color is None else there & (color[rows] > 0)


def _gaps(frame: Frame, parts: Sequence[_Part], scale: float) -> tuple[list[Tensor], list[Tensor]]:
    """Of each half, the gap between the denoised picture and the sum, and the sum, in the frame's scale."""
    totals = [torch.zeros(*frame.size, 3), torch.zeros(*frame.size, 3)]
    for part in parts:
        for total, half in zip(totals, part.halves, strict=True):
            total.add_(half)
    pictures = [Scaled(half, scale) for half in frame.candidates[0].halves]
    return [picture[slice(None)] - total for picture, total in zip(pictures, totals, strict=True)], totals


def _share(
    part: _Part, halves: tuple[Tensor, Tensor], gaps: Sequence[Tensor], totals: Sequence[Tensor], scale: float
) -> Tensor:
    """α of step 2, over tiles, (1, h, w)."""
    size = (part.x.shape[0], part.x.shape[1])

    def evidence(rows: slice) -> Tensor:
        both = torch.zeros(2, rows.stop - rows.start, size[1], dtype=torch.float64)
        for i in (0, 1):
            x, witness = part.halves[i][rows].double(), Scaled(halves[1 - i], scale)[rows].double()
            share = gaps[i][rows].double() * (x / totals[i][rows].double().clamp(min=1e-12))
            weight = 1 / (x.mean(-1) ** 2 + 0.01 * scale**2)
            both += weight * torch.stack([((witness - x) * share).mean(-1), (share**2).mean(-1)])
        return both

    tiles = tile_means(size[0], evidence, _SIDE)
    nd = tiles + _COMMON * torch.tensor(average(tiles, size, _SIDE), dtype=torch.float64)[:, None, None]
    ratio = nd[:1] / nd[1:].clamp(min=torch.finfo(torch.float64).tiny)
    return ratio.clamp(0, _LARGEST_SHARE) + _LEAST_SHARE


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


def _features(frame: Frame) -> dict[str, Pair]:
    pairs = {buffer.name: getattr(frame, buffer.name) for buffer in FEATURES}
    return {name: pair for name, pair in pairs.items() if pair is not None}
