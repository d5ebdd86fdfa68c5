"""Renders that are no halves: what a stage needs beyond them, and what ``combine`` joins."""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from selfcorrect import exr
from selfcorrect.errors import FileError, FrameError
from selfcorrect.exr.limits import check_alike
from selfcorrect.image.repair import repaired

__all__ = ["Images", "color_of", "load_extra", "load_images", "same_file", "save_combined"]


@dataclass(frozen=True, eq=False)
class Images:
    """Renders of one frame in memory.

    Attributes:
        images: (H, W, 3) float32 tensors of linear radiance, finite; a reconstructed one may be negative.
        source: the first one as it was read.
        lost: a line for each of its attributes that cannot be written back.
    """

    images: tuple[Tensor, ...]
    source: exr.HalfFile
    lost: tuple[str, ...]


def load_extra(paths: Sequence[str], size: tuple[int, int]) -> tuple[Tensor, ...]:
    """The colours of images that a stage needs beyond the halves, of this height and width.

    Raises:
        FileError: a file cannot be read, or the same file was given twice.
        FrameError: a size does not fit.
    """
    _check_different(paths)
    return tuple(color_of(path, size) for path in paths)


def load_images(paths: Sequence[str]) -> Images:
    """Read the colour of several renders of one frame.

    Raises:
        FileError: a file cannot be read, or the same file was given twice.
        FrameError: sizes do not fit.
    """
    _check_different(paths)
    check_alike(paths)
    first = exr.load_half(paths[0])
    lost = exr.check_source(first.file)
    size = first.buffers["color"].shape[:2]
    colors = [first.buffers["color"], *(color_of(path, size) for path in paths[1:])]
    images = tuple(repaired(color, path) for color, path in zip(colors, paths, strict=True))
    return Images(images, first, tuple(lost))


def save_combined(path: str, images: Images, image: Tensor, *, details: Mapping[str, Any]) -> int:
    """Write a combined colour under the names it had in the first render, with all else of that one.

    Returns:
        how many values lay beyond the range of half floats and were clipped, where the file holds those.
    """
    attributes = {"selfcorrect/combine": json.dumps(dict(details))}
    return exr.write(path, images.source.file, image.cpu().numpy(), images.source.taken["color"], attributes)


def color_of(path: str, size: tuple[int, ...]) -> Tensor:
    """The colour of a file, of this height and width.

    Raises:
        FileError: it cannot be read.
        FrameError: its size does not fit.
    """
    color = torch.from_numpy(exr.load_half(path).buffers["color"])
    if color.shape[:2] != size:
        raise FrameError(
            f"{path}: expected {size[1]}x{size[0]} pixels like the halves, but got {color.shape[1]}x{color.shape[0]}"
        )
    return color


def same_file(a: Path, b: Path) -> bool:
    """Whether two names that are there are of one file."""
    return a.exists() and b.exists() and os.path.samefile(a, b)


def _check_different(paths: Sequence[str]) -> None:
    for i, path in enumerate(paths):
        if any(path == other or same_file(Path(path), Path(other)) for other in paths[:i]):
            raise FileError(f"{path}: expected renders with seeds of their own, but got the same file twice")
