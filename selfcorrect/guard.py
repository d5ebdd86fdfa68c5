"""Never worse than the denoised input: a blend that each half's witness decides.

The halves are independent, so y^b is an unbiased witness of what the denoised z^a and the corrected g^a should have
been. For the blend z + α (g − z) the error is a parabola in α whose two coefficients need no reference:

    n = w (y^b − z^a)·(g^a − z^a),   d = w ‖g^a − z^a‖²,   w = 1 / (mean_rgb(z)² + 0.01)

averaged over pixels and summed over both directions; its minimum is α = n / d. Whether that is a gain is judged by
other pixels than those that chose α: the fields of a chessboard. How α is found for several candidates
and ever smaller tiles is in :mod:`selfcorrect.pooling`.

The image is gone through in bands of rows (:mod:`selfcorrect.image.bands`): only n and d are kept for every pixel,
the rest as means over tiles of 16 pixels. Standard errors are taken over these tiles: evidence inside one may be
correlated.

Measured with `scripts/bench/quality.py`; README has the numbers.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor

from selfcorrect.image.bands import average, enlarged, enlarged_rows, in_bands, tile_means, widened
from selfcorrect.image.channels import channel_mean
from selfcorrect.image.exposure import Radiance, scale_
from selfcorrect.pooling import pairs, pooled, taken_off

__all__ = ["CERTAIN", "Estimate", "Evidence", "Guarded", "guard", "keep_above_", "keep_light_"]

_OUTERMOST = 0.005  # share of the tiles at either end that the verdict pulls in
CERTAIN = 1.645  # standard errors: the normal distribution leaves 5 % beyond
_LIGHT_TOLERANCE = 3.0  # standard errors of the noisy mean
_FOLD = 8  # pixels: half of the smallest tile; wide pixel filters correlate noise over one or two
_DARKEST = 0.01  # radiance; darker pixels weigh no more
_LARGEST_SCALE = 1.02  # of the whole image, to keep its light
_BIAS_SHRINKS = 0.45  # how much of the denoiser's change with the noise is taken for a change of its bias

Pair = tuple[Radiance, Radiance]


@dataclass(frozen=True)
class Estimate:
    """Errors estimated without a reference, as relMSE, and the gain.

    Attributes:
        noisy: of the mean of the halves.
        denoised: of the denoised image.
        corrected: of the output.
        change: corrected over denoised, minus 1; negative is better.
        standard_error: of ``change``.
        improved: whether the evidence says that the output is better; if not, the output is the denoised image.
        independent: whether the halves can tell at all; if not, the output is the denoised image and no number is told:
            all are 0.
    """

    noisy: float
    denoised: float
    corrected: float
    change: float
    standard_error: float
    improved: bool
    independent: bool = True

    def without(self, fireflies: float, uncertain: float) -> Self:
        """The estimate of an output without fireflies, whose relMSE in the denoised image was this, and how uncertain.

        The guard hardly counts them: their own radiance, by which it weighs, hides them.
        """
        denoised = self.denoised + fireflies
        left = self.corrected / denoised if denoised > 0 else 1.0
        if left >= 1:  # lost in the rounding of a far larger error
            return self
        return replace(
            self,
            denoised=denoised,
            change=left - 1,
            standard_error=math.hypot(self.standard_error * self.denoised, left * uncertain) / denoised,
            improved=True,
        )

    def with_unjudged(self, error: float) -> Self:
        """The estimate where so much relMSE may be in the denoised image and stays in the output, judged by nothing."""
        if error <= 0:
            return self
        denoised = self.denoised + error
        return replace(
            self,
            denoised=denoised,
            corrected=self.corrected + error,
            change=(self.corrected - self.denoised) / denoised,
            standard_error=self.standard_error * self.denoised / denoised,
        )

    def __str__(self) -> str:
        if not self.independent:
            return "relMSE unknown: the halves share their noise, the denoised image is kept; use another seed for one"
        if not self.improved:
            return f"relMSE ≈ {self.denoised:.3g}: the evidence shows no gain, the denoised image is kept"
        errors = f"{self.denoised:.3g} → {self.corrected:.3g}"
        return f"relMSE ≈ {errors} ({100 * self.change:+.0f} ± {100 * self.standard_error:.0f} %)"


@dataclass(frozen=True, eq=False)
class Guarded:
    """The blend and what decided it.

    Attributes:
        image: (H, W, 3), linear radiance.
        estimate: of what was gained.
        alpha: the weight of each candidate over tiles of 16 pixels, (K, h, w).
        errors: the relative squared error before and after over the same, (2, h, w).
        shares: of the gain, by candidate; their sum is 1, or all are 0 where nothing was gained.
    """

    image: Tensor
    estimate: Estimate
    alpha: Tensor
    errors: Tensor
    shares: tuple[float, ...]

    def maps(self) -> tuple[Tensor, Tensor, Tensor]:
        """Each (H, W): the weight of all candidates together, 0 … 1, and the estimated relative squared error of the
        denoised image and of the blend, smoothed over 16 pixels.
        """
        tiles = torch.cat([self.alpha.sum(0, keepdim=True), self.errors])
        alpha, before, after = enlarged(tiles, (self.image.shape[0], self.image.shape[1])).clamp_(min=0)
        return alpha, before, after


class Evidence:
    """n and d of both directions at every pixel, gathered as the candidates' halves are made.

    Args:
        color: noisy halves, (H, W, 3) each, linear radiance of a mean near 1.
        denoised: denoised halves.
        candidates: how many images may be blended in, K.
    """

    def __init__(self, color: Pair, denoised: Pair, candidates: int = 1):
        self.color, self.denoised, self.candidates = color, denoised, candidates
        self.size = (color[0].shape[0], color[0].shape[1])
        self._usual = [tile_means(self.size[0], partial(_log_level, half)) for half in denoised]
        planes = candidates + candidates * (candidates + 1) // 2
        self._nd = torch.zeros(2, planes, *self.size, device=self._usual[0].device)  # direction, n or d
        self._rows = 0

    @property
    def complete(self) -> bool:
        """Whether every row has been gathered."""
        return self._rows == self.size[0]

    def add(self, rows: slice, *halves: tuple[Tensor, Tensor]) -> None:
        """Gather from rows of the halves of every candidate, each made with its own denoised half.

        No half may have seen its witness but through the network's few weights.
        """
        self._rows += rows.stop - rows.start

        def gather(part: slice) -> None:
            band = slice(rows.start + part.start, rows.start + part.stop)
            y, z = self.y(band), self.z(band)
            for i in (0, 1):
                changes = [pair[i][part].double() - z[i] for pair in halves]
                weight, residual = self.weight(i, band), y[1 - i] - z[i]
                products = [residual * change for change in changes]
                products += [changes[k] * changes[m] for k, m in pairs(self.candidates)]
                for plane, product in enumerate(products):
                    self._nd[i, plane, band] = weight * channel_mean(product)

        in_bands(rows.stop - rows.start, gather)

    def y(self, rows: slice) -> list[Tensor]:
        """The noisy halves."""
        return [half[rows].double() for half in self.color]

    def z(self, rows: slice) -> list[Tensor]:
        """The denoised halves."""
        return [half[rows].double() for half in self.denoised]

    def nd(self, i: int, rows: slice) -> Tensor:
        """n of each candidate and d of each two of them, of one direction, (K + K (K + 1) / 2, rows, W)."""
        return self._nd[i, :, rows].double()

    def both(self, rows: slice) -> Tensor:
        """n and d of both directions together."""
        return self.nd(0, rows) + self.nd(1, rows)

    def first_fold(self, rows: slice) -> Tensor:
        """A chessboard, (rows, W)."""
        y = torch.arange(rows.start, rows.stop, device=self._nd.device)[:, None] // _FOLD
        return (y + torch.arange(self.size[1], device=self._nd.device) // _FOLD) % 2 == 0

    def fold(self, i: int, rows: slice) -> Tensor:
        """n and d of both directions on the fields of one colour, else 0.

        Not of one direction: g^a − z^a is in part a mean of the noise of half a around, and its product with the noise
        of half b, summed over a tile, is the same number in both directions.
        """
        return self.both(rows) * (self.first_fold(rows) == (i == 0))

    def weight(self, i: int, rows: slice) -> Tensor:
        """What one direction's evidence is multiplied by.

        It must not know the witness: low where the witness is high, it would reward darkening. And a firefly that the
        denoiser has left is a large error in a dark place; its own radiance would give it no weight. So a pixel counts
        for its own radiance, but at most for the usual one around it.
        """
        usual = enlarged_rows(self._usual[i], self.size, rows)[0].exp()
        return 1.0 / (torch.minimum(channel_mean(self.denoised[i][rows].double()), usual) ** 2 + 0.01)


def _log_level(radiance: Radiance, rows: slice) -> Tensor:
    return channel_mean(radiance[rows].double()).clamp(min=_DARKEST).log()[None]


def guard(
    evidence: Evidence, denoised_full: Radiance, images: Sequence[Radiance], *, scale: float = 1.0, out: Tensor
) -> Guarded:
    """Blend candidates into the denoised image as far as the halves confirm them.

    Args:
        evidence: of every row.
        denoised_full: denoised mean of the halves.
        images: each candidate of the full buffer, (H, W, 3).
        scale: what the radiance was multiplied by; the estimate is that of the frame before.
        out: (H, W, 3), what the blend is written to; it may be the last of ``images``.
    """
    size, count = evidence.size, evidence.candidates
    chosen = [pooled(size, partial(evidence.fold, i), count) for i in (0, 1)]

    def judged(rows: slice) -> tuple[Tensor, Tensor]:
        """What one fold's evidence alone would choose is judged by the other's: the gain, with and without w.

        By candidate, (K, rows, W).
        """
        weights = [enlarged_rows(alpha, size, rows) for alpha in chosen]
        alpha = torch.where(evidence.first_fold(rows), weights[1], weights[0])
        gain = [taken_off(alpha, evidence.nd(i, rows)) for i in (0, 1)]
        return gain[0] + gain[1], gain[0] / evidence.weight(0, rows) + gain[1] / evidence.weight(1, rows)

    def gains(rows: slice) -> Tensor:
        gain, unweighted = judged(rows)
        weighted = _metric_weight(denoised_full[rows].double(), scale) * unweighted
        return torch.cat([gain.sum(0, keepdim=True), weighted.sum(0, keepdim=True), weighted])

    gain = tile_means(size[0], gains)
    # More than chance, in the weights that decide and in those of the metric.
    means = average(gain, size)
    improved = all(means[i] > 0 and _more_than_chance(gain[i]) for i in (0, 1))
    shares = tuple(part / means[1] if improved else 0.0 for part in means[2:])

    alpha = pooled(size, evidence.both, count) if improved else gain.new_zeros(count, 1, 1)

    def blend(rows: slice) -> None:
        full, weights = denoised_full[rows].double(), enlarged_rows(alpha, size, rows)
        blended = full
        for weight, image in zip(weights, images, strict=True):
            blended = blended + weight[:, :, None] * (image[rows].double() - full)
        out[rows] = blended

    in_bands(size[0], blend)

    def squares(rows: slice) -> Tensor:
        """Mean squared differences, and the gain, by which :func:`_estimate` knows errors."""
        y, z, full = evidence.y(rows), evidence.z(rows), denoised_full[rows].double()
        between = channel_mean((y[0] - y[1]) ** 2)
        crossed = channel_mean((z[0] - y[1]) ** 2 + (z[1] - y[0]) ** 2) / 2
        spread = channel_mean((z[0] - z[1]) ** 2)
        nonlinear = channel_mean(((z[0] + z[1]) / 2 - full) ** 2)
        gained = judged(rows)[1].sum(0) if improved else torch.zeros_like(spread)
        # The best image there is says what errors are relative to: where the denoiser has left fireflies or blurred
        # a lamp, its own radiance would hide its error.
        return _metric_weight(_shown(out, rows), scale) * torch.stack([between, crossed, spread, nonlinear, gained])

    estimate, errors = _estimate(tile_means(size[0], squares), size, improved)
    return Guarded(out, estimate, alpha.expand(count, *errors.shape[1:]), errors, shares)


def _metric_weight(radiance: Tensor, scale: float) -> Tensor:
    """relMSE's 1 / (mean_rgb² + 0.01) of the frame in its own units, times 1 / scale²."""
    return 1.0 / (channel_mean(radiance) ** 2 + 0.01 * scale**2)


