"""What the commands `frame`, `sequence` and `demo` do alike: flags, machine, one frame through memory, what is told."""

import argparse
import contextlib
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from importlib.metadata import version
from typing import Any

import torch
from tqdm import tqdm

import denoisers
from selfcorrect import files
from selfcorrect.correct import Result, correct
from selfcorrect.errors import SettingsError, printable
from selfcorrect.exr.file import OUTPUT
from selfcorrect.frame import Frame
from selfcorrect.independence import doubts
from selfcorrect.settings import Settings
from selfcorrect.stages import weights
from selfcorrect.stages.core.network import Network

__all__ = [
    "Corrected",
    "EndOnInterrupt",
    "Runner",
    "add_halves",
    "add_run_flags",
    "answer",
    "log",
    "mapping",
    "settings_of",
]

_WRITE_SECONDS = 5e-7  # a pixel


def log(*lines: str) -> None:
    """Lines on stderr, in one piece; what files put into them is escaped. Where nothing can be told, so be it."""
    if sys.stderr is None:  # closed before Python began; print would take stdout
        return
    with OUTPUT, contextlib.suppress(OSError, ValueError):
        print("\n".join(map(printable, lines)), file=sys.stderr, flush=True)


def answer(report: Mapping[str, Any]) -> None:
    """One JSON object, in one line on stdout."""
    with OUTPUT:
        print(json.dumps(report), flush=True)


def add_halves(parser: argparse.ArgumentParser) -> None:
    """A frame's two halves, and their denoised images where the user has them."""
    parser.add_argument("a", metavar="A.exr", help="half a; FILE.exr::LAYER chooses a layer")
    parser.add_argument("b", metavar="B.exr", help="half b, rendered with another seed")
    parser.add_argument("--denoised-a", metavar="DA.exr", help="denoised half a, instead of a denoiser")
    parser.add_argument("--denoised-b", metavar="DB.exr")
    parser.add_argument("--denoised", metavar="D.exr", help="denoised mean of both halves")


