"""What the render scripts share: frame ranges, seeds and file names. Blender's Python has the standard library only.

A shot is ``NAME_a.####.exr`` and ``NAME_b.####.exr``, what ``selfcorrect sequence`` reads; a single frame is
``NAME_a.exr`` and ``NAME_b.exr``.
"""

import argparse
import hashlib
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

HALVES = ("a", "b")


def parse_frames(text: str) -> list[int]:
    """Frames of a range: ``1-240``, ``1-240x2``, ``1-3,5,7-20:2``, ``5-5``; in its order, each once.

    Raises:
        argparse.ArgumentTypeError: it is no range.
    """
    frames: dict[int, None] = {}
    for item in text.split(","):
        match = re.fullmatch(r"\s*(-?\d+)(?:-(-?\d+)(?:[x:](\d+))?)?\s*", item)
        first, last, step = (None, None, None) if match is None else match.groups()
        if first is None or int(last or first) < int(first) or int(step or 1) < 1:
            raise argparse.ArgumentTypeError(
                f"expected frames such as 1-240, 1-240x2 or 1-3,5,7-20:2, but got {text!r}"
            )
        frames |= dict.fromkeys(range(int(first), int(last or first) + 1, int(step or 1)))
    return list(frames)


def even(text: str) -> int:
    """Samples of both halves together: an even number above zero.

    Raises:
        argparse.ArgumentTypeError: it is not.
    """
    if not text.isdecimal() or int(text) < 2 or int(text) % 2:
        raise argparse.ArgumentTypeError(f"expected an even number of samples, to halve it, but got {text!r}")
    return int(text)


def size(text: str) -> tuple[int, int]:
    """Width and height of ``WxH``.

    Raises:
        argparse.ArgumentTypeError: it is no size.
    """
    match = re.fullmatch(r"([1-9]\d*)[x×]([1-9]\d*)", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"expected a size such as 1920x1080, but got {text!r}")
    return int(match[1]), int(match[2])


def seed_of(seed: int, frame: int, half: str) -> int:
    """Seed of one half of one frame, below 2³¹ (Blender's are signed).

    Hashed, since counting up would give half b of a frame under seed 1 the samples of half a under seed 2.
    """
    digest = hashlib.sha256(f"{seed} {frame} {half}".encode()).digest()
    return int.from_bytes(digest[:4], "little") >> 1


def path_of(folder: Path, name: str, half: str, frame: int | None) -> Path:
    """File of one half; ``frame`` is None for a single frame."""
    return folder / (f"{name}_{half}.exr" if frame is None else f"{name}_{half}.{frame:04d}.exr")


@contextmanager
def published(path: Path) -> Iterator[Path]:
    """A name to write under, in the same folder, that becomes ``path`` only once the block has ended well."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp.exr")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags that all render scripts have."""
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder for the halves")
    parser.add_argument(
        "--spp", type=even, required=True, metavar="N", help="samples per pixel of both halves together"
    )
    parser.add_argument("--frames", type=parse_frames, metavar="1-24", help="1-240, 1-240x2, 1-3,5,7-20:2")
    parser.add_argument("--size", type=size, metavar="WxH", help="by default the scene's own")
    parser.add_argument("--name", help="the file names begin with it (default: the scene file's name)")
    parser.add_argument("--seed", type=int, default=0, help="another number gives other samples (default: 0)")
