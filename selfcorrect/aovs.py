"""AOVs that sum to the corrected picture. Tensors in, tensors out.

Each AOV k of a sum is denoised by the denoiser of the picture, from each half and from both: z_k^a, z_k^b and z_k.
Two steps make of them what sums:

1. The guard (:mod:`selfcorrect.guard`), an AOV's own halves its witness, blends the noisy mean in as far as they
   confirm it: x_k, and x_k^a, x_k^b. Passes that hardly have noise, such as emission and the environment, are better
   than what a denoiser makes of them.
2. The picture moves towards Σ_k x_k where its halves are certain that this is better (:mod:`selfcorrect.sums`): what
   sums to the picture takes its errors on, and where they are large, such as around a lamp, the division of the gap
   made AOVs worse than they were denoised alone. This needs the halves of the corrected picture.
3. The corrected picture c and Σ_k x_k leave a gap. It is divided, the minimum-variance estimate under constraints:

       minimise Σ_k (o_k - x_k)² / v_k   subject to   Σ_k o_k = c,   o_k ≥ 0,
       v_k = M_k (mean_rgb(x_k)² + 0.3),   M_k = mean over pixels of ‖x_k^a - x_k^b‖² / (mean_rgb(x_k)² + 0.3),

   in radiance of a mean near 1. The solution is o_k = max(x_k + λ v_k, 0), with one λ a pixel and colour channel. So
   what is minimised is the sum over AOVs of the error that each takes on, weighed as the metric does, relative to the
   one that it has, as far as its halves tell. M_k is one number an AOV: taken over tiles it follows fireflies and
   edges, and made passes worse.

Nothing appears where both halves of a pass are exactly 0 for a pixel and its neighbours, or where its colour is 0, but
where the picture has light that no pass has: the sum comes first.

Measured with `scripts/bench/aovs.py`, beside the ratio method and denoising each AOV alone; Eq. 10 with AOVs as payload
of the picture's weights hardly added to it.
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
from selfcorrect.image.channels import channel_mean
from selfcorrect.image.exposure import Scaled, scale_, scale_to_one
from selfcorrect.image.repair import Repairs
from selfcorrect.sums import toward_sum_

__all__ = [
    "AovSum",
    "Corrected",
    "Denoise",
    "correct_alone",
    "correct_aovs",
    "correct_sums",
    "denoiser_of",
    "reconciled",
]

Pair = tuple[Any, Any]
Denoise = Callable[[Pair], tuple[tuple[Tensor, Tensor], Tensor]]
"""From noisy halves to denoised halves and the denoised mean."""

_EMPTY = 1  # pixels around one that have to be 0 for it to be none of the pass
_DARKEST = 0.3  # squared radiance, of a mean near 1; results are alike from 0.1 to 1
_ROWS = 16  # of all AOVs that are worked on at once
_LEAST = 1e-12  # M of an AOV whose halves are alike: the gap goes elsewhere, if it can


@dataclass(frozen=True)
class AovSum:
    """AOVs whose noisy halves sum to the picture's.

    Attributes:
        name: what the log calls it.
        halves: noisy halves of each AOV by its name, (H, W, 3) linear radiance each, of products where the renderer has
            divided by a colour. A mapping that makes them when they are asked for keeps memory low.
        remainder: the AOVs are only a part of the picture; what they leave of it takes part, and is not given back.
        colors: (H, W, 3) colour by the name of each AOV that will be divided by it.
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
        picture: what they sum to, (H, W, 3): the corrected picture as given, or moved towards their sum.
        moved: how far, 0 … 1, as a mean over the frame.
    """

    images: dict[str, Tensor]
    repairs: dict[str, Repairs]
    gap: float
    closing: float
    picture: Tensor
    moved: float = 0.0


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
        given = zip((mean(color), *color), aids, strict=True)
        full, a, b = (denoiser(image, **beside).clamp(min=0) for image, beside in given)
        return (a, b), full

    return each


def correct_aovs(
    image: Any, frame: Frame, sums: AovSum, denoise: Denoise, halves: tuple[Tensor, Tensor] | None = None
) -> Corrected:
    """Denoise the AOVs of a sum and make them sum to the corrected picture.

    Args:
        image: the corrected picture, (H, W, 3) linear radiance ≥ 0, NumPy or torch.
        frame: the denoised frame that it was made of.
        sums: the AOVs.
        denoise: see :func:`denoiser_of`.
        halves: those of the corrected picture, of ``correct(…, keep_halves=True)``. With them, the picture itself moves
            towards the sum where they are certain that this is better; without, it stays as it is, and AOVs take all
            of its errors on.

    Returns:
        The AOVs, and the picture that they sum to. The same input gives the same bits.

    Raises:
        FrameError: an AOV is of another size than the frame, or hardly finite.
    """
    return correct_sums(image, frame, [sums], denoise, halves)[0]


def correct_sums(
    image: Any, frame: Frame, sums: Sequence[AovSum], denoise: Denoise, halves: tuple[Tensor, Tensor] | None = None
) -> list[Corrected]:
    """As :func:`correct_aovs`, with several sums that have no AOV in common: all sum to the same picture."""
    target = checked(COLOR, (image,), ["the corrected picture"], frame.size)[0][0].cpu()
    scale = scale_to_one(frame.candidates[0].halves)
    if halves is not None:
        target, halves = target.clone(), (halves[0].cpu().clone(), halves[1].cpu().clone())
    color = (frame.color[0].cpu(), frame.color[1].cpu())
    made, repairs, moved = list[dict[str, _Part]](), list[dict[str, Repairs]](), list[float]()
    for one in sums:
        totals = None if halves is None else (torch.zeros_like(target), torch.zeros_like(target))
        parts, counted = dict[str, _Part](), dict[str, Repairs]()
        for name, (noisy, counts) in _noisy(frame, one):
            parts[name] = _part(noisy, denoise, scale, one.colors.get(name), totals)
            if name:
                counted[name] = counts
        if halves is not None and totals is not None:
            moved.append(toward_sum_(target, halves, _Total(list(parts.values())), totals, color, scale))
        made.append(parts)
        repairs.append(counted)
    found = []
    for i, parts in enumerate(made):
        gap, closing = _reconcile_(list(parts.values()), target)
        images = {name: part.x for name, part in parts.items() if name}
        found.append(Corrected(images, repairs[i], gap, closing, target, moved[i] if moved else 0.0))
    return found


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
        there: where it may have light: (H, W, 1), or (H, W, 3) with a colour.
        color: what it will be divided by.
        spread: M of step 3.
        darkest: 0.3 of its formulas, in the units of x.
    """

    x: Tensor
    there: Tensor
    color: Tensor | None
    spread: float
    darkest: float

    def variance(self, rows: slice) -> Tensor:
        """v at rows of the image."""
        x = self.x[rows].double()
        level = x.mean(-1, keepdim=True) ** 2 + self.darkest
        return torch.where(self.there[rows], self.spread * level, 0.0).expand_as(x)

    def anywhere(self, rows: slice) -> Tensor:
        """What divides light that no pass has: alike, but for a pass whose colour is 0."""
        like = self.x[rows].double()
        return torch.ones_like(like) if self.color is None else (self.color[rows] > 0).double()


