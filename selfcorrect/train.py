"""The optimiser's loop on one frame."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from selfcorrect.kernel import Guides
from selfcorrect.loss import dual_buffer_loss, learning_rate, relative_weight
from selfcorrect.network import Network
from selfcorrect.patches import batches, steps_count
from selfcorrect.settings import Settings

__all__ = ["Progress", "starting_losses", "train"]

Progress = Callable[[int, int, float], None]

_WARM_UP = 20  # steps over which the cosine schedule reaches its rate
_SAMPLE = 4  # rows and columns of patches that tell how well a network starts


def train(
    network: Network,
    guides: tuple[Guides, Guides],
    settings: Settings,
    generator: torch.Generator,
    progress: Progress | None = None,
) -> list[float]:
    """Optimise ``network`` in place on the halves' guides.

    Returns:
        Eq. 8 before each step. A step whose loss or gradient is not finite is not taken.
    """
    weights = _weights(guides, settings)
    size = (settings.patch, settings.patch)
    optimiser = torch.optim.Adam(network.parameters(), eps=settings.adam_epsilon, fused=True)
    rate = learning_rate(guides, settings)
    steps = steps_count((guides[0].height, guides[0].width), settings)
    losses: list[float] = []
    for corners in batches((guides[0].height, guides[0].width), settings, generator):
        batch = [patch for half in guides for patch in half.views(corners, size)]
        loss = dual_buffer_loss(network(batch), corners, guides, weights, settings)
        optimiser.zero_grad()
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(network.parameters(), settings.gradient_limit or math.inf)
        for group in optimiser.param_groups:
            group["lr"] = rate * _schedule(len(losses), steps, settings)
        if bool(norm.isfinite()) and bool(loss.isfinite()):
            optimiser.step()
        losses.append(float(loss.detach()))
        if progress is not None:
            progress(len(losses), steps, losses[-1])
    return losses


@torch.no_grad()
def starting_losses(network: Network, guides: tuple[Guides, Guides], settings: Settings) -> Tensor:
    """Eq. 8 of a network as it is, on patches spread evenly over the frame, the same ones at every call: (N,) float64.

    One network's loss says little, since most of it is noise; the difference of two is that of their errors.
    """
    whole = guides[0].height, guides[0].width
    size = (min(settings.patch, whole[0]), min(settings.patch, whole[1]))
    starts = [torch.linspace(0, whole[i] - size[i], _SAMPLE).long().unique() for i in (0, 1)]
    weights = _weights(guides, settings)
    losses = []
    for corner in torch.cartesian_prod(*starts).split(1):  # one at a time: less memory than a training step
        raw = network(torch.cat([half.patches(corner, size) for half in guides]))
        losses.append(dual_buffer_loss(raw, corner, guides, weights, settings).double())
    return torch.stack(losses)


def _weights(guides: tuple[Guides, Guides], settings: Settings) -> tuple[Tensor, Tensor]:
    a, b = (relative_weight(half.denoised, settings.loss_epsilon) for half in guides)
    # a weight that knows the witness rewards darkening
    return (b, a) if settings.crossed_weights else (a, b)


def _schedule(step: int, steps: int, settings: Settings) -> float:
    """Factor of the rate: constant, or half a cosine after a linear warm-up."""
    if settings.schedule == "constant":
        return 1.0
    return min(1.0, (step + 1) / _WARM_UP) * (1 + math.cos(math.pi * step / steps)) / 2