def add_run_flags(parser: argparse.ArgumentParser) -> None:
    """The flags that every command with a correction takes; the settings' fields are among them."""
    parser.add_argument("--denoiser", metavar="NAME", help=f"one of {' | '.join(denoisers.names())}")
    parser.add_argument("--preset", default=Settings.default(), help=" | ".join(Settings.presets()))
    parser.add_argument("--device", default="cpu", help="torch device: cpu, cuda, …")
    parser.add_argument("--threads", type=int, metavar="N", help="CPU threads, by default all")
    parser.add_argument("--map", action="append", default=[], metavar="ROLE=CHANNEL", help="albedo=MyAlbedo, …")
    parser.add_argument(
        "--aov", type=_aov_names, default=[], metavar="error,blend", help="also write what the guard found, as channels"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    group = parser.add_argument_group("settings, by default those of the preset")
    for f in fields(Settings):
        how: dict[str, Any] = {"type": type(f.default), "metavar": "|".join(f.metadata["choices"]) or "N"}
        if f.metadata["unit"] == "s":
            how = {"type": _seconds, "metavar": "10s"}
        if isinstance(f.default, bool):
            how = {"action": argparse.BooleanOptionalAction}
        if f.metadata["unit"] == "file":
            group.add_argument(f"--{f.name.replace('_', '-')}", metavar="FILE", help=f.metadata["help"])
            continue
        presets = ", ".join(f"{name}: {getattr(s, f.name)}" for name, s in Settings.presets().items())
        group.add_argument(
            f"--{f.name.replace('_', '-')}", default=None, help=f"{f.metadata['help']} ({presets})", **how
        )


def _seconds(text: str) -> float:
    """Seconds from 10, 10s, 2m or 1h."""
    units = {"s": 1.0, "m": 60.0, "h": 3600.0}
    number, unit = (text[:-1], units[text[-1]]) if text[-1:] in units else (text, 1.0)
    try:
        return float(number) * unit
    except ValueError:
        raise SettingsError(f"expected a time like 10s or 2m, but got {text!r}") from None


def settings_of(options: argparse.Namespace) -> Settings:
    """The preset, with what the flags change."""
    changes = {f.name: getattr(options, f.name) for f in fields(Settings)}
    return Settings.preset(options.preset, **{k: v for k, v in changes.items() if v is not None})


def mapping(options: argparse.Namespace) -> dict[str, str]:
    """Role → channel, from --map."""
    pairs = [entry.partition("=") for entry in options.map]
    for role, equals, channel in pairs:
        if not (role and equals and channel):
            raise SettingsError(f"expected --map ROLE=CHANNEL, but got {role + equals + channel!r}")
    return {role: channel for role, _, channel in pairs}


def _use_machine(options: argparse.Namespace) -> None:
    if options.threads is not None:
        if options.threads < 1:
            raise SettingsError(f"expected --threads of at least 1, but got {options.threads}")
        torch.set_num_threads(options.threads)
    try:
        torch.empty(0, device=options.device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise SettingsError(
            f"expected a --device that this machine has, but got {options.device!r}: {reason}"
        ) from None


@dataclass(frozen=True, eq=False)
class Corrected:
    """What is left of a frame that was corrected: not its buffers.

    Attributes:
        origin: its half a.
        facts: what --json tells of it.
        result: the correction.
        denoiser: who denoised it.
        began: when the work on it began, by ``time.perf_counter``.
        seconds: how long the stages before the correction took.
    """

    origin: files.Origin
    facts: dict[str, Any]
    result: Result
    denoiser: str
    began: float
    seconds: dict[str, float]


class Runner:
    """Corrects frames as the flags say, and tells of it.

    Args:
        options: what the flags of :func:`add_run_flags` gave.
        given: denoised halves are given, so that no denoiser is needed.
        scratch: bytes that the denoiser may take beside its images, where it can be told.

    Raises:
        SelfcorrectError: settings, device or denoiser are not to be had.
    """

    def __init__(self, options: argparse.Namespace, *, given: bool, scratch: int | None = None):
        self.settings = settings_of(options)
        if options.aov and not self.settings.guard:
            aov = ",".join(options.aov)
            raise SettingsError(f"expected the guard with --aov {aov}, but got settings that turn it off")
        weights.check(self.settings)
        _check_sub_images(options, self.settings, given=given)
        _use_machine(options)
        self._options = options
        self._taken: dict[str, list[str]] = {}
        self._denoise = None
        if options.denoiser is not None or not given:
            spec = options.denoiser or denoisers.default()
            self._denoise = denoisers.create(spec, threads=options.threads, scratch=scratch)

    @property
    def denoiser(self) -> str:
        """Who denoises, unless there are denoised halves beside."""
        return "given" if self._denoise is None else self._options.denoiser or denoisers.default()

    def correct(
        self,
        loaded: files.Loaded,
        network: Network | None = None,
        meanwhile: Callable[[], None] | None = None,
        *,
        began: float | None = None,
        stop: Callable[[], bool] | None = None,
        show: Callable[[Frame], None] | None = None,
    ) -> Corrected:
        """Denoise and correct a frame.

        Args:
            loaded: it, as read; its frame is given up.
            network: to start from.
            meanwhile: called after every optimiser step.
            began: when the work on it began.
            stop: says when to end training.
            show: called with the denoised frame.
        """
        start = time.perf_counter()
        began = start if began is None else began
        seconds = {"read": start - began}
        frame, denoiser = self.prepare(loaded, seconds)
        if show is not None:
            show(frame)
        with _Progress(meanwhile) as progress:
            result = correct(
                frame.to(self._options.device),
                self._left(time.perf_counter() - began, frame),
                warm_start=network,
                progress=progress,
                stop=stop,
            )
        return Corrected(loaded.origin, _facts(frame, result), result, denoiser, began, seconds)

    def prepare(self, loaded: files.Loaded, seconds: dict[str, float]) -> tuple[Frame, str]:
        """Denoise a frame where that is to be done, and tell of it; ``seconds`` is added to.

        Returns:
            The frame with its denoised halves, and who denoised it.
        """
        taken = loaded.origin.taken
        if taken != self._taken:  # of a shot, only where it changes
            for role, names in taken.items():
                log(f"{role}: {', '.join(names)}")
        self._taken = taken
        for doubt in doubts(loaded.frame):
            log(f"warning: {doubt}")
        frame, denoiser = _denoised(self._options, loaded.frame, self._denoise, seconds)
        for name in frame.constant:
            log(f"{name}: the same at every pixel; not used")
        for name, repairs in frame.repairs.items():
            if any(repairs):
                log(f"{name}: {repairs.non_finite} pixels were NaN or infinite, {repairs.negative} negative; repaired")
        return frame, denoiser

    def _left(self, spent: float, frame: Frame) -> Settings:
        """The settings with what is left of the time budget after reading and denoising, and for writing."""
        if not self.settings.time_budget:
            return self.settings
        writing = _WRITE_SECONDS * frame.size[0] * frame.size[1]
        # a budget that is spent already must not turn into none
        return replace(self.settings, time_budget=max(self.settings.time_budget - spent - writing, 1e-9))

    def write(self, output: str, corrected: Corrected, more: Mapping[str, Any]) -> dict[str, Any]:
        """Write a frame; returns what --json prints. ``more`` is kept in the output's attribute, too."""
        written = time.perf_counter()
        result = corrected.result
        estimate = None if result.estimate is None else asdict(result.estimate)
        details = {
            "preset": self._options.preset,
            "denoiser": corrected.denoiser,
            "version": version("selfcorrect"),
            "estimate": estimate,
            "start": result.start._asdict(),
            **more,
        }
        extra = _extra(self._options, result)
        clipped = files.save(output, corrected.origin, result, settings=self.settings, details=details, extra=extra)
        lines = [] if result.estimate is None else [str(result.estimate)]
        if clipped:
            lines.append(f"{output}: {clipped} values beyond the range of half floats were clipped")
        now = time.perf_counter()
        seconds = corrected.seconds | result.seconds | {"write": now - written, "total": now - corrected.began}
        lines.append(f"{output}: written after {seconds['total']:.1f} s ({_spent(result)})")
        log(*lines)  # in one piece: another frame may be in work meanwhile
        return {
            "output": output,
            "settings": self.settings.to_dict(),
            **details,
            "channels": corrected.origin.taken,
            "seconds": {name: round(value, 3) for name, value in seconds.items()},
            **corrected.facts,
        }


def _check_sub_images(options: argparse.Namespace, settings: Settings, *, given: bool) -> None:
    """Raise where the flag --sub-images and the stage that reads them do not go together."""
    named, wanted = getattr(options, "sub_images", None), "deep-combiner-4" in settings.stage_names
    if wanted and not named:
        raise SettingsError(
            "expected --sub-images A1.exr A2.exr B1.exr B2.exr, of the command frame, with the stage deep-combiner-4, "
            "but got none"
        )
    if named and not wanted:
        raise SettingsError(f"expected the stage deep-combiner-4 with --sub-images, but got {settings.stages!r}")
    if named and given and options.denoiser is None:
        raise SettingsError("expected --denoiser NAME with --sub-images, which have to be denoised too, but got none")


def _facts(frame: Frame, result: Result) -> dict[str, Any]:
    """What --json tells of the frame and of the work done on it."""
    return {
        "size": {"width": frame.size[1], "height": frame.size[0]},
        "repairs": {name: repairs._asdict() for name, repairs in frame.repairs.items()},
        "constant": frame.constant,
        "input_scale": result.input_scale,
        "steps": len(result.losses),
        "parameters": 0 if result.network is None else sum(p.numel() for p in result.network.parameters()),
        "threads": torch.get_num_threads(),
    }


def _denoised(
    options: argparse.Namespace, frame: Frame, denoise: Callable[..., Any] | None, seconds: dict[str, float]
) -> tuple[Frame, str]:
    """The frame with denoised halves, and who denoised it; a denoiser that is named beats files found beside."""
    if frame.denoised is not None and options.denoiser is None:
        if frame.sub_images is not None:
            raise SettingsError(
                "expected --denoiser NAME with --sub-images, as the halves' files hold denoised images and those of "
                "the sub-images must be alike, but got none"
            )
        return frame, "given"
    assert denoise is not None  # created above, in every case that gets here
    start = time.perf_counter()
    name = options.denoiser or denoisers.default()
    log(f"denoiser: {name}")
    frame = frame.denoise(denoise, full=frame.denoised_full is None)
    seconds["denoise"] = time.perf_counter() - start
    return frame, name


def _spent(result: Result) -> str:
    return ", ".join(f"{name} {value:.1f} s" for name, value in result.seconds.items())


def _extra(options: argparse.Namespace, result: Result) -> dict[str, Any]:
    """The maps that --aov asks for, as channels."""
    return {
        f"selfcorrect.{name}": image.cpu().numpy()
        for name, image in result.aovs.items()
        if name.partition(".")[0] in options.aov
    }


def _aov_names(text: str) -> list[str]:
    names = text.split(",")
    if not set(names) <= {"error", "blend"}:
        raise SettingsError(f"expected --aov error, blend or both, but got {text!r}")
    return names


class EndOnInterrupt:
    """While it is entered, the first Ctrl-C asks training to end; the second one interrupts as usual."""

    def __init__(self) -> None:
        self._asked = False
        self._before: Any = None

    def __call__(self) -> bool:
        """Whether training is asked to end."""
        return self._asked

    def __enter__(self) -> "EndOnInterrupt":
        self._before = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGINT, self._before)

    def _handle(self, *_: object) -> None:
        if self._asked:
            raise KeyboardInterrupt
        self._asked = True
        # not log(): its lock may be held by the very thread that this interrupts
        with contextlib.suppress(OSError):
            os.write(2, b"interrupted: writing what has been learned so far; again to write nothing\n")


class _Progress:
    """A bar on a terminal, a plain line for every tenth in a log."""

    def __init__(self, meanwhile: Callable[[], None] | None) -> None:
        self._bar: Any = None
        self._meanwhile = meanwhile

    def __enter__(self) -> "_Progress":
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def __call__(self, step: int, steps: int, loss: float) -> None:
        if self._meanwhile is not None:
            self._meanwhile()
        if sys.stderr is not None and sys.stderr.isatty():
            if self._bar is None:
                self._bar = tqdm(total=steps, desc="training", unit="step", file=sys.stderr)
            self._bar.set_postfix(loss=f"{loss:.4g}")
            self._bar.update(step - self._bar.n)
        elif step * 10 // steps > (step - 1) * 10 // steps:
            log(f"training: step {step} of {steps}, loss {loss:.5g}")
