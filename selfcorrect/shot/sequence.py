"""The frames of a shot one after the other, each from the last one's network and its neighbours. No files."""

import itertools
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from selfcorrect import stages
from selfcorrect.correct import Result, correct
from selfcorrect.frame import Frame
from selfcorrect.history import Histories, available
from selfcorrect.settings import Settings
from selfcorrect.shot.chain import Chain
from selfcorrect.stages.core.network import Network
from selfcorrect.stages.core.train import Progress

__all__ = ["correct_sequence"]


def correct_sequence(
    frames: Iterable[Frame],
    settings: Settings | None = None,
    *,
    warm_start: Network | None = None,
    cold: bool = False,
    radius: int | None = None,
    denoiser: Callable[..., Any] | None = None,
    progress: Progress | None = None,
) -> Iterator[Result]:
    """Correct the frames of a shot, one at a time, in constant memory: as many are held as are within reach.

    Args:
        frames: denoised frames in their order; an iterator may read each when it is asked for.
        settings: by default the default preset; frames that start warm take its ``warm_steps``.
        warm_start: the network that the first frame starts from, and later ones that cannot go on from the last one
            because they have other buffers (:mod:`selfcorrect.shot.chain` has the rule).
        cold: no frame starts from the one before; each starts from ``warm_start``, or from nothing.
        radius: how many frames on either side give their samples; by default what the settings say, ``frame_radius``,
            where optical flow is installed, and none where it is not.
        denoiser: what denoised the frames, to denoise gathered samples (:class:`selfcorrect.history.Histories`);
            without one the neighbours give less.
        progress: called as ``progress(step, steps, loss)`` after every optimiser step of every frame.

    Yields:
        What :func:`selfcorrect.correct` gives for each frame. A result depends on the frames since the last one that
        started cold, ``result.start.warm`` being False, and on those within reach: ``radius``, with a denoiser one
        more.

    Raises:
        FrameError: a frame has no denoised halves, or ``warm_start`` was trained with other settings, or with other
            buffers than the first frame's.
        MissingPackageError: there is no optical flow; ``radius=0`` does without.
        FileError: the weights of a trained stage are not there or do not fit.
        SettingsError: a stage stands where it cannot.

    Source:
        Back et al. 2022, Table 3, for the warm start; the choice between warm and cold is this project's.
    """
    settings = settings or Settings.preset(Settings.default())
    opened, chain = stages.opened(settings), Chain(warm_start, cold=cold)
    if radius is None:
        radius = settings.frame_radius if available() else 0
    for frame in _remembering(frames, Histories(radius if settings.guard else 0, denoiser)):
        start = chain.link(frame).network
        result = correct(frame, settings, warm_start=start, progress=progress, opened=opened)
        chain.corrected(result.network)
        yield result


def _remembering(frames: Iterable[Frame], histories: Histories) -> Iterator[Frame]:
    """Each frame with its history, once those after it that are within reach have come."""
    reach, given, held = histories.reach, iter(frames), dict[int, Frame]()
    if not reach:
        yield from given
        return
    for number in itertools.count():
        while number + reach not in held and (frame := next(given, None)) is not None:
            held[max(held, default=-1) + 1] = frame
        if number not in held:
            return
        held = {n: frame for n, frame in held.items() if n >= number - reach}
        yield histories.of(number, held)[0]
