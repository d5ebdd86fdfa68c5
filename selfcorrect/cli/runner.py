"""One frame through memory, as the flags say, for `frame`, `sequence`, `bench` and `demo` alike."""

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

import denoisers
from denoisers import check_threads
from selfcorrect import facts, files, renders, stages
from selfcorrect.aov_channels import correct_channels
from selfcorrect.aovs import denoiser_of
from selfcorrect.candidates import with_candidates
from selfcorrect.cli import flags
from selfcorrect.cli.memory import keep_freed
from selfcorrect.cli.terminal import Progress, log
from selfcorrect.correct import COLOR_OUTPUT, Result, correct
from selfcorrect.errors import MissingPackageError, SettingsError
from selfcorrect.frame import Frame
from selfcorrect.history import Histories, available
from selfcorrect.independence import doubts
from selfcorrect.kernel.compiled import installed, missing
from selfcorrect.settings import Settings
from selfcorrect.stages.core.network import Network
from selfcorrect.stages.stage import Extra, Images

__all__ = ["Corrected", "Denoised", "Runner"]

_WRITE_SECONDS = 5e-7  # a pixel


@dataclass(frozen=True, eq=False)
class Denoised:
    """A frame to be corrected.

    Attributes:
        frame: with its denoised halves.
        origin: its half a.
        extra: by name of a stage, what that needs beyond the halves.
        facts: what is known of it.
        began: when the work on it began, by ``time.perf_counter``.
        layer: name of its view layer, where the files have several.
    """

    frame: Frame
    origin: files.Origin
    extra: dict[str, Images]
    facts: facts.Denoised
    began: float
    layer: str = ""


@dataclass(frozen=True, eq=False)
class Corrected:
    """What is left of a frame that was corrected: not its buffers.

    Attributes:
        origin: its half a.
        outputs: the images to write, by name.
        aovs: channels of corrected AOVs, by their full names.
        network: for the next frame to start from.
        facts: what is known of it.
        began: when the work on it began, by ``time.perf_counter``.
        layer: name of its view layer, where the files have several.
    """

    origin: files.Origin
    outputs: Mapping[str, Any]
    aovs: Mapping[str, Any]
    network: Network | None
    facts: facts.Corrected
    began: float
    layer: str = ""


