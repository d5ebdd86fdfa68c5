"""A training step recorded once as a CUDA graph and replayed: the host then starts a few things a step, not a hundred.

A graph repeats what it has recorded on the same memory. So what changes from step to step, where the patches lie and
the learning rate, is written into tensors that stay, and nothing in the step may depend on a value that the host knows.
"""

from collections.abc import Callable, Sequence
from typing import Protocol

import torch
from torch import Tensor

from selfcorrect.errors import DeviceError
from selfcorrect.kernel.cross_bilateral import Window, check_reach
from selfcorrect.kernel.device import on_device
from selfcorrect.kernel.guides import Guides
from selfcorrect.settings import Settings

__all__ = ["CudaGraph", "Graph", "Replayed", "Step"]

Step = Callable[[Sequence[Tensor], Tensor, Tensor], Tensor]
"""From patches of half a, then of half b, their corners and the learning rate to Eq. 8 before the step."""

_WARM_UP = 3  # steps taken as they are, in which kernels are compiled and libraries find their memory


class Graph(Protocol):
    """What records and replays."""

    def run(self, function: Callable[[], Tensor]) -> Tensor:
        """The function's result, where it is recorded later."""
        ...

    def record(self, function: Callable[[], Tensor]) -> Tensor:
        """What will hold the function's result after each :meth:`replay`; it is not run yet."""
        ...

    def replay(self) -> None:
        """Run what was recorded."""
        ...


class CudaGraph:
    """CUDA's own. Never tried: no GPU was at hand."""

    def __init__(self, device: torch.device):
        self._device, self._stream = device, torch.cuda.Stream(device)
        self._graph = torch.cuda.CUDAGraph()

    def run(self, function: Callable[[], Tensor]) -> Tensor:
        """On the stream that is recorded later, as autograd remembers streams."""
        usual = torch.cuda.current_stream(self._device)
        self._stream.wait_stream(usual)
        with torch.cuda.stream(self._stream):
            result = function()
        usual.wait_stream(self._stream)
        return result

    def record(self, function: Callable[[], Tensor]) -> Tensor:
        """As of :class:`Graph`; other threads may go on, but for what they do on the device.

        Raises:
            DeviceError: the function does what a graph cannot hold.
        """
        try:
            with torch.cuda.graph(self._graph, stream=self._stream, capture_error_mode="thread_local"):
                return function()
        except torch.cuda.OutOfMemoryError:
            raise
        except RuntimeError as error:
            reason = str(error).partition("\n")[0]
            raise DeviceError(
                f"expected a training step that CUDA can record, but got: {reason}; leave out --cuda-graph"
            ) from error

    def replay(self) -> None:
        """On the current stream, after what was written into the step's inputs there."""
        self._graph.replay()


class Replayed:
    """The step of a batch of a fixed number of patches.

    Args:
        step: to be repeated; it changes what it trains in place.
        guides: of both halves.
        settings: ``batch``, ``patch`` and what makes the window.
        graph: records and replays.
    """

    def __init__(self, step: Step, guides: tuple[Guides, Guides], settings: Settings, graph: Graph):
        self._step, self._guides, self._graph = step, guides, graph
        self._window, self._device = Window.of(settings), guides[0].planes.device
        self._corners = torch.zeros(settings.batch, 2, dtype=torch.int64, device=self._device)
        self._rate = torch.zeros((), dtype=torch.float64, device=self._device)
        self._side = torch.arange(settings.patch, device=self._device)
        self._warm, self._loss = 0, torch.empty(0)

    def __call__(self, corners: Tensor, rate: float) -> Tensor:
        """Eq. 8 before the step; ``corners`` are on the CPU, of as many patches as a batch has or fewer."""
        side = len(self._side)
        check_reach(self._guides[0], corners, (side, side), self._window)
        there = on_device(corners, self._device)
        self._rate.fill_(rate)
        if len(corners) < len(self._corners):  # the last of an epoch
            return self._graph.run(lambda: self._once(there))
        self._corners.copy_(there)
        if self._warm < _WARM_UP:
            self._warm += 1
            return self._graph.run(lambda: self._once(self._corners))
        if not self._loss.numel():
            self._loss = self._graph.record(lambda: self._once(self._corners))
        self._graph.replay()
        return self._loss.clone()

    def _once(self, corners: Tensor) -> Tensor:
        patches = [patch for half in self._guides for patch in self._cut(half, corners)]
        return self._step(patches, corners, self._rate)

    def _cut(self, half: Guides, corners: Tensor) -> tuple[Tensor, ...]:
        """As ``half.views``, of corners that the host does not know."""
        rows, columns = (corners[:, i, None] + half.margin + self._side for i in (0, 1))
        return half.planes[:, rows[:, :, None], columns[:, None, :]].unbind(1)
