"""What a CUDA graph does, on the CPU: a mock of recording and replaying.

Recorded are torch's operations with the very tensors that they were given, and the launches of the kernel for CUDA in
Triton's interpreter. A replay repeats them on the same memory, whatever the host has in mind by then: a number that
the host had known when it was recorded stays as it was. It shows that nothing in what is recorded depends on the host,
not that CUDA would record it.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_leaves

_HOST = ("aten::_local_scalar_dense", "aten::nonzero", "aten::lift_fresh", "aten::equal", "aten::is_nonzero")
"""Operations whose result goes to the host, or whose input comes from there."""


class Tape(TorchDispatchMode):
    """Has the methods of :class:`selfcorrect.stages.core.replay.Graph`.

    Attributes:
        replays: how many there were.
    """

    def __init__(self) -> None:
        super().__init__()
        self.replays = 0
        self._repeat: list[Callable[[], None]] = []
        self._before: list[tuple[Tensor, Tensor]] = []
        self._recording = False

    def run(self, function: Callable[[], Tensor]) -> Tensor:
        return function()

    def record(self, function: Callable[[], Tensor]) -> Tensor:
        """Runs it, as the CPU knows no other way, and undoes what it has changed."""
        self._recording = True
        with self:
            result = function()
        self._recording = False
        with torch.no_grad():
            for tensor, before in reversed(self._before):
                tensor.copy_(before)
        self._before.clear()
        return result

    @torch.no_grad()
    def replay(self) -> None:
        self.replays += 1
        for repeat in self._repeat:
            repeat()

    def launching(self, launch: Callable[..., Tensor]) -> Callable[..., Tensor]:
        """``launch``, recorded where anything is."""

        def launched(*arguments: Any, **named: Any) -> Tensor:
            with _disable_current_modes():
                result = launch(*arguments, **named)
            if self._recording:
                self._repeat.append(lambda: result.copy_(launch(*arguments, **named)))
            return result

        return launched

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        name = func.overloadpacket._qualified_op_name
        assert name not in _HOST, f"{name} while a graph is recorded"
        for argument, value in zip(func._schema.arguments, args, strict=False):
            if argument.alias_info is not None and argument.alias_info.is_write:
                self._before.append((value, value.clone()))
        result = func(*args, **kwargs)

        def repeat() -> None:
            for kept, new in zip(tree_leaves(result), tree_leaves(func(*args, **kwargs)), strict=True):
                if isinstance(kept, Tensor) and kept.data_ptr() != new.data_ptr():  # neither a view nor in place
                    kept.copy_(new)

        self._repeat.append(repeat)
        return result
