"""Fireflies that the denoiser has left: two independent halves show them, where no single image can.

A path of great energy that one half has met and the other has not stays in that half's denoised image as a bright spot,
and in that of both. Where one denoised half is far brighter than the other, the darker one is taken, if six things say
that chance has met a firefly and not the other half missed a light. With m the mean of a half's channels, of a frame
whose mean is near 1, and ε = 0.1:

1. The halves differ: δ = | ln( (m^a + ε) / (m^b + ε) ) | > max(ln 3, 4 s). s is the spread of the halves around: the
   third quartile of δ in tiles of 16 pixels, of it the median over 5×5 tiles. A frame of few samples, or a caustic,
   whose halves disagree everywhere, explains its own disagreement.
2. The other half's *noisy* pixels, which no denoiser has touched, contradict: over 5×5 pixels the brighter half's mean
   lies two standard errors of theirs above their mean. Where they have met the light as well, and be it in one
   pixel, that error is large, and it stays.
3. Somewhere within four pixels the spot outshines what both halves agree on nearly everywhere: the 0.99 quantile of
   min(m^a, m^b). What is as bright as the frame's lights and their reflections may be one.
4. The darker half is itself no brighter than that: a lamp or a star that both have met stays, however different.
5. Nowhere within four pixels is there a pixel of the spot around which the other half's noisy pixels, again within
   four, reach half of the brightest of the spot's own half. In a caustic both meet paths of the same great energy, one
   here and one beside: however few, they are light.
6. Nor is there a pixel of the spot around which, again within four, its own half has more than two peaks (as bright as
   any of the eight around) that reach half of the brightest. What three pixels have met alike is light, of which one
   half has met more than its share, but the other is further from the truth.

Where neighbouring frames are known, they tell how often such paths are met: of the energy E that the spot's own half
has there, p E is what all other halves have on average, each counted for E at most, fetched along their motion. The
image of both halves shows E / 2, so the share 1 − 2 p of it goes, and from p = 1/2 on it is a caustic and stays.

What is found is grown by two pixels and smoothed, since the denoiser has spread the spot. No more light is taken than a
given share of the image: if need be, only the largest disagreements count. What was made of both halves has no
witness; `scripts/bench/fireflies.py` measures the rule against references.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from selfcorrect.image.bands import TILE, bands, enlarged_rows, shares, tile_means, widened
from selfcorrect.image.channels import channel_mean
from selfcorrect.image.exposure import Radiance

__all__ = ["Removed", "Rule", "remove_fireflies_"]

_AROUND = 2  # tiles on each side, of which the median is taken
_GROWN = 2  # pixels
_WITNESS = 5  # side of the window of noisy pixels
_SPOT = 4  # pixels from a spot's brightest part
_REACH = 2 * _GROWN + 4 * _SPOT + 1
_ROWS = 128  # worked on at a time, with _REACH more on either side
_MOST_PIXELS = 2**20  # that tell what is bright, in rows spread evenly over the frame
_STRICTER = 2.0  # each time too much would go, the threshold is multiplied by this
_TRIES = 5

Pair = tuple[Radiance, Radiance]
Rows = Callable[[slice], Tensor]


class Rule(NamedTuple):
    """What is a firefly; `scripts/bench/fireflies.py` tries other values of the constants.

    Attributes:
        least: how many times brighter one half must be than the other in any case.
        spreads: how many spreads around δ must exceed.
        quantile: of δ in a tile, that is its spread.
        darkest: ε.
        doubts: standard errors of the other half's noisy pixels.
        alike: share of a firefly's noisy radiance that the other half's pixels nearby must not reach, and of its own
            half's no more peaks than ``peaks``.
        peaks: the most pixels that one firefly, or two, may show in.
        usual: share of the pixels, 0 … 1, that are darker than what may be a light.
        most: share of the image's light, 0 … 1, that may go.
    """

    least: float = 3.0
    spreads: float = 4.0
    quantile: float = 0.75
    darkest: float = 0.1
    doubts: float = 2.0
    alike: float = 0.5
    peaks: int = 2
    usual: float = 0.99
    most: float = 0.01


class Removed(NamedTuple):
    """What was taken away.

    Attributes:
        pixels: share of the pixels that were changed.
        light: share of the image's mean radiance.
        error: the relMSE that these fireflies were in the denoised image, if the darker half is right.
        standard_error: of ``error``: as few spots as there may be are hardly a sample, and of one it is the whole.
    """

    pixels: float
    light: float
    error: float
    standard_error: float

    def __str__(self) -> str:
        return (
            f"fireflies of one half were removed from {self.pixels:.2%} of the pixels, with {self.light:.2%} of the "
            "light; --fireflies keep leaves them"
        )


def remove_fireflies_(
    image: Tensor,
    color: Pair,
    denoised: Pair,
    denoised_full: Radiance,
    *,
    seen: Tensor | None = None,
    scale: float = 1.0,
    rule: Rule | None = None,
) -> Removed:
    """Remove fireflies from an image that was made of both halves, in place.

    Args:
        image: (H, W, 3) linear radiance ≥ 0.
        color: the noisy halves, like the others of the same shape and units.
        denoised: the denoised halves, each made of one half alone.
        denoised_full: denoised mean of the halves, whose error is told.
        seen: of neighbouring frames, as :class:`selfcorrect.Frame` has it.
        scale: what brings radiance to a mean near 1.
        rule: by default the one that the module describes.
    """
    rule = rule or Rule()
    found = _Search(color, denoised, seen, scale, rule)
    before = _mean(image, lambda rows: channel_mean(image[rows].double()))
    for _ in range(_TRIES):
        taken = _mean(image, lambda rows: channel_mean(found.excess(image, rows)))
        if taken <= rule.most * before:
            break
        found.stricter *= _STRICTER
    else:
        return Removed(0.0, 0.0, 0.0, 0.0)
    if taken == 0:
        return Removed(0.0, 0.0, 0.0, 0.0)

    def errors(rows: slice) -> Tensor:
        excess = found.excess(denoised_full, rows)
        left = denoised_full[rows].double() - excess
        return (channel_mean(excess**2) / (channel_mean(left) ** 2 + 0.01))[None]

    count = image.shape[0] * image.shape[1]
    spots = tile_means(image.shape[0], errors, band=_ROWS)
    spots = spots[0] * shares(spots, (image.shape[0], image.shape[1])) * (TILE**2 / count)
    pixels = 0.0
    for rows in bands(image.shape[0], _ROWS):
        excess = found.excess(image, rows)
        pixels += float((excess > 0).any(-1).sum())
        image[rows] = image[rows].double() - excess
    return Removed(pixels / count, taken / before, float(spots.sum()), float(spots.square().sum().sqrt()))


class _Search:
    """Where the halves say that a firefly is.

    Attributes:
        stricter: what the threshold is multiplied by.
    """

    def __init__(self, color: Pair, denoised: Pair, seen: Tensor | None, scale: float, rule: Rule):
        self.stricter = 1.0
        self._color, self._denoised, self._seen, self._scale, self._rule = color, denoised, seen, scale, rule
        self._size = (denoised[0].shape[0], denoised[0].shape[1])
        self._spread = _median_around(_tile_quantiles(self._size, self._disagreement, rule.quantile))[None]
        self._usual = self._usual_brightness()

    def _means(self, images: Pair, rows: slice) -> tuple[Tensor, Tensor]:
        """m of both halves, (rows, W) each."""
        a, b = (channel_mean(half[rows].double()) * self._scale for half in images)
        return a, b

    def _disagreement(self, rows: slice) -> Tensor:
        """δ, (rows, W)."""
        a, b = self._means(self._denoised, rows)
        return ((a + self._rule.darkest) / (b + self._rule.darkest)).log().abs()

    def _usual_brightness(self) -> float:
        step = max(math.ceil(self._size[0] * self._size[1] / _MOST_PIXELS), 1)
        seen = [
            torch.minimum(*self._means(self._denoised, rows))[::step].flatten() for rows in bands(self._size[0], _ROWS)
        ]
        return float(torch.cat(seen).quantile(self._rule.usual))

    def weight(self, rows: slice) -> Tensor:
        """How far a pixel is a firefly, 0 … 1, (rows, W)."""
        wide, inner = widened(rows, _REACH, self._size[0])
        a, b = self._means(self._denoised, wide)
        spread = enlarged_rows(self._spread, self._size, wide)[0]
        threshold = self.stricter * (self._rule.spreads * spread).clamp(min=math.log(self._rule.least))
        found = (self._disagreement(wide) > threshold) & (torch.minimum(a, b) <= self._usual)
        if not found.any():  # most bands of most frames; what follows is dear
            return torch.zeros_like(a)[inner]
        found &= self._contradicted(a, b, wide)
        light = self._met_by_both(a, b, wide) & found | self._met_by_many(found, a, b, wide)
        found &= _largest_around(light, _SPOT) == 0
        spot = found & (torch.maximum(a, b) > self._usual)
        found &= _largest_around(spot, _SPOT) > 0
        share = _mean_around(_largest_around(found, _GROWN), _GROWN)
        if self._seen is not None:
            often = _largest_around(found * self._often(self._seen[wide], a, b, wide), _SPOT + 2 * _GROWN)
            share = share * (1 - 2 * often).clamp(min=0)
        return share[inner]

    def _contradicted(self, a: Tensor, b: Tensor, rows: slice) -> Tensor:
        """Whether the noisy pixels of the darker half contradict the brighter one, (rows, W)."""
        reach, doubts = _WITNESS // 2, []
        for bright, witness in zip((a, b), reversed(self._means(self._color, rows)), strict=True):
            mean = _mean_around(witness, reach)
            variance = (_mean_around(witness**2, reach) - mean**2).clamp(min=0)
            doubts.append(_mean_around(bright, reach) - mean > self._rule.doubts * variance.sqrt() / _WITNESS)
        contradicted: Tensor = torch.where(a > b, doubts[0], doubts[1])
        return contradicted

    def _met_by_both(self, a: Tensor, b: Tensor, rows: slice) -> Tensor:
        """Whether the darker half's noisy pixels nearby are about as bright as the brighter one's, (rows, W)."""
        in_a, in_b = (_largest_around(noisy, _SPOT) for noisy in self._means(self._color, rows))
        return torch.where(a > b, in_b > self._rule.alike * in_a, in_a > self._rule.alike * in_b)

    def _met_by_many(self, found: Tensor, a: Tensor, b: Tensor, rows: slice) -> Tensor:
        """Where found, whether more peaks of the brighter half's noisy pixels nearby are alike than a firefly has."""
        side = 2 * _SPOT + 1

        def around(noisy: Tensor) -> Tensor:
            peaks = F.pad(noisy.where(noisy == _largest_around(noisy, 1), 0.0), (_SPOT,) * 4)
            return peaks.unfold(0, side, 1).unfold(1, side, 1)[found].flatten(1)

        in_a, in_b = (around(noisy) for noisy in self._means(self._color, rows))
        highest = torch.where((a > b)[found][:, None], in_a, in_b).topk(self._rule.peaks + 1).values
        many = torch.zeros_like(found)
        many[found] = highest[:, -1] > self._rule.alike * highest[:, 0]
        return many

    def _often(self, seen: Tensor, a: Tensor, b: Tensor, rows: slice) -> Tensor:
        """p: how often the other halves have met what the brighter one has around each pixel, 0 … 1, (rows, W).

        0 where that is not most of what it has nearby.
        """
        usual = torch.minimum(a, b)
        in_a, in_b = (_mean_around(noisy - usual, _SPOT) for noisy in self._means(self._color, rows))
        energy, theirs = torch.where(a > b, in_a, in_b), torch.where(a > b, in_b, in_a)
        halves = [theirs, *(_mean_around(one, _SPOT) for one in (seen.double() * self._scale).unbind(-1))]
        met = torch.stack([torch.minimum(one, energy) for one in halves]).mean(0)
        inside = energy > _largest_around(energy, _SPOT) / 2  # of a window that misses the path nothing can be told
        often: Tensor = torch.where(inside & (energy > 0), met / energy, 0.0).clamp(0, 1)
        return often

    def excess(self, image: Radiance, rows: slice) -> Tensor:
        """What to take off rows of an image, (rows, W, 3) ≥ 0."""
        a, b = (half[rows].double() for half in self._denoised)
        darker = torch.where(a.mean(-1, keepdim=True) < b.mean(-1, keepdim=True), a, b)
        return self.weight(rows)[..., None] * (image[rows].double() - darker).clamp(min=0)


