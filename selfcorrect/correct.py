"""The stages on one frame, in order, and the guard. No files, no printing, no reference."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from selfcorrect import stages
from selfcorrect.errors import DeviceError, FrameError
from selfcorrect.fireflies import Removed, remove_fireflies_
from selfcorrect.frame import Candidate, Frame
from selfcorrect.guard import Estimate, Evidence, Guarded, guard, keep_above_, keep_light_
from selfcorrect.history import NAME, with_history
from selfcorrect.image.bands import bands, enlarged_rows
from selfcorrect.image.exposure import Scaled, scale_, scale_to_one
from selfcorrect.independence import dependence
from selfcorrect.kernel.compiled import warn_if_missing
from selfcorrect.lone_pixels import lone_pixels, set_aside, unjudged
from selfcorrect.settings import Settings
from selfcorrect.stages.core.infer import SIDE
from selfcorrect.stages.core.network import Network
from selfcorrect.stages.core.train import Progress
from selfcorrect.stages.images import StageImages
from selfcorrect.stages.stage import Images, Learned, Stage, Start, Work

__all__ = ["COLOR_OUTPUT", "Result", "Start", "correct"]

COLOR_OUTPUT = "color"
"""Name of the corrected colour among the outputs."""

_MAPS = ("blend", "error.before", "error.after")


@dataclass(frozen=True, eq=False)
class Result:
    """What :func:`correct` gives back.

    Attributes:
        outputs: images by name. ``color`` is the corrected linear radiance, (H, W, 3) ≥ 0, the same kind of array as
            the frame's colour was. Where the guard is on there are its maps, tensors (H, W): ``blend`` (weight of what
            the stages made), and ``error.before`` and ``error.after`` (estimated relative squared error).
        network: the trained network, for the next call's ``warm_start``; None without the core, and where the guard
            finds that the halves share their noise: then nothing is trained and the denoised image is kept.
        losses: Eq. 8 before each optimiser step.
        seconds: how long each stage took.
        estimate: what the guard says was gained; None where the settings turn it off.
        shares: of that gain, by candidate, ``stages`` being what the stages made; they sum to 1 where there is one.
        removed: fireflies that were taken out of the corrected colour; None where the settings keep them.
        lone: how many pixels are as the denoiser has them since nothing around them speaks for what both halves show
            (:mod:`selfcorrect.lone_pixels`); 0 without the guard.
        input_scale: what radiance was multiplied by.
        start: whether training went on from ``warm_start``, and why.
        halves: what the output would be of each half alone, (H, W, 3) linear radiance ≥ 0 on the CPU, before fireflies
            are removed and light is kept; where they were asked for and the guard is on.
    """

    outputs: Mapping[str, Any]
    network: Network | None
    losses: list[float]
    seconds: dict[str, float]
    estimate: Estimate | None
    removed: Removed | None
    input_scale: float
    start: Start
    lone: int = 0
    shares: Mapping[str, float] = field(default_factory=dict)
    halves: tuple[Tensor, Tensor] | None = None

    @property
    def image(self) -> Any:
        """The corrected colour."""
        return self.outputs[COLOR_OUTPUT]

    def with_outputs(self, images: Mapping[str, Any]) -> "Result":
        """This result with further outputs, such as the AOVs of :func:`selfcorrect.correct_aovs`."""
        return replace(self, outputs={**self.outputs, **images})

    @property
    def maps(self) -> dict[str, Tensor]:
        """What the guard found."""
        return {name: self.outputs[name] for name in _MAPS if name in self.outputs}


@contextmanager
def _on_any_device() -> Iterator[None]:
    """What makes a device other than the CPU keep the promises of :func:`correct`: the same bits, and one line."""
    try:
        # cuDNN's defaults may add up in any order, and round the operands of single precision to ten bits
        with torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=False):
            yield
    except torch.cuda.OutOfMemoryError:
        raise DeviceError(
            "expected a device with memory for the frame, a step's --batch of --patch pixels and tiles of "
            f"{SIDE} pixels, but got one that has run out; free some, take a smaller --batch or --patch, or "
            "--device cpu, where --maxmem says beforehand what is needed"
        ) from None


@_on_any_device()
def correct(
    frame: Frame,
    settings: Settings | None = None,
    *,
    denoiser: Callable[..., Any] | None = None,
    warm_start: Network | None = None,
    progress: Progress | None = None,
    stop: Callable[[], bool] | None = None,
    opened: Sequence[Stage] | None = None,
    extra: Mapping[str, Images] | None = None,
    keep_halves: bool = False,
) -> Result:
    """Correct a denoised frame (Back et al. 2022).

    Args:
        frame: halves with their denoised images, linear radiance.
        settings: by default the default preset.
        denoiser: what denoised the frame, for the samples that its ``neighbours`` within ``frame_radius`` give;
            without it they give less, without neighbours it is not asked.
        warm_start: the network of the last frame, to go on from with the settings' ``warm_steps``; it is left as it
            is. Where Eq. 8 does not show it to be the better start, as after a cut, a new one is taken.
        progress: called as ``progress(step, steps, loss)`` for every optimiser step in turn; on a device other than the
            CPU for several together.
        stop: asked before every optimiser step; when it says True, training ends and the result so far is inferred.
        opened: the settings' stages, to spare a shot from reading their weights for every frame
            (:func:`selfcorrect.stages.opened`).
        extra: by name of a stage, what it needs beyond the halves, such as the
            :class:`selfcorrect.stages.deep_combiner_4.SubImages` of deep-combiner-4, on any device.
        keep_halves: also give the corrected halves, which :func:`selfcorrect.correct_aovs` has use for.

    Returns:
        The corrected image and the network. The same seed gives the same bits on the same machine and number of
        threads (``torch.set_num_threads``).

    Raises:
        FrameError: the frame has no denoised halves, or lacks what a stage needs beyond them, or ``warm_start`` was
            trained with other buffers or settings.
        FileError: the weights of a trained stage are not there or do not fit.
        SettingsError: a stage stands where it cannot.
        DeviceError: the device is out of memory.
        MissingPackageError: the frame has neighbours, and there is no optical flow.

    Warns:
        MissingKernelsWarning: once in a process, on a CPU without the compiled kernels: about 30 times as long.
    """
    if frame.color[0].device.type == "cpu":
        warn_if_missing()
    settings = settings or Settings.preset(Settings.default())
    frame = _remembering(frame, settings, denoiser)
    given, *more = frame.candidates
    if opened is None:
        opened = stages.opened(settings)
    if warm_start is not None and not any(stage.learns for stage in opened):
        learning = " or ".join(name for name, stage in stages.STAGES.items() if stage.learns)
        raise FrameError(f"expected the stage {learning} with a warm start, but got the stages {settings.stages}")
    first = StageImages.of(frame.halves, given, settings.input_scale or scale_to_one(given.halves))
    if settings.guard and dependence(*frame.color).tells_nothing:
        return _kept(frame, first)
    lone = lone_pixels(frame.halves, first.scale) if settings.guard else torch.empty(0, 2)
    first = first._replace(halves=set_aside(first.halves, lone))
    judge = _Judge(first, more, keep_halves=keep_halves) if settings.guard else None
    work = Work(warm_start=warm_start, progress=progress, stop=stop)
    state, learned, seconds = _through(opened, first, work, extra or {}, judge)
    image, guarded = state.full.clamp(min=0), None
    if judge is not None:
        begun = time.perf_counter()
        image, guarded = judge.blend(state, image)
        seconds["guard"] = time.perf_counter() - begun
    estimate = guarded.estimate.with_unjudged(unjudged(first.full, frame.halves, lone)) if guarded else None
    removed = None
    if settings.fireflies == "remove":
        begun = time.perf_counter()
        removed = remove_fireflies_(image, frame.color, given.halves, first.full, seen=frame.seen, scale=first.scale)
        if estimate is not None and removed.pixels:
            estimate = estimate.without(removed.error, removed.standard_error)
        seconds["fireflies"] = time.perf_counter() - begun
    maps = dict(zip(_MAPS, guarded.maps(), strict=True)) if guarded else {}
    return Result(
        outputs={COLOR_OUTPUT: frame.like_input(image), **maps},
        network=learned.network if learned else None,
        losses=learned.losses if learned else [],
        seconds=seconds,
        estimate=estimate,
        removed=removed,
        input_scale=first.scale,
        start=learned.start if learned else Start(warm=False),
        lone=len(lone),
        shares=dict(zip([*(c.name for c in more), "stages"], guarded.shares, strict=True)) if guarded else {},
        halves=judge.halves if judge is not None else None,
    )


def _remembering(frame: Frame, settings: Settings, denoiser: Callable[..., Any] | None) -> Frame:
    """The frame with what its neighbours know of it, which optical flow finds on the CPU; a shot knows it already."""
    known = any(candidate.name == NAME for candidate in frame.more)
    if known or not (frame.neighbours and settings.guard and settings.frame_radius):
        return frame
    around = {distance: neighbour.to("cpu") for distance, neighbour in frame.neighbours.items()}
    remembered, _ = with_history(frame.to("cpu"), around, denoiser, radius=settings.frame_radius)
    return remembered.to(frame.color[0].device)


def _through(
    opened: Sequence[Stage], state: StageImages, work: Work, extra: Mapping[str, Images], judge: "_Judge | None"
) -> tuple[StageImages, Learned | None, dict[str, float]]:
    """The state after all stages, what was learned last, and the seconds of each."""
    learned, seconds = None, dict[str, float]()
    for stage in opened:
        begun = time.perf_counter()
        beyond = extra.get(stage.name)
        own = replace(
            work,
            warm_start=work.warm_start if stage.learns else None,
            extra=None if beyond is None else beyond.to(state.full.device),
            keep=judge.keep if judge is not None and stage is opened[-1] else None,
        )
        state, just_learned, parts = stage.run(state, own)
        learned = just_learned or learned
        seconds |= parts or {stage.name: time.perf_counter() - begun}
    return state, learned, seconds


def _kept(frame: Frame, first: StageImages) -> Result:
    """The denoised image: halves that share their noise can neither train nor judge a correction."""
    nothing = torch.zeros(frame.size)
    return Result(
        outputs={COLOR_OUTPUT: frame.like_input(first.full.clamp(min=0)), **{name: nothing.clone() for name in _MAPS}},
        network=None,
        losses=[],
        seconds={},
        estimate=Estimate(0.0, 0.0, 0.0, 0.0, 0.0, improved=False, independent=False),
        removed=None,
        input_scale=first.scale,
        start=Start(warm=False),
    )


class _Judge:
    """The guard on one frame: what the stages make of it, and further candidates, against what the denoiser had."""

    def __init__(self, first: StageImages, more: Sequence[Candidate], *, keep_halves: bool = False):
        self._first = first
        self.halves: tuple[Tensor, Tensor] | None = None
        if keep_halves:
            a, b = (torch.empty(first.full.shape) for _ in "ab")
            self.halves = a, b
        self._full = [Scaled(c.full, first.scale) for c in more]
        self._halves = [tuple(Scaled(half, first.scale) for half in c.halves) for c in more]
        self._evidence = Evidence(first.scaled_color, first.scaled_images, 1 + len(more))

    def keep(self, rows: slice, halves: tuple[Tensor, Tensor]) -> None:
        """Gather from rows of the halves that the stages made."""
        others = [(a[rows], b[rows]) for a, b in self._halves]
        self._evidence.add(rows, *others, halves)
        for kept, half in zip(self.halves or (), halves, strict=False):
            kept[rows] = half.to(kept.device)

    def blend(self, state: StageImages, image: Tensor) -> tuple[Tensor, Guarded]:
        """The output, made of ``image`` and the other candidates; ``image`` is used up."""
        first, evidence = self._first, self._evidence
        if not evidence.complete:
            everything = slice(0, image.shape[0])
            self.keep(everything, (state.scaled_images[0][:], state.scaled_images[1][:]))
        full = Scaled(first.full, first.scale)
        scale_(image, first.scale)
        guarded = guard(evidence, full, [*self._full, image], scale=first.scale, out=image)
        self._blend_halves_(guarded.alpha)
        if not guarded.estimate.improved:
            return image.copy_(first.full), guarded  # not the frame's own tensor: the caller may change the result
        keep_above_(image, full, first.scaled_color)
        keep_light_(image, full, first.scaled_color)
        return scale_(image, 1 / first.scale).clamp_(min=0), guarded

    def _blend_halves_(self, alpha: Tensor) -> None:
        """Blend the halves that are kept as the image is."""
        for i, kept in enumerate(self.halves or ()):
            size = (kept.shape[0], kept.shape[1])
            images = [pair[i] for pair in self._halves]
            for rows in bands(size[0]):
                z, weights = self._first.scaled_images[i][rows].double(), enlarged_rows(alpha, size, rows)
                changes = [*(image[rows].to(z) for image in images), kept[rows].to(z)]
                blend = z
                for weight, change in zip(weights, changes, strict=True):
                    blend = blend + weight[:, :, None] * (change - z)
                kept[rows] = (blend / self._first.scale).clamp(min=0).to(kept)
