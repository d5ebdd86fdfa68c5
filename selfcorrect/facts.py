"""The facts of a run, gathered once: the log, ``--json`` and the output's attributes all read them. Prints nothing."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from typing import Any

import torch

from selfcorrect import words
from selfcorrect.correct import Result
from selfcorrect.exr.passes import Others
from selfcorrect.fireflies import Removed
from selfcorrect.frame import Frame
from selfcorrect.guard import Estimate
from selfcorrect.history import NAME, History
from selfcorrect.image.repair import Repairs
from selfcorrect.settings import Settings
from selfcorrect.stages.stage import Start

__all__ = ["Corrected", "Denoised", "Written", "channel_lines"]

_SAMPLES = 250_000  # pixels that tell where most was gained


def channel_lines(channels: Mapping[str, list[str]]) -> list[str]:
    """What was taken for what, for the log."""
    return [f"{role}: {', '.join(names)}" for role, names in channels.items()]


@dataclass(frozen=True)
class Denoised:
    """What is known of a frame before it is corrected.

    Attributes:
        denoiser: who denoised it; ``given`` where the files hold denoised halves.
        channels: role → channels that were taken for it.
        size: height and width in pixels.
        repairs: by buffer, how many pixels were changed on the way in.
        constant: the G-buffers that are the same at every pixel, and not used.
        seconds: of reading and denoising.
        promises: by name of a further denoiser, the share of the error that its image may take off at most.
        candidates: the further images that the guard may blend in.
        history: what the neighbours of a frame of a shot gave; None where they were not asked.
    """

    denoiser: str
    channels: Mapping[str, list[str]]
    size: tuple[int, int]
    repairs: Mapping[str, Repairs]
    constant: list[str]
    seconds: Mapping[str, float]
    promises: Mapping[str, float] = field(default_factory=dict)
    candidates: tuple[str, ...] = ()
    history: History | None = None

    @classmethod
    def of(
        cls,
        frame: Frame,
        denoiser: str,
        channels: Mapping[str, list[str]],
        seconds: Mapping[str, float],
        repairs: Mapping[str, Repairs],
    ) -> "Denoised":
        """Those of a denoised frame; ``repairs`` are those of images beyond its buffers."""
        return cls(
            denoiser,
            channels,
            frame.size,
            {**frame.repairs, **repairs},
            list(frame.constant),
            dict(seconds),
        )

    def judged(self, frame: Frame, promises: Mapping[str, float], seconds: float) -> "Denoised":
        """Those of the frame with the candidates of further denoisers, and what each had promised."""
        return replace(
            self,
            promises=dict(promises),
            candidates=tuple(candidate.name for candidate in frame.more),
            seconds={**self.seconds, "candidates": seconds},
        )

    def remembered(self, history: History, seconds: float) -> "Denoised":
        """Those of the frame with its history."""
        return replace(self, history=history, seconds={**self.seconds, "history": seconds})

    def lines(self) -> list[str]:
        """For the log: what was not used, and what was repaired."""
        unused = [f"{name}: the same at every pixel; not used" for name in self.constant]
        repaired = [
            f"{name}: {counts.non_finite} pixels were NaN or infinite, {counts.negative} negative; repaired"
            for name, counts in self.repairs.items()
            if any(counts)
        ]
        further = [
            f"candidate {name}: {'taken' if name in self.candidates else 'left out'}, a few crops promise up to "
            f"{100 * promise:.0f} % less error"
            for name, promise in self.promises.items()
        ]
        return unused + repaired + further + ([] if self.history is None else self.history.lines())


@dataclass(frozen=True)
class Corrected:
    """What is known of a frame once it is corrected.

    Attributes:
        before: of the frame as it was denoised.
        preset: the name that the settings came from.
        settings: of the correction, as they were asked for.
        estimate: what the guard says was gained; None where it is off.
        removed: fireflies that were taken out; None where they are kept.
        start: what training began from.
        seconds: of each stage.
        input_scale: what radiance was multiplied by.
        steps: of the optimiser.
        parameters: of the network; 0 without one.
        threads: of the CPU.
        place: which tones gained most, in words; empty where nothing did.
        more: what else belongs into the attributes, by name: plain values.
        version: of selfcorrect.
        lone: how many pixels are left to the denoiser, of which nothing around them says what they are.
        shares: of what was gained, by candidate.
    """

    before: Denoised
    preset: str
    settings: Settings
    estimate: Estimate | None
    removed: Removed | None
    start: Start
    seconds: Mapping[str, float]
    input_scale: float
    steps: int
    parameters: int
    threads: int
    place: str = ""
    more: Mapping[str, Any] = field(default_factory=dict)
    version: str = field(default_factory=lambda: version("selfcorrect"))
    lone: int = 0
    shares: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(
        cls, before: Denoised, result: Result, preset: str, settings: Settings, more: Mapping[str, Any] | None = None
    ) -> "Corrected":
        """Those of a result that was computed on torch's present number of threads."""
        return cls(
            before=before,
            preset=preset,
            settings=settings,
            estimate=result.estimate,
            removed=result.removed,
            start=result.start,
            seconds=dict(result.seconds),
            input_scale=result.input_scale,
            steps=len(result.losses),
            parameters=0 if result.network is None else sum(p.numel() for p in result.network.parameters()),
            threads=torch.get_num_threads(),
            place=_place(result),
            more=dict(more or {}),
            lone=result.lone,
            shares=dict(result.shares),
        )

    def with_layers(self, name: str, others: "Mapping[str, Corrected]") -> "Corrected":
        """Those of a frame with further view layers, by name; ``name`` is its own."""
        if not others:
            return self
        layers = {layer: {**other.run(), "channels": dict(other.before.channels)} for layer, other in others.items()}
        return replace(self, more={**self.more, "layer": name, "layers": layers})

    def start_line(self) -> str:
        """What a frame of a shot started from, for the log."""
        start = self.start
        if start.warm_loss is None:
            return "started cold"
        how = "started warm" if start.warm else "did not look like the frame before: started cold"
        return f"{how} (loss before training {start.warm_loss:.5g} warm, {start.cold_loss:.5g} cold)"

    def attributes(self) -> dict[str, str]:
        """For the output file: by name, JSON."""
        return {
            "selfcorrect/settings": json.dumps(self.settings.to_dict()),
            "selfcorrect/run": json.dumps(self.run()),
        }

    def run(self) -> dict[str, Any]:
        """How the output was made, beside its settings: plain values."""
        return {
            "preset": self.preset,
            "denoiser": self.before.denoiser,
            "version": self.version,
            "estimate": None if self.estimate is None else asdict(self.estimate),
            "fireflies": None if self.removed is None else self.removed._asdict(),
            "lone_pixels": self.lone,
            "gained_by": dict(self.shares),
            "start": self.start._asdict(),
            **self.more,
        }


