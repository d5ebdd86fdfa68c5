"""From the files of a shot to its files: read ahead, written behind, skipped where done, gone on where one fails.

The one state is on disk: an output is there under its name only when it is whole (:mod:`selfcorrect.publish`), and
its attribute ``selfcorrect/run`` carries the recipe it was made by. So a run that was killed is resumed by running it
again, and two runs on the same shot do no more harm than to do the work twice.
"""

import hashlib
import json
import os
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, NamedTuple

from selfcorrect import exr, files
from selfcorrect.errors import FileError, SelfcorrectError, out_of_memory
from selfcorrect.exr import channels
from selfcorrect.exr.file import one_line
from selfcorrect.publish import remove_abandoned
from selfcorrect.settings import Settings
from selfcorrect.shot.framerange import fill, has_frame
from selfcorrect.shot.state import State, check_state_target, save_state, state_after
from selfcorrect.stages.core.network import Network

__all__ = ["Done", "Habits", "Job", "Outcome", "Shot", "recipe", "run"]


@dataclass(frozen=True)
class Shot:
    """File names with a place for the frame number, ``####`` or ``%04d``, and the numbers; layers as in a frame.

    Attributes:
        a: half a.
        b: half b.
        output: the corrected frame.
        frames: numbers in the order of the work.
        denoised_a: denoised half a, where the user has it.
        denoised_b: denoised half b.
        denoised: denoised mean of both halves.
        mapping: role → channel.
    """

    a: str
    b: str
    output: str
    frames: Sequence[int]
    denoised_a: str | None = None
    denoised_b: str | None = None
    denoised: str | None = None
    mapping: Mapping[str, str] | None = None

    def sources(self, frame: int) -> files.Sources:
        """The files of one frame.

        Raises:
            SettingsError: a name has no place for the number.
        """
        given = {"denoised_a": self.denoised_a, "denoised_b": self.denoised_b, "denoised": self.denoised}
        names: dict[str, Any] = {role: fill(name, frame) for role, name in given.items() if name is not None}
        return files.Sources(fill(self.a, frame), fill(self.b, frame), **names, mapping=self.mapping)

    def target(self, frame: int) -> str:
        """The output of one frame."""
        return fill(self.output, frame)


@dataclass(frozen=True)
class Habits:
    """How a shot is worked through.

    Attributes:
        settings: of the correction.
        made_by: what else decides the outputs, such as the denoiser's name: goes into the recipe.
        skip_existing: leave out frames whose output is whole and was made by the same recipe.
        cold: no frame starts from the one before.
        warm_start: what the first frame starts from, and a frame whose predecessor was skipped and left no state.
        save_state: file to keep the network in after every frame; with a place for the frame number, one for each.
        fail_fast: end with the first frame that fails.
    """

    settings: Settings
    made_by: Mapping[str, Any]
    skip_existing: bool = False
    cold: bool = False
    warm_start: Network | None = None
    save_state: str | None = None
    fail_fast: bool = False


class Job(NamedTuple):
    """One frame to correct.

    Attributes:
        frame: its number.
        output: the file to write.
        loaded: what was read.
        recipe: to be stored in the output.
        network: what to start from.
        meanwhile: to be called now and then during the work; reports the last frame once it is written.
    """

    frame: int
    output: str
    loaded: files.Loaded
    recipe: str
    network: Network | None
    meanwhile: Callable[[], None]


class Done(NamedTuple):
    """A corrected frame: its network, and what writes it, which is called in another thread and returns a report.

    Stages without the core have no network, and nothing to go on from.
    """

    network: Network | None
    write: Callable[[], Any]


class Outcome(NamedTuple):
    """What became of a frame.

    Attributes:
        frame: its number.
        output: its file.
        kind: what happened.
        reason: of a failure.
        report: what the job's ``write`` returned.
    """

    frame: int
    output: str
    kind: Literal["written", "skipped", "failed"]
    reason: str = ""
    report: Any = None


class _Fetched(NamedTuple):
    recipe: str
    loaded: files.Loaded | None  # None: the output is there


