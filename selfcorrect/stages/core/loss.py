"""The dual-buffer loss and the learning rate, which need no reference (Back et al. 2022, Eqs. 8 and 9)."""

from functools import partial
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from selfcorrect.kernel.cross_bilateral import Window, cross_bilateral_loss
from selfcorrect.kernel.guides import Guides
from selfcorrect.settings import Settings

__all__ = ["Witness", "dual_buffer_loss", "learning_rate", "relative_weight", "witnesses"]

_AROUND = 9  # side of the window that a pixel's spread is the mean of


class Witness(NamedTuple):
    """What Eq. 8 compares a half's correction with, padded like the guides.

    Attributes:
        radiance: what the other half measured, (3, …).
        weight: of the squared difference, (…).
    """

    radiance: Tensor
    weight: Tensor


def witnesses(guides: tuple[Guides, Guides], settings: Settings) -> tuple[Witness, Witness]:
    """The witness of half a, which is half b, and that of half b."""
    weight_a, weight_b = (relative_weight(half.denoised, settings.loss_epsilon) for half in guides)
    if settings.crossed_weights:  # a weight that knows the witness rewards darkening
        weight_a, weight_b = weight_b, weight_a
    a, b = guides
    return Witness(_bounded(b, a, settings), weight_b), Witness(_bounded(a, b, settings), weight_a)


def _bounded(half: Guides, other: Guides, settings: Settings) -> Tensor:
    """A half's radiance, no further from its denoised image z than so many times the spread around each pixel.

    One firefly in the witness can weigh more in Eq. 8 than all that can be gained, and a network that sees it fifty
    times learns to find it. The spread is the other half's, so that no pixel moves its own bound, relative to z, and
    at least the frame's median.
    """
    if not settings.witness_limit:
        return half.radiance

    def level(guides: Guides) -> Tensor:
        return guides.denoised.mean(0, keepdim=True) ** 2 + settings.loss_epsilon

    squares = ((other.radiance - other.denoised) ** 2).mean(0, keepdim=True) / level(other)
    spread = F.avg_pool2d(squares, _AROUND, stride=1, padding=_AROUND // 2, count_include_pad=False)
    usual = _median(spread.flatten())
    limit = settings.witness_limit * (torch.maximum(spread, usual) * level(half)).sqrt()
    return half.denoised + (half.radiance - half.denoised).clamp(-limit, limit)


def _median(values: Tensor) -> Tensor:
    """The upper one of two. Sorting takes eight times as long, but is deterministic on any device."""
    if values.device.type == "cpu":
        return values.kthvalue(len(values) // 2 + 1).values
    return values.sort().values[len(values) // 2]


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
    raw: Tensor,
    corners: Tensor,
    guides: tuple[Guides, Guides],
    witnesses: tuple[Witness, Witness],
    settings: Settings,
) -> Tensor:
    """Eq. 8: mean of ½ [ (g^a − y^b)² / (mean_rgb(z^b)² + ε) + (g^b − y^a)² / (mean_rgb(z^a)² + ε) ].

    ``raw`` (2N, heads, h, w) holds the heads of half a's N patches, then of half b's; ``witnesses`` are those of a
    and of b, with y^b and y^a and the weights.
    """
    loss = partial(cross_bilateral_loss, window=Window.of(settings), threads=torch.get_num_threads())
    one_way = [
        loss(half, heads, corners, *own) for half, heads, own in zip(guides, raw.chunk(2), witnesses, strict=True)
    ]
    return one_way[0] + one_way[1]
