"""Optimise on one frame, infer, guard. No files, no printing, no reference image."""

import copy
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from selfcorrect.bands import average, bands, tile_means
from selfcorrect.errors import FrameError
from selfcorrect.frame import Frame, Half, mean
from selfcorrect.guard import Estimate, Evidence, guard, keep_light, trust_in_full
from selfcorrect.infer import TILE, infer, infer_tile
from selfcorrect.kernel import LARGEST, Guides
from selfcorrect.network import Network
from selfcorrect.patches import crops, overhang
from selfcorrect.settings import Settings
from selfcorrect.train import Limits, Progress, starting_losses, train

__all__ = ["Result", "Start", "correct"]

_TRIAL = 256  # side of the tile whose time is taken for the time budget
_GUARD_SECONDS = 2e-6  # a pixel, with some to spare


class Start(NamedTuple):
    """What training began from.

    Attributes:
        warm: from the network that was given, not from a new one.
        cold_loss: Eq. 8 of a new network on a sample of the frame; None where no network was given.
        warm_loss: the same of the network that was given.
    """

    warm: bool
    cold_loss: float | None = None
    warm_loss: float | None = None


@dataclass(frozen=True, eq=False)
class Result:
    """What :func:`correct` gives back.

    Attributes:
        image: corrected linear radiance, (H, W, 3) ≥ 0, the same kind of array as the frame's colour was.
        network: the trained network, for the next call's ``warm_start``.
        losses: Eq. 8 before each optimiser step.
        seconds: how long each stage took.
        estimate: what the guard says was gained; None where the settings turn it off.
        aovs: the guard's maps, each (H, W): ``blend`` (weight of the corrected image), and ``error.before`` and
            ``error.after`` (estimated relative squared error); empty where the guard is off.
        input_scale: what radiance was multiplied by.
        start: whether training went on from ``warm_start``, and why.
    """

    image: Any
    network: Network
    losses: list[float]
    seconds: dict[str, float]
    estimate: Estimate | None
    aovs: dict[str, Tensor]
    input_scale: float
    start: Start


def correct(
    frame: Frame,
    settings: Settings | None = None,
    *,
    warm_start: Network | None = None,
    progress: Progress | None = None,
    stop: Callable[[], bool] | None = None,
) -> Result:
    """Correct a denoised frame (Back et al. 2022).

    Args:
        frame: halves with their denoised images, linear radiance.
        settings: by default the default preset.
        warm_start: the network of the last frame, to go on from with the settings' ``warm_steps``; it is left as it
            is. Where Eq. 8 does not show it to be the better start, as after a cut, a new one is taken.
        progress: called as ``progress(step, steps, loss)`` after every optimiser step.
        stop: asked before every optimiser step; when it says True, training ends and the result so far is inferred.

    Returns:
        The corrected image and the network. The same seed gives the same bits on the same machine and number of
        threads (``torch.set_num_threads``).

    Raises:
        FrameError: the frame has no denoised halves, or ``warm_start`` was trained with other buffers or settings.
    """
    settings = settings or Settings.preset(Settings.default())
    if frame.denoised is None:
        raise FrameError("expected a frame with denoised halves, but got none; call frame.denoise(denoiser) first")
    began = time.perf_counter()
    scale = settings.input_scale or _automatic_scale(frame)
    generator = torch.Generator().manual_seed(settings.seed)
    guides = _training_guides(frame, settings, scale, generator)
    network = Network.for_guides(guides[0], settings, generator)
    start = Start(warm=False)
    if warm_start is not None:
        network.traits.check(warm_start.traits)
        start = _start(network, warm_start, guides, settings)
    if start.warm and warm_start is not None:
        network.load_state_dict(warm_start.state_dict())
    limits = Limits(stop=stop or Limits.stop)
    if settings.time_budget:
        reserved = _seconds_after_training(network, frame, settings, scale)
        limits = replace(limits, seconds=settings.time_budget - reserved - (time.perf_counter() - began))
    losses = train(network, guides, _warm(settings) if start.warm else settings, generator, progress, limits)
    del guides
    trained = time.perf_counter()
    image, estimate, aovs = _finish(frame, network, settings, scale)
    seconds = {"train": trained - began, "infer": time.perf_counter() - trained}
    return Result(frame.like_input(image), network, losses, seconds, estimate, aovs, scale, start)