class Runner:
    """Corrects frames as the flags say, and tells of it.

    Args:
        options: what the flags of ``add_run_flags`` and ``add_written`` in :mod:`selfcorrect.cli.flags` gave.
        given: denoised halves are given, so that no denoiser is needed.
        scratch: bytes that the denoiser may take beside its images, where it can be told.
        layers: how many view layers a frame has that share its time budget.

    Raises:
        SelfcorrectError: settings, device or denoiser are not to be had.
    """

    def __init__(self, options: argparse.Namespace, *, given: bool, scratch: int | None = None, layers: int = 1):
        self.layers = layers
        self.settings = flags.settings_of(options)
        if options.diagnostics and not self.settings.guard:
            named = ",".join(options.diagnostics)
            raise SettingsError(f"expected the guard with --diagnostics {named}, but got settings that turn it off")
        self._stages = stages.opened(self.settings)
        self._extra_files = flags.extra_files(options, self.settings)
        if given and options.denoiser is None:
            self._check_denoiser(" which have to be denoised too,")
        _use_machine(options)
        self._options = options
        self._told: dict[str, dict[str, list[str]]] = {}
        self._denoise = self._opened(self._spec, scratch) if options.denoiser is not None or not given else None
        self._aovs_denoise = self._of_aovs(scratch) if (getattr(options, "aovs", None) or "none") != "none" else None
        self._further = {}
        if self._denoise is not None and self.settings.guard and self.settings.candidates != "none":
            self._further = {spec: self._opened(spec, scratch) for spec in denoisers.variants(self._spec)}
        self._tell_what_is_slow()

    def _opened(self, spec: str, scratch: int | None) -> Callable[..., Any]:
        return denoisers.create(spec, threads=self._options.threads, scratch=scratch)

    def _of_aovs(self, scratch: int | None) -> Callable[..., Any]:
        """The picture's denoiser, or the default one where the picture's denoised halves are given."""
        if self._denoise is not None:
            return self._denoise
        log(f"AOVs: denoised by {self._spec}: --denoised-a and --denoised-b are of the picture alone")
        return self._opened(self._spec, scratch)

    def _tell_what_is_slow(self) -> None:
        if self._denoise is not None and self._options.denoiser is None and denoisers.fallback():
            log(denoisers.fallback())
        if not installed():
            log(f"warning: {missing()}")
        if torch.device(self._options.device).type != "cpu":
            bound = [stage.name for stage in self._stages if stage.on_cpu]
            bound += [] if self._denoise is None else [f"the denoiser {self.denoiser}"]
            if bound:
                log(f"{' and '.join(bound)}: on the CPU; all else on {self._options.device}")

    @property
    def denoiser(self) -> str:
        """Who denoises, unless there are denoised halves beside."""
        return "given" if self._denoise is None else self._spec

    @property
    def _spec(self) -> str:
        return self._options.denoiser or denoisers.default()

    def histories(self) -> Histories:
        """What makes histories of a shot's frames, as the settings say; without optical flow there are none."""
        if self.settings.frame_radius and not available():
            missing = MissingPackageError("optical flow", "flow")
            log(f"warning: the frames of the shot do not help each other, --frame-radius is 0: {missing}")
            self.settings = replace(self.settings, frame_radius=0)
        return Histories(self.settings.frame_radius if self.settings.guard else 0, self._denoise)

    def correct(
        self,
        denoised: Denoised,
        network: Network | None = None,
        meanwhile: Callable[[], None] | None = None,
        *,
        stop: Callable[[], bool] | None = None,
        show: Callable[[Frame], None] | None = None,
        gather: Callable[[Frame, Result], None] | None = None,
        more: Mapping[str, Any] | None = None,
    ) -> Corrected:
        """Correct a frame, with what further candidates it has use for.

        Args:
            denoised: it; its frame is given up.
            network: to start from.
            meanwhile: called after every optimiser step.
            stop: says when to end training.
            show: called with the denoised frame.
            gather: called with it and the result.
            more: what else to keep in the output's attributes.
        """
        denoised = self.prepare(denoised)
        frame, origin, began, known = denoised.frame, denoised.origin, denoised.began, denoised.facts
        if show is not None:
            show(frame)
        with Progress(meanwhile) as progress:
            result = correct(
                frame.to(self._options.device),
                self._left(time.perf_counter() - began, frame),
                warm_start=network,
                progress=progress,
                stop=stop,
                opened=self._stages,
                extra=denoised.extra,
                keep_halves=bool(origin.plan.groups),
            )
        aovs, about, result = self._aovs(origin, frame, result)
        if gather is not None:
            gather(frame, result)
        corrected = facts.Corrected.of(known, result, self._options.preset, self.settings, {**(more or {}), **about})
        outputs = _outputs(result, self._options.diagnostics)
        return Corrected(origin, outputs, aovs, result.network, corrected, began, denoised.layer)

    def _aovs(
        self, origin: files.Origin, frame: Frame, result: Result
    ) -> tuple[dict[str, Any], dict[str, Any], Result]:
        """Channels of the AOVs that the user wants corrected, what is to be told of them, and the result with the
        picture that they sum to.
        """
        if not origin.plan.written:
            return {}, {}, result
        assert self._aovs_denoise is not None  # there would be no plan
        start = time.perf_counter()
        denoise = denoiser_of(frame, self._aovs_denoise)
        a, b = origin.reopened()
        assert b is not None  # there would be no plan
        through = self._options.pass_through
        halves, result = result.halves, replace(result, halves=None)
        found = correct_channels(
            (a, b), origin.plan, result.image, frame, denoise, corrected_halves=halves, pass_through=through
        )
        log(*found.lines, f"AOVs: {time.perf_counter() - start:.1f} s")
        result = result.with_outputs({COLOR_OUTPUT: frame.like_input(found.picture)})
        return found.planes, {"aovs": found.facts}, result

    def denoise(self, loaded: files.Loaded, began: float | None = None, *, keep_aids: bool = False) -> Denoised:
        """Read what stages need beyond the halves, and denoise where that is to be done.

        Args:
            loaded: the frame, as read; it is given up.
            began: when the work on it began.
            keep_aids: as for :meth:`selfcorrect.Frame.denoise`.
        """
        began = time.perf_counter() if began is None else began
        frame, channels = loaded.frame, loaded.origin.taken
        extra = {
            name: _extra(name).of(frame, renders.load_extra(paths, frame.size))
            for name, paths in self._extra_files.items()
        }
        seconds = {"read": time.perf_counter() - began}
        denoiser = "given"
        if frame.denoised is None or self._options.denoiser is not None:  # who is named beats files found beside
            denoiser, start = self.denoiser, time.perf_counter()
            assert self._denoise is not None  # created above, in every case that gets here
            frame = frame.denoise(self._denoise, full=frame.denoised_full is None, keep_aids=keep_aids)
            extra = {name: images.denoise(frame, self._denoise) for name, images in extra.items()}
            seconds["denoise"] = time.perf_counter() - start
        else:
            self._check_denoiser(" as the halves' files hold denoised images and those of both must be alike,")
        repairs = {name: counts for images in extra.values() for name, counts in images.repairs.items()}
        known = facts.Denoised.of(frame, denoiser, channels, seconds, repairs)
        return Denoised(frame, loaded.origin, extra, known, began, loaded.layer)

    def prepare(self, denoised: Denoised) -> Denoised:
        """The frame with further candidates, where they are worth it; and tell of all that is known of it."""
        frame, known, begun = denoised.frame, denoised.facts, time.perf_counter()
        if self.layers > 1:
            log(f"view layer {denoised.layer or '(none)'}")
        if known.channels != self._told.get(denoised.layer):  # of a shot, only where it changes
            log(*facts.channel_lines(known.channels))
        self._told[denoised.layer] = dict(known.channels)
        for line in denoised.origin.plan.lines:
            log(line)
        for warning in (*denoised.origin.lost, *doubts(frame)):
            log(f"warning: {warning}")
        if known.denoiser != "given":
            log(f"denoiser: {known.denoiser}")
            frame, promises = with_candidates(frame, self._further, every=self.settings.candidates == "all")
            known = known.judged(frame, promises, time.perf_counter() - begun)
        for line in known.lines():
            log(line)
        return replace(denoised, frame=frame, facts=known)

    def write(self, output: str, corrected: Corrected, others: Sequence[Corrected] = ()) -> facts.Written:
        """Write a frame with its further view layers, and tell of it."""
        start = time.perf_counter()
        known = corrected.facts.with_layers(corrected.layer, {other.layer: other.facts for other in others})
        saved = files.save(
            output,
            corrected.origin,
            corrected.outputs,
            known.attributes(),
            pass_through=self._options.pass_through,
            aovs=corrected.aovs,
            others=[files.Picture(o.layer, o.origin.taken["color"], o.outputs, o.aovs) for o in others],
        )
        now = time.perf_counter()
        seconds = {"write": now - start, "total": now - corrected.began}
        written = facts.Written(output, saved.clipped, saved.others, seconds, known)
        log(*written.lines())  # in one piece: another frame may be in work meanwhile
        return written

    def _left(self, spent: float, frame: Frame) -> Settings:
        """The settings with what is left of the time budget after reading and denoising, and for writing."""
        if not self.settings.time_budget:
            return self.settings
        writing = _WRITE_SECONDS * frame.size[0] * frame.size[1]
        # a budget that is spent already must not turn into none
        return replace(self.settings, time_budget=max(self.settings.time_budget / self.layers - spent - writing, 1e-9))

    def _check_denoiser(self, why: str) -> None:
        """Raise where no denoiser is named and a stage's images have to be denoised."""
        for name in self._extra_files:
            raise SettingsError(f"expected --denoiser NAME with {_extra(name).flag},{why} but got none")


def _extra(stage: str) -> Extra:
    extra = stages.STAGES[stage].extra
    assert extra is not None  # the flags have found its files
    return extra


def _outputs(result: Result, diagnostics: list[str]) -> dict[str, Any]:
    """The corrected colour, and the maps that --diagnostics asks for."""
    maps = {name: image.cpu().numpy() for name, image in result.maps.items() if name.partition(".")[0] in diagnostics}
    return {COLOR_OUTPUT: result.image, **maps}


def _use_machine(options: argparse.Namespace) -> None:
    keep_freed()
    if options.threads is not None:
        check_threads(options.threads, "--threads")
        torch.set_num_threads(options.threads)
    try:
        torch.zeros(1, device=options.device, dtype=torch.float64).cpu()  # the guard's; MPS has none
    except (RuntimeError, AssertionError, TypeError) as error:
        reason = str(error).splitlines()[0].partition(". ")[0]
        raise SettingsError(
            f"expected a --device that this machine has, but got {options.device!r}: {reason}"
        ) from None
