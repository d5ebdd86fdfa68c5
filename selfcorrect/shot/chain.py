"""What a frame of a shot takes from those before it: one rule, for the API and for the command.

A frame starts from the first of these networks that there is and that has seen the same buffers:

1. that of the last frame that was corrected, unless every frame is to start without it (``cold``); where frames were
   left out since, because their output was there, it is that of the last one of those, from its state on disk;
2. the warm start that the user gave;

and cold where there is none. So where buffers change in mid-shot, as where a renderer leaves out an albedo that is the
same everywhere, a frame never fails for it. Only a warm start that does not fit where the shot begins is an error, as
it is for a single frame: the user named the wrong file.

Whether a network that fits is also the better start, which it is not after a cut, is for the frame itself to show:
:func:`selfcorrect.correct` decides it by Eq. 8. Whatever else a frame takes from its neighbours belongs in
:class:`Link`.
"""

from typing import NamedTuple

from selfcorrect.buffers import TERMS
from selfcorrect.frame import Frame
from selfcorrect.stages.core.network import Network, buffer_names

__all__ = ["Chain", "Link", "fits"]


class Link(NamedTuple):
    """What a frame takes from those before it.

    Attributes:
        network: to start from; None: cold.
        notes: in a line each, why it is not simply the last frame's.
    """

    network: Network | None
    notes: tuple[str, ...] = ()


class Chain:
    """The frames of one shot, in order: ask :meth:`link` before each, and say what became of it.

    Args:
        warm_start: the network that the user gave.
        cold: no frame starts from the one before.
    """

    def __init__(self, warm_start: Network | None = None, *, cold: bool = False):
        self._given = warm_start
        self._cold = cold
        self._last: Network | None = None
        self._begun = False
        self._note = ""

    def link(self, frame: Frame) -> Link:
        """What this frame takes.

        Where the shot begins, that is the warm start also if it does not fit: :func:`selfcorrect.correct` refuses it.
        """
        if not self._begun:
            return Link(self._given)
        notes = [self._note] if self._note else []
        network, unfit = None, []
        for candidate, whose in ((self._last, "the frame before"), (self._given, "the warm start")):
            if candidate is None:
                continue
            if fits(candidate, frame):
                network = candidate
                break
            unfit.append(whose)
        if unfit:
            how = "starts cold" if network is None else "starts from the warm start"
            notes.append(f"other buffers than {' and '.join(unfit)}: {how}")
        return Link(network, tuple(notes))

    def corrected(self, network: Network | None) -> None:
        """The frame was corrected; ``network`` is what it learned, if its stages learn."""
        self._go_on(network, "")

    def left_out(self, name: str, network: Network | None) -> None:
        """The frame's output was there.

        Args:
            name: what notes call the frame.
            network: that of its state, if it left one.
        """
        how = "left no state: this frame does not go on from it" if network is None else "goes on from its state"
        self._go_on(network, f"{name} was there and {how}")

    def _go_on(self, network: Network | None, note: str) -> None:
        self._begun = True
        if not self._cold:
            self._last, self._note = network, note


def fits(network: Network, frame: Frame) -> bool:
    """Whether the frame has the buffers of the one that the network was trained on."""
    there = (term for term in TERMS if term.kind == "radiance" or getattr(frame, term.name) is not None)
    return network.traits.buffers == buffer_names(there)