def _training_guides(
    frame: Frame, settings: Settings, scale: float, generator: torch.Generator
) -> tuple[Guides, Guides]:
    """What the network is trained on: both halves whole, or crops of them at the same places."""
    margin = settings.window // 2
    regions = crops(frame.size, settings, generator)
    if not regions:
        margin += max(overhang(frame.size, s) for s in (settings, _warm(settings)))

    def one(half: Half) -> Guides:
        assert half.denoised is not None  # correct() has checked; tells the type checker
        cut = partial(
            Guides.of_half,
            half.color,
            half.denoised,
            margin=margin,
            albedo=half.albedo,
            normal=half.normal,
            visibility=half.visibility,
            scale=scale,
        )
        return Guides.stack([cut(region=region) for region in regions]) if regions else cut()

    return one(frame.halves[0]), one(frame.halves[1])


def _seconds_after_training(network: Network, frame: Frame, settings: Settings, scale: float) -> float:
    """How long inference and guard will take, by the time of a small tile."""
    half, pixels = frame.halves[0], frame.size[0] * frame.size[1]
    region = (0, 0, min(frame.size[0], _TRIAL), min(frame.size[1], _TRIAL))
    infer_tile(network, half, settings, region, scale=scale)  # the first call is slower
    start = time.perf_counter()
    infer_tile(network, half, settings, region, scale=scale)
    inference = (time.perf_counter() - start) / (region[2] * region[3])
    passes = 4 if settings.inference == "full" else 2
    return pixels * (inference * passes + (_GUARD_SECONDS if settings.guard else 0.0))


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


def _automatic_scale(frame: Frame) -> float:
    """What brings the denoised frame's mean near 1; by the mean of roots, which a few bright pixels do not move."""
    denoised = frame.denoised
    assert denoised is not None  # correct() has checked; tells the type checker

    def roots(rows: slice) -> Tensor:
        return torch.stack([half[rows].double().mean(-1).clamp(min=0).sqrt() for half in denoised])

    root = sum(average(tile_means(frame.size[0], roots), frame.size)) / 2
    return 1 / root**2 if root > 0 else 1.0


class _Scaled:
    """An image times a factor, bounded so that squares stay finite; made where it is read, never whole."""

    def __init__(self, image: Tensor, factor: float):
        self.shape = image.shape
        self._image, self._factor = image, factor

    def __getitem__(self, rows: slice) -> Tensor:
        return (self._image[rows].double() * self._factor).clamp(max=LARGEST).float()


def _finish(
    frame: Frame, network: Network, settings: Settings, scale: float
) -> tuple[Tensor, Estimate | None, dict[str, Tensor]]:
    """The result from the trained network, in the frame's own units, with the guard's estimate and maps."""
    assert frame.denoised is not None  # correct() has checked; tells the type checker
    given = mean(frame.denoised) if frame.denoised_full is None else frame.denoised_full
    (ya, yb), (za, zb) = ([_Scaled(half, scale) for half in pair] for pair in (frame.color, frame.denoised))
    full = _Scaled(given, scale)
    evidence = Evidence((ya, yb), (za, zb)) if settings.guard else None
    image = torch.empty_like(given)
    for rows in bands(frame.size[0], TILE):
        corrected = _corrected(frame, network, settings, scale, rows)
        image[rows] = mean(corrected)
        if settings.inference == "full":
            with_full = mean(_corrected(frame, network, settings, scale, rows, given))
            image[rows] += trust_in_full((za, zb), full, rows).to(image.dtype) * (with_full - image[rows])
        if evidence is not None:
            evidence.add(rows, corrected)
    image.clamp_(min=0)
    if evidence is None:
        return _unscaled(image, scale), None, {}
    guarded = guard(evidence, full, image, scale=scale)
    del evidence
    image = _unscaled(keep_light(image, full, (ya, yb)), scale) if guarded.estimate.improved else image.copy_(given)
    alpha, before, after = guarded.maps()
    return image, guarded.estimate, {"blend": alpha, "error.before": before, "error.after": after}


def _corrected(
    frame: Frame, network: Network, settings: Settings, scale: float, rows: slice, denoised: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Rows of both corrected halves."""
    a, b = (infer(network, half, settings, scale=scale, denoised=denoised, rows=rows) for half in frame.halves)
    return a, b


def _unscaled(image: Tensor, scale: float) -> Tensor:
    """In the frame's own units, in place."""
    for rows in bands(image.shape[0]):
        image[rows] = (image[rows].double() / scale).clamp(0, torch.finfo(torch.float32).max)
    return image
