"""The frames of a shot one after the other, each from the last one's network. No files."""

from collections.abc import Iterable, Iterator

from selfcorrect import stages
from selfcorrect.correct import Result, correct
from selfcorrect.frame import Frame
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
    progress: Progress | None = None,
) -> Iterator[Result]:
    """Correct the frames of a shot, one at a time, in constant memory.

    Args:
        frames: denoised frames in their order; an iterator may read each when it is asked for.
        settings: by default the default preset; frames that start warm take its ``warm_steps``.
        warm_start: the network that the first frame starts from, and later ones that cannot go on from the last one
            because they have other buffers (:mod:`selfcorrect.shot.chain` has the rule).
        cold: no frame starts from the one before; each starts from ``warm_start``, or from nothing.
        progress: called as ``progress(step, steps, loss)`` after every optimiser step of every frame.

    Yields:
        What :func:`selfcorrect.correct` gives for each frame. A result depends on the frames since the last one that
        started cold, ``result.start.warm`` being False, and on nothing before.

    Raises:
        FrameError: a frame has no denoised halves, or ``warm_start`` was trained with other settings, or with other
            buffers than the first frame's.
        FileError: the weights of a trained stage are not there or do not fit.
        SettingsError: a stage stands where it cannot.

    Source:
        Back et al. 2022, Table 3, for the warm start; the choice between warm and cold is this project's.
    """
    settings = settings or Settings.preset(Settings.default())
    opened, chain = stages.opened(settings), Chain(warm_start, cold=cold)
    for frame in frames:
        start = chain.link(frame).network
        result = correct(frame, settings, warm_start=start, progress=progress, opened=opened)
        chain.corrected(result.network)
        yield result
