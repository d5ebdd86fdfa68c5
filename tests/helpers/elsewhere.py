"""A device that is none: tensors of the CPU in disguise, which refuse what a device of its own would refuse.

They say that they are on torch's ``meta`` device, have values all the same, and are computed with on the CPU. What
mixes them with tensors of the CPU raises, as it would on CUDA, and whatever makes the host wait for a value is
counted. A mock: it shows what is where, not that a device computes the right thing.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_map_only

ELSEWHERE = torch.device("meta")

_COPIES = ("aten::_to_copy", "aten::copy_")
_WAITS = ("aten::_local_scalar_dense", "aten::equal", "aten::is_nonzero", "aten::nonzero", "aten::masked_select")


class Elsewhere(Tensor):
    """A tensor in disguise, of one on the CPU."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> "Elsewhere":
        disguised: Elsewhere = Tensor._make_wrapper_subclass(
            cls,
            inner.shape,
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            device=ELSEWHERE,
        )
        disguised.inner = inner
        return disguised

    def tolist(self) -> Any:
        """By way of the CPU: torch refuses it to classes that are not its own."""
        return self.cpu().tolist()

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise AssertionError(f"{func} outside the disguise")


class _Disguise(TorchDispatchMode):
    def __init__(self) -> None:
        super().__init__()
        self.waits = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        name = func.overloadpacket._qualified_op_name
        found: list[Tensor] = []
        tree_map_only(Tensor, found.append, (args, kwargs))
        disguised = [tensor for tensor in found if isinstance(tensor, Elsewhere)]
        wanted = kwargs.get("device")
        if wanted is not None:
            kwargs["device"] = torch.device("cpu")
        if disguised and name not in _COPIES:
            here = [tensor for tensor in found if not isinstance(tensor, Elsewhere) and tensor.ndim]
            assert not here, f"{name} of {[tuple(t.shape) for t in here]} on the CPU and of tensors elsewhere"
        there = wanted == ELSEWHERE if wanted is not None else bool(disguised)
        if name == "aten::copy_":
            there = isinstance(args[0], Elsewhere)
        self.waits += bool(disguised) and (name in _WAITS or not there)
        worn = {id(tensor.inner): tensor for tensor in disguised}
        args, kwargs = tree_map_only(Elsewhere, lambda tensor: tensor.inner, (args, kwargs))
        result = func(*args, **kwargs)

        def disguise(tensor: Tensor) -> Tensor:
            return worn[id(tensor)] if id(tensor) in worn else Elsewhere(tensor)

        return tree_map_only(Tensor, disguise, result) if there else result


@contextmanager
def elsewhere() -> Iterator[Callable[[], int]]:
    """While this is entered, ``tensor.to(ELSEWHERE)`` is in disguise; gives how often the host has waited so far."""
    disguise = _Disguise()
    with disguise:
        yield lambda: disguise.waits