def run(
    shot: Shot,
    habits: Habits,
    work: Callable[[Job], Done],
    report: Callable[[Outcome], None],
    note: Callable[[str], None],
) -> int:
    """Work through a shot.

    While a frame is being computed, the next one is read and the last one written, a thread each; three frames are in
    memory at most.

    Args:
        shot: the files.
        habits: how.
        work: corrects one frame; called in this thread.
        report: told of every frame once it is written, skipped or has failed; called in this thread, in order.
        note: told in one line what a user may want to know, such as why an output was not good enough to skip.

    Returns:
        How many frames failed.

    Raises:
        SelfcorrectError: the shot cannot be begun: a name without a place for the number, an output folder that is
            missing or cannot be written to.
    """
    return _Run(shot, habits, work, report, note).all()


class _Run:
    def __init__(
        self,
        shot: Shot,
        habits: Habits,
        work: Callable[[Job], Done],
        report: Callable[[Outcome], None],
        note: Callable[[str], None],
    ):
        self.shot, self.habits, self.work, self.note, self._tell = shot, habits, work, note, report
        self.failed = 0
        self._writing: deque[tuple[int, Future[Any]]] = deque()
        self._network = habits.warm_start
        self._skipped: tuple[int, str] | None = None  # the predecessor and its recipe, where it was skipped

    def all(self) -> int:
        self._check()
        with ThreadPoolExecutor(1, "read ahead") as reader, ThreadPoolExecutor(1, "write behind") as writer:
            frames = iter(self.shot.frames)
            ahead = self._ahead(reader, frames)
            while ahead is not None and not self._ended:
                frame, fetched = ahead
                try:
                    there = fetched.result()
                except Exception as error:
                    ahead = self._ahead(reader, frames)
                    self._fail(frame, error)
                    continue
                ahead = self._ahead(reader, frames)
                self._one(frame, there, writer)
                del fetched, there  # one frame less in memory while the next one is awaited
            self._flush()
            if ahead is not None:
                ahead[1].cancel()
        return self.failed

    @property
    def _ended(self) -> bool:
        return self.habits.fail_fast and self.failed > 0

    def _check(self) -> None:
        for frame in self.shot.frames[:1]:
            self._check_apart(self.shot.sources(frame), self.shot.target(frame))
            remove_abandoned(exr.check_target(self.shot.target(frame)).parent)
            if self.habits.save_state is not None:
                remove_abandoned(check_state_target(self._state_file(frame)).parent)

    def _check_apart(self, sources: files.Sources, output: str) -> None:
        """An output in place of an input would be corrected once more by the run that resumes this one."""
        given = (sources.a, sources.b, sources.denoised_a, sources.denoised_b, sources.denoised)
        for path in given:
            if path is not None and os.path.realpath(path.partition("::")[0]) == os.path.realpath(output):
                raise FileError(f"{output}: expected an output apart from the inputs, but got one of them")

    def _ahead(self, reader: ThreadPoolExecutor, frames: Any) -> tuple[int, "Future[_Fetched]"] | None:
        frame = next(frames, None)
        return None if frame is None else (frame, reader.submit(self._fetch, frame))

    def _fetch(self, frame: int) -> _Fetched:
        """In the reader's thread."""
        sources, output = self.shot.sources(frame), self.shot.target(frame)
        made = recipe(sources, self.habits)
        if self.habits.skip_existing and Path(output).exists():
            reason = _unlike(output, made)
            if not reason:
                return _Fetched(made, None)
            self.note(f"frame {frame}: {reason}; it is made again")
        exr.check_target(output)
        return _Fetched(made, files.load(sources))

    def _one(self, frame: int, fetched: _Fetched, writer: ThreadPoolExecutor) -> None:
        output = self.shot.target(frame)
        if fetched.loaded is None:
            self._skipped = frame, fetched.recipe
            self._flush()
            self._report(Outcome(frame, output, "skipped"))
            return
        network = self._start(frame)
        try:
            done = self.work(
                Job(frame, output, fetched.loaded, fetched.recipe, network, lambda: self._flush(wait=False))
            )
        except Exception as error:
            self._fail(frame, error)
            return
        if not self.habits.cold:
            self._network = done.network
        self._flush()
        self._writing.append((frame, writer.submit(self._write, frame, fetched.recipe, done)))

    def _start(self, frame: int) -> Network | None:
        """The network that a frame starts from."""
        if self._skipped is not None and not self.habits.cold:
            before, made = self._skipped
            state = state_after(self._state_file(before), before, made) if self.habits.save_state else None
            self._network = state.network if state else self.habits.warm_start
            how = "goes on from its state" if state else "left no state: this frame does not go on from it"
            self.note(f"frame {frame}: frame {before} was there and {how}")
        self._skipped = None
        return self._network

    def _write(self, frame: int, made: str, done: Done) -> Any:
        """In the writer's thread. The state comes first: there is no output whose successor could not go on from it.

        But a state that cannot be written loses no image: the frame is written and then reported as failed.
        """
        problem = None
        if self.habits.save_state is not None and done.network is not None:
            try:
                save_state(self._state_file(frame), State(done.network, frame, made), self.habits.settings)
            except (OSError, SelfcorrectError) as error:
                problem = error
        report = done.write()
        if problem is not None:
            raise FileError(f"{problem}; the image {self.shot.target(frame)} is written")
        return report

    def _state_file(self, frame: int) -> str:
        pattern = str(self.habits.save_state)
        return fill(pattern, frame) if has_frame(pattern) else pattern

    def _flush(self, *, wait: bool = True) -> None:
        """Report what was written; wait for what is being written, or leave it for later."""
        while self._writing and (wait or self._writing[0][1].done()):
            frame, future = self._writing.popleft()
            try:
                self._report(Outcome(frame, self.shot.target(frame), "written", report=future.result()))
            except Exception as error:
                self._fail(frame, error)

    def _fail(self, frame: int, error: Exception) -> None:
        """Whatever one frame's files make fail ends this frame alone."""
        self._flush()
        self._report(Outcome(frame, self.shot.target(frame), "failed", self._reason(frame, error)))

    def _reason(self, frame: int, error: Exception) -> str:
        if isinstance(error, SelfcorrectError):
            return str(error)
        sources = self.shot.sources(frame)
        got = "too little memory" if out_of_memory(error) else f"{type(error).__name__}: {one_line(error)}"
        return f"{sources.a}, {sources.b}: expected files that can be worked on, but got {got}"

    def _report(self, outcome: Outcome) -> None:
        self.failed += outcome.kind == "failed"
        self._tell(outcome)