def _shown(image: Tensor, rows: slice) -> Tensor:
    """Radiance to weigh errors by: a pixel clipped to black amid bright ones is taken for an eighth of them."""
    wide, inner = widened(rows, 1, image.shape[0])
    radiance = image[wide].double()
    around = F.avg_pool2d(radiance.permute(2, 0, 1), 3, 1, 1, count_include_pad=False).permute(1, 2, 0)
    return torch.maximum(radiance, around / 8)[inner]


def _estimate(squares: Tensor, size: tuple[int, int], improved: bool) -> tuple[Estimate, Tensor]:
    """What the guard tells, and the error before and after, over tiles, (2, h, w).

    ``squares`` are the tile means of weighted squared differences: between the noisy halves, crossed (each denoised
    half and its witness), the spread of the denoised halves, between their mean and the full buffer; and the gain.

    The error of a denoised half is known without bias (Eq. 6): E‖z^a − y^b‖² is that error plus the variance of y^b.
    It consists of variance, half of the spread V between the halves, and bias. The full buffer has half the variance.
    Its bias is smaller too, unless the denoiser is linear; then the full buffer is the mean of the halves. How far it
    is not tells by how much.
    """
    between, crossed, v, nonlinear, gained = average(squares, size)
    bias = max(crossed - between / 2 - v / 2, 0.0)
    left = max(1 - _BIAS_SHRINKS * math.sqrt(nonlinear / bias), 0.0) if bias > 0 else 0.0
    half = max(bias + v / 2, gained)
    denoised = left * bias + v / 4
    ratio = gained / half if half > 0 else 0.0
    estimate = Estimate(
        noisy=between / 4,
        denoised=denoised,
        corrected=denoised * (1 - ratio),
        change=-ratio,
        standard_error=_standard_error(squares[4]) / half if half > 0 else 0.0,
        improved=improved,
    )
    before = left * (squares[1] - squares[0] / 2 - squares[2] / 2) + squares[2] / 4
    after = before - squares[4] * (denoised / half if half > 0 else 0.0)
    return estimate, torch.stack([before, after])


