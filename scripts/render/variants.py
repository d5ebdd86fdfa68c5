"""Which of Mitsuba's variants renders on this machine.

Mitsuba takes whichever LLVM library it finds, and ends the process when that one cannot compile a kernel, as LLVM 15
cannot. So a process of its own renders first (`llvm_probe.py`).
"""

import subprocess
import sys
from functools import cache
from pathlib import Path

LLVM, SCALAR = "llvm_ad_rgb", "scalar_rgb"
FIX = "install LLVM 19 (apt-get install libllvm19), or set DRJIT_LIBLLVM_PATH to its libLLVM.so"
_PYTHON_ERROR = 1  # exit code
_TIMEOUT = 300  # seconds; on two cores the first time takes seven, later ones two
_PROBE = Path(__file__).with_name("llvm_probe.py")


class VariantError(Exception):
    """A variant that cannot render here what was asked for; one line."""


@cache
def failure() -> str | None:
    """What keeps the LLVM variants from rendering, on one line; None where nothing does.

    Raises:
        RuntimeError: the probe itself is broken, which says nothing of LLVM.
    """
    try:
        result = subprocess.run(
            [sys.executable, str(_PROBE)], capture_output=True, text=True, check=False, timeout=_TIMEOUT
        )
    except subprocess.TimeoutExpired:
        return f"no image after {_TIMEOUT} s"
    if result.returncode == 0:
        return None
    if result.returncode == _PYTHON_ERROR:
        raise RuntimeError(result.stderr)
    lines = result.stderr.strip().splitlines() or [f"exit code {result.returncode}"]
    return next((line for line in lines if "LLVM ERROR" in line or "too old" in line), lines[-1])


def refusal(purpose: str) -> str:
    """The line for a user whose LLVM does not serve, where :func:`failure` has found one."""
    return f"expected an LLVM library for {purpose}, but got none that renders ({failure()}); {FIX}"


def chosen(wanted: str | None, *, sampler: bool = False) -> str:
    """The variant to render with: the wanted one, or else LLVM where it renders and scalar where it does not.

    Args:
        wanted: by the user; None leaves the choice.
        sampler: common random numbers will be asked for, which need LLVM.

    Raises:
        VariantError: it needs an LLVM library, and there is none that renders.
    """
    if sampler and not (wanted or LLVM).startswith("llvm"):
        raise VariantError(f"expected an LLVM variant with common random numbers, but got {wanted}")
    if not (wanted or LLVM).startswith("llvm") or failure() is None:
        return wanted or LLVM
    if sampler or wanted:
        raise VariantError(refusal("common random numbers" if sampler else wanted or LLVM))
    print(f"{refusal('a faster render')}; rendering with {SCALAR}", file=sys.stderr, flush=True)
    return SCALAR
