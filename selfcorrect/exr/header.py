"""The header of an OpenEXR file, read byte by byte and checked before the library sees the pixels.

Four properties of the OpenEXR library make this needed: it allocates whatever a damaged data window claims; it
takes a file with missing chunks (an interrupted render) for a good one; it refuses a file for one letter of
an attribute that is not UTF-8; and it hands out attributes as values, from which the bytes do not always
come back (24/1 for 24000/1000).

Source: https://openexr.com/en/latest/OpenEXRFileLayout.html
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from selfcorrect.errors import FileError

__all__ = ["MAGIC", "Attribute", "Channel", "Header", "Window", "check", "parse", "readable", "restore", "views"]

MAGIC = b"v/1\x01"
"""The first bytes of every OpenEXR file."""

_TILED, _DEEP, _MULTIPART = 0x200, 0x800, 0x1000
_MOST_PIXELS = 2**31
_PIXEL_BYTES = (4, 2, 4)
_ANY = 65536.0
"""The other compressions have no such bound; a black 4K frame came to 40,000 (measured, HTJ2K)."""

_COMPRESSIONS = (
    ("NO", 1, 1.0),
    ("RLE", 1, 64.0),
    ("ZIPS", 1, 1032.0),
    ("ZIP", 16, 1032.0),
    ("PIZ", 32, _ANY),
    ("PXR24", 16, 1376.0),
    ("B44", 32, _ANY),
    ("B44A", 32, _ANY),
    ("DWAA", 32, _ANY),
    ("DWAB", 256, _ANY),
    ("HTJ2K256", 256, _ANY),
    ("HTJ2K32", 32, _ANY),
    ("LJ2K", 256, _ANY),
    ("ZSTD", 1, _ANY),
)
"""By number: name, scan lines in a chunk, most bytes of pixels in one byte of the file (deflate: 1032)."""


@dataclass(frozen=True)
class Attribute:
    """Type and bytes of an attribute as the file has them, and where the bytes begin."""

    type: str
    data: bytes
    offset: int


class Channel(NamedTuple):
    """A channel as the header lists it; ``type`` is 0 for uint, 1 for half, 2 for float."""

    name: str
    type: int
    linear: bool
    sampling: tuple[int, int]


class Window(NamedTuple):
    """A data or display window: its first and last pixel, both inside."""

    x_min: int
    y_min: int
    x_max: int
    y_max: int

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.y_max - self.y_min + 1, self.x_max - self.x_min + 1


@dataclass(frozen=True)
class Header:
    """The header of one part.

    Attributes:
        attributes: name → attribute.
        tiled: the pixels are stored in tiles.
        deep: the pixels are deep.
        channels: the channels in the order of the file.
        data_window: the pixels that are stored.
        display_window: the pixels of the picture.
        compression: its number in the format.
    """

    attributes: Mapping[str, Attribute]
    tiled: bool
    deep: bool
    channels: tuple[Channel, ...]
    data_window: Window
    display_window: Window
    compression: int

    @property
    def name(self) -> str:
        """The part's name; empty in most single-part files."""
        attribute = self.attributes.get("name")
        return "" if attribute is None else attribute.data.decode("utf-8", "replace")

    @property
    def storage(self) -> str:
        """What the OpenEXR library calls the way in which flat pixels are stored."""
        return "tiledimage" if self.tiled else "scanlineimage"

    @property
    def compression_name(self) -> str:
        """What the OpenEXR library calls the compression; its number where that is not known."""
        known = self.compression < len(_COMPRESSIONS)
        return _COMPRESSIONS[self.compression][0] if known else str(self.compression)

    @property
    def views(self) -> list[str]:
        """The views that a stereo file names."""
        return views(self.attributes)


