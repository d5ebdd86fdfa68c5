"""Which form of a kernel runs: the one question about the device, asked at every call.

Every kernel's folder has its forms beside one another, one signature: ``reference.py``, plain torch, ``cpu.py``,
compiled, and where there is one ``gpu.py``, for CUDA. Its ``__init__.py`` validates, asks :func:`choose`, and calls
that form.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from selfcorrect.errors import SettingsError
from selfcorrect.kernel.compiled import functions, installed, missing

__all__ = ["BACKENDS", "choose", "instruction_set", "instruction_sets"]

BACKENDS = ("cpu", "gpu", "reference")


def choose(
    backend: str | None,
    tensors: Sequence[Tensor],
    *,
    dtypes: Sequence[torch.dtype] = (torch.float32,),
    fits: bool = True,
    limit: str = "",
    gpu: bool = False,
) -> str:
    """The name of the form that these tensors are computed with.

    Args:
        backend: one of :data:`BACKENDS`; by default the compiled form where it can compute this, else the reference.
            "gpu" asked for on the CPU is Triton's interpreter, for tests, or an error of Triton's.
        tensors: what is computed with.
        dtypes: that the compiled form takes, or turns into float32 itself.
        fits: whether the compiled form can compute it as far as the kernel itself is concerned.
        limit: what that asks for, in words.
        gpu: whether there is a form for CUDA; it takes float32.

    Raises:
        SettingsError: there is no such form, or it cannot compute with these tensors.
    """
    kinds = sorted({f"{tensor.dtype} on {tensor.device.type}".removeprefix("torch.") for tensor in tensors})
    compiled = fits and all(tensor.device.type == "cpu" and tensor.dtype in dtypes for tensor in tensors)
    compiled = compiled and installed()
    if backend is None:
        return "cpu" if compiled else "gpu" if gpu and _on_cuda(tensors) else "reference"
    offered = [name for name in BACKENDS if gpu or name != "gpu"]
    if backend not in offered:
        raise SettingsError(f"expected a backend out of {', '.join(offered)}, but got {backend!r}")
    if backend == "cpu" and not installed():
        raise SettingsError(f"expected the compiled kernels for the backend cpu, but got none: {missing()}")
    if backend == "cpu" and not compiled:
        taken = " or ".join(str(dtype).removeprefix("torch.") for dtype in dtypes)
        wanted = f"{taken} on cpu" + (f" and {limit}" if limit else "")
        got = ", ".join(kinds) + ("" if fits else " and more")
        raise SettingsError(f"expected {wanted} for the backend cpu, but got {got}; leave the backend to be chosen")
    return backend


def _on_cuda(tensors: Sequence[Tensor]) -> bool:
    """ROCm calls itself cuda too; what is compiled for it has never been looked at."""
    on_device = all(tensor.device.type == "cuda" and tensor.dtype == torch.float32 for tensor in tensors)
    return on_device and torch.version.hip is None


def instruction_sets() -> list[str]:
    """Names of the compiled variants that this processor can run, slowest first; none where they are not installed."""
    return list(functions.instruction_sets()) if installed() else []


def instruction_set(name: str, known: Sequence[str] = ()) -> str:
    """The variant of this name, or the fastest for an empty one.

    Args:
        name: of the variant, or empty.
        known: the variants of a kernel that has more than :func:`instruction_sets`, slowest first.

    Raises:
        SettingsError: this processor cannot run it.
    """
    known = known or instruction_sets()
    if name and name not in known:
        raise SettingsError(f"expected an instruction set out of {', '.join(known)} (this processor's), but got {name}")
    return name or known[-1]