def _more_than_chance(tiles: Tensor) -> bool:
    """Whether a mean over tiles is above 0 by more than chance gives in one case of twenty, the outermost pulled in.

    One tile with a firefly in its witness can be the whole sum, and then neither it nor its standard error means
    anything: the highest and the lowest half per cent of the tiles count as the next one.
    """
    ordered = tiles.flatten().sort().values
    cut = int(_OUTERMOST * len(ordered))
    pulled_in = ordered.clamp(float(ordered[cut]), float(ordered[-1 - cut]))
    return float(pulled_in.mean()) > CERTAIN * _standard_error(pulled_in)


def _standard_error(tiles: Tensor) -> float:
    """Of the mean, over tiles as independent draws; of a single tile, the mean's own size."""
    if tiles.numel() == 1:
        return float(tiles.abs())
    return float(tiles.std()) / math.sqrt(tiles.numel())


def keep_above_(image: Tensor, denoised: Radiance, color: Pair) -> Tensor:
    """Raise what is darker than the denoised image and than all nine noisy pixels around, in place.

    Tiles decide how much of a correction is taken; in one of their pixels it may shoot past what it corrects, and a
    black pixel on a lamp is seen by everybody. Nothing is lowered likewise: noise has its tail at the bright end, so
    that the truth often lies above all that a few samples have met, and hardly ever below.

    Args:
        image: (H, W, 3) linear radiance.
        denoised: the same of the denoised mean of the halves.
        color: noisy halves.
    """

    def keep(rows: slice) -> None:
        wide, inner = widened(rows, 1, image.shape[0])
        noisy = (color[0][wide].double() + color[1][wide].double()) / 2
        least = -F.max_pool2d(-noisy.permute(2, 0, 1), 3, 1, 1).permute(1, 2, 0)[inner]
        image[rows] = torch.maximum(image[rows].double(), torch.minimum(least, denoised[rows].double()))

    in_bands(image.shape[0], keep)
    return image


