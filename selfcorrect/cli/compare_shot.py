"""The command `compare --shot`: errors of the frames of a shot, and of the change from each to the next."""

import argparse
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch

from selfcorrect import exr, metrics
from selfcorrect.cli import memory
from selfcorrect.cli.terminal import answer, show
from selfcorrect.errors import FileError, FrameError
from selfcorrect.exr.limits import check_alike
from selfcorrect.frame import mean
from selfcorrect.history.motion import available, between, warped
from selfcorrect.shot.framerange import fill, there

__all__ = ["compare_shot"]


class _Frame(NamedTuple):
    number: int
    image: torch.Tensor
    references: tuple[torch.Tensor, torch.Tensor]
    weight: torch.Tensor


def compare_shot(options: argparse.Namespace) -> None:
    """Print a line a frame and the means; the change along the motion too where there is optical flow."""
    rows, previous = [], None
    for frame in _frames(options):
        row: dict[str, Any] = {"frame": frame.number, **_errors(options.image, frame)}
        if previous is not None:
            row |= _change(frame, previous)
        rows.append(row)
        if not options.json:
            show("  ".join(f"{name.replace('_', ' ')} {_figure(value)}" for name, value in row.items()))
        previous = frame
    names = [name for name in rows[-1] if name != "frame"]
    means = {name: float(np.mean([row[name] for row in rows if name in row])) for name in names}
    if options.json:
        answer({"frames": rows, "mean": means})
    else:
        show("mean   " + "  ".join(f"{name.replace('_', ' ')} {_figure(value)}" for name, value in means.items()))


def _frames(options: argparse.Namespace) -> Iterator[_Frame]:
    numbers = there(options.image)
    if not numbers:
        raise FileError(f"{options.image}: expected the frames of a shot, but got no such file")
    for number in numbers:
        second = options.reference if options.reference_b is None else options.reference_b
        image, *paths = (fill(name, number) for name in (options.image, options.reference, second))
        if options.weight is not None:
            paths.append(fill(options.weight, number))
        check_alike([image, *paths])
        if options.maxmem is not None:  # the frame before is held beside it
            memory.check_compared(memory.parse_size(options.maxmem), [image, *paths] * 2)
        a, b, *smooth = (torch.from_numpy(exr.load_half(path).buffers["color"]) for path in paths)
        weight = smooth[0] if smooth else mean((a, b))
        yield _Frame(number, torch.from_numpy(exr.load_picture(image)[0]), (a, b), weight)


def _errors(name: str, frame: _Frame) -> dict[str, float]:
    try:
        return {
            "relmse": metrics.relmse(frame.image, *frame.references, frame.weight),
            "mean_radiance_ratio": metrics.mean_radiance_ratio(frame.image, frame.weight),
        }
    except FrameError as error:
        raise FrameError(f"{fill(name, frame.number)}: {error}") from None


def _change(frame: _Frame, previous: _Frame) -> dict[str, float]:
    """Temporal errors since the frame before: pixel by pixel, and along the motion of the reference."""

    def of(before: _Frame) -> float:
        a, b = ((frame.references[i], before.references[i]) for i in (0, 1))
        return metrics.temporal_error(frame.image, before.image, a, b, (frame.weight, before.weight))

    found = {"temporal_error": of(previous)}
    if available():
        here, before = ((w / (1 + w)).mean(-1).clamp(0, 1) for w in (frame.weight, previous.weight))
        motion, _ = between(here, before)
        moved = [warped(image, motion.offset) for image in (previous.image, *previous.references, previous.weight)]
        found["temporal_error_along_motion"] = of(_Frame(previous.number, moved[0], (moved[1], moved[2]), moved[3]))
    return found


def _figure(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.5g}"
