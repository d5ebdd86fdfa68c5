"""The optimiser's loop on one frame."""

import copy
import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from selfcorrect.kernel.backend import choose
from selfcorrect.kernel.guides import Guides
from selfcorrect.settings import Settings
from selfcorrect.stages.core.loss import dual_buffer_loss, learning_rate, witnesses
from selfcorrect.stages.core.network import Network
from selfcorrect.stages.core.patches import batches, most_steps, steps_count
from selfcorrect.stages.core.replay import CudaGraph, Replayed

__all__ = ["Adam", "Limits", "Progress", "starting_losses", "train"]

Progress = Callable[[int, int, float], None]

_WARM_UP = 20  # steps over which the cosine schedule reaches its rate, but no more than a fifth of all
_SHORTEST_ROUND = 0.5  # of the time that the steps took before: less is not worth beginning again for
_LEAST_GAIN = 0.001  # of Eq. 8, most of which is noise that no network can take away
_FETCHED_EVERY = 16  # steps; also how far a time budget or Ctrl-C may be overrun while the device catches up
_SAMPLE = 4  # rows and columns of patches that tell how well a network starts


class Adam:
    """Adam (Kingma and Ba 2015) with a bound on the gradient's norm, on all parameters as one vector.

    ``torch.optim`` has the same; importing what it needs takes a second, as long as some frames.

    Args:
        parameters: to be optimised.
        epsilon: added to the root of the second moment.
        limit: largest norm of the gradient.
    """

    def __init__(self, parameters: Iterable[Tensor], epsilon: float, limit: float):
        self._parameters = list(parameters)
        self._epsilon, self._limit = epsilon, limit
        self._first = torch.zeros(sum(p.numel() for p in self._parameters), device=self._parameters[0].device)
        self._second = torch.zeros_like(self._first)
        # 0.9 and 0.999 to the power of the steps so far, which the host cannot count: it does not know which were taken
        self._decay = torch.ones(2, dtype=torch.float64, device=self._first.device)
        self._each = torch.tensor([0.9, 0.999], dtype=torch.float64).to(self._first.device)

    @torch.no_grad()
    def step(self, rate: float | Tensor, loss: Tensor) -> None:
        """One step down the gradients, which are taken away; none where they or the loss are not finite.

        Nothing here makes the host wait for the device, and a CUDA graph can hold it where ``rate`` is a tensor.
        """
        gradient = torch.cat(
            [torch.zeros_like(p).flatten() if p.grad is None else p.grad.flatten() for p in self._parameters]
        )
        for parameter in self._parameters:
            parameter.grad = None
        norm = gradient.norm().double()
        taken = norm.isfinite() & loss.isfinite()
        gradient *= (self._limit / (norm + 1e-6)).clamp(max=1.0)
        decay = self._decay * self._each
        first = self._first.lerp(gradient, 0.1)
        second = (self._second * 0.999).addcmul_(gradient, gradient, value=0.001)
        root = (second / (1 - decay[1])).sqrt_().add_(self._epsilon)
        change = (first / root).mul_(rate / (1 - decay[0])).where(taken, 0.0)
        for kept, new in ((self._first, first), (self._second, second), (self._decay, decay)):
            kept.copy_(new.where(taken, kept))
        sizes = [p.numel() for p in self._parameters]
        for parameter, part in zip(self._parameters, change.split(sizes), strict=True):
            parameter.sub_(part.view_as(parameter))


@dataclass(frozen=True)
class Limits:
    """When training ends before its steps are done, and whether it goes on after them.

    Attributes:
        seconds: for training; 0 or less leaves the network as it is. Where there is time left after the settings'
            steps, they are taken again, as long as Eq. 8 says that something is gained.
        stop: asked before each step; training ends when it says True.
    """

    seconds: float = math.inf
    stop: Callable[[], bool] = lambda: False


def train(
    network: Network,
    guides: tuple[Guides, Guides],
    settings: Settings,
    generator: torch.Generator,
    progress: Progress | None = None,
    limits: Limits | None = None,
) -> list[float]:
    """Optimise ``network`` in place on the halves' guides.

    Returns:
        Eq. 8 before each step. A step whose loss or gradient is not finite is not taken.
    """
    limits = limits or Limits()
    end = time.perf_counter() + limits.seconds
    losses = _round(network, guides, settings, generator, progress, limits.stop, end)
    most = most_steps((guides[0].height, guides[0].width), settings)
    while math.isfinite(end) and settings.steps and len(losses) < most and not limits.stop():
        left = end - time.perf_counter()
        if left < _SHORTEST_ROUND * (limits.seconds - left):
            break
        before, known = copy.deepcopy(network.state_dict()), starting_losses(network, guides, settings)
        losses += _round(network, guides, settings, generator, progress, limits.stop, end)
        gain = known - starting_losses(network, guides, settings)
        if float(gain.mean()) < 0:
            network.load_state_dict(before)
        if float(gain.mean()) <= _LEAST_GAIN * float(known.mean()):
            break
    return losses


