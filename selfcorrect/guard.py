"""Never worse than the denoised input: a blend that each half's witness decides.

The halves are independent, so y^b is an unbiased witness of what the denoised z^a and the corrected g^a should have
been. For the blend z + α (g − z) the error is a parabola in α whose two coefficients need no reference:

    n = w (y^b − z^a)·(g^a − z^a),   d = w ‖g^a − z^a‖²,   w = 1 / (mean_rgb(z)² + 0.01)

averaged over pixels and summed over both directions; its minimum is α = n / d. Locally n is mostly noise, and a single
firefly in the witness can turn its sign. So the evidence is pooled from coarse to fine: the whole frame first, then
tiles of 128, 64, 32 and 16 pixels. Each level starts from what the level above found, moves as far as its own evidence
is certain, and then takes off one standard error.

Measured with `scripts/bench_quality.py`; README has the numbers.
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

__all__ = ["Estimate", "Guarded", "guard", "keep_light", "trust_in_full"]

_LEVELS = (128, 64, 32, 16)  # sides of the tiles
_PRIOR_VARIANCE = 0.25  # how far a tile's α may be expected to lie from that of the tile around it, squared
_ERROR_TILE = 16  # pixels whose evidence may be correlated: standard errors are taken over tiles of this side
_LIGHT_TOLERANCE = 3.0  # standard errors of the noisy mean
_DARKEST = 0.01  # radiance; darker pixels weigh no more
_LEAST_CERTAINTY = 1.5  # standard errors of the gain: frames that gain have 4 and more, fireflies in training give 2
_LARGEST_SCALE = 1.02  # of the whole image, to keep its light
_DISAGREEMENT = 0.5  # (max − min) / (max + min) of the denoised halves: one of them has left a firefly
_BIAS_SHRINKS = 0.45  # how much of the denoiser's change with the noise is taken for a change of its bias

Pair = tuple[Tensor, Tensor]


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
    """

    noisy: float
    denoised: float
    corrected: float
    change: float
    standard_error: float
    improved: bool

    def __str__(self) -> str:
        if not self.improved:
            return f"relMSE ≈ {self.denoised:.3g}: the evidence shows no gain, the denoised image is kept"
        errors = f"{self.denoised:.3g} → {self.corrected:.3g}"
        return f"relMSE ≈ {errors} ({100 * self.change:+.0f} ± {100 * self.standard_error:.0f} %)"


@dataclass(frozen=True, eq=False)
class Guarded:
    """The blend and what decided it.

    Attributes:
        image: (H, W, 3), linear radiance.
        alpha: weight of the corrected image, (H, W), 0 … 1.
        estimate: of what was gained.
        errors: estimated relative squared error of each pixel of the denoised image and of the blend, smoothed over
            16 pixels, (2, H, W).
    """

    image: Tensor
    alpha: Tensor
    estimate: Estimate
    errors: Tensor


def guard(
    color: Pair, denoised: Pair, corrected: Pair, denoised_full: Tensor, corrected_full: Tensor, *, scale: float = 1.0
) -> Guarded:
    """Blend the corrected image into the denoised one as far as the halves bear it out.

    Args:
        color: noisy halves, (H, W, 3) each, linear radiance of a mean near 1.
        denoised: denoised halves.
        corrected: each half corrected with its own denoised half: no half has seen its witness but through the
            network's 20,303 weights.
        denoised_full: denoised mean of the halves.
        corrected_full: the corrected image to blend in.
        scale: what the radiance was multiplied by; the estimate is that of the frame before.
    """
    y, z, g = ((pair[0].double(), pair[1].double()) for pair in (color, denoised, corrected))
    full = denoised_full.double()
    change = [g[i] - z[i] for i in (0, 1)]
    # The weight must not know the witness: low where the witness is high, it would reward darkening.
    weight = [1.0 / (_level(z[i]) ** 2 + 0.01) for i in (0, 1)]
    n = [weight[i] * ((y[1 - i] - z[i]) * change[i]).mean(-1) for i in (0, 1)]
    d = [weight[i] * (change[i] ** 2).mean(-1) for i in (0, 1)]

    # What one direction alone would choose is judged by the witness of the other.
    gain, unweighted = torch.zeros_like(n[0]), torch.zeros_like(n[0])
    for i in (0, 1):
        chosen = _pooled(n[i], d[i])
        judged = chosen * n[1 - i] - chosen**2 * d[1 - i] / 2
        gain += judged
        unweighted += judged / weight[1 - i]
    # More than chance, in the weights that decide and in those of the metric.
    in_metric = _metric_weight(full, scale) * unweighted
    improved = _certainty(gain) > 1 and _certainty(in_metric) > _LEAST_CERTAINTY

    alpha = _pooled(n[0] + n[1], d[0] + d[1]) if improved else torch.zeros_like(gain)
    image = full + alpha[..., None] * (corrected_full.double() - full)
    # The best image there is says what errors are relative to: where the denoiser has left fireflies or blurred
    # a lamp, its own radiance would hide its error.
    own = _metric_weight(_shown(image), scale)
    estimate, errors = _estimate(y, z, full, own, own * unweighted if improved else torch.zeros_like(gain), improved)
    dtype = denoised_full.dtype
    errors = errors.clamp(0, torch.finfo(dtype).max)
    return Guarded(image.to(dtype), alpha.to(dtype), estimate, errors.to(dtype))


