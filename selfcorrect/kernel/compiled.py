"""The compiled kernels, or what stands for them where they are not installed, as in a wheel made without a compiler."""

import warnings
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from selfcorrect.errors import MissingKernelsWarning

if TYPE_CHECKING:
    from selfcorrect.kernel import _cpu as functions

__all__ = ["functions", "installed", "missing", "warn_if_missing"]


_FOLDER = Path(__file__).parents[2]


class _Missing:
    """Stands for the extension module; nobody who asks :func:`installed` first gets to it."""

    def __getattr__(self, name: str) -> NoReturn:
        raise ImportError(missing())


def _imported() -> tuple[Any, str]:
    """The extension module, or what stands for it, and why."""
    try:
        return import_module("selfcorrect.kernel._cpu"), ""
    except ImportError as error:
        return _Missing(), str(error)


if TYPE_CHECKING:
    _reason = ""
else:
    functions, _reason = _imported()


def installed() -> bool:
    """Whether the compiled kernels are there."""
    return not _reason


def missing() -> str:
    """What it means where they are not, and what to do, in one line; nothing where they are.

    How much slower the reference is: `scripts/bench/no_compiler.py`.
    """
    if installed():
        return ""
    elsewhere = ""
    if (_FOLDER / "pyproject.toml").is_file():  # Python started there takes it, whatever is installed
        elsewhere = f"Python reads the sources in {_FOLDER}: start it elsewhere if selfcorrect is installed; else "
    return (
        f"the compiled kernels are not installed ({_reason}), and plain torch is about 30 times slower; {elsewhere}"
        "install the wheel for this machine, or a C++ compiler (g++ or clang++) and run in the folder of selfcorrect: "
        "pip install --force-reinstall --no-deps ."
    )


@cache
def warn_if_missing() -> None:
    """Warn where they are not; once in a process, as a shot would be told of it for every frame."""
    if not installed():
        warnings.warn(missing(), MissingKernelsWarning, stacklevel=2)
