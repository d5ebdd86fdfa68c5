"""Ctrl-C while the command is still importing: it ends at once, quietly.

The imports take seconds, and an exception in the middle of them is a traceback, or, inside a library that is half
initialised, anything. So as long as nothing has been done, the first interrupt ends the process. Whoever imports the
package as a library keeps the signals that they have.
"""

import os
import signal
import sys
from pathlib import PurePath
from typing import NoReturn

__all__ = ["begin", "begun"]

_INTERRUPTED = 130  # 128 + SIGINT, what shells give


def begin() -> None:
    """From now on Ctrl-C ends the process, if it is the command; called before anything large is imported."""
    if _is_command() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


def begun() -> None:
    """From now on Ctrl-C is an exception again; the command catches it."""
    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _is_command() -> bool:
    """Whether this process was started as ``selfcorrect`` or as ``python -m selfcorrect``."""
    if sys.argv[:1] == ["-m"]:  # Python looks for the module
        return "selfcorrect" in sys.orig_argv
    return PurePath(sys.argv[0] if sys.argv else "").stem == "selfcorrect"


def _end(*_: object) -> NoReturn:
    os._exit(_INTERRUPTED)
