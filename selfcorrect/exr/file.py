"""One OpenEXR file in memory: read, checked, every part, channel and attribute as it is.

The library groups ``R G B`` into one array but not ``X Y Z``, so channels are always read apart. What it
gives is held against the header (:mod:`selfcorrect.exr.header`): where the pixels of a part are damaged it
prints a warning and leaves the part out.
"""

import contextlib
import io
import mmap
import os
import stat
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from selfcorrect.errors import ChannelError, FileError, one_line
from selfcorrect.exr import channels, header
from selfcorrect.exr.header import Attribute, Window
from selfcorrect.output import OUTPUT

__all__ = [
    "LIBRARY_ERRORS",
    "OUTPUT",
    "ExrFile",
    "Part",
    "Pixels",
    "float_type",
    "headers",
    "one_line",
    "quiet",
    "read",
]

Pixels = NDArray[Any]

LIBRARY_ERRORS = (RuntimeError, ValueError, TypeError, LookupError, ArithmeticError, AttributeError, MemoryError)
"""What the OpenEXR library raises for a file or an image that it refuses."""


@dataclass(frozen=True, eq=False)
class Part:
    """One part of a file.

    Attributes:
        name: its name; empty in most single-part files.
        header: attribute name → value, as the OpenEXR library gives it.
        attributes: attribute name → type and bytes, as the file has them.
        channels: channel name → (height, width) array, read-only, of type float16, float32 or uint32.
        linear: the channels that are marked as perceptually linear, a hint to lossy compression.
        data_window: the pixels that are stored.
        display_window: the pixels of the picture.
    """

    name: str
    header: Mapping[str, Any]
    attributes: Mapping[str, Attribute]
    channels: dict[str, Pixels]
    linear: frozenset[str]
    data_window: Window
    display_window: Window


@dataclass(frozen=True, eq=False)
class ExrFile:
    """A file that was read.

    Attributes:
        path: the file, without the layer.
        layer: the layer that the user named, or None.
        parts: its parts, one or more.
    """

    path: str
    layer: str | None
    parts: tuple[Part, ...]

    @cached_property
    def _places(self) -> dict[str, tuple[int, str]]:
        views = header.views(self.parts[0].attributes)
        full = channels.full_names([(part.name, list(part.channels)) for part in self.parts], views)
        return {
            name: (index, channel)
            for index, (part, names) in enumerate(zip(self.parts, full, strict=True))
            for name, channel in zip(names, part.channels, strict=True)
        }

    @property
    def channel_names(self) -> list[str]:
        """Full names (see :func:`selfcorrect.exr.channels.full_names`) in the order of the file."""
        return list(self._places)

    @property
    def data_window(self) -> Window:
        """Data window of the first part."""
        return self.parts[0].data_window

    @property
    def display_window(self) -> Window:
        """Display window, which all parts share."""
        return self.parts[0].display_window

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the first part's data window."""
        return self.data_window.size

    def place(self, name: str) -> tuple[int, str]:
        """Index of the part that holds a channel, and the channel's name in that part.

        Raises:
            ChannelError: there is no such channel.
        """
        if name not in self._places:
            raise ChannelError(f"{self.path}: expected channel '{name}', but got {channels.listed(self.channel_names)}")
        return self._places[name]

    def pixels(self, name: str) -> Pixels:
        """Pixels of a channel by its full name, (height, width), in the type of the file."""
        index, channel = self.place(name)
        return self.parts[index].channels[channel]

    def give_up(self, name: str) -> None:
        """Free the memory of a channel that nobody will read again; its type can still be asked for."""
        index, channel = self.place(name)
        held = self.parts[index].channels
        held[channel] = np.empty((0, 0), held[channel].dtype)


def float_type(file: ExrFile, name: str) -> np.dtype[Any]:
    """The type of a colour channel.

    Raises:
        ChannelError: it holds no floating-point numbers.
    """
    dtype = file.pixels(name).dtype
    if dtype.kind != "f":
        raise ChannelError(f"{file.path}: expected colour channel '{name}' as half or float, but got {dtype}")
    return dtype


