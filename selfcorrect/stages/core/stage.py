"""The stage that the project is named for: a network optimised on one frame, and what it makes of it."""

import copy
import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from selfcorrect.buffers import DENOISED
from selfcorrect.frame import Half, mean
from selfcorrect.image.bands import bands, enlarged_rows, in_bands
from selfcorrect.image.exposure import Scaled, scale_
from selfcorrect.kernel.guides import Guides
from selfcorrect.settings import Settings
from selfcorrect.stages.core.infer import SIDE, infer, infer_tile
from selfcorrect.stages.core.network import Network
from selfcorrect.stages.core.patches import crops, overhang
from selfcorrect.stages.core.train import Limits, Progress, starting_losses, train
from selfcorrect.stages.core.transfer import gained_by_both
from selfcorrect.stages.images import StageImages
from selfcorrect.stages.stage import Keep, Learned, Outcome, Stage, Start, Work

__all__ = ["Core", "inferred", "trained"]

_TRIAL = 256  # side of the tile whose time is taken for the time budget
_GUARD_SECONDS = 2e-6  # a pixel, with some to spare


def trained(
    state: StageImages,
    settings: Settings,
    *,
    warm_start: Network | None = None,
    progress: Progress | None = None,
    stop: Callable[[], bool] | None = None,
) -> Learned:
    """A network optimised on the state's halves; arguments as in :func:`selfcorrect.correct`."""
    began = time.perf_counter()
    generator = torch.Generator().manual_seed(settings.seed)
    guides = _training_guides(state, settings, generator)
    network = Network.for_guides(guides[0], settings, generator)
    start = Start(warm=False)
    if warm_start is not None:
        network.traits.check(warm_start.traits)
        start = _start(network, warm_start, guides, settings)
    if start.warm and warm_start is not None:
        network.load_state_dict(warm_start.state_dict())
    limits = Limits(stop=stop or Limits.stop)
    if settings.time_budget:
        reserved = _seconds_after_training(network, state, settings)
        limits = replace(limits, seconds=settings.time_budget - reserved - (time.perf_counter() - began))
    losses = train(network, guides, _warm(settings) if start.warm else settings, generator, progress, limits)
    return Learned(network, start, losses)


def inferred(state: StageImages, network: Network, settings: Settings, keep: Keep) -> Tensor:
    """The corrected image: the mean of both corrected halves, with what the denoiser gains from both where asked for.

    ``keep`` is called with rows and what the network makes there of each half, of radiance times the state's scale:
    whole corrected halves are not held here.
    """
    images = Scaled(state.images[0], state.scale), Scaled(state.images[1], state.scale)
    full = Scaled(state.full, state.scale)
    image = torch.empty_like(state.full)
    size = (image.shape[0], image.shape[1])
    gained = gained_by_both(images, full) if settings.inference == "full" else None

    def add(top: int, halves: tuple[Tensor, Tensor], part: slice) -> None:
        own = slice(top + part.start, top + part.stop)
        image[own] = mean((halves[0][part], halves[1][part]))
        if gained is not None:
            share = enlarged_rows(gained, size, own)[0, :, :, None]
            image[own] += share.to(image.dtype) * (full[own] - mean((images[0][own], images[1][own])))

    for rows in bands(size[0], SIDE):
        a, b = (infer(network, half, settings, scale=state.scale, rows=rows) for half in state.halves)
        in_bands(rows.stop - rows.start, partial(add, rows.start, (a, b)))
        keep(rows, (a, b))
    return scale_(image.clamp_(min=0), 1 / state.scale)


def _training_guides(state: StageImages, settings: Settings, generator: torch.Generator) -> tuple[Guides, Guides]:
    """What the network is trained on: both halves whole, or crops of them at the same places."""
    size = (state.full.shape[0], state.full.shape[1])
    margin = settings.window // 2
    regions = crops(size, settings, generator)
    if not regions:
        margin += max(overhang(size, s) for s in (settings, _warm(settings)))

    def one(half: Half, denoised: Tensor) -> Guides:
        buffers = half._asdict() | {DENOISED.name: denoised}
        cut = partial(Guides.of_half, buffers, margin=margin, scale=state.scale)
        return Guides.stack((cut(region=region) for region in regions), len(regions)) if regions else cut()

    return one(state.halves[0], state.images[0]), one(state.halves[1], state.images[1])


def _seconds_after_training(network: Network, state: StageImages, settings: Settings) -> float:
    """How long inference and guard will take, by the time of a small tile."""
    height, width, _ = state.full.shape
    region = (0, 0, min(height, _TRIAL), min(width, _TRIAL))
    tile = partial(infer_tile, network, state.halves[0], settings, region, scale=state.scale)
    tile()  # the first call is slower
    start = time.perf_counter()
    tile()
    inference = (time.perf_counter() - start) / (region[2] * region[3])
    return height * width * (2 * inference + (_GUARD_SECONDS if settings.guard else 0.0))


def _warm(settings: Settings) -> Settings:
    """The settings of a frame that starts warm: never more steps than one that starts cold."""
    steps = settings.warm_steps or settings.steps
    return replace(
        settings,
        steps=min(steps, settings.steps or steps),
        learning_rate=settings.warm_learning_rate or settings.learning_rate,
    )


def _start(cold: Network, warm: Network, guides: tuple[Guides, Guides], settings: Settings) -> Start:
    """Which of both networks fits the frame better before any training.

    The network that is given has to be better by more than chance, its standard error over the sample's patches: a
    frame that starts warm trains for fewer steps, and those would not be enough after a cut.
    """
    here = copy.deepcopy(cold)  # on the device of the guides
    here.load_state_dict(warm.state_dict())
    cold_losses, warm_losses = (starting_losses(network, guides, settings) for network in (cold, here))
    gain = cold_losses - warm_losses
    chance = float(gain.std()) / math.sqrt(len(gain)) if len(gain) > 1 else 0.0
    return Start(float(gain.mean()) > chance, float(cold_losses.mean()), float(warm_losses.mean()))


class Core(Stage):
    """A network trained on the frame's own halves, and what it makes of them."""

    name = "core"
    learns = True

    def run(self, state: StageImages, work: Work) -> Outcome:
        """Train, then infer."""
        began = time.perf_counter()
        learned = trained(state, self.settings, warm_start=work.warm_start, progress=work.progress, stop=work.stop)
        middle = time.perf_counter()
        after = self._after(state, learned.network, work.keep)
        return Outcome(after, learned, {"train": middle - began, "infer": time.perf_counter() - middle})

    def _after(self, state: StageImages, network: Network, keep: Keep | None) -> StageImages:
        if keep is not None:
            return state._replace(full=inferred(state, network, self.settings, keep))
        images = torch.empty_like(state.full), torch.empty_like(state.full)

        def hold(rows: slice, halves: tuple[Tensor, Tensor]) -> None:
            for image, half in zip(images, halves, strict=True):
                image[rows] = half / state.scale

        full = inferred(state, network, self.settings, hold)
        return state.then(images, full)