def _largest_around(values: Tensor, reach: int) -> Tensor:
    return F.max_pool2d(values.double()[None], 2 * reach + 1, 1, reach)[0]


def _mean_around(values: Tensor, reach: int) -> Tensor:
    return F.avg_pool2d(values[None], 2 * reach + 1, 1, reach, count_include_pad=False)[0]


def _mean(image: Tensor, pixels: Rows) -> float:
    total = sum(float(pixels(rows).sum()) for rows in bands(image.shape[0], _ROWS))
    return total / (image.shape[0] * image.shape[1])


def _tile_quantiles(size: tuple[int, int], pixels: Rows, share: float) -> Tensor:
    """Of a map, over tiles of 16 pixels, (h, w); border tiles are filled up with the edge's pixels."""
    strips = []
    for rows in bands(size[0], _ROWS):
        values = pixels(rows)
        below, right = -values.shape[0] % TILE, -values.shape[1] % TILE
        padded = F.pad(values[None], (0, right, 0, below), mode="replicate")[0]
        tiles = padded.unflatten(0, (-1, TILE)).unflatten(2, (-1, TILE)).transpose(1, 2).flatten(2)
        strips.append(tiles.quantile(share, dim=-1))
    return torch.cat(strips)


def _median_around(tiles: Tensor) -> Tensor:
    """The median of each tile and those around it; beyond the border the edge's tile counts again."""
    side = 2 * _AROUND + 1
    padded = F.pad(tiles[None], (_AROUND,) * 4, mode="replicate")[0]
    return padded.unfold(0, side, 1).unfold(1, side, 1).flatten(2).sort(-1).values[..., side**2 // 2]