def views(attributes: Mapping[str, Attribute]) -> list[str]:
    """The views that these attributes of a file's first part name, in ``multiView``; none in most files."""
    attribute = attributes.get("multiView")
    data = b"" if attribute is None or attribute.type != "stringvector" else attribute.data
    names = []
    while len(data) >= 4:
        length = int.from_bytes(data[:4], "little")
        names.append(data[4 : 4 + length].decode("utf-8", "replace"))
        data = data[4 + length :]
    return names


def parse(data: bytes | memoryview, file: str) -> tuple[list[Header], int]:
    """Read the headers of all parts.

    Args:
        data: the whole file.
        file: what messages call it.

    Returns:
        The headers, and the offset of the chunk tables that follow them.

    Raises:
        FileError: the file is no OpenEXR file, or its header is not complete.
    """
    if data[:4] != MAGIC:
        got = "an empty file" if not data else f"a file that begins with {bytes(data[:4])!r}"
        raise FileError(f"{file}: expected an OpenEXR file, but got {got}")
    try:
        (version,) = struct.unpack_from("<I", data, 4)
        headers: list[Header] = []
        position = 8
        while not headers or (version & _MULTIPART and data[position]):
            attributes, position = _attributes(data, position)
            headers.append(_header(attributes, version))
    except (ValueError, IndexError, KeyError, struct.error):
        raise FileError(
            f"{file}: expected a complete OpenEXR header, but got one that is truncated or damaged; "
            "render or copy the file again"
        ) from None
    return headers, position + bool(version & _MULTIPART)


def _attributes(data: bytes | memoryview, position: int) -> tuple[dict[str, Attribute], int]:
    attributes = {}
    while data[position]:
        name, position = _word(data, position)
        kind, position = _word(data, position)
        (size,) = struct.unpack_from("<i", data, position)
        position += 4
        if not 0 <= size <= len(data) - position:
            raise ValueError("an attribute that ends outside the file")
        attributes[name] = Attribute(kind, bytes(data[position : position + size]), position)
        position += size
    return attributes, position + 1


def _word(data: bytes | memoryview, position: int) -> tuple[str, int]:
    word = bytes(data[position : position + 256])
    word = word[: word.index(b"\0")]
    return word.decode("utf-8", "surrogateescape"), position + len(word) + 1


def _header(attributes: dict[str, Attribute], version: int) -> Header:
    storage = attributes["type"].data.decode("ascii", "replace") if version & _MULTIPART else ""
    return Header(
        attributes,
        tiled=bool(version & _TILED) or storage == "tiledimage",
        deep=bool(version & _DEEP) or storage.startswith("deep"),
        channels=_channels(attributes["channels"].data),
        data_window=Window(*struct.unpack("<4i", attributes["dataWindow"].data)),
        display_window=Window(*struct.unpack("<4i", attributes["displayWindow"].data)),
        compression=attributes["compression"].data[0],
    )


def _channels(data: bytes) -> tuple[Channel, ...]:
    channels, position = [], 0
    while data[position]:
        name, position = _word(data, position)
        kind, linear, x, y = struct.unpack_from("<iB3xii", data, position)
        channels.append(Channel(name, kind, bool(linear), (x, y)))
        position += 16
    return tuple(channels)