def _metric_weight(radiance: Tensor, scale: float) -> Tensor:
    """relMSE's 1 / (mean_rgb² + 0.01) of the frame in its own units, times 1 / scale²."""
    return 1.0 / (radiance.mean(-1) ** 2 + 0.01 * scale**2)


def _shown(radiance: Tensor) -> Tensor:
    """Radiance to weigh errors by: a pixel clipped to black amid bright ones is taken for an eighth of them."""
    around = F.avg_pool2d(radiance.permute(2, 0, 1), 3, 1, 1, count_include_pad=False).permute(1, 2, 0)
    return torch.maximum(radiance, around / 8)


def _estimate(
    y: Pair, z: Pair, full: Tensor, weight: Tensor, gained: Tensor, improved: bool
) -> tuple[Estimate, Tensor]:
    """What the guard tells, and maps of the error before and after, (2, H, W).

    The error of a denoised half is known without bias (Eq. 6): E‖z^a − y^b‖² is that error plus the variance of y^b.
    It consists of variance, half of the spread V between the halves, and bias. The full buffer has half the variance.
    Its bias is smaller too, unless the denoiser is linear; then the full buffer is the mean of the halves. How far it
    is not tells by how much.
    """
    between = weight * ((y[0] - y[1]) ** 2).mean(-1)
    crossed = weight * ((z[0] - y[1]) ** 2 + (z[1] - y[0]) ** 2).mean(-1) / 2
    spread = weight * ((z[0] - z[1]) ** 2).mean(-1)
    nonlinear = weight * (((z[0] + z[1]) / 2 - full) ** 2).mean(-1)
    v = float(spread.mean())
    bias = max(float((crossed - between / 2).mean()) - v / 2, 0.0)
    left = max(1 - _BIAS_SHRINKS * math.sqrt(float(nonlinear.mean()) / bias), 0.0) if bias > 0 else 0.0
    half = max(bias + v / 2, float(gained.mean()))
    denoised = left * bias + v / 4
    ratio = float(gained.mean()) / half if half > 0 else 0.0
    before = left * (crossed - between / 2 - spread / 2) + spread / 4
    after = before - gained * (denoised / half if half > 0 else 0.0)
    estimate = Estimate(
        noisy=float(between.mean()) / 4,
        denoised=denoised,
        corrected=denoised * (1 - ratio),
        change=-ratio,
        standard_error=_tile_error(gained) / half if half > 0 else 0.0,
        improved=improved,
    )
    return estimate, torch.stack([_smooth(before), _smooth(after)])


def _pooled(n: Tensor, d: Tensor) -> Tensor:
    """α of each pixel from evidence pooled over the frame, then over ever smaller tiles."""
    floor = torch.finfo(torch.float64).tiny
    certain = n.mean() - _tile_error(n)
    alpha = (certain / d.mean().clamp(min=floor)).clamp(0, 1).expand_as(n)
    for side in _LEVELS:
        if side > max(n.shape):
            continue
        around = _means(alpha, side)
        evidence, curvature = _means(n, side), _means(d, side)
        variance = _means((n - alpha * d) ** 2, side) / side**2
        ridge = variance / (_PRIOR_VARIANCE * curvature).clamp(min=floor)
        moved = (evidence + ridge * around - variance.sqrt()) / (curvature + ridge).clamp(min=floor)
        alpha = F.interpolate(moved.clamp(0, 1)[None, None], size=n.shape, mode="bilinear")[0, 0]
    return alpha


