"""A file with another colour: everything else passes through bit by bit.

What the OpenEXR library cannot keep by itself when a file passes through, and what is done about it:

- rationals in lowest terms only, strings in UTF-8 only, other NaNs: the bytes are put back after writing;
- empty vectors and channel lists as attributes: handed over as opaque bytes;
- the order of attributes and channels: written sorted, which the format leaves to the writer;
- arrays that are not C-contiguous are written scrambled, without an error: all are made contiguous;
- a file of scan lines in no order (a line order that only tiles may have): written from the top;
- a file with DWA or B44 compression would lose precision in every channel once more: it is written with ZIP;
- mip and rip maps lose all levels but the first: such files are refused (see :mod:`selfcorrect.exr.header`);
- standard attributes of another type can be read but not written, or are lost without an error (``version`` as a
  string, ``name`` or ``tiles`` as a number): the first are refused, the second told of, before the work
  (:func:`check_source`).

Sources: https://openexr.com/en/latest/OpenEXRFileLayout.html and trials with OpenEXR 3.5.
"""

import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from selfcorrect.errors import FileError, FrameError, one_line
from selfcorrect.exr import header
from selfcorrect.exr.file import LIBRARY_ERRORS, ExrFile, Part, Pixels, float_type, quiet
from selfcorrect.publish import publish

__all__ = ["check_source", "check_target", "write"]

_HALF_MAX = 65504.0
_LOSSY = {"B44_COMPRESSION", "B44A_COMPRESSION", "DWAA_COMPRESSION", "DWAB_COMPRESSION"}
_REWRITTEN = {"channels", "chunkCount", "compression"}
_OWN = {"channels", "chunkCount"}  # the library's own account of what it writes


def write(
    path: str | Path,
    source: ExrFile,
    color: Pixels,
    names: Sequence[str],
    attributes: Mapping[str, str],
    extra: Mapping[str, Pixels] | None = None,
    planes: Mapping[str, Pixels] | None = None,
) -> int:
    """Write what a file holds with another colour; everything else passes through bit by bit.

    The file appears under its name only when it is complete; an existing file survives any failure, and
    ``path`` may be a file that was read.

    Args:
        path: the file to write; its name ends in ``.exr``.
        source: the file that passes through.
        color: (height, width, 3) linear radiance; stored as half or float, whichever the channels were.
        names: full names of the three channels that it replaces.
        attributes: name → text, stored in the first part, in place of an attribute of that name; what is not
            Unicode in the text (bytes of a file name) is escaped.
        extra: channel name → (height, width) array, stored in the colour's part, in place of a channel of
            that name if there is one; float64 becomes float32.
        planes: full name → (height, width) array, in place of other channels of the file, stored in their types.

    Returns:
        How many values were beyond the range of half (±65504) and were clipped to it.

    Raises:
        ChannelError: a name is not in ``source``.
        FileError: the file cannot be written.
        FrameError: a size differs from that of the channel it replaces.
    """
    target = check_target(path)
    contents = [dict(part.channels) for part in source.parts]
    clipped = 0
    replaced = dict(zip(names, np.moveaxis(np.asarray(color), -1, 0), strict=True))
    for name, values in {**(planes or {}), **replaced}.items():
        index, channel = source.place(name)
        dtype = float_type(source, name)
        _same_size(source, name, values, contents[index][channel])
        if values.dtype == dtype:
            contents[index][channel] = values
        elif dtype == np.float16:
            clipped += int(np.count_nonzero(np.abs(values) > _HALF_MAX))
            contents[index][channel] = np.clip(values, -_HALF_MAX, _HALF_MAX).astype(dtype)
        else:
            contents[index][channel] = values.astype(dtype)
    beside = source.place(names[0])[0]
    for name, values in (extra or {}).items():
        _same_size(source, name, values, source.pixels(names[0]))
        known = values.dtype in (np.float16, np.float32, np.uint32)
        contents[beside][name] = values if known else values.astype(np.float32)
    added = {name: text.encode(errors="backslashreplace").decode() for name, text in attributes.items()}
    publish(target, _encode(source, contents, added, str(path)))
    return clipped


def _same_size(source: ExrFile, name: str, values: Pixels, replaced: Pixels) -> None:
    if values.shape != replaced.shape:
        raise FrameError(f"{source.path}: expected {replaced.shape} pixels for '{name}', but got {values.shape}")


def _encode(
    source: ExrFile, contents: Sequence[Mapping[str, Pixels]], added: Mapping[str, str], file: str
) -> memoryview:
    parts, kept = [], []
    for index, (part, arrays) in enumerate(zip(source.parts, contents, strict=True)):
        new = added if index == 0 else {}
        pixels = {
            name: OpenEXR.Channel(name, np.ascontiguousarray(array), 1, 1, name in part.linear)
            for name, array in arrays.items()
        }
        parts.append(OpenEXR.Part({**_attributes(part), **new}, pixels, part.name))
        rewritten = _REWRITTEN | new.keys() | ({"lineOrder"} if _disordered(part) else set())
        kept.append({k: v for k, v in part.attributes.items() if k not in rewritten})
    stream = io.BytesIO()
    try:
        with quiet():
            OpenEXR.File(parts).write(stream)
    except LIBRARY_ERRORS as error:
        raise FileError(f"{file}: expected a writable image, but got: {one_line(error)}") from None
    data = stream.getbuffer()
    header.restore(data, kept, file)
    return data