def headers(file: str, *, plausible: bool = False) -> tuple[list[header.Header], int]:
    """The headers of all parts of a file, and its size in bytes; no pixel is read.

    Args:
        file: without a layer.
        plausible: also check them as :func:`read` does, against the chunk tables and the file's size.

    Raises:
        FileError: the file is missing or no OpenEXR file, or its header is not complete, or not ``plausible``.
    """
    try:
        _check_regular(file)
        with open(file, "rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            if not size:
                return header.parse(b"", file)[0], 0
            with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as whole, memoryview(whole) as data:
                found, tables = header.parse(data, file)
                if plausible:
                    header.check(found, tables, data, file)
                return found, size
    except IsADirectoryError:
        raise FileError(f"{file}: expected an OpenEXR file, but got a folder") from None
    except OSError as error:
        raise FileError(f"{file}: expected an OpenEXR file, but got: {error.strerror}") from None


def read(path: str | Path) -> ExrFile:
    """Read a file with all its pixels.

    Args:
        path: the file, or ``FILE.exr::LAYER``.

    Raises:
        FileError: the file is missing, no OpenEXR file, truncated, damaged, or of a kind that is not
            supported (deep, subsampled, multi-resolution).
    """
    file, _, layer = str(path).partition("::")
    try:
        data = _bytes(file)
    except IsADirectoryError:
        raise FileError(f"{file}: expected an OpenEXR file, but got a folder") from None
    except OSError as error:
        raise FileError(f"{file}: expected an OpenEXR file, but got: {error.strerror}") from None
    headers, tables = header.parse(data, file)
    header.check(headers, tables, data, file)
    try:
        with quiet():
            stream = io.BytesIO(header.readable(data, headers))
            parts = OpenEXR.File(stream, separate_channels=True).parts
            if len(parts) == len(headers):
                read_parts = tuple(map(_part, parts, headers))
    except MemoryError:
        raise FileError(f"{file}: expected memory for all its pixels, but got too little; see --maxmem") from None
    except LIBRARY_ERRORS as error:
        raise FileError(
            f"{file}: expected an intact OpenEXR file, but got: {one_line(error)}; render or copy it again"
        ) from None
    if len(parts) != len(headers):
        raise FileError(
            f"{file}: expected intact pixels in all of {len(headers)} parts, but got them in {len(parts)}: "
            "the file is truncated or damaged; render or copy it again"
        )
    return ExrFile(file, layer or None, read_parts)


def _bytes(file: str) -> bytes:
    """The whole file, or its first bytes where they show that it is something else, however large."""
    _check_regular(file)
    with open(file, "rb") as stream:
        start = stream.read(len(header.MAGIC))
        if start != header.MAGIC:
            return start
        stream.seek(0)
        return stream.read()


def _check_regular(file: str) -> None:
    """Refuse what may never end, or never begin: pipes, sockets, devices.

    Raises:
        FileError: it is one of those.
        OSError: there is nothing of this name.
    """
    mode = os.stat(file).st_mode
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        raise FileError(f"{file}: expected an OpenEXR file, but got a pipe or a device; name a file")


def _part(part: Any, header: header.Header) -> Part:
    pixels = {channel.name: part.channels[channel.name].pixels for channel in header.channels}
    for array in pixels.values():
        array.flags.writeable = False
    return Part(
        name=part.name(),
        header=part.header,
        attributes=header.attributes,
        channels=pixels,
        linear=frozenset(channel.name for channel in header.channels if channel.linear),
        data_window=header.data_window,
        display_window=header.display_window,
    )


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keep the library from writing to stdout (from Python) and stderr (from C) what it raises anyway.

    Both are the process's: what another thread prints meanwhile without :data:`OUTPUT` is lost too.
    """
    with OUTPUT, contextlib.redirect_stdout(io.StringIO()), open(os.devnull, "wb") as nowhere:
        try:
            stderr = os.dup(2)
        except OSError:  # closed: nothing to keep the library from
            yield
            return
        os.dup2(nowhere.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
