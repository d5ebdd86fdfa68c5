"""Every error that a user can fix.

::

    SelfcorrectError            the CLI prints it as one line and exits with 2
    ├── FileError               a file that is missing, not EXR, truncated, not writable
    │   └── ChannelError        a file without a channel that is needed
    ├── FrameError              buffers that do not fit together
    ├── SettingsError           an unknown setting, preset, or a value out of range
    ├── DenoiserError           a denoiser that is unknown, does not fit, or failed
    ├── DeviceError             a device that is out of memory, or cannot record a step
    └── MissingPackageError     an optional package; the message carries the command that installs it

A message is one line: «expected X, but got Y», with the file and the channel named, and the fix.
"""

import re
import unicodedata
from importlib import import_module

__all__ = [
    "ChannelError",
    "DenoiserError",
    "DeviceError",
    "FileError",
    "FrameError",
    "MissingKernelsWarning",
    "MissingPackageError",
    "SelfcorrectError",
    "SettingsError",
    "one_line",
    "out_of_memory",
    "packages_of",
    "printable",
]

_NO_MEMORY = re.compile("allocate memory|out of memory|bad_alloc", re.IGNORECASE)


def out_of_memory(error: BaseException) -> bool:
    """Whether an exception says that there was no memory left: Python's, NumPy's, or one of torch's allocators."""
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and bool(_NO_MEMORY.search(str(error))))


def one_line(error: BaseException) -> str:
    """The message of a library's error, without its line breaks."""
    return " ".join(str(error).split()) or type(error).__name__


def packages_of(extra: str) -> list[str]:
    """The packages of one of the project's extras, as pip takes them: that works wherever selfcorrect came from."""
    lines = [line.partition(";") for line in import_module("importlib.metadata").requires("selfcorrect") or ()]
    return [package.strip() for package, _, marker in lines if re.search(rf"""extra == ['"]{extra}['"]""", marker)]


def printable(text: str) -> str:
    r"""Text for a log: what a file put into it moves no cursor and begins no line of its own.

    Control characters, line separators and characters that turn the direction of writing are escaped, as is what is
    not Unicode; line breaks are left to the caller.

    >>> printable("a channel called \x1b[31mred"), printable("µ → ±")
    ('a channel called \\x1b[31mred', 'µ → ±')
    """
    return "".join(
        character
        if unicodedata.category(character) not in ("Cc", "Cf", "Cs", "Zl", "Zp")
        else character.encode("unicode_escape", "surrogatepass").decode("ascii")
        for character in text
    )


class SelfcorrectError(Exception):
    """Base of all errors that selfcorrect raises for input that a user can fix."""


class FileError(SelfcorrectError):
    """A file is missing, is not an EXR, is truncated, or cannot be written."""


class ChannelError(FileError):
    """A file lacks a channel that is needed."""


class FrameError(SelfcorrectError):
    """Buffers do not fit together: sizes, channel counts, identical halves."""


class SettingsError(SelfcorrectError):
    """A setting or preset is unknown, or a value is out of its range."""


class DenoiserError(SelfcorrectError):
    """A denoiser is unknown, does not fit its input, or failed."""


class DeviceError(SelfcorrectError):
    """A device cannot hold what it is asked to work on, or not do it in the way that is asked for."""


class MissingPackageError(SelfcorrectError):
    """An optional package is not installed."""

    def __init__(self, purpose: str, extra: str):
        packages = " ".join(f"'{package}'" for package in packages_of(extra))
        super().__init__(f"{purpose} needs a package that is not installed; run: pip install {packages}")


class MissingKernelsWarning(UserWarning):
    """The compiled kernels are not installed: the reference in plain torch runs instead, which is much slower."""