def _means(image: Tensor, side: int) -> Tensor:
    """Means over tiles; those at the far border are smaller."""
    return F.avg_pool2d(image[None, None], side, ceil_mode=True, count_include_pad=False)[0, 0]


def _tile_error(image: Tensor) -> float:
    """Standard error of the mean, over tiles as independent draws; of a single tile, the mean's own size."""
    tiles = _means(image, _ERROR_TILE).flatten()
    if len(tiles) == 1:
        return float(tiles.abs())
    return float(tiles.std()) / math.sqrt(len(tiles))


def _certainty(image: Tensor) -> float:
    """The mean in units of its standard error."""
    mean, error = float(image.mean()), _tile_error(image)
    return mean / error if error > 0 else math.copysign(math.inf, mean) if mean else 0.0


def _level(radiance: Tensor) -> Tensor:
    """Radiance that the relative error counts from, (H, W): each pixel's own, at most the usual one around it.

    A firefly that the denoiser has left is a large error in a dark place; its own radiance would give it no weight.
    """
    level = radiance.mean(-1)
    around = _smooth(level.clamp(min=_DARKEST).log()).exp()
    return torch.minimum(level, around)


def _smooth(image: Tensor) -> Tensor:
    means = _means(image, _ERROR_TILE)
    return F.interpolate(means[None, None], size=image.shape, mode="bilinear")[0, 0]


def trust_in_full(denoised: Pair, denoised_full: Tensor, *, scale: float = 1.0) -> Tensor:
    """How far the full buffer's denoised image may stand in for the halves' own, (H, W, 1), 0 … 1.

    It is the better input, but a firefly that the denoiser has left in one half is in the full buffer too; with their
    own images only one of the corrected halves has it. So not where the halves differ by more than a factor of three,
    unless the full buffer sides with the darker one.
    """
    a, b, full = (scale * image.double().mean(-1) for image in (*denoised, denoised_full))
    middle, half = (a + b) / 2, (a - b).abs() / 2
    left_in_one = half > _DISAGREEMENT * middle.clamp(min=_DARKEST / 10)
    sides_with_darker = (2 * (middle - full) / half.clamp(min=torch.finfo(torch.float64).tiny)).clamp(0, 1)
    doubt = torch.where(left_in_one, 1 - sides_with_darker, 0.0)[None, None]
    around = F.max_pool2d(doubt, 5, 1, 2)
    return 1 - F.avg_pool2d(around, 5, 1, 2, count_include_pad=False)[0, 0][..., None]


def keep_light(image: Tensor, denoised: Tensor, color: Pair) -> Tensor:
    """Bring the image's mean radiance to within three standard errors of the noisy mean.

    Corrections learned from a loss that has not seen every bright path lose light; the noisy mean has not. Small
    losses are scaled away. For what two per cent of scaling do not reach, light comes back from where the denoised
    image has kept more of it, smoothed over 16 pixels, so that its fireflies stay away.
    """
    noisy = (color[0].double() + color[1].double()) / 2
    mean, target, kept = (float(x.double().mean()) for x in (image, noisy, denoised))
    within = _LIGHT_TOLERANCE * _error_of_mean(color)
    if mean <= 0 or abs(mean - target) <= within:
        return image
    wanted = target + within if mean > target else target - within
    result = image.double()
    if abs(kept - target) < abs(mean - target):
        reachable = min(max(mean, wanted / _LARGEST_SCALE), wanted * _LARGEST_SCALE)
        share = min(1.0, (reachable - mean) / (kept - mean))
        lost = (denoised.double() - result).unbind(-1)
        result = (result + share * torch.stack([_smooth(channel) for channel in lost], -1)).clamp(min=0)
    scale = min(max(wanted / float(result.mean()), 1 / _LARGEST_SCALE), _LARGEST_SCALE)
    return (result * scale).to(image.dtype)


def _error_of_mean(color: Pair) -> float:
    """Standard error of the mean radiance of both halves."""
    difference = (color[0].double() - color[1].double()).mean(-1) / 2
    return math.sqrt(float((difference**2).mean()) / difference.numel())
