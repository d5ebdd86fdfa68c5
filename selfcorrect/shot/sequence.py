"""The frames of a shot one after the other, each from the last one's network. No files."""

from collections.abc import Iterable, Iterator

from selfcorrect.buffers import TERMS
from selfcorrect.correct import Result, correct
from selfcorrect.frame import Frame
from selfcorrect.settings import Settings
from selfcorrect.stages.core.network import Network, buffer_names
from selfcorrect.stages.core.train import Progress

__all__ = ["correct_sequence", "follows"]


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
        warm_start: the network that the first frame starts from.
        cold: no frame starts from the one before; each starts from ``warm_start``, or from nothing.
        progress: called as ``progress(step, steps, loss)`` after every optimiser step of every frame.

    Yields:
        What :func:`selfcorrect.correct` gives for each frame. A result depends on the frames since the last one that
        started cold, ``result.start.warm`` being False, and on nothing before.

    Raises:
        FrameError: a frame has no denoised halves, or ``warm_start`` was trained with other buffers or settings.

    Source:
        Back et al. 2022, Table 3, for the warm start; the choice between warm and cold is this project's.
    """
    last: Network | None = None
    for frame in frames:
        start = last if last is not None and follows(last, frame) else warm_start
        result = correct(frame, settings, warm_start=start, progress=progress)
        if not cold:
            last = result.network
        yield result


def follows(network: Network, frame: Frame) -> bool:
    """Whether the frame has the buffers of the one that the network was trained on."""
    there = (term for term in TERMS if term.kind == "radiance" or getattr(frame, term.name) is not None)
    return network.traits.buffers == buffer_names(there)
