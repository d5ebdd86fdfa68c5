"""One half of a frame from its files: colour and whichever G-buffers there are."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from selfcorrect.buffers import FEATURES, MOTION
from selfcorrect.errors import FrameError
from selfcorrect.exr import channels, motion
from selfcorrect.exr.file import ExrFile, Pixels, float_type, headers, read
from selfcorrect.exr.header import Window
from selfcorrect.exr.passes import picture

__all__ = ["HalfFile", "load_half", "load_picture"]

_FEATURES = {feature.name for feature in (*FEATURES, MOTION)}


@dataclass(frozen=True, eq=False)
class HalfFile:
    """The buffers of one half of a frame.

    Attributes:
        file: the file that holds the colour.
        buffers: role → (height, width, channels) array, C-contiguous; values as they are in the file: float32,
            but float16 for G-buffers that the file has as half floats. Roles are those of
            :data:`selfcorrect.exr.channels.ROLES`, and ``denoised`` where a separate file has it.
        taken: role → the channels that were taken, ``file:channel`` where another file gave them.
    """

    file: ExrFile
    buffers: dict[str, NDArray[np.floating[Any]]]
    taken: dict[str, list[str]]


def load_picture(path: str | Path) -> tuple[NDArray[np.floating[Any]], list[str]]:
    """Read what people look at: the channels that an output's colour is written to, and their names.

    They are the colour's, but where a file has a picture beside its noisy image, that; a layer that names a pass is
    that pass.

    Raises:
        FileError, ChannelError: as for :func:`load_half`.
    """
    file = read(path)
    color = channels.choose(file.channel_names, file=file.path, layer=file.layer)["color"]
    named = file.layer is not None and color[0].rpartition(".")[0].casefold() == file.layer.casefold()
    shown = color if named else picture(file.channel_names, color)
    return _stacked([file.pixels(name) for name in shown], half=False), list(shown)


def load_half(path: str | Path, *, mapping: Mapping[str, str] | None = None, shot: bool = False) -> HalfFile:
    """Read one half of a frame: colour and whichever G-buffers there are, in the file or in files beside it.

    Args:
        path: the colour file, or ``FILE.exr::LAYER``.
        mapping: role → channel name of the user's own (see :func:`selfcorrect.exr.channels.choose`).
        shot: also motion, which only the neighbours of a shot's frame have use for.

    Raises:
        FileError: a file cannot be read.
        ChannelError: there is no colour, or the layer or a name of ``mapping`` is not in the file.
        FrameError: the data windows of the buffers differ.
        SettingsError: ``mapping`` holds a role that does not exist.
    """
    file = read(path)
    chosen = channels.choose(file.channel_names, file=file.path, layer=file.layer, mapping=mapping)
    sources = {role: (file, names) for role, names in chosen.items() if shot or role != MOTION.name}
    for role, sibling in channels.siblings(file.path).items():
        if role not in sources:
            _check_size(file, role, str(sibling))
            other = read(sibling)
            sources[role] = other, channels.sibling_channels(other.channel_names, role, file=other.path)
    window = _window(file, chosen["color"][0])
    buffers, taken = {}, {}
    for role, (source, names) in sources.items():
        for name in names:
            if _window(source, name) != window:
                raise FrameError(
                    f"{source.path}: expected channel '{name}' ({role}) with the colour's data window "
                    f"{tuple(window)}, but got {tuple(_window(source, name))}"
                )
        buffers[role] = _stacked([source.pixels(name) for name in names], half=role in _FEATURES)
        if role == MOTION.name:
            buffers[role] = motion.read(names, buffers[role])
        prefix = "" if source is file else f"{Path(source.path).name}:"
        taken[role] = [prefix + name for name in names]
    for name in chosen["color"]:
        float_type(file, name)
    return HalfFile(file, buffers, taken)


def _check_size(file: ExrFile, role: str, sibling: str) -> None:
    """Refuse a file beside the colour by its header where it claims more pixels than the colour has."""
    height, width = max((part.data_window.size for part in headers(sibling)[0]), key=math.prod)
    if height * width > math.prod(file.size):
        raise FrameError(
            f"{sibling}: expected {file.size[1]}x{file.size[0]} pixels ({role}) like {file.path}, "
            f"but got {width}x{height}; move it away or render it again"
        )


def _stacked(planes: Sequence[Pixels], *, half: bool) -> NDArray[np.floating[Any]]:
    kept = half and all(plane.dtype == np.float16 for plane in planes)
    image = np.empty((*planes[0].shape, len(planes)), np.float16 if kept else np.float32)
    for index, plane in enumerate(planes):
        image[..., index] = plane
    return image


def _window(file: ExrFile, name: str) -> Window:
    return file.parts[file.place(name)[0]].data_window
