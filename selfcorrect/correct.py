"""Optimise on one frame, infer, average. No files, no printing, no reference image."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from selfcorrect.errors import FrameError
from selfcorrect.frame import Frame
from selfcorrect.kernel import Guides, cross_bilateral
from selfcorrect.loss import dual_buffer_loss, learning_rate, relative_weight
from selfcorrect.network import Network
from selfcorrect.patches import grid
from selfcorrect.settings import Settings

__all__ = ["Result", "correct"]

Progress = Callable[[int, int, float], None]


@dataclass(frozen=True, eq=False)
class Result:
    """What :func:`correct` gives back.

    Attributes:
        image: corrected linear radiance, (H, W, 3) ≥ 0, the same kind of array as the frame's colour was.
        network: the trained network, for the next call's ``warm_start``.
        learning_rate: the rate that the halves' variance gave.
        losses: Eq. 8 before each optimiser step.
        seconds: how long each stage took.
    """

    image: Any
    network: Network
    learning_rate: float
    losses: list[float]
    seconds: dict[str, float]


def correct(
    frame: Frame,
    settings: Settings | None = None,
    *,
    warm_start: Network | None = None,
    progress: Progress | None = None,
) -> Result:
    """Correct a denoised frame (Back et al. 2022).

    Args:
        frame: halves with their denoised images, linear radiance.
        settings: by default the default preset.
        warm_start: the network of another frame with the same buffers to start from; it is left as it is.
        progress: called as ``progress(step, steps, loss)`` after every optimiser step.

    Returns:
        The corrected image and the network. The same seed gives the same bits on the same machine and number of
        threads (``torch.set_num_threads``).

    Raises:
        FrameError: the frame has no denoised halves, or ``warm_start`` was trained with other buffers or settings.
    """
    settings = settings or next(iter(Settings.presets().values()))
    if frame.denoised is None:
        raise FrameError("expected a frame with denoised halves, but got none; call frame.denoise(denoiser) first")
    start = time.perf_counter()
    generator = torch.Generator().manual_seed(settings.seed)
    corners = grid(*frame.size, patch=settings.patch, stride=settings.stride)
    guides = _guides(frame, corners, settings)
    network = Network.for_guides(guides[0], settings, generator)
    if warm_start is not None:
        if warm_start.shape != network.shape:
            raise FrameError(
                f"expected a warm start with weights {network.shape[0]} … {network.shape[-2]}, "
                f"but got {warm_start.shape[0]} … {warm_start.shape[-2]}: other buffers or settings"
            )
        network.load_state_dict(warm_start.state_dict())
    rate = learning_rate(*frame.color, settings.learning_rate)
    losses = _train(network, guides, corners, rate, settings, generator, progress)
    trained = time.perf_counter()
    g_a, g_b = (_infer(network, half, settings) for half in guides)
    image = ((g_a + g_b) / 2).clamp(min=0)
    seconds = {"train": trained - start, "infer": time.perf_counter() - trained}
    return Result(frame.like_input(image), network, rate, losses, seconds)


def _guides(frame: Frame, corners: Tensor, settings: Settings) -> tuple[Guides, Guides]:
    """Both halves, padded far enough for every patch and its window."""
    beyond = (corners + settings.patch - torch.tensor(frame.size)).max()
    margin = max(0, int(beyond), int(-corners.min())) + settings.window // 2

    def one(index: int) -> Guides:
        half = frame.halves[index]
        assert half.denoised is not None  # correct() has checked; tells the type checker
        return Guides.of_half(
            half.color,
            half.denoised,
            margin=margin,
            albedo=half.albedo,
            normal=half.normal,
            visibility=half.visibility,
        )

    return one(0), one(1)


def _train(
    network: Network,
    guides: tuple[Guides, Guides],
    corners: Tensor,
    rate: float,
    settings: Settings,
    generator: torch.Generator,
    progress: Progress | None,
) -> list[float]:
    size = (settings.patch, settings.patch)
    a, b = (relative_weight(half.denoised, settings.loss_epsilon) for half in guides)
    optimiser = torch.optim.Adam(network.parameters(), lr=rate, eps=settings.adam_epsilon)
    steps = settings.epochs * -(-len(corners) // settings.batch)
    losses: list[float] = []
    for _ in range(settings.epochs):
        for chosen in torch.randperm(len(corners), generator=generator).split(settings.batch):
            batch = torch.cat([half.patches(corners[chosen], size) for half in guides])
            loss = dual_buffer_loss(network(batch), corners[chosen], guides, (a, b), settings)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            losses.append(float(loss.detach()))
            if progress is not None:
                progress(len(losses), steps, losses[-1])
    return losses


@torch.no_grad()
def _infer(network: Network, half: Guides, settings: Settings) -> Tensor:
    """The corrected half, (H, W, 3), on the whole image at once."""
    origin = torch.zeros(1, 2, dtype=torch.int64)
    raw = network(half.patches(origin, (half.height, half.width)))
    g = cross_bilateral(
        half,
        raw,
        origin,
        window=settings.window,
        combination=settings.combination,
        threads=torch.get_num_threads(),
    )
    return g[0].permute(1, 2, 0)
