"""The stages on one frame, in order, and the guard. No files, no printing, no reference."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from selfcorrect.errors import FrameError
from selfcorrect.frame import Frame, mean
from selfcorrect.guard import Estimate, Evidence, Guarded, guard, keep_light
from selfcorrect.image.bands import average, tile_means
from selfcorrect.image.exposure import Scaled, scaled
from selfcorrect.independence import dependence
from selfcorrect.settings import Settings
from selfcorrect.stages import steps, weights
from selfcorrect.stages.core.network import Network
from selfcorrect.stages.core.stage import Start, inferred, trained
from selfcorrect.stages.core.train import Progress
from selfcorrect.stages.steps import StageImages, SubImage

__all__ = ["Result", "Start", "correct"]

_STEPS = {
    "regression": steps.regress,
    "james-stein": steps.james_stein,
    "neural-james-stein": steps.neural_james_stein,
    "deep-combiner": steps.deep_combiner,
    "deep-combiner-4": steps.deep_combiner_4,
}

_AOVS = ("blend", "error.before", "error.after")


@dataclass(frozen=True, eq=False)
class Result:
    """What :func:`correct` gives back.

    Attributes:
        image: corrected linear radiance, (H, W, 3) ≥ 0, the same kind of array as the frame's colour was.
        network: the trained network, for the next call's ``warm_start``; None without the core, and where the guard
            finds that the halves share their noise: then nothing is trained and the denoised image is kept.
        losses: Eq. 8 before each optimiser step.
        seconds: how long each stage took.
        estimate: what the guard says was gained; None where the settings turn it off.
        aovs: the guard's maps, each (H, W): ``blend`` (weight of the corrected image), and ``error.before`` and
            ``error.after`` (estimated relative squared error); empty where the guard is off.
        input_scale: what radiance was multiplied by.
        start: whether training went on from ``warm_start``, and why.
    """

    image: Any
    network: Network | None
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
        FrameError: the frame has no denoised halves, or no sub-images for the stage that takes those, or
            ``warm_start`` was trained with other buffers or settings.
        FileError: the weights of a trained stage are not there or do not fit.
    """
    settings = settings or Settings.preset(Settings.default())
    if frame.denoised is None:
        raise FrameError("expected a frame with denoised halves, but got none; call frame.denoise(denoiser) first")
    if warm_start is not None and "core" not in settings.stage_names:
        raise FrameError(f"expected the stage core with a warm start, but got the stages {settings.stages}")
    weights.check(settings)
    given = mean(frame.denoised) if frame.denoised_full is None else frame.denoised_full
    sub_images = _sub_images(frame) if "deep-combiner-4" in settings.stage_names else ()
    first = StageImages(frame.halves, given, settings.input_scale or _automatic_scale(frame), sub_images)
    if settings.guard and dependence(*frame.color).tells_nothing:
        return _kept(frame, first)
    state, core, seconds = first, None, dict[str, float]()

    def timed(name: str, begun: float) -> None:
        seconds[name] = time.perf_counter() - begun

    evidence = Evidence(first.scaled_color, first.scaled_images) if settings.guard else None
    for position, name in enumerate(settings.stage_names, 1):
        begun = time.perf_counter()
        if name == "core":
            core = trained(state, settings, warm_start=warm_start, progress=progress, stop=stop)
            timed("train", begun)
            begun = time.perf_counter()
            last = position == len(settings.stage_names)
            state = _after_core(state, core.network, settings, evidence if last else None)
            timed("infer", begun)
        else:
            state = _STEPS[name](state, settings)
            timed(name, begun)
    image, guarded = state.full.clamp(min=0), None
    if evidence is not None:
        begun = time.perf_counter()
        if not evidence.complete:
            evidence.add(slice(0, frame.size[0]), (state.scaled_images[0][:], state.scaled_images[1][:]))
        image, guarded = _guarded(first, image, evidence)
        timed("guard", begun)
    return Result(
        image=frame.like_input(image),
        network=core.network if core else None,
        losses=core.losses if core else [],
        seconds=seconds,
        estimate=guarded.estimate if guarded else None,
        aovs=dict(zip(_AOVS, guarded.maps(), strict=True)) if guarded else {},
        input_scale=first.scale,
        start=core.start if core else Start(warm=False),
    )


def _kept(frame: Frame, first: StageImages) -> Result:
    """The denoised image: halves that share their noise can neither train nor judge a correction."""
    nothing = torch.zeros(frame.size)
    return Result(
        image=frame.like_input(first.full.clamp(min=0)),
        network=None,
        losses=[],
        seconds={},
        estimate=Estimate(0.0, 0.0, 0.0, 0.0, 0.0, improved=False, independent=False),
        aovs={name: nothing.clone() for name in _AOVS},
        input_scale=first.scale,
        start=Start(warm=False),
    )


def _sub_images(frame: Frame) -> tuple[SubImage, ...]:
    if frame.sub_images is None or frame.denoised_sub_images is None:
        got = "none" if frame.sub_images is None else "such as are not denoised; call frame.denoise(denoiser)"
        raise FrameError(f"expected a frame with four denoised sub-images for the stage deep-combiner-4, but got {got}")
    return tuple(SubImage(*each) for each in zip(frame.sub_images, frame.denoised_sub_images, strict=True))


def _automatic_scale(frame: Frame) -> float:
    """What brings the denoised frame's mean near 1; by the mean of roots, which a few bright pixels do not move."""
    denoised = frame.denoised
    assert denoised is not None  # correct() has checked; tells the type checker

    def roots(rows: slice) -> Tensor:
        return torch.stack([half[rows].double().mean(-1).clamp(min=0).sqrt() for half in denoised])

    root = sum(average(tile_means(frame.size[0], roots), frame.size)) / 2
    return 1 / root**2 if root > 0 else 1.0


def _after_core(state: StageImages, network: Network, settings: Settings, evidence: Evidence | None) -> StageImages:
    """The state after the core; where nothing but the guard comes after it, the halves go to its evidence alone."""
    if evidence is not None:
        return state._replace(full=inferred(state, network, settings, evidence.add))
    images = torch.empty_like(state.full), torch.empty_like(state.full)

    def keep(rows: slice, halves: tuple[Tensor, Tensor]) -> None:
        for image, half in zip(images, halves, strict=True):
            image[rows] = half / state.scale

    full = inferred(state, network, settings, keep)
    return state.then(images, full)


def _guarded(first: StageImages, image: Tensor, evidence: Evidence) -> tuple[Tensor, Guarded]:
    """What the stages made of the frame, guarded against what the denoiser had; ``image`` is used up."""
    full = Scaled(first.full, first.scale)
    guarded = guard(evidence, full, scaled(image, first.scale), scale=first.scale)
    if not guarded.estimate.improved:
        return image.copy_(first.full), guarded  # not the frame's own tensor: the caller may change the result
    kept = keep_light(guarded.image, full, first.scaled_color)
    return scaled(kept, 1 / first.scale).clamp_(min=0), guarded
