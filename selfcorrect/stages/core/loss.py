"""The dual-buffer loss and the learning rate, which need no reference (Back et al. 2022, Eqs. 8 and 9)."""

from functools import partial

import torch
from torch import Tensor

from selfcorrect.kernel.cross_bilateral import Window, cross_bilateral_loss
from selfcorrect.kernel.guides import Guides
from selfcorrect.settings import Settings

__all__ = ["dual_buffer_loss", "learning_rate", "relative_weight"]


def relative_weight(denoised: Tensor, epsilon: float) -> Tensor:
    """Eq. 8's 1 / (mean_rgb(z)² + ε) from planes (3, …) of denoised radiance."""
    return 1.0 / (denoised.mean(0) ** 2 + epsilon)


def learning_rate(guides: tuple[Guides, Guides], settings: Settings) -> float:
    """The set rate; by default times the root of the frame's mean variance, (y^a − y^b)² / 4."""
    if not settings.rate_from_variance:
        return settings.learning_rate
    color_a, color_b = (half.inner[:3].double() for half in guides)
    variance = ((color_a - color_b) ** 2 / 4).mean()
    return settings.learning_rate * float(torch.sqrt(variance))


def dual_buffer_loss(
    raw: Tensor, corners: Tensor, guides: tuple[Guides, Guides], weights: tuple[Tensor, Tensor], settings: Settings
) -> Tensor:
    """Eq. 8: mean of ½ [ (g^a − y^b)² / (mean_rgb(z^b)² + ε) + (g^b − y^a)² / (mean_rgb(z^a)² + ε) ].

    ``raw`` (2N, heads, h, w) holds the heads of half a's N patches, then of half b's; ``weights`` are the
    :func:`relative_weight` of a and of b, padded like the guides.
    """
    a, b = guides
    raw_a, raw_b = raw.chunk(2)
    one_way = partial(
        cross_bilateral_loss,
        window=Window.of(settings),
        threads=torch.get_num_threads(),
    )
    return one_way(a, raw_a, corners, b.radiance, weights[1]) + one_way(b, raw_b, corners, a.radiance, weights[0])
