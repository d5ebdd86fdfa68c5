"""The stages on one frame: optimise, infer, what stands around that, guard. No files, no printing, no reference."""

import time
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from selfcorrect.errors import FrameError
from selfcorrect.frame import Frame, Half, mean
from selfcorrect.guard import Estimate, Guarded, guard, keep_light
from selfcorrect.kernel import LARGEST, Guides, cross_bilateral
from selfcorrect.network import Network
from selfcorrect.patches import overhang
from selfcorrect.settings import Settings
from selfcorrect.stages import steps
from selfcorrect.stages.steps import State
from selfcorrect.train import Progress, train

__all__ = ["Result", "correct"]


@dataclass(frozen=True, eq=False)
class Result:
    """What :func:`correct` gives back.

    Attributes:
        image: corrected linear radiance, (H, W, 3) ≥ 0, the same kind of array as the frame's colour was.
        network: the trained network, for the next call's ``warm_start``; None where the core did not run.
        losses: Eq. 8 before each optimiser step.
        seconds: how long each stage took.
        estimate: what the guard says was gained; None where the settings turn it off.
        aovs: the guard's maps, each (H, W): ``blend`` (weight of the corrected image), and ``error.before`` and
            ``error.after`` (estimated relative squared error); empty where the guard is off.
        input_scale: what radiance was multiplied by.
    """

    image: Any
    network: Network | None
    losses: list[float]
    seconds: dict[str, float]
    estimate: Estimate | None
    aovs: dict[str, Tensor]
    input_scale: float


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
    settings = settings or Settings.preset(Settings.default())
    if frame.denoised is None:
        raise FrameError("expected a frame with denoised halves, but got none; call frame.denoise(denoiser) first")
    if warm_start is not None and "core" not in settings.stage_names:
        raise FrameError(f"expected the stage core with a warm start, but got the stages {settings.stages}")
    scale = settings.input_scale or _automatic_scale(frame)
    halves = _scaled(frame, scale)
    start = State(halves, _full(frame, halves, scale))
    state, network, losses, seconds = start, None, list[float](), dict[str, float]()
    for name in settings.stage_names:
        begun = time.perf_counter()
        if name == "core":
            network, losses = _trained(state, settings, warm_start, progress)
            seconds["train"] = time.perf_counter() - begun
            trained = time.perf_counter()
            state = _inferred(state, network, settings)
            seconds["infer"] = time.perf_counter() - trained
        else:
            state = _STEPS[name](state, settings)
            seconds[name] = time.perf_counter() - begun
    begun = time.perf_counter()
    image, guarded = _finish(frame, start, state, settings, scale)
    if guarded:
        seconds["guard"] = time.perf_counter() - begun
    estimate, aovs = (guarded.estimate, _aovs(guarded)) if guarded else (None, {})
    return Result(frame.like_input(image), network, losses, seconds, estimate, aovs, scale)


_STEPS = {"regression": steps.regress, "james-stein": steps.james_stein}


def _trained(
    state: State, settings: Settings, warm_start: Network | None, progress: Progress | None
) -> tuple[Network, list[float]]:
    """The network optimised on this frame, and its losses."""
    height, width, _ = state.full.shape
    margin = overhang((height, width), settings) + settings.window // 2
    guides = (_guides(state.halves[0], margin), _guides(state.halves[1], margin))
    generator = torch.Generator().manual_seed(settings.seed)
    network = Network.for_guides(guides[0], settings, generator)
    if warm_start is not None:
        if warm_start.shape != network.shape:
            raise FrameError(
                f"expected a warm start with weights {network.shape[0]} … {network.shape[-2]}, "
                f"but got {warm_start.shape[0]} … {warm_start.shape[-2]}: other buffers or settings"
            )
        network.load_state_dict(warm_start.state_dict())
    return network, train(network, guides, settings, generator, progress)