def keep_light_(image: Tensor, denoised: Radiance, color: Pair) -> Tensor:
    """Bring the image's mean radiance to within three standard errors of the noisy mean, in place.

    Corrections learned from a loss that has not seen every bright path lose light; the noisy mean has not. Small
    losses are scaled away. For what two per cent of scaling do not reach, light comes back from where the denoised
    image has kept more of it, smoothed over 16 pixels, so that its fireflies stay away.
    """
    size = (image.shape[0], image.shape[1])

    def means(rows: slice) -> Tensor:
        a, b = (channel_mean(half[rows].double()) for half in color)
        shown = (channel_mean(x[rows].double()) for x in (image, denoised))
        return torch.stack([*shown, (a + b) / 2, ((a - b) / 2) ** 2])

    mean, kept, target, variance = average(tile_means(size[0], means), size)
    within = _LIGHT_TOLERANCE * math.sqrt(variance / (size[0] * size[1]))
    if mean <= 0 or abs(mean - target) <= within:
        return image
    wanted = target + within if mean > target else target - within
    if abs(kept - target) < abs(mean - target):
        reachable = min(max(mean, wanted / _LARGEST_SCALE), wanted * _LARGEST_SCALE)
        share = min(1.0, (reachable - mean) / (kept - mean))
        lost = tile_means(size[0], lambda rows: (denoised[rows].double() - image[rows].double()).permute(2, 0, 1))

        def give_back(rows: slice) -> None:
            returned = share * enlarged_rows(lost, size, rows).permute(1, 2, 0)
            image[rows] = (image[rows].double() + returned).clamp(min=0)

        in_bands(size[0], give_back)
        (mean,) = average(tile_means(size[0], lambda rows: channel_mean(image[rows].double())[None]), size)
    return scale_(image, min(max(wanted / mean, 1 / _LARGEST_SCALE), _LARGEST_SCALE))