class _Total:
    """The sum of AOVs, made where it is read."""

    def __init__(self, parts: Sequence[_Part]):
        self._parts, self.shape = parts, parts[0].x.shape

    def __getitem__(self, rows: slice) -> Tensor:
        return torch.stack([part.x[rows] for part in self._parts]).double().sum(0)


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


def _part(
    halves: tuple[Tensor, Tensor],
    denoise: Denoise,
    scale: float,
    color: Tensor | None,
    totals: tuple[Tensor, Tensor] | None = None,
) -> _Part:
    """Step 1: an AOV denoised and blended, as a whole and of each half; its halves are added to the ``totals``."""
    size = (halves[0].shape[0], halves[0].shape[1])
    there = torch.cat([_there(halves, color, rows) for rows in bands(size[0])])
    darkest = _DARKEST / scale**2
    if not any(bool(half.any()) for half in halves):
        return _Part(torch.zeros(*size, 3), there, color, 0.0, darkest)
    denoised, full = denoise(halves)
    y = (Scaled(halves[0], scale), Scaled(halves[1], scale))
    z = (Scaled(denoised[0], scale), Scaled(denoised[1], scale))
    evidence = Evidence(y, z)
    for rows in bands(size[0]):
        evidence.add(rows, (y[0][rows], y[1][rows]))
    noisy = Scaled(mean(halves), scale)
    guarded = guard(evidence, Scaled(full, scale), [noisy], scale=scale, out=torch.empty_like(full))
    x = scale_(guarded.image, 1 / scale).clamp_(min=0)
    for rows in bands(size[0]):
        x[rows] = torch.where(there[rows], x[rows], 0.0)

    def blended(i: int, rows: slice) -> Tensor:
        """x of one half, of a mean near 1."""
        alpha, own = enlarged_rows(guarded.alpha, size, rows)[0][:, :, None], z[i][rows].double()
        return torch.where(there[rows], (own + alpha * (y[i][rows].double() - own)).clamp(min=0), 0.0)

    def differences(rows: slice) -> Tensor:
        """‖x^a - x^b‖², relative."""
        squared = channel_mean((blended(0, rows) - blended(1, rows)) ** 2)
        return (squared / (channel_mean(scale * x[rows].double()) ** 2 + _DARKEST))[None]

    for i, total in enumerate(totals or ()):
        for rows in bands(size[0]):
            total[rows] += (blended(i, rows) / scale).float()

    (spread,) = average(tile_means(size[0], differences), size)
    return _Part(x, there, color, spread + _LEAST, darkest)


def _there(halves: tuple[Tensor, Tensor], color: Tensor | None, rows: slice) -> Tensor:
    """Where a pass may have light, at rows of the image: not where it is exactly 0 around, or its colour is."""
    wide, inner = widened(rows, _EMPTY, halves[0].shape[0])
    lit = ((halves[0][wide] > 0) | (halves[1][wide] > 0)).any(-1, keepdim=True).float()
    there = F.max_pool2d(lit.permute(2, 0, 1), 2 * _EMPTY + 1, 1, _EMPTY).permute(1, 2, 0)[inner] > 0
    return there if color is None else there & (color[rows] > 0)


def _reconcile_(parts: Sequence[_Part], target: Tensor) -> tuple[float, float]:
    """Make parts sum to the target, in place; the gap that was there and the one that is left, relative to it."""
    before = after = level = 0.0
    for rows in bands(target.shape[0], _ROWS):
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


def _features(frame: Frame) -> dict[str, Any]:
    pairs = {buffer.name: getattr(frame, buffer.name) for buffer in FEATURES}
    return {name: pair for name, pair in pairs.items() if pair is not None}
