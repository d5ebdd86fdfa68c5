"""Uncorrelated weighting of an unbiased pair (Back et al. 2023, Eqs. 5 and 8).

y is rendered with independent samples, z with common random numbers or made from finite differences: its noise is about
the same in neighbouring pixels, and cancels in their differences. Both are unbiased, so that

    μ_c = y_c + Σ_i k_i (Δz_ci − Δy_ci),   Δz_ci = z_c − z_i

is unbiased for any weights k that are uncorrelated with what they weigh. The published weights look at the *difference*
of two sub-averages of z, and weigh their *mean*: for equal, symmetric noise the two are uncorrelated. Of skewed noise,
as of rare bright paths at few samples, a bias is left: pixels beside what such paths light come out too bright.
"""

import torch
from torch import Tensor

from selfcorrect.errors import FrameError, SettingsError
from selfcorrect.image.windows import box_mean, reflected
from selfcorrect.settings import COMBINE_KERNELS

__all__ = ["GAMMAS", "KERNELS", "WINDOW", "combine"]

WINDOW = 15
GAMMAS = (0.01, 0.025, 0.05, 0.1, 0.2, 0.5, 1.0, 1.5, 2.0, 2.5)
KERNELS = COMBINE_KERNELS
_ROWS = 64  # worked on at a time, so that the sums stay in the cache


def combine(
    independent: tuple[Tensor, ...],
    correlated: tuple[Tensor, ...],
    *,
    samples: int,
    crossed: bool = False,
    kernel: str = "uncorrelated",
    gammas: tuple[float, ...] = GAMMAS,
) -> tuple[Tensor, float]:
    """Combine four independent sub-images of y with four of z.

    Eq. 8: ``k_i = exp(−γ n (Δz¹_ci − Δz²_ci)²) / |Ω|`` per channel over Ω of 15×15 pixels, the border mirrored without
    repeating the edge pixel. Sub-images 1 and 2 give one result, 3 and 4 another, and their mean is returned. γ is the
    one for which the two differ least: the mean of (μ^a − μ^b)² / (ȳ² + 0.01), with ȳ the window's mean of y.

    Args:
        independent: y¹ … y⁴, (H, W, C) linear radiance.
        correlated: z¹ … z⁴; those of one number may share samples with y of that number only if ``crossed``.
        samples: n, samples per pixel of each sub-image.
        crossed: combine y of 1 and 2 with z and weights of 3 and 4, and the other way round: for a z made from y.
        kernel: "uncorrelated"; "cross-weighting" weighs with the other two sub-images; "uniform" is 1/|Ω|.
        gammas: to choose from.

    Returns:
        μ (H, W, C) in the dtype of y¹, and γ (0 for the uniform kernel).

    Raises:
        FrameError: there are not four images each of one shape.
        SettingsError: ``kernel``, ``samples`` or ``gammas`` is out of range.
    """
    shapes = {tuple(image.shape) for image in (*independent, *correlated)}
    if len(independent) != 4 or len(correlated) != 4 or len(shapes) != 1 or len(independent[0].shape) != 3:
        raise FrameError(f"expected four images y and four z of one shape (H, W, C), but got {sorted(shapes)}")
    if kernel not in KERNELS or samples < 1 or not gammas or min(gammas) < 0:
        raise SettingsError(
            f"expected a kernel of {', '.join(KERNELS)}, samples of at least 1 and gammas of at least 0, "
            f"but got {kernel!r}, {samples} and {gammas}"
        )
    if kernel == "uniform":
        gammas = (0.0,)
    y, z = ([image.permute(2, 0, 1).double() for image in images] for images in (independent, correlated))
    pairs = ((0, 1), (2, 3))
    results = []
    for own, other in (pairs, pairs[::-1]):
        shown, weighed = other if crossed else own, other if kernel == "cross-weighting" or crossed else own
        spread = samples**0.5 * (z[weighed[0]] - z[weighed[1]])
        base = (y[own[0]] + y[own[1]]) / 2
        results.append(_combined(base, (z[shown[0]] + z[shown[1]]) / 2 - base, spread, gammas))
    weight = 1 / (box_mean(torch.stack(y).mean(0), WINDOW) ** 2 + 0.01)
    best = min(range(len(gammas)), key=lambda g: float((weight * (results[0][g] - results[1][g]) ** 2).mean()))
    image = ((results[0][best] + results[1][best]) / 2).permute(1, 2, 0)
    return image.to(independent[0].dtype), gammas[best]


def _combined(y: Tensor, excess: Tensor, spread: Tensor, gammas: tuple[float, ...]) -> list[Tensor]:
    """Eq. 5 for each γ; ``excess`` is z − y, so that Δz − Δy is its difference; ``spread`` is √n (z¹ − z²)."""
    radius = WINDOW // 2
    e, s = reflected(excess, radius), reflected(spread, radius)
    height, width = y.shape[1:]
    sums = [torch.zeros_like(y) for _ in gammas]
    for top in range(0, height, _ROWS):
        rows = min(_ROWS, height - top)
        e_c, s_c = (image[:, top : top + rows] for image in (excess, spread))
        for tap in range(WINDOW**2):
            at = (slice(None), slice(top + tap // WINDOW, top + tap // WINDOW + rows))
            column = slice(tap % WINDOW, tap % WINDOW + width)
            change = e_c - e[(*at, column)]
            distance = (s_c - s[(*at, column)]) ** 2
            weights: dict[float, Tensor] = {}
            for total, gamma in zip(sums, gammas, strict=True):
                half = weights.get(gamma / 2)  # half of the published γ are twice another: a square is cheaper
                weights[gamma] = torch.exp(-gamma * distance) if half is None else half * half
                total[:, top : top + rows].addcmul_(weights[gamma], change)
    return [y + total / WINDOW**2 for total in sums]