def recipe(sources: files.Sources, habits: Habits) -> str:
    """What an output is made by, as a digest: version, settings, denoiser, layers, and the bytes of every input.

    Where the chain began is no part of it: the same frame may start cold in one chunk and warm in another.

    Raises:
        FileError: an input cannot be read.
    """
    given = (sources.a, sources.b, sources.denoised_a, sources.denoised_b, sources.denoised)
    parts = [path.partition("::") for path in given if path]
    beside = [
        str(path) for half in (sources.a, sources.b) for path in channels.siblings(half.partition("::")[0]).values()
    ]
    contents = [_digest(path) for path in (*(path for path, _, _ in parts), *sorted(beside), *habits.settings.files)]
    how = {
        "version": version("selfcorrect"),
        "settings": habits.settings.to_dict(),
        "cold": habits.cold,
        "made by": dict(habits.made_by),
        "layers": [layer for _, _, layer in parts],
        "given": [bool(path) for path in given],
        "mapping": dict(sources.mapping or {}),
        "contents": contents,
    }
    return hashlib.blake2b(json.dumps(how, sort_keys=True).encode(), digest_size=16).hexdigest()


def _digest(path: str) -> str:
    try:
        with open(path, "rb") as stream:
            return hashlib.file_digest(stream, "blake2b").hexdigest()
    except OSError as error:
        raise FileError(f"{path}: expected an OpenEXR file, but got: {error.strerror}") from None


def _unlike(output: str, made: str) -> str:
    """Why an output that is there is not the one that this recipe makes; empty where it is."""
    try:
        header = exr.read(output).parts[0].header
    except FileError as error:
        return str(error)
    try:
        run = json.loads(header.get("selfcorrect/run", ""))
    except (ValueError, TypeError, RecursionError):  # no JSON, an attribute of another type, brackets without end
        run = None
    if not isinstance(run, dict) or "recipe" not in run:
        return f"{output}: expected an output of selfcorrect sequence, but got another file"
    if run["recipe"] != made:
        return f"{output}: expected an output of these inputs and settings, but got one of others"
    return ""
