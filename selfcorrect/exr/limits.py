"""What the headers of a frame's files say together, before a pixel of any of them is read.

A file of some kilobytes may claim gigabytes of pixels: one that does not fit the others is refused by its header.
"""

from collections.abc import Sequence

from selfcorrect.errors import FrameError
from selfcorrect.exr.file import headers

__all__ = ["check_alike", "stored_bytes"]

_BYTES = {0: 4, 1: 2, 2: 4}  # uint, half, float


def check_alike(paths: Sequence[str]) -> None:
    """Refuse files of which no part has the size that the first one has.

    Args:
        paths: the files of one frame, each perhaps with ``::LAYER``; the first is half a.

    Raises:
        FileError: a file is missing or no OpenEXR file.
        FrameError: a file has another size than half a.
    """
    known: set[tuple[int, int]] = set()
    for path in paths:
        parts, _ = headers(path.partition("::")[0])
        sizes = {part.data_window.size for part in parts}
        known = known or sizes
        if not known & sizes or any(_pixels(size) > max(map(_pixels, known)) for size in sizes):
            height, width = max(sizes, key=_pixels)
            expected = max(known, key=_pixels)
            raise FrameError(
                f"{path}: expected {expected[1]}x{expected[0]} pixels like {paths[0]}, but got {width}x{height}"
            )


def stored_bytes(path: str) -> int:
    """Bytes that all pixels of a file take in memory, by its header.

    Raises:
        FileError: the file is missing or no OpenEXR file.
    """
    parts, _ = headers(path.partition("::")[0])
    return sum(
        _pixels(part.data_window.size) * _BYTES.get(channel.type, 4) for part in parts for channel in part.channels
    )


def _pixels(size: tuple[int, int]) -> int:
    return size[0] * size[1]
