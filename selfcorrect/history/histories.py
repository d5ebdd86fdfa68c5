"""The candidate ``history`` of a shot's frames: what is made of one is made once, for all that it is a neighbour of.

With a denoiser, the noisy halves of the frames around are gathered and denoised again, and the outcome is averaged with
that of the next neighbours on either side: the first brings most, the second takes half of the remaining flicker.
Without one, as where a user brings denoised images, those of the frames around are averaged.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch

from selfcorrect.frame import Candidate, Frame, mean
from selfcorrect.history.gather import averaged, excess_of, gathered
from selfcorrect.history.motion import Motion, between, chained, picture
from selfcorrect.independence import dependence

__all__ = ["NAME", "Histories", "History", "with_history"]

NAME = "history"
"""Of the candidate."""

_LEAST_FOUND = 0.03  # mean weight of a neighbour's pixels: below, it shows something else, as after a cut

Denoiser = Callable[..., Any]


class History(NamedTuple):
    """What the neighbours gave.

    Attributes:
        found: by distance in frames, negative before, the mean weight of a neighbour's pixels: 1 where each is the same
            surface in the same light.
        left_out: by distance, why a neighbour was not used.
        told: share of the pixels that moved as the files tell, and not by optical flow; None where they tell nothing.
    """

    found: Mapping[int, float] = {}
    left_out: Mapping[int, str] = {}
    told: float | None = None

    @property
    def samples(self) -> float:
        """How many frames' samples a pixel has on average, 1 without neighbours."""
        return 1 + sum(self.found.values())

    def lines(self) -> list[str]:
        """For the log."""
        if not self.found:
            return ["no history: no neighbour shows what this frame shows", *self._left_out()]
        found = ", ".join(f"{distance:+d}: {100 * share:.0f} %" for distance, share in self.found.items())
        of = f"history of {len(self.found)} frames: pixels found {found}; {self.samples:.1f} frames' samples a pixel"
        return [of, self._motion(), *self._left_out()]

    def _motion(self) -> str:
        if self.told is None:
            return "motion: by optical flow"
        if not self.told:
            return "motion: by optical flow; the files' own does not fit what the frames show"
        return (
            f"motion: the files' own at {100 * self.told:.0f} % of the pixels, else by optical flow, which fits better"
        )

    def _left_out(self) -> list[str]:
        return [f"history: the frame at {distance:+d} {reason}; left out" for distance, reason in self.left_out.items()]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "found": {str(distance): share for distance, share in self.found.items()},
            "left_out": {str(distance): reason for distance, reason in self.left_out.items()},
            "samples": self.samples,
            "motion_of_files": self.told,
        }


