"""What an OpenEXR file holds, and which of its channels would be used for what."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from selfcorrect.errors import ChannelError
from selfcorrect.exr import channels
from selfcorrect.exr.file import Pixels, headers, read
from selfcorrect.exr.header import Window
from selfcorrect.exr.limits import stored_bytes

__all__ = ["ChannelReport", "Inspection", "PartReport", "inspect"]

_STRIP = 64  # rows
_DTYPES = ("uint32", "float16", "float32")


@dataclass(frozen=True)
class ChannelReport:
    """One channel: full name, type, count of NaN and of infinite pixels, and the range of the finite ones.

    All but name and type is None where the pixels were not read.
    """

    name: str
    dtype: str
    nan: int | None = None
    inf: int | None = None
    minimum: float | None = None
    maximum: float | None = None
    mean: float | None = None

    def line(self) -> str:
        """Text for people."""
        if self.nan is None:
            return f"{self.name}: {self.dtype}"
        bad = "".join(f", {count} {kind}" for kind, count in (("NaN", self.nan), ("infinite", self.inf)) if count)
        if self.mean is None:
            return f"{self.name}: {self.dtype}, no finite pixel{bad}"
        return f"{self.name}: {self.dtype}, {self.minimum:.6g} … {self.maximum:.6g}, mean {self.mean:.6g}{bad}"


@dataclass(frozen=True)
class PartReport:
    """One part: its storage, windows and channels."""

    name: str
    storage: str
    compression: str
    data_window: Window
    display_window: Window
    channels: tuple[ChannelReport, ...]


@dataclass(frozen=True)
class Inspection:
    """What a file holds and what would be taken from it.

    Attributes:
        path: the file.
        parts: what it holds.
        layers: the layers that hold colour; ``""`` stands for colour without a layer.
        taken: role → channels that would be used; empty where there is no colour.
        siblings: role → separate file that would be used.
        problem: why nothing would be taken, or None.
    """

    path: str
    parts: tuple[PartReport, ...]
    layers: tuple[str, ...]
    taken: dict[str, tuple[str, ...]]
    siblings: dict[str, str]
    problem: str | None

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON; windows are ``[x_min, y_min, x_max, y_max]``."""
        return asdict(self)

    def lines(self) -> list[str]:
        """Text for people, a line each for parts, channels and roles."""
        text = [self.path]
        for part in self.parts:
            height, width = part.data_window.size
            text.append(
                f"part '{part.name}': {width}×{height} pixels, {part.storage}, {part.compression}, "
                f"data window {tuple(part.data_window)}, display window {tuple(part.display_window)}"
            )
            text += [f"  {channel.line()}" for channel in part.channels]
        if any(self.layers):
            text.append("layers: " + ", ".join(layer or "(none)" for layer in self.layers))
        text += [f"{role}: {', '.join(names)}" for role, names in self.taken.items()]
        text += [f"{role}: {file}" for role, file in self.siblings.items()]
        return text if self.problem is None else [*text, self.problem]


def inspect(path: str | Path, *, most: int | None = None) -> Inspection:
    """Say what a file holds and which channels would be used for what.

    Args:
        path: the file, or ``FILE.exr::LAYER``.
        most: bytes that its pixels may take, by its header, to be read; more are left unread, and only what the header
            says is told. By default all are read.

    Raises:
        FileError: the file cannot be read.
    """
    if most is not None and stored_bytes(str(path)) > most:
        parts, names, named, layer = _by_header(str(path))
    else:
        parts, names, named, layer = _by_pixels(path)
    taken, siblings, problem = {}, {}, None
    try:
        taken = channels.choose(names, file=named, layer=layer)
        found = channels.siblings(named)
        siblings = {role: str(sibling) for role, sibling in found.items() if role not in taken}
    except ChannelError as error:
        problem = str(error)
    return Inspection(named, parts, tuple(channels.layers(names)), taken, siblings, problem)


_Found = tuple[tuple[PartReport, ...], list[str], str, str | None]
"""Parts, full names of all channels, the file without the layer, the layer."""


def _by_pixels(path: str | Path) -> _Found:
    file = read(path)
    parts = []
    for index, part in enumerate(file.parts):
        reports = [_report(name, file.pixels(name)) for name in file.channel_names if file.place(name)[0] == index]
        storage, compression = part.header["type"].name, part.header["compression"].name.removesuffix("_COMPRESSION")
        windows = part.data_window, part.display_window
        parts.append(PartReport(part.name, storage, compression, *windows, tuple(reports)))
    return tuple(parts), file.channel_names, file.path, file.layer


def _by_header(path: str) -> _Found:
    file, _, layer = path.partition("::")
    found, _ = headers(file, plausible=True)
    names = channels.full_names([(part.name, [c.name for c in part.channels]) for part in found], found[0].views)
    parts = []
    for part, full in zip(found, names, strict=True):
        reports = [ChannelReport(name, _DTYPES[c.type]) for name, c in zip(full, part.channels, strict=True)]
        windows = part.data_window, part.display_window
        parts.append(PartReport(part.name, part.storage, part.compression_name, *windows, tuple(reports)))
    return tuple(parts), [name for full in names for name in full], file, layer or None


def _report(name: str, pixels: Pixels) -> ChannelReport:
    """Strip by strip: the copies in double precision stay small beside the pixels."""
    nan, count, total, low, high = 0, 0, 0.0, np.inf, -np.inf
    for top in range(0, pixels.shape[0], _STRIP):
        strip = pixels[top : top + _STRIP]
        nan += int(np.count_nonzero(np.isnan(strip)))
        finite = strip[np.isfinite(strip)].astype(np.float64)
        if finite.size:
            count, total = count + finite.size, total + float(finite.sum())
            low, high = min(low, float(finite.min())), max(high, float(finite.max()))
    inf = pixels.size - count - nan
    if not count:
        return ChannelReport(name, pixels.dtype.name, nan, inf, None, None, None)
    return ChannelReport(name, pixels.dtype.name, nan, inf, low, high, total / count)