class _Losses:
    """Eq. 8 before each step, left on the device and fetched every so many steps: to fetch is to wait for it.

    Args:
        progress: told of each step in turn, when its loss is fetched.
        device: that of the losses; on the CPU they are there at once.
    """

    def __init__(self, progress: Progress | None, device: torch.device):
        self._progress = progress
        self._every = 1 if device.type == "cpu" else _FETCHED_EVERY
        self._values: list[float] = []
        self._waiting: list[Tensor] = []

    @property
    def count(self) -> int:
        """Of the steps so far."""
        return len(self._values) + len(self._waiting)

    def add(self, loss: Tensor, steps: int) -> None:
        """The loss of the next out of so many steps."""
        self._waiting.append(loss)
        if len(self._waiting) == self._every:
            self.fetched(steps)

    def fetched(self, steps: int) -> list[float]:
        """All of them, on the host."""
        if self._waiting:
            for value in torch.stack(self._waiting).tolist():
                self._values.append(value)
                if self._progress is not None:
                    self._progress(len(self._values), steps, value)
            self._waiting.clear()
        return self._values


def _round(
    network: Network,
    guides: tuple[Guides, Guides],
    settings: Settings,
    generator: torch.Generator,
    progress: Progress | None,
    stop: Callable[[], bool],
    end: float,
) -> list[float]:
    """The settings' steps, or as many as there is time for; the schedule's end is reached in either case."""
    judges = witnesses(guides, settings)
    size = (settings.patch, settings.patch)
    optimiser = Adam(network.parameters(), settings.adam_epsilon, settings.gradient_limit or math.inf)
    rate = learning_rate(guides, settings)
    steps = steps_count((guides[0].height, guides[0].width), settings)
    losses = _Losses(progress, guides[0].planes.device)

    def step(patches: Sequence[Tensor], corners: Tensor, rate: float | Tensor) -> Tensor:
        loss = dual_buffer_loss(network(patches), corners, guides, judges, settings)
        loss.backward()
        optimiser.step(rate, loss.detach())
        return loss.detach()

    recording = settings.cuda_graph and choose(None, [guides[0].planes], gpu=True) == "gpu"
    replayed = Replayed(step, guides, settings, CudaGraph(guides[0].planes.device)) if recording else None
    began = time.perf_counter()
    for corners in batches(guides[0], settings, generator):
        done = max(losses.count / steps, (time.perf_counter() - began) / max(end - began, 1e-9)) if steps else 1.0
        if done >= 1 or stop():
            break
        now = rate * _schedule(losses.count, steps, done, settings)
        if replayed:
            loss = replayed(corners, now)
        else:
            loss = step([patch for half in guides for patch in half.views(corners, size)], corners, now)
        losses.add(loss, steps)
    return losses.fetched(steps)


@torch.no_grad()
def starting_losses(network: Network, guides: tuple[Guides, Guides], settings: Settings) -> Tensor:
    """Eq. 8 of a network as it is, on patches spread evenly over the frame, the same ones at every call: (N,) float64.

    One network's loss says little, since most of it is noise; the difference of two is that of their errors.
    """
    whole = guides[0].height, guides[0].width
    size = (min(settings.patch, whole[0]), min(settings.patch, whole[1]))
    starts = [torch.linspace(0, whole[i] - size[i], _SAMPLE).long().unique() for i in (0, 1)]
    corners = torch.cartesian_prod(*starts)
    if guides[0].stacked > 1:
        first = guides[0].pitch * torch.linspace(0, guides[0].stacked - 1, _SAMPLE**2).long().unique()
        corners = torch.stack([first, torch.zeros_like(first)], 1)
    judges = witnesses(guides, settings)
    losses = []
    for corner in corners.split(1):  # one at a time: less memory than a training step
        raw = network([patch for half in guides for patch in half.views(corner, size)])
        losses.append(dual_buffer_loss(raw, corner, guides, judges, settings).double())
    return torch.stack(losses)


def _schedule(step: int, steps: int, done: float, settings: Settings) -> float:
    """Factor of the rate: constant, or half a cosine over the part ``done`` of the way, after a linear warm-up."""
    if settings.schedule == "constant":
        return 1.0
    return min(1.0, (step + 1) / min(_WARM_UP, max(steps // 5, 1))) * (1 + math.cos(math.pi * done)) / 2