class Histories:
    """The histories of the frames of one shot.

    Args:
        radius: how many frames on either side give their samples.
        denoiser: as for :meth:`selfcorrect.Frame.denoise`; None, or one that needs both halves at once: the
            neighbours' denoised images are averaged instead, which gains less.
    """

    def __init__(self, radius: int, denoiser: Denoiser | None = None):
        self._radius = radius
        self._denoiser = None if getattr(denoiser, "dual", False) else denoiser
        self._motions: dict[tuple[int, int], Motion] = {}
        self._refused: dict[tuple[int, int], str] = {}
        self._gathered: dict[int, tuple[Candidate, History]] = {}
        self._aided: dict[int, Frame] = {}

    @property
    def reach(self) -> int:
        """How many frames on either side a frame's history depends on."""
        return self._radius + (self._denoiser is not None) if self._radius else 0

    def of(self, number: int, frames: Mapping[int, Frame]) -> tuple[Frame, History]:
        """A frame with its history as one candidate more, and what the neighbours gave.

        Args:
            number: of the frame.
            frames: it and those around it that there are, by their numbers, with their denoised halves. They are the
                same from one call to the next, and what was made of those that are no longer among them is let go.

        Raises:
            MissingPackageError: there is no optical flow.
        """
        self._forget(frames)
        frame, frames = frames[number], {n: self._with_aids(n, frame) for n, frame in frames.items()}
        mine, history = self._candidate(number, frames)
        if self._denoiser is not None and not history.found:
            return frame, history
        around, left_out = self._neighbours(number, frames, 1 if self._denoiser is not None else self._radius)
        if self._denoiser is None:
            if not around:
                return frame, History({}, left_out)
            others = {n: frames[n].candidates[0] for n in around}
        else:
            others = {n: self._candidate(n, frames)[0] for n in around if self._lends(n, number, history, frames)}
        images, found = [], dict[int, float]()
        for which in (0, 1, 2):  # half a, half b, both
            given = {n: (frames[n], self._motion(number, n, frames), _images(others[n])[which]) for n in others}
            image, found = averaged(frames[number], _images(mine)[which], given)
            images.append(image)
        if self._denoiser is None:
            found = {n - number: share for n, share in found.items()}
            history = History(found, left_out, self._told(number, around, frames))
        candidate = Candidate(NAME, (images[0], images[1]), images[2])
        met = {n + number: (frames[n + number], self._motion(number, n + number, frames)) for n in history.found}
        return frame.with_candidate(candidate).with_seen(excess_of(met)), history

    def _lends(self, other: int, number: int, history: History, frames: Mapping[int, Frame]) -> bool:
        """Whether what the next frame has gathered may be averaged in: it shows the same, and nothing of our noise."""
        if other - number not in history.found:
            return False
        sources = [other + distance for distance in self._candidate(other, frames)[1].found]
        return not any(self._shared_noise(number, n, frames) for n in sources if n != number)

    def _with_aids(self, number: int, frame: Frame) -> Frame:
        """With the G-buffers as the denoiser gets them: what is compared is cleaner, and prefiltered once."""
        if self._denoiser is None or frame.aids is not None:
            return frame
        if number not in self._aided:
            self._aided[number] = frame.with_aids(self._denoiser)
        return self._aided[number]

    def _candidate(self, number: int, frames: Mapping[int, Frame]) -> tuple[Candidate, History]:
        """The frame's image before the next neighbours' are averaged in."""
        if number not in self._gathered:
            self._gathered[number] = self._gather(number, frames)
        return self._gathered[number]

    def _gather(self, number: int, frames: Mapping[int, Frame]) -> tuple[Candidate, History]:
        frame, given = frames[number], frames[number].candidates[0]
        if self._denoiser is None:
            return given, History()
        around, left_out = self._neighbours(number, frames, self._radius)
        if not around:
            return given, History({}, left_out)
        halves, found = self._gathered_from(number, around, frames)
        while unlike := _unlike(number, found):
            left_out |= {n - number: "shows something else, or lies beyond what does" for n in unlike}
            around = [n for n in around if n not in unlike]
            if not around:
                return given, History({}, left_out)
            halves, found = self._gathered_from(number, around, frames)
        full, a, b = (
            torch.as_tensor(self._denoiser(color, **aids)).clamp(min=0)
            for color, aids in zip((mean((halves[0], halves[1])), *halves), frame.aids or (), strict=True)
        )
        found = {n - number: share for n, share in found.items()}
        return Candidate(NAME, (a, b), full), History(found, left_out, self._told(number, around, frames))

    def _gathered_from(
        self, number: int, around: list[int], frames: Mapping[int, Frame]
    ) -> tuple[tuple[torch.Tensor, torch.Tensor], dict[int, float]]:
        """Both halves with the samples of these frames, and the weight of the pixels of each on average."""
        neighbours = {n: (frames[n], self._motion(number, n, frames)) for n in around}
        (a, in_a), (b, in_b) = (gathered(frames[number], neighbours, i) for i in (0, 1))
        return (a, b), {n: (in_a[n] + in_b[n]) / 2 for n in around}

    def _neighbours(self, number: int, frames: Mapping[int, Frame], radius: int) -> tuple[list[int], dict[int, str]]:
        """Those that can be used, and why the others cannot. A frame of another size ends the search on its side."""
        used, left_out = [], {}
        for side in (-1, 1):
            for distance in range(side, side * (radius + 1), side):
                other = frames.get(number + distance)
                if other is None:
                    continue
                if other.size != frames[number].size:
                    left_out[distance] = f"is of {other.size[1]}x{other.size[0]} pixels"
                    break
                if reason := self._shared_noise(number, number + distance, frames):
                    left_out[distance] = reason
                    continue
                used.append(number + distance)
        return sorted(used), left_out

    def _shared_noise(self, one: int, other: int, frames: Mapping[int, Frame]) -> str:
        """Why two frames may not help each other: any half of one with the noise of any of the other."""
        pair = min(one, other), max(one, other)
        if pair not in self._refused:
            a, b = frames[pair[0]], frames[pair[1]]
            shared = any(dependence(mine, its).tells_nothing for mine in a.color for its in b.color)
            self._refused[pair] = "has this frame's noise: render each frame with seeds of its own" if shared else ""
        return self._refused[pair]

    def _motion(self, one: int, other: int, frames: Mapping[int, Frame]) -> Motion:
        if (one, other) not in self._motions:
            told = _told(one, other, frames), _told(other, one, frames)
            there, back = between(picture(frames[one]), picture(frames[other]), told)
            self._motions[one, other], self._motions[other, one] = there, back
        return self._motions[one, other]

    def _told(self, number: int, around: list[int], frames: Mapping[int, Frame]) -> float | None:
        """Share of the pixels whose motion is that of the files; None where they tell none."""
        if frames[number].motion is None:
            return None
        return sum(self._motion(number, n, frames).told for n in around) / len(around)

    def _forget(self, frames: Mapping[int, Frame]) -> None:
        self._gathered = {n: made for n, made in self._gathered.items() if n in frames}
        self._aided = {n: made for n, made in self._aided.items() if n in frames}
        self._motions = {pair: made for pair, made in self._motions.items() if set(pair) <= frames.keys()}
        self._refused = {pair: made for pair, made in self._refused.items() if set(pair) <= frames.keys()}


def with_history(
    frame: Frame, neighbours: Mapping[int, Frame], denoiser: Denoiser | None = None, *, radius: int = 2
) -> tuple[Frame, History]:
    """One frame with the history that its neighbours give, as one candidate more; a shot does with less work.

    Args:
        frame: with its denoised halves.
        neighbours: by distance in frames (−1 is the one before), with their denoised halves; those beyond ``radius``
            by one are neighbours' neighbours.
        denoiser: as for :class:`Histories`.
        radius: how many frames on either side give their samples.

    Raises:
        MissingPackageError: there is no optical flow.
    """
    return Histories(radius, denoiser).of(0, {0: frame, **neighbours})


def _unlike(number: int, found: Mapping[int, float]) -> set[int]:
    """The frames that show something else, as after a cut, and those beyond them."""
    cuts = [n for n, weight in found.items() if weight < _LEAST_FOUND]
    return {n for n in found for cut in cuts if n == cut or (n > cut > number) or (n < cut < number)}


def _told(one: int, other: int, frames: Mapping[int, Frame]) -> torch.Tensor | None:
    """Offsets by what the files of the frames on the way tell; None where one of them is not there."""
    side = 1 if other > one else -1
    way = [frames.get(n) for n in range(one, other + side, side)]
    there = [frame for frame in way if frame is not None and frame.size == frames[one].size]
    return chained(there, side) if len(there) == len(way) else None


def _images(candidate: Candidate) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return *candidate.halves, candidate.full
