"""From the files of a shot to its files: read ahead, written behind, skipped where done, gone on where one fails.

The one state is on disk: an output is there under its name only when it is whole (:mod:`selfcorrect.publish`), and
its attribute ``selfcorrect/run`` carries the recipe it was made by. So a run that was killed is resumed by running it
again, and two runs on the same shot do no more harm than to do the work twice.
"""

import os
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from selfcorrect import exr, files
from selfcorrect.errors import FileError, SelfcorrectError, one_line, out_of_memory
from selfcorrect.publish import remove_abandoned
from selfcorrect.settings import ALL_LAYERS, Settings
from selfcorrect.shot.chain import Chain, Link
from selfcorrect.shot.framerange import fill, has_frame
from selfcorrect.shot.recipe import Digests, recipe, unlike
from selfcorrect.shot.state import State, check_state_target, save_state, state_after
from selfcorrect.stages.core.network import Network

__all__ = ["Done", "Job", "Options", "Outcome", "Shot", "run"]


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
        denoised_full: denoised mean of both halves.
        mapping: role → channel.
        aovs: which AOVs are corrected.
        layers: which view layers are, as for :meth:`selfcorrect.files.Sources.of_layers`.
    """

    a: str
    b: str
    output: str
    frames: Sequence[int]
    denoised_a: str | None = None
    denoised_b: str | None = None
    denoised_full: str | None = None
    mapping: Mapping[str, str] | None = None
    aovs: str | None = None
    layers: str = ALL_LAYERS

    def sources(self, frame: int) -> files.Sources:
        """The files of one frame.

        Raises:
            SettingsError: a name has no place for the number.
        """

        def filled(name: str | None) -> str | None:
            return None if name is None else fill(name, frame)

        return files.Sources(
            a=fill(self.a, frame),
            b=fill(self.b, frame),
            denoised_a=filled(self.denoised_a),
            denoised_b=filled(self.denoised_b),
            denoised_full=filled(self.denoised_full),
            mapping=self.mapping,
            aovs=self.aovs,
        )

    def target(self, frame: int) -> str:
        """The output of one frame."""
        return fill(self.output, frame)


@dataclass(frozen=True)
class Options:
    """How a shot is worked through.

    Attributes:
        settings: of the correction.
        made_by: what else decides the outputs, such as the denoiser's name: goes into the recipe.
        skip_existing: leave out frames whose output is whole and was made by the same recipe.
        cold: no frame starts from the one before.
        warm_start: what the first frame starts from, and any that cannot go on from the one before it
            (:mod:`selfcorrect.shot.chain` has the rule).
        save_state: file to keep the network in after every frame; with a place for the frame number, one for each.
        fail_fast: end with the first frame that fails.
        reach: how many frames on either side the work on a frame looks at, also those beyond ``Shot.frames``.
    """

    settings: Settings
    made_by: Mapping[str, Any]
    skip_existing: bool = False
    cold: bool = False
    warm_start: Network | None = None
    save_state: str | None = None
    fail_fast: bool = False
    reach: int = 0


class Job(NamedTuple):
    """One frame to correct.

    Attributes:
        frame: its number.
        output: the file to write.
        loaded: what was read.
        recipe: to be stored in the output.
        link: what it takes from the frames before.
        meanwhile: to be called now and then during the work; reports the last frame once it is written.
        around: what was read of the frames within reach, by number, the frame itself among them; the same objects from
            job to job.
        missing: why others within reach could not be read; empty of one whose files are not there.
    """

    frame: int
    output: str
    loaded: files.Loaded
    recipe: str
    link: Link
    meanwhile: Callable[[], None]
    around: Mapping[int, files.Loaded]
    missing: Mapping[int, str]


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
    read: dict[int, files.Loaded | Exception] | None  # what was not within reach before; None: the output is there


def run(
    shot: Shot,
    options: Options,
    work: Callable[[Job], Done],
    report: Callable[[Outcome], None],
    note: Callable[[str], None],
) -> int:
    """Work through a shot.

    While a frame is being computed, what the next one needs is read and the last one written, a thread each; three
    frames are in memory at most, and twice the reach.

    Args:
        shot: the files.
        options: how.
        work: corrects one frame; called in this thread.
        report: told of every frame once it is written, skipped or has failed; called in this thread, in order.
        note: told in one line what a user may want to know, such as why an output was not good enough to skip.

    Returns:
        How many frames failed.

    Raises:
        SelfcorrectError: the shot cannot be begun: a name without a place for the number, an output folder that is
            missing or cannot be written to.
    """
    return _Run(shot, options, work, report, note).all()


class _Run:
    def __init__(
        self,
        shot: Shot,
        options: Options,
        work: Callable[[Job], Done],
        report: Callable[[Outcome], None],
        note: Callable[[str], None],
    ):
        self.shot, self.options, self.work, self.note, self._tell = shot, options, work, note, report
        self.failed = 0
        self._writing: deque[tuple[int, Future[Any]]] = deque()
        self._chain = Chain(options.warm_start, cold=options.cold)
        self._skipped: tuple[int, str] | None = None  # the predecessor and its recipe, where it was skipped
        self._around: dict[int, files.Loaded | Exception] = {}  # what is within reach
        self._read: set[int] = set()  # the numbers in it once the reader's last frame is worked on; the reader's own
        self._digests = Digests()  # the reader's own

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
        return self.options.fail_fast and self.failed > 0

    def _check(self) -> None:
        for frame in self.shot.frames[:1]:
            self._check_apart(self.shot.sources(frame), self.shot.target(frame))
            remove_abandoned(exr.check_target(self.shot.target(frame)).parent)
            if self.options.save_state is not None:
                remove_abandoned(check_state_target(self._state_file(frame)).parent)

    def _check_apart(self, sources: files.Sources, output: str) -> None:
        """An output in place of an input would be corrected once more by the run that resumes this one."""
        for path in sources.inputs:
            if path is not None and os.path.realpath(path.partition("::")[0]) == os.path.realpath(output):
                raise FileError(f"{output}: expected an output apart from the inputs, but got one of them")

    def _ahead(self, reader: ThreadPoolExecutor, frames: Any) -> tuple[int, "Future[_Fetched]"] | None:
        frame = next(frames, None)
        return None if frame is None else (frame, reader.submit(self._fetch, frame))

    def _fetch(self, frame: int) -> _Fetched:
        """In the reader's thread."""
        sources, output = self.shot.sources(frame), self.shot.target(frame)
        around = [n for distance in range(1, self.options.reach + 1) for n in (frame - distance, frame + distance)]
        around = [n for n in around if n >= 0]
        made = recipe(
            sources,
            self.options.settings,
            self.options.made_by,
            cold=self.options.cold,
            around=[*map(self.shot.sources, around)],
            digests=self._digests,
        )
        if self.options.skip_existing and Path(output).exists():
            reason = unlike(output, made)
            if not reason:
                return _Fetched(made, None)
            self.note(f"frame {frame}: {reason}; it is made again")
        exr.check_target(output)
        read = {n: self._load(n) for n in (frame, *around) if n not in self._read}
        self._read = {frame, *around}
        return _Fetched(made, read)

    def _load(self, frame: int) -> files.Loaded | Exception:
        """In the reader's thread. What is wrong with a file is for the frames that need it to tell."""
        try:
            return files.load_all(self.shot.sources(frame), self.shot.layers, shot=self.options.reach > 0)
        except Exception as error:
            return error

    def _one(self, frame: int, fetched: _Fetched, writer: ThreadPoolExecutor) -> None:
        output = self.shot.target(frame)
        if fetched.read is None:
            self._skipped = frame, fetched.recipe
            self._flush()
            self._report(Outcome(frame, output, "skipped"))
            return
        self._around = {n: r for n, r in self._around.items() if abs(n - frame) <= self.options.reach} | fetched.read
        fetched.read.clear()
        loaded = self._around[frame]
        if isinstance(loaded, Exception):
            self._fail(frame, loaded)
            return
        try:
            done = self.work(self._job(frame, output, loaded, fetched.recipe))
        except Exception as error:
            self._fail(frame, error)
            return
        self._chain.corrected(done.network)
        self._flush()
        self._writing.append((frame, writer.submit(self._write, frame, fetched.recipe, done)))

    def _job(self, frame: int, output: str, loaded: files.Loaded, made: str) -> Job:
        link = self._link(loaded)
        for note in link.notes:
            self.note(f"frame {frame}: {note}")
        around = {n: read for n, read in self._around.items() if isinstance(read, files.Loaded)}
        missing = {
            n: self._reason(n, read) if self._exists(n) else ""
            for n, read in self._around.items()
            if isinstance(read, Exception)
        }
        if not self.options.reach:
            self._around.clear()  # nothing holds the frame longer than the work on it
        return Job(frame, output, loaded, made, link, lambda: self._flush(wait=False), around, missing)

    def _exists(self, frame: int) -> bool:
        return any(os.path.exists(path.partition("::")[0]) for path in self.shot.sources(frame).paths)

    def _link(self, loaded: files.Loaded) -> Link:
        """What a frame takes from those before it."""
        if self._skipped is not None:  # the last one of several: only its state needs to be read
            before, made = self._skipped
            reads = self.options.save_state is not None and not self.options.cold
            state = state_after(self._state_file(before), before, made) if reads else None
            self._chain.left_out(f"frame {before}", state.network if state else None)
            self._skipped = None
        return self._chain.link(loaded.frame)

    def _write(self, frame: int, made: str, done: Done) -> Any:
        """In the writer's thread. The state comes first: there is no output whose successor could not go on from it.

        But a state that cannot be written loses no image: the frame is written and then reported as failed.
        """
        problem = None
        if self.options.save_state is not None and done.network is not None:
            try:
                save_state(self._state_file(frame), State(done.network, frame, made), self.options.settings)
            except (OSError, SelfcorrectError) as error:
                problem = error
        report = done.write()
        if problem is not None:
            raise FileError(f"{problem}; the image {self.shot.target(frame)} is written")
        return report

    def _state_file(self, frame: int) -> str:
        pattern = str(self.options.save_state)
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