def check_source(source: ExrFile) -> list[str]:
    """Refuse a file whose attributes could not be written back; to be called before long work.

    Returns:
        A line for each attribute that the library reads but writes otherwise or not at all: it will be lost.

    Raises:
        FileError: an attribute keeps the file from being written; the message names the first one.
    """
    written, together = _trial([(part, _attributes(part)) for part in source.parts])
    if together is None:
        return _lost(source, written)
    for part in source.parts:
        for name, value in _attributes(part).items():
            _, reason = _trial([(part, {name: value})])
            if reason is not None:
                kind = part.attributes[name].type if name in part.attributes else type(value).__name__
                raise FileError(
                    f"{source.path}: expected attributes that can be written back, but got '{name}' of type {kind} "
                    f"({reason}); remove it or write it anew"
                )
    raise FileError(f"{source.path}: expected attributes that can be written back, but got: {together}; write it anew")


def _trial(headers: Sequence[tuple[Part, Mapping[str, Any]]]) -> tuple[bytes, str | None]:
    """What the library writes of these attributes around one pixel; or nothing, and why."""
    pixel = np.zeros(2, np.int32), np.zeros(2, np.int32)
    parts = [
        OpenEXR.Part({**attributes, "dataWindow": pixel}, {"Y": np.zeros((1, 1), np.float32)}, part.name)
        for part, attributes in headers
    ]
    stream = io.BytesIO()
    try:
        with quiet():
            OpenEXR.File(parts).write(stream)
    except LIBRARY_ERRORS as error:
        return b"", one_line(error)
    return stream.getvalue(), None


def _lost(source: ExrFile, written: bytes) -> list[str]:
    """A line for each attribute of which neither the library nor :func:`header.restore` brings back the bytes."""
    lines = []
    for part, now in zip(source.parts, header.parse(written, source.path)[0], strict=True):
        for name, before in part.attributes.items():
            after = now.attributes.get(name)
            own = name in _REWRITTEN | {"type"} or (name == "lineOrder" and _disordered(part))
            if not own and (after is None or (after.type, len(after.data)) != (before.type, len(before.data))):
                what = "left out" if after is None else f"replaced by the {after.type} that the format has there"
                lines.append(
                    f"{source.path}: attribute '{name}' of type {before.type} cannot be written back and is {what}"
                )
    return lines


def _disordered(part: Part) -> bool:
    """Whether a part of scan lines has the line order that only tiles may have."""
    return bool(part.header["type"] == OpenEXR.scanlineimage and part.header.get("lineOrder") == OpenEXR.RANDOM_Y)


def _attributes(part: Part) -> dict[str, Any]:
    """The attributes to write, but for the library's own."""
    attributes = {name: _writable(name, part) for name in part.header if name not in _OWN}
    if attributes["compression"].name in _LOSSY:
        attributes["compression"] = OpenEXR.ZIP_COMPRESSION
    if _disordered(part):
        attributes["lineOrder"] = OpenEXR.INCREASING_Y
    return attributes


def _writable(name: str, part: Part) -> Any:
    """Value of an attribute in a form that the library can write."""
    value, attribute = part.header[name], part.attributes.get(name)
    if attribute is not None and isinstance(value, list) and (not value or attribute.type == "chlist"):
        return OpenEXR.OpaqueAttribute(attribute.data, attribute.type)
    return value


def check_target(path: str | Path, suffix: str = ".exr") -> Path:
    """The file to write, with links resolved so that a link stays one; to be called before long work.

    Raises:
        FileError: it cannot be written.
    """
    target = Path(os.path.realpath(path))
    if target.suffix.lower() != suffix:
        raise FileError(f"{path}: expected an output whose name ends in {suffix}, but got '{target.name}'")
    if os.path.isdir(target):
        raise FileError(f"{path}: expected a file to write, but got a folder; add a file name")
    if not os.path.isdir(target.parent):
        raise FileError(f"{path}: expected a folder at {target.parent}, but got none; create it first")
    if not os.access(target.parent, os.W_OK):
        raise FileError(f"{path}: expected a folder to write to, but {target.parent} is read-only; choose another")
    if os.path.exists(target) and not os.path.isfile(target):
        raise FileError(f"{path}: expected a file to write, but got a pipe or a device; choose another")
    _check_name(path, target)
    if os.path.exists(target) and not os.access(target, os.W_OK):
        raise FileError(f"{path}: expected a file to overwrite, but got a read-only one; choose another")
    return target


def _check_name(path: str | Path, target: Path) -> None:
    """Refuse a name that the file system does not take."""
    try:
        os.lstat(target)
    except FileNotFoundError:
        pass
    except OSError as error:
        raise FileError(f"{path}: expected a name for the output, but got: {error.strerror}; choose another") from None
