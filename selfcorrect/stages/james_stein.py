"""James–Stein combination of an unbiased and a biased image, classical variant (Gu et al. 2022, Eqs. 6 and 13).

Noise makes a block lie farther from any other image than the truth does, by p σ² on average. So a block that lies no
farther from the biased image than its noise explains is replaced by it, and one that lies farther is kept: in
expectation its squared error is never larger than that of the noise, however wrong the biased image is, and where the
noise goes to zero so does the error.

That promise is one of equal noise in all pixels of a block. Monte Carlo noise grows with radiance: with the published
block sums an inverted image made some frames 10 % worse (dining-room, 256 spp), as the noise of bright pixels let dark
ones go. So :func:`james_stein` takes a weight of each pixel; with :func:`relative_weight` both the noise becomes nearly
even and the squared error the relative one, and no frame, sample count or biased image was found that it makes
worse (``scripts/bench/stages.py dominance``).
"""

import torch
from torch import Tensor

from selfcorrect.errors import FrameError, SettingsError
from selfcorrect.frame import mean
from selfcorrect.image.channels import channel_mean
from selfcorrect.image.exposure import scale_
from selfcorrect.image.windows import box_mean, gaussian_mean
from selfcorrect.stages.images import StageImages
from selfcorrect.stages.stage import Outcome, Stage, Work

__all__ = ["WINDOW", "JamesStein", "james_stein", "relative_weight", "variance_of_mean"]

WINDOW = 15  # side of the block Ω; p = 15 · 15 = 225
SIGMA = 4.0  # pixels, of the Gaussian that smooths the variance: a block's standard deviation, √((15² − 1) / 12) = 4.3
_LEVEL_SIGMA = 2.0  # pixels; of 1, 2 and 4 the best on most of six development frames
_DARKEST = 0.1  # of the frame's mean radiance; darker pixels weigh no more


def variance_of_mean(halves: tuple[Tensor, Tensor]) -> Tensor:
    """Variance of the mean of two independent halves, (x^a − x^b)² / 4, as float64: one sample of it a pixel."""
    difference = halves[0].double() - halves[1].double()
    return (difference / 2) ** 2


def relative_weight(unbiased: Tensor, *, sigma: float = _LEVEL_SIGMA) -> Tensor:
    """1 / (level² + ε), (H, W, 1) float64, with the level the mean over channels and a Gaussian window of (H, W, C)."""
    level = gaussian_mean(channel_mean(unbiased.double())[None], sigma)[0]
    floor = max(_DARKEST * float(level.abs().mean()), torch.finfo(torch.float32).tiny)
    return (1 / (level**2 + floor**2))[..., None]


def james_stein(
    unbiased: Tensor,
    biased: Tensor,
    variance: Tensor,
    weight: Tensor | None = None,
    *,
    window: int = WINDOW,
    sigma: float = SIGMA,
) -> Tensor:
    """Shrink the unbiased image towards the biased one, block by block, each channel on its own.

    Eq. 13: ``θ_i = y_i + mean_{c ∈ Ω_i} (1 − (p−2) σ²_c / ‖X_c − Y_c‖²)⁺ (x_i − y_i)``, where X_c, Y_c are blocks
    Ω_c of p = window² pixels. Ω is mirrored at the border without repeating the edge pixel.

    Args:
        unbiased: x, noisy linear radiance, (H, W, C).
        biased: y, for example denoised or corrected radiance, (H, W, C). The promise needs noise independent of x's; a
            y that was made from x lies nearer to it, and is trusted a little more than is right.
        variance: of each pixel of x, (H, W, C) ≥ 0; see :func:`variance_of_mean`. It is smoothed here (Eq. 6).
        weight: of each pixel's squared error, (H, W, 1) or (H, W, C); None is the published formula.
        window: side of Ω, odd, at least 3.
        sigma: standard deviation in pixels of the Gaussian that smooths the variance; 0 leaves it as it is.

    Returns:
        θ, (H, W, C), in the dtype of x.

    Raises:
        FrameError: the shapes differ.
        SettingsError: the window is even or less than 3, or sigma is negative.
    """
    if not unbiased.shape == biased.shape == variance.shape or unbiased.ndim != 3:
        shapes = ", ".join(str(tuple(image.shape)) for image in (unbiased, biased, variance))
        raise FrameError(f"expected unbiased, biased and variance of one shape (H, W, C), but got {shapes}")
    if window % 2 == 0 or window < 3 or not 0 <= sigma < float("inf"):
        raise SettingsError(f"expected an odd window of at least 3 and a sigma ≥ 0, but got {window} and {sigma}")
    # float64: the square of the largest float32 is finite
    x, y, s2 = (image.permute(2, 0, 1).double() for image in (unbiased, biased, variance))
    q = torch.ones_like(x[:1]) if weight is None else weight.permute(2, 0, 1).double()
    kept = box_mean(_shrinkage(q * (x - y) ** 2, _smoothed(q * s2, sigma), window), window)
    limit = torch.finfo(unbiased.dtype).max
    return (y + kept * (x - y)).permute(1, 2, 0).clamp(-limit, limit).to(unbiased.dtype)


def _smoothed(variance: Tensor, sigma: float) -> Tensor:
    return gaussian_mean(variance, sigma) if sigma else variance


def _shrinkage(squared: Tensor, variance: Tensor, window: int) -> Tensor:
    """``(1 − (p−2) σ²_c / ‖X_c − Y_c‖²)⁺`` of the block around each pixel; where both are 0, nothing hangs on it."""
    p = window**2
    noise, distance = (p - 2) * variance, p * box_mean(squared, window)
    return 1 - torch.where(noise < distance, noise / distance, 1.0)


class JamesStein(Stage):
    """Each half and the full image shrunk from the noisy radiance towards what the stages so far have made (Eq. 13).

    Where a half's noise is large is told by both halves, (y^a − y^b)² / 2, but only as a mean over a block: see
    ``tests/stages/test_stages.py`` for how little the half thereby knows of its witness.
    """

    name = "james-stein"

    def run(self, state: StageImages, work: Work) -> Outcome:
        """Shrink with the relative weight."""
        scaled = state.scaled()
        variance = variance_of_mean(scaled.color)

        def shrunk(noisy: Tensor, image: Tensor, variance: Tensor) -> Tensor:
            return scale_(james_stein(noisy, image, variance, relative_weight(noisy)), 1 / state.scale)

        a, b = (shrunk(noisy, image, 2 * variance) for noisy, image in zip(scaled.color, scaled.images, strict=True))
        return Outcome(state.then((a, b), shrunk(mean(scaled.color), scaled.full, variance)))