@dataclass(frozen=True)
class Written:
    """What is known of a frame once its output is written: everything.

    Attributes:
        output: the file.
        clipped: how many values lay beyond the range of half floats.
        others: what became of the channels beside the colour.
        seconds: of writing, and in total.
        corrected: what was known before.
    """

    output: str
    clipped: int
    others: Others
    seconds: Mapping[str, float]
    corrected: Corrected

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        facts, before = self.corrected, self.corrected.before
        seconds = {**before.seconds, **facts.seconds, **self.seconds}
        height, width = before.size
        return {
            "output": self.output,
            "settings": facts.settings.to_dict(),
            **facts.run(),
            "channels": dict(before.channels),
            "other_channels": self.others._asdict(),
            "seconds": {name: round(value, 3) for name, value in seconds.items()},
            "size": {"width": width, "height": height},
            "repairs": {name: counts._asdict() for name, counts in before.repairs.items()},
            "constant": before.constant,
            "candidates": {
                name: {"promise": promise, "taken": name in before.candidates}
                for name, promise in before.promises.items()
            },
            "history": None if before.history is None else before.history.to_dict(),
            "input_scale": facts.input_scale,
            "steps": facts.steps,
            "parameters": facts.parameters,
            "threads": facts.threads,
        }

    def lines(self) -> list[str]:
        """For the log: what was clipped, how long it took, and last what was gained, in words before numbers."""
        estimate, removed = self.corrected.estimate, self.corrected.removed
        lines = []
        if removed is not None and removed.pixels:
            lines.append(str(removed))
        if self.corrected.lone:
            lines.append(
                f"left as the denoiser has them: {self.corrected.lone} pixels that both halves show over a hundred "
                "times as bright as all around, like stars or fireflies"
            )
        if (share := self.corrected.shares.get(NAME, 0.0)) > 0:
            lines.append(f"{100 * share:.0f} % of the gain are the neighbouring frames'")
        if self.clipped:
            lines.append(f"{self.output}: {self.clipped} values beyond the range of half floats were clipped")
        spent = ", ".join(f"{name} {value:.1f} s" for name, value in self.corrected.seconds.items())
        lines += self.others.lines()
        lines.append(f"{self.output}: written after {self.seconds['total']:.1f} s ({spent})")
        if estimate is not None:
            lines.append(f"{self.output}: {words.closing(asdict(estimate), self.corrected.place)}")
        return lines


def _place(result: Result) -> str:
    """Which tones gained most; some of the pixels tell."""
    if result.estimate is None or not result.estimate.improved:
        return ""
    every = max(1, round((result.image.shape[0] * result.image.shape[1] / _SAMPLES) ** 0.5))
    image = torch.as_tensor(result.image)[::every, ::every].cpu().double()
    before, after = (result.maps[f"error.{when}"][::every, ::every].cpu() for when in ("before", "after"))
    return words.where(image, before, after)