def check(headers: Sequence[Header], tables: int, data: bytes | memoryview, file: str) -> None:
    """Refuse what cannot be read, or not without harm, by the header and the chunk tables alone.

    A data window is too large where it has more than 2³¹ pixels, or more bytes than a file of this length can
    hold in its compression.

    Args:
        headers: the headers of all parts.
        tables: offset of the chunk tables.
        data: the whole file.
        file: what messages call it.

    Raises:
        FileError: deep, subsampled or multi-resolution pixels, an implausible data window, or missing chunks.
    """
    needed = 0.0
    for header in headers:
        _check_kind(header, file)
        height, width = header.data_window.size
        if min(height, width) < 1 or height * width > _MOST_PIXELS:
            raise FileError(
                f"{file}: expected a data window of 1 to {_MOST_PIXELS} pixels, but got {width}×{height}: "
                "the header is damaged; render or copy the file again"
            )
        pixel = sum(_PIXEL_BYTES[channel.type] for channel in header.channels)
        needed += height * width * pixel / _COMPRESSIONS[header.compression][2]
        if needed > len(data):
            raise FileError(
                f"{file}: expected a file that can hold the {width}×{height} pixels of its data window, "
                f"but got {len(data)} bytes: it is truncated or its header is damaged; "
                "render or copy it again"
            )
    expected = complete = 0
    for header in headers:
        count = _chunks(header)
        table = np.frombuffer(bytes(data[tables : tables + 8 * count]), dtype=np.uint8)
        offsets = table[: table.size // 8 * 8].view("<u8")
        expected += count
        complete += int(np.count_nonzero((offsets > tables) & (offsets < len(data))))
        tables += 8 * count
    if complete != expected:
        raise FileError(
            f"{file}: expected {expected} chunks of pixels, but got {complete}: the file is truncated or its "
            "render was interrupted; render or copy it again"
        )


def _check_kind(header: Header, file: str) -> None:
    if header.deep:
        raise FileError(f"{file}: expected flat pixels, but got deep ones; flatten the file first")
    if not header.channels:
        raise FileError(f"{file}: expected channels, but got none")
    if header.compression >= len(_COMPRESSIONS):
        raise FileError(f"{file}: expected a known compression, but got number {header.compression}")
    for channel in header.channels:
        if channel.sampling != (1, 1):
            raise FileError(
                f"{file}: expected channel '{channel.name}' at full resolution, but got it subsampled by "
                f"{channel.sampling[0]}×{channel.sampling[1]}; render it without subsampling"
            )
        if not 0 <= channel.type < len(_PIXEL_BYTES):
            raise FileError(f"{file}: expected channel '{channel.name}' as uint, half or float, but got {channel.type}")
    if header.tiled:
        tiles = header.attributes.get("tiles")
        if tiles is None or len(tiles.data) != 9 or min(struct.unpack_from("<2I", tiles.data)) < 1:
            raise FileError(f"{file}: expected tiles of a size, but got a damaged description of tiles")
        if tiles.data[8] & 15:
            raise FileError(
                f"{file}: expected an image of one resolution, but got a mip or rip map; "
                "extract its first level, or render without them"
            )


def _chunks(header: Header) -> int:
    height, width = header.data_window.size
    if header.tiled:
        across, down = struct.unpack_from("<2I", header.attributes["tiles"].data)
        return -(-width // int(across)) * -(-height // int(down))
    return -(-height // _COMPRESSIONS[header.compression][1])


def readable(data: bytes, headers: Sequence[Header]) -> bytes:
    """The file with ``?`` for every letter of a string attribute that is not UTF-8."""
    fixed = None
    for header in headers:
        for attribute in header.attributes.values():
            if attribute.type in {"string", "stringvector"} and not _is_text(attribute.data):
                fixed = fixed or bytearray(data)
                text = bytes(byte if byte < 128 else ord("?") for byte in attribute.data)
                fixed[attribute.offset : attribute.offset + len(text)] = text
    return data if fixed is None else bytes(fixed)


def _is_text(data: bytes) -> bool:
    try:
        data.decode()
    except UnicodeDecodeError:
        return False
    return True


def restore(data: memoryview, sources: Sequence[Mapping[str, Attribute]], file: str) -> None:
    """Put the bytes that attributes had back into a file just written, in place.

    Args:
        data: the file that was written.
        sources: per part, name → attribute as it was; those that are of another length now stay as they are.
        file: what messages call the file.
    """
    headers, _ = parse(data, file)
    for header, attributes in zip(headers, sources, strict=True):
        for name, attribute in attributes.items():
            now = header.attributes.get(name)
            if now is not None and (now.type, len(now.data)) == (attribute.type, len(attribute.data)):
                data[now.offset : now.offset + len(now.data)] = attribute.data