def _automatic_scale(frame: Frame) -> float:
    """What brings the denoised frame's mean near 1; by the mean of roots, which a few bright pixels do not move."""
    assert frame.denoised is not None
    roots = torch.stack(frame.denoised).double().mean(-1).clamp(min=0).sqrt().mean()
    return float(1 / roots**2) if roots > 0 else 1.0


def _scaled(frame: Frame, scale: float) -> tuple[Half, Half]:
    """Both halves with their radiance scaled, and bounded so that its squares stay finite."""

    def one(half: Half) -> Half:
        assert half.denoised is not None  # correct() has checked; tells the type checker
        return half._replace(color=_bounded(half.color, scale), denoised=_bounded(half.denoised, scale))

    return one(frame.halves[0]), one(frame.halves[1])


def _full(frame: Frame, halves: tuple[Half, Half], scale: float) -> Tensor:
    """The denoised mean of the halves where there is one, else the mean of the denoised halves."""
    if frame.denoised_full is not None:
        return _bounded(frame.denoised_full, scale)
    a, b = halves[0].denoised, halves[1].denoised
    assert a is not None
    assert b is not None
    return mean((a, b))


def _bounded(radiance: Tensor, scale: float) -> Tensor:
    return (radiance.double() * scale).clamp(max=LARGEST).float()


def _guides(half: Half, margin: int, denoised: Tensor | None = None) -> Guides:
    """Buffers of a half, padded; with another denoised image where one is given."""
    shown = half.denoised if denoised is None else denoised
    assert shown is not None
    return Guides.of_half(
        half.color,
        shown,
        margin=margin,
        albedo=half.albedo,
        normal=half.normal,
        visibility=half.visibility,
    )


def _aovs(guarded: Guarded) -> dict[str, Tensor]:
    return {"blend": guarded.alpha, "error.before": guarded.errors[0], "error.after": guarded.errors[1]}


def _inferred(state: State, network: Network, settings: Settings) -> State:
    """What the trained network makes of each half with its own image, and of both with the full one or their own."""

    def infer(shown: Tensor | None) -> tuple[Tensor, Tensor]:
        return _infer(network, state.halves[0], shown, settings), _infer(network, state.halves[1], shown, settings)

    later = settings.guard or settings.stage_names[-1] != "core"
    with_halves = infer(None) if later or settings.inference == "halves" else None
    with_full = infer(state.full) if settings.inference == "full" else with_halves
    assert with_full is not None
    return state.then(with_halves or with_full, mean(with_full).clamp(min=0))


def _finish(
    frame: Frame, start: State, state: State, settings: Settings, scale: float
) -> tuple[Tensor, Guarded | None]:
    """What the stages made of the frame, guarded against what the denoiser had, in the frame's own units."""
    if not settings.guard:
        return _unscaled(state.full, scale), None
    guarded = guard(start.color, start.images, state.images, start.full, state.full, scale=scale)
    if not guarded.estimate.improved:
        assert frame.denoised is not None
        return (mean(frame.denoised) if frame.denoised_full is None else frame.denoised_full), guarded
    return _unscaled(keep_light(guarded.image, start.full, start.color), scale), guarded


def _unscaled(image: Tensor, scale: float) -> Tensor:
    return (image.double() / scale).clamp(0, torch.finfo(torch.float32).max).float()


@torch.no_grad()
def _infer(network: Network, half: Half, shown: Tensor | None, settings: Settings) -> Tensor:
    """The corrected half, (H, W, 3), on the whole image at once."""
    guides = _guides(half, settings.window // 2, shown)
    origin = torch.zeros(1, 2, dtype=torch.int64)
    raw = network(guides.patches(origin, (guides.height, guides.width)))
    g = cross_bilateral(
        guides,
        raw,
        origin,
        window=settings.window,
        combination=settings.combination,
        threads=torch.get_num_threads(),
    )
    return g[0].permute(1, 2, 0)
