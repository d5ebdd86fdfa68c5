"""The optimiser's loop on one frame."""

import math
from collections.abc import Callable

import torch

from selfcorrect.kernel import Guides
from selfcorrect.loss import dual_buffer_loss, learning_rate, relative_weight
from selfcorrect.network import Network
from selfcorrect.patches import batches, steps_count
from selfcorrect.settings import Settings

__all__ = ["Progress", "train"]

Progress = Callable[[int, int, float], None]

_WARM_UP = 20  # steps over which the cosine schedule reaches its rate


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
    a, b = (relative_weight(half.denoised, settings.loss_epsilon) for half in guides)
    if settings.crossed_weights:  # a weight that knows the witness rewards darkening
        a, b = b, a
    size = (settings.patch, settings.patch)
    optimiser = torch.optim.Adam(network.parameters(), eps=settings.adam_epsilon, fused=True)
    rate = learning_rate(guides, settings)
    steps = steps_count((guides[0].height, guides[0].width), settings)
    losses: list[float] = []
    for corners in batches((guides[0].height, guides[0].width), settings, generator):
        batch = [patch for half in guides for patch in half.views(corners, size)]
        loss = dual_buffer_loss(network(batch), corners, guides, (a, b), settings)
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


def _schedule(step: int, steps: int, settings: Settings) -> float:
    """Factor of the rate: constant, or half a cosine after a linear warm-up."""
    if settings.schedule == "constant":
        return 1.0
    return min(1.0, (step + 1) / _WARM_UP) * (1 + math.cos(math.pi * step / steps)) / 2
