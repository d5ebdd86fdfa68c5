"""Every error that a user can fix.

::

    SelfcorrectError            the CLI prints it as one line and exits with 2
    ├── FileError               a file that is missing, not EXR, truncated, not writable
    │   └── ChannelError        a file without a channel that is needed
    ├── FrameError              buffers that do not fit together
    ├── SettingsError           an unknown setting, preset, or a value out of range
    ├── DenoiserError           a denoiser that is unknown, does not fit, or failed
    ├── DeviceError             a device that is out of memory
    └── MissingPackageError     an optional package; the message carries the command that installs it

A message is one line: «expected X, but got Y», with the file and the channel named, and the fix.
"""

__all__ = [
    "ChannelError",
    "DenoiserError",
    "DeviceError",
    "FileError",
    "FrameError",
    "MissingPackageError",
    "SelfcorrectError",
    "SettingsError",
]


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
    """A device cannot hold what it is asked to work on."""


class MissingPackageError(SelfcorrectError):
    """An optional package is not installed."""

    def __init__(self, purpose: str, extra: str):
        super().__init__(f"{purpose} needs a package that is not installed; run: pip install 'selfcorrect[{extra}]'")
