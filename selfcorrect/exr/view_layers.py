"""The view layers of a frame's files, each a picture with passes of its own, by the files' headers alone."""

from collections.abc import Sequence
from typing import NamedTuple

from selfcorrect.errors import ChannelError
from selfcorrect.exr import channels
from selfcorrect.exr.channels import listed
from selfcorrect.exr.file import headers
from selfcorrect.settings import ALL_LAYERS

__all__ = ["ViewLayers", "chosen", "view_layers"]

_MADE = "composite"  # what Blender's compositor has made of the others: no render


class ViewLayers(NamedTuple):
    """What is to be corrected.

    Attributes:
        names: of view layers, ``""`` of the colour without one, in the order of half a.
        lines: what the log says of those that are left.
    """

    names: tuple[str, ...]
    lines: tuple[str, ...] = ()


def view_layers(path: str) -> list[str]:
    """View layers with a colour, and views with layers, in the order of the file; ``""`` stands for colour without one.

    Raises:
        FileError: the file cannot be read.
    """
    parts, _ = headers(path.partition("::")[0])
    named = [(part.name, [channel.name for channel in part.channels]) for part in parts]
    views = parts[0].views if parts else ()
    return channels.layers([name for full in channels.full_names(named, views) for name in full])


def chosen(a: str, b: str, wanted: str) -> ViewLayers:
    """The view layers to correct of two halves.

    Args:
        a: half a; where a layer is named, ``file.exr::Layer``, that is it.
        b: half b.
        wanted: :data:`selfcorrect.settings.ALL_LAYERS`, or names with commas between them, case aside; a view stands
            for all layers of it.

    Raises:
        FileError: a file cannot be read.
        ChannelError: a layer that is named is not in a half.
    """
    if "::" in a or "::" in b:
        if wanted != ALL_LAYERS:
            raise ChannelError(f"{a}: expected a layer after :: or --layers {wanted}, but got both")
        return ViewLayers((a.partition("::")[2],))
    in_a, in_b = view_layers(a), view_layers(b)
    if wanted != ALL_LAYERS:
        names = [name for text in wanted.split(",") if text.strip() for name in _named(a, in_a, text.strip())]
        for name in names:
            _named(b, in_b, name)
        if not names:
            raise ChannelError(f"{a}: expected names of view layers with --layers, but got {wanted!r}")
        return ViewLayers(tuple(dict.fromkeys(names)))
    rendered = [name for name in in_a if name.rpartition(".")[2].casefold() != _MADE] or in_a
    both = [name for name in rendered if name in in_b]
    if not both:
        return ViewLayers(("",))  # loading says what is expected
    lines = [f"view layer {name}: in half a only, and so as in half a" for name in rendered if name not in in_b]
    return ViewLayers(tuple(both), tuple(lines))


def _named(path: str, there: Sequence[str], name: str) -> list[str]:
    """The layers that a name stands for."""
    exact = [layer for layer in there if layer.casefold() == name.casefold()]
    found = exact or [layer for layer in there if layer.casefold().startswith(f"{name.casefold()}.")]
    if not found:
        got = listed([layer for layer in there if layer])
        raise ChannelError(f"{path}: expected a view layer '{name}' with a colour for --layers, but got {got}")
    return found
