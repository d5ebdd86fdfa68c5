"""The command `sequence`: the frames of a shot, from files to files."""

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from selfcorrect import files
from selfcorrect.cli import flags, memory, pages
from selfcorrect.cli.runner import Corrected, Denoised, Runner
from selfcorrect.cli.terminal import answer, log
from selfcorrect.errors import ChannelError, FileError, FrameError, SelfcorrectError
from selfcorrect.settings import Settings
from selfcorrect.shot import run as shot
from selfcorrect.shot.chain import Chain
from selfcorrect.shot.framerange import parse_frames
from selfcorrect.shot.state import load_state
from selfcorrect.stages.core.network import Network

__all__ = ["run"]


def run(options: argparse.Namespace) -> int:
    """Returns how many frames failed."""
    frames = parse_frames(options.frames)
    work = shot.Shot(
        a=options.a,
        b=options.b,
        output=options.output,
        frames=frames,
        **flags.denoised(options),
        mapping=flags.mapping(options),
        aovs=options.aovs,
        layers=options.view_layers,
    )
    page = pages.ShotPage.at(options.report, frames)
    layers = _layers(work, frames)
    scratch = memory.fitted(options, options.maxmem, work.sources(frames[0]), shot=True, layers=layers)
    runner = Runner(options, given=options.denoised_a is not None, scratch=scratch, layers=layers)
    around = _Around(runner)
    further = _Further(runner, cold=options.cold)
    how = shot.Options(
        runner.settings,
        {
            "denoiser": runner.denoiser,
            "diagnostics": options.diagnostics,
            "pass through": options.pass_through,
            "aovs": options.aovs,
            "view layers": options.view_layers,
        },
        skip_existing=options.skip_existing,
        cold=options.cold,
        warm_start=None if options.warm_start is None else _given(options.warm_start, runner.settings),
        save_state=options.save_state,
        fail_fast=options.fail_fast,
        reach=around.reach,
    )

    def one(job: shot.Job) -> shot.Done:
        more = {"frame": job.frame, "recipe": job.recipe}
        gather = None if page is None else page.gather(job.frame)
        corrected = runner.correct(around.denoised(job), job.link.network, job.meanwhile, gather=gather, more=more)
        log(f"frame {job.frame}: {corrected.facts.start_line()}")
        others = further.corrected(job)
        return shot.Done(corrected.network, partial(runner.write, job.output, corrected, others))  # the frame is let go

    def report(outcome: shot.Outcome) -> None:
        further.told(outcome)
        if page is not None:
            page.told(outcome)
        if outcome.kind != "written":
            log(f"frame {outcome.frame}: {outcome.kind}: {outcome.reason or outcome.output}")
        if options.json:
            told = {"output": outcome.output, "reason": outcome.reason}
            if outcome.report is not None:
                told = outcome.report.to_dict()
            try:
                answer({"frame": outcome.frame, "outcome": outcome.kind, **told})
            except FileError as error:  # the frames count, not what is told of them
                log(f"selfcorrect: {error}")

    try:
        failed = shot.run(work, how, one, report, log)
    finally:  # also after Ctrl-C: what is done can be looked at
        if page is not None:
            page.write(options.output, runner.settings, {"preset": options.preset, "denoiser": runner.denoiser})
    if failed:
        log(f"selfcorrect: {failed} of {len(frames)} frames failed")
    return failed


def _layers(work: shot.Shot, frames: Sequence[int]) -> int:
    """How many view layers are corrected of the first frame, like which all are; what is wrong with it, it tells."""
    try:
        layers, lines = work.sources(frames[0]).of_layers(work.layers)
    except (FileError, ChannelError):
        return 1
    log(*lines)
    return len(layers)


class _Around:
    """The frames around the one in work, each denoised once, and what they give to it."""

    def __init__(self, runner: Runner):
        self._runner = runner
        self._histories = runner.histories()
        self._known: dict[int, Denoised | SelfcorrectError] = {}

    @property
    def reach(self) -> int:
        """How many frames on either side are needed."""
        return self._histories.reach

    def denoised(self, job: shot.Job) -> Denoised:
        """The frame of a job, with its history where there is to be one."""
        began = time.perf_counter()
        if not self.reach:
            return self._runner.denoise(job.loaded, began)
        self._known = {n: known for n, known in self._known.items() if n in job.around}
        for n in sorted(job.around.keys() - self._known.keys()):
            self._known[n] = self._denoise(job.around[n])
        mine = self._known[job.frame]
        if isinstance(mine, SelfcorrectError):
            raise mine
        begun = time.perf_counter()
        frames = {n: known.frame for n, known in self._known.items() if isinstance(known, Denoised)}
        frame, history = self._histories.of(job.frame, frames)
        reasons = {n: f"cannot be read ({why})" if why else "is not there" for n, why in job.missing.items()}
        reasons |= {n: f"cannot be used ({why})" for n, why in self._known.items() if isinstance(why, SelfcorrectError)}
        left_out = {n - job.frame: reason for n, reason in sorted(reasons.items())}
        history = history._replace(left_out={**left_out, **history.left_out})
        known = mine.facts.remembered(history, time.perf_counter() - begun)
        return replace(mine, frame=frame, facts=known, began=began)

    def _denoise(self, loaded: files.Loaded) -> "Denoised | SelfcorrectError":
        try:
            return self._runner.denoise(loaded, keep_aids=True)
        except SelfcorrectError as error:
            return error


class _Further:
    """The further view layers of a shot's files, each a shot of its own: neighbours, and networks that are handed on.

    A state on disk is that of the first layer alone: after frames that were left out, the others start cold.
    """

    def __init__(self, runner: Runner, *, cold: bool):
        self._runner = runner
        self._cold = cold
        self._shots: dict[str, tuple[_Around, Chain]] = {}

    def corrected(self, job: shot.Job) -> list[Corrected]:
        """The further layers of a job's frame."""
        found = []
        for loaded in job.loaded.others:
            layer = loaded.layer
            around, chain = self._shots.setdefault(layer, (_Around(self._runner), Chain(cold=self._cold)))
            beside = {n: one for n, read in job.around.items() for one in read.others if one.layer == layer}
            absent = {n: f"no view layer {layer}" for n in job.around.keys() - beside.keys()}
            link = chain.link(loaded.frame)
            own = job._replace(loaded=loaded, link=link, around=beside, missing={**job.missing, **absent})
            corrected = self._runner.correct(around.denoised(own), link.network, job.meanwhile)
            log(f"frame {job.frame}, view layer {layer}: {corrected.facts.start_line()}")
            chain.corrected(corrected.network)
            found.append(corrected)
        return found

    def told(self, outcome: shot.Outcome) -> None:
        """What became of a frame."""
        if outcome.kind == "skipped":
            for _, chain in self._shots.values():
                chain.left_out(f"frame {outcome.frame}", None)


def _given(path: str, settings: Settings) -> Network:
    network = load_state(path).network
    try:
        network.traits.check_settings(settings)
    except FrameError as error:
        raise FrameError(f"{path}: {error}") from None
    return network
