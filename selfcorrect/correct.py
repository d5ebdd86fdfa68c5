"""The stages on one frame, in order, and the guard. No files, no printing, no reference."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from selfcorrect.core import Start, inferred, trained
from selfcorrect.errors import FrameError
from selfcorrect.frame import Frame, mean
from selfcorrect.guard import Estimate, Guarded, guard, keep_light
from selfcorrect.network import Network
from selfcorrect.settings import Settings
from selfcorrect.stages import steps
from selfcorrect.stages.steps import State
from selfcorrect.train import Progress

__all__ = ["Result", "Start", "correct"]

_STEPS = {"regression": steps.regress, "james-stein": steps.james_stein}


@dataclass(frozen=True, eq=False)
class Result:
    """What :func:`correct` gives back.

    Attributes:
        image: corrected linear radiance, (H, W, 3) ≥ 0, the same kind of array as the frame's colour was.
        network: the trained network, for the next call's ``warm_start``; None without the core.
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
        FrameError: the frame has no denoised halves, or ``warm_start`` was trained with other buffers or settings.
    """
    settings = settings or Settings.preset(Settings.default())
    if frame.denoised is None:
        raise FrameError("expected a frame with denoised halves, but got none; call frame.denoise(denoiser) first")
    if warm_start is not None and "core" not in settings.stage_names:
        raise FrameError(f"expected the stage core with a warm start, but got the stages {settings.stages}")
    given = mean(frame.denoised) if frame.denoised_full is None else frame.denoised_full
    first = State(frame.halves, given, settings.input_scale or _automatic_scale(frame))
    state, core, seconds = first, None, dict[str, float]()

    def timed(name: str, begun: float) -> None:
        seconds[name] = time.perf_counter() - begun

    for name in settings.stage_names:
        begun = time.perf_counter()
        if name == "core":
            core = trained(state, settings, warm_start=warm_start, progress=progress, stop=stop)
            timed("train", begun)
            begun = time.perf_counter()
            state = inferred(state, core.network, settings)
            timed("infer", begun)
        else:
            state = _STEPS[name](state, settings)
            timed(name, begun)
    image, guarded = state.full.clamp(min=0), None
    if settings.guard:
        begun = time.perf_counter()
        image, guarded = _guarded(first, state)
        timed("guard", begun)
    return Result(
        image=frame.like_input(image),
        network=core.network if core else None,
        losses=core.losses if core else [],
        seconds=seconds,
        estimate=guarded.estimate if guarded else None,
        aovs=_aovs(guarded) if guarded else {},
        input_scale=first.scale,
        start=core.start if core else Start(warm=False),
    )


def _aovs(guarded: Guarded) -> dict[str, Tensor]:
    return {"blend": guarded.alpha, "error.before": guarded.errors[0], "error.after": guarded.errors[1]}


def _automatic_scale(frame: Frame) -> float:
    """What brings the denoised frame's mean near 1; by the mean of roots, which a few bright pixels do not move."""
    assert frame.denoised is not None
    roots = torch.stack(frame.denoised).double().mean(-1).clamp(min=0).sqrt().mean()
    return float(1 / roots**2) if roots > 0 else 1.0


def _guarded(first: State, last: State) -> tuple[Tensor, Guarded]:
    """What the stages made of the frame, guarded against what the denoiser had."""
    before, after = first.scaled(), last.scaled()
    guarded = guard(before.color, before.images, after.images, before.full, after.full, scale=first.scale)
    if not guarded.estimate.improved:
        return first.full, guarded
    kept = keep_light(guarded.image, before.full, before.color)
    return (kept.double() / first.scale).clamp(0, torch.finfo(torch.float32).max).float(), guarded
