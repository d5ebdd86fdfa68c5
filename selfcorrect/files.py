"""From files to file: the halves of one frame in, the corrected frame out."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from selfcorrect import exr
from selfcorrect.buffers import FEATURES, MOTION
from selfcorrect.correct import COLOR_OUTPUT
from selfcorrect.errors import ChannelError, FileError, FrameError, SettingsError
from selfcorrect.exr.aovs import Plan, plan
from selfcorrect.exr.limits import check_alike
from selfcorrect.exr.passes import Others, means, picture
from selfcorrect.exr.view_layers import chosen, view_layers
from selfcorrect.frame import Frame
from selfcorrect.renders import color_of, same_file
from selfcorrect.settings import ALL_LAYERS

__all__ = [
    "Loaded",
    "Origin",
    "Picture",
    "Saved",
    "Sources",
    "load",
    "load_all",
    "save",
]


@dataclass(frozen=True)
class Sources:
    """The files of one frame; each may be ``file.exr::Layer``.

    Attributes:
        a: half a; the output takes its other channels and its metadata from here.
        b: half b.
        denoised_a: denoised half a, where the user has it.
        denoised_b: denoised half b.
        denoised_full: denoised mean of both halves.
        mapping: role → channel, for what no table knows.
        aovs: which AOVs are corrected: None, ``none``, ``auto``, or names (:func:`selfcorrect.exr.aovs.plan`).
    """

    a: str
    b: str
    denoised_a: str | None = None
    denoised_b: str | None = None
    denoised_full: str | None = None
    mapping: Mapping[str, str] | None = None
    aovs: str | None = None

    def of_layers(self, wanted: str) -> "tuple[list[tuple[str, Sources]], list[str]]":
        """The same files for each view layer that is to be corrected, with its name; and what the log says of others.

        Args:
            wanted: as for :func:`selfcorrect.exr.view_layers.chosen`.

        Raises:
            FileError: a file cannot be read.
            ChannelError: a layer that is named is not in every file.
        """
        if "color" in (self.mapping or {}) and wanted == ALL_LAYERS:
            return [("", self)], []
        names, lines = chosen(self.a, self.b, wanted)
        if len(names) == 1 and (wanted == ALL_LAYERS or "::" in self.a):
            return [(names[0], self)], list(lines)
        given = [path for path in (self.denoised_a, self.denoised_b, self.denoised_full) if path]
        lacking = {
            path: [name for name in names if name not in view_layers(path)] for path in given if "::" not in path
        }
        if any(lacking.values()) and len(names) > 1:
            path, absent = next((path, absent) for path, absent in lacking.items() if absent)
            if wanted != ALL_LAYERS:
                raise ChannelError(
                    f"{path}: expected the view layers of --layers {wanted}, but got none named {', '.join(absent)}; "
                    "leave them out of --layers"
                )
            told = f"view layers {', '.join(names[1:])}: not corrected: {path} has no denoised ones"
            return [(names[0], self._of(names[0], given=False))], [*lines, told]
        plain = bool(lacking) and any(lacking.values())
        return [(name, self._of(name, given=not plain)) for name in names], list(lines)

    def _of(self, layer: str, *, given: bool) -> "Sources":
        """The same files, one layer of them; ``given``: of the denoised images, too."""

        def at(path: str | None) -> str | None:
            return f"{path}::{layer}" if path and layer and given and "::" not in path else path

        a, b = (f"{path}::{layer}" if layer else path for path in (self.a, self.b))
        denoised = at(self.denoised_a), at(self.denoised_b), at(self.denoised_full)
        return Sources(a, b, *denoised, self.mapping, self.aovs)

    @property
    def inputs(self) -> tuple[str | None, ...]:
        """Every file, or None where there is none: the halves, their denoised images, the full denoised image."""
        return self.a, self.b, self.denoised_a, self.denoised_b, self.denoised_full

    @property
    def paths(self) -> list[str]:
        """Every file that is named, half a first."""
        return [path for path in self.inputs if path]


@dataclass(frozen=True)
class Origin:
    """The files of both halves, whose pixels are not kept: what passes through is read again when it is written.

    Attributes:
        path: half a's, with its layer.
        taken: role → channel names.
        stamp: what tells whether it has changed since.
        other: half b's, with its layer.
        other_stamp: likewise.
        alike: both halves call the colour the same, so that their other channels can be told apart by name.
        plan: the AOVs to correct.
        lost: a line for each attribute of half a that cannot be written back.
    """

    path: str
    taken: dict[str, list[str]]
    stamp: tuple[int, int, int]
    other: str
    other_stamp: tuple[int, int, int]
    alike: bool
    plan: Plan = field(default_factory=Plan)
    lost: tuple[str, ...] = ()

    def reopened(self) -> tuple[exr.ExrFile, exr.ExrFile | None]:
        """Half a; and half b, where the halves' other channels can be told apart by name.

        Raises:
            FileError: a file has changed since it was read.
        """
        a = _unchanged(self.path, self.stamp)
        return a, _unchanged(self.other, self.other_stamp) if self.alike else None


def _unchanged(path: str, stamp: tuple[int, int, int]) -> exr.ExrFile:
    if _stamp(path) != stamp:
        raise FileError(f"{path}: expected the file that was read, but got one changed since; run again")
    return exr.read(path)


@dataclass(frozen=True, eq=False)
class Loaded:
    """A frame in memory, and where it came from.

    Attributes:
        frame: its buffers; without denoised halves where the files hold none.
        origin: half a.
        layer: name of its view layer, empty where there is one only.
        others: the files' further view layers.
    """

    frame: Frame
    origin: Origin
    layer: str = ""
    others: "tuple[Loaded, ...]" = ()


def load(sources: Sources, *, shot: bool = False) -> Loaded:
    """Read both halves and, where they are given, their denoised images; for a ``shot`` also motion.

    Raises:
        FileError: a file cannot be read, or the same file was given twice.
        ChannelError: a channel is missing.
        FrameError: sizes do not fit.
    """
    _check_distinct(sources)
    stamps = _stamp(sources.a), _stamp(sources.b)
    check_alike(sources.paths)
    half_a = _half(sources.a, sources.mapping, passes=True, shot=shot)
    half_b = _half(sources.b, sources.mapping, shot=shot and MOTION.name not in half_a.buffers)
    height, width = half_a.buffers["color"].shape[:2]
    if half_b.buffers["color"].shape[:2] != (height, width):
        other = half_b.buffers["color"].shape
        raise FrameError(
            f"{sources.b}: expected {width}x{height} pixels like {sources.a}, but got {other[1]}x{other[0]}"
        )
    if half_a.window != half_b.window:
        raise FrameError(
            f"{sources.b}: expected the data window {half_a.window} of {sources.a}, but got {half_b.window}; "
            "render both halves without cropping to what is seen"
        )
    pairs: dict[str, Any] = {"color": (half_a.buffers["color"], half_b.buffers["color"])}
    taken = {"color": half_a.taken["color"]}
    for role in (feature.name for feature in FEATURES):
        in_a, in_b = role in half_a.buffers, role in half_b.buffers
        if in_a != in_b:
            there, lacking = (sources.a, sources.b) if in_a else (sources.b, sources.a)
            raise ChannelError(f"{lacking}: expected {role} channels like {there}, but got none")
        if in_a:
            pairs[role] = (half_a.buffers[role], half_b.buffers[role])
            taken[role] = half_a.taken[role]
    if moving := next((half for half in (half_a, half_b) if MOTION.name in half.buffers), None):
        # of surfaces, not of samples: both halves show the same, and one tells it
        pairs[MOTION.name] = (moving.buffers[MOTION.name],) * 2
        taken[MOTION.name] = moving.taken[MOTION.name]
    denoised = _denoised(sources, half_a, half_b)
    if denoised:
        pairs["denoised"] = denoised
        taken["denoised"] = half_a.taken.get("denoised", [str(sources.denoised_a)])
    if sources.denoised_full:
        pairs["denoised_full"] = color_of(sources.denoised_full, (height, width))
    try:
        frame = Frame(**pairs)
    except FrameError as error:
        raise FrameError(f"{sources.a} (half a), {sources.b} (half b): {error}") from None
    alike = half_a.taken["color"] == half_b.taken["color"]
    origin = Origin(sources.a, taken, stamps[0], sources.b, stamps[1], alike, lost=half_a.lost)
    return Loaded(frame, replace(origin, plan=_plan(origin, sources.aovs, half_a.taken)))


def load_all(sources: Sources, layers: str, *, shot: bool = False) -> Loaded:
    """Read a frame with all its view layers; as :func:`load` and :meth:`Sources.of_layers`, with their errors."""
    named, _ = sources.of_layers(layers)
    first, *others = (replace(load(own, shot=shot), layer=name) for name, own in named)
    return replace(first, others=tuple(others))


def _plan(origin: Origin, wanted: str | None, taken: Mapping[str, list[str]]) -> Plan:
    if wanted is None or wanted == "none":
        return Plan()
    a, b = origin.reopened()
    if b is None:
        raise ChannelError(
            f"{origin.other}: expected the colour's channels of {origin.path} for --aovs, but got others"
        )
    return plan(a, b, taken["color"], wanted, "".join(taken.get("alpha", [])[:1]))


class _Half(NamedTuple):
    """What is kept of a half: tensors, which the frame takes over without a copy."""

    buffers: dict[str, Tensor]
    taken: dict[str, list[str]]
    window: tuple[int, ...]  # of the colour's data
    lost: tuple[str, ...]  # attributes that cannot be written back


def _half(path: str, mapping: Mapping[str, str] | None = None, *, passes: bool = False, shot: bool = False) -> _Half:
    """A half; ``passes``: its other channels and its attributes are to be written again; ``shot``: with motion."""
    half = exr.load_half(path, mapping=mapping, shot=shot)
    lost = exr.check_source(half.file) if passes else []
    used = {role: torch.from_numpy(buffer) for role, buffer in half.buffers.items() if role != "alpha"}
    window = half.file.parts[half.file.place(half.taken["color"][0])[0]].data_window
    return _Half(used, half.taken, tuple(window), tuple(lost))


def _stamp(path: str) -> tuple[int, int, int]:
    file = path.partition("::")[0]
    try:
        found = os.stat(file)
    except OSError as error:
        raise FileError(f"{file}: expected an OpenEXR file, but got: {error.strerror}") from None
    return found.st_ino, found.st_size, found.st_mtime_ns


class Picture(NamedTuple):
    """What a further view layer of the same files becomes.

    Attributes:
        layer: its name.
        color: full names of the channels that its colour was read from.
        outputs: images by name, as for :func:`save`.
        aovs: channels of its corrected AOVs by their full names.
    """

    layer: str
    color: Sequence[str]
    outputs: Mapping[str, Any]
    aovs: Mapping[str, Any]


class Saved(NamedTuple):
    """What was written: how many values lay beyond the range of half floats and were clipped, where the file holds
    those, and what became of the channels beside the colour.
    """

    clipped: int
    others: Others


def save(
    path: str,
    origin: Origin,
    outputs: Mapping[str, Any],
    attributes: Mapping[str, str],
    *,
    pass_through: bool = False,
    aovs: Mapping[str, Any] | None = None,
    others: Sequence[Picture] = (),
) -> Saved:
    """Write a frame's outputs with all else of the halves: what is linear in the samples as the mean of both
    (:mod:`selfcorrect.exr.passes`), the rest as half a has it, bit by bit.

    Args:
        path: the file to write.
        origin: the halves.
        outputs: images by name; ``color`` takes the place of the picture, any other becomes the channel
            ``selfcorrect.NAME``.
        attributes: name → text.
        pass_through: every channel but the picture and the AOVs that were corrected is half a's.
        aovs: channels of corrected AOVs by their full names.
        others: further view layers; what is not their colour becomes ``LAYER.selfcorrect.NAME``.

    Raises:
        FileError: a half has changed since it was read, or the output cannot be written.
    """
    a, b = origin.reopened()
    shown = picture(a.channel_names, origin.taken["color"])
    corrected, pictures = dict(aovs or {}), dict[str, Any]()
    extra = {f"selfcorrect.{name}": image for name, image in outputs.items() if name != COLOR_OUTPUT}
    for other in others:
        color = np.moveaxis(np.asarray(other.outputs[COLOR_OUTPUT]), -1, 0)
        pictures |= dict(zip(picture(a.channel_names, other.color), color, strict=True))
        corrected |= other.aovs
        beside = {n: image for n, image in other.outputs.items() if n != COLOR_OUTPUT}
        extra |= {f"{other.layer}.selfcorrect.{name}": image for name, image in beside.items()}
    planes = dict[str, Any]()
    told = Others(0, len(a.channel_names) - len(shown) - len(pictures) - len(corrected))
    if b is not None and not pass_through:
        planes, told = means(a, b, but={*shown, *pictures, *corrected})
    del b
    planes |= pictures | corrected
    clipped = exr.write(path, a, outputs[COLOR_OUTPUT], shown, attributes, extra=extra, planes=planes)
    return Saved(clipped, told._replace(corrected=len(corrected)))


def _check_distinct(sources: Sources) -> None:
    a, b = (Path(path.partition("::")[0]) for path in (sources.a, sources.b))
    if sources.a == sources.b or (sources.a.partition("::")[2] == sources.b.partition("::")[2] and same_file(a, b)):
        raise FileError(
            f"{sources.b}: expected the other half of the samples, but got the same file twice; identical halves "
            "carry no information: render the second one with another seed"
        )
    if (sources.denoised_a is None) != (sources.denoised_b is None):
        given = sources.denoised_a or sources.denoised_b
        raise SettingsError(f"{given}: expected both denoised halves or none, but got one")


def _denoised(sources: Sources, half_a: _Half, half_b: _Half) -> tuple[Any, Any] | None:
    """The denoised halves that the user named, else those that lie beside the halves."""
    size = half_a.buffers["color"].shape[:2]
    if sources.denoised_a and sources.denoised_b:
        return color_of(sources.denoised_a, size), color_of(sources.denoised_b, size)
    if "denoised" in half_a.buffers and "denoised" in half_b.buffers:
        return half_a.buffers["denoised"], half_b.buffers["denoised"]
    return None
