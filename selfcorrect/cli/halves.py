"""A frame's two halves on the command line; and what to give instead of one file or a folder."""

import argparse
import re
import shlex
from collections.abc import Sequence
from pathlib import Path

from selfcorrect.errors import FileError
from selfcorrect.exr import channels
from selfcorrect.exr.file import headers

__all__ = ["check"]

_HALF_A = re.compile(r"(?<![a-z])a(?![a-z])", re.IGNORECASE)
_NUMBER = re.compile(r"\d+(?=\.exr$)", re.IGNORECASE)
_ANOTHER_SEED = "render the frame twice, with half of the samples and another seed each"


def check(options: argparse.Namespace) -> None:
    """Raise where there are not two halves, or one is a folder, and say what to give instead.

    Args:
        options: what the flags of :func:`selfcorrect.cli.flags.add_halves` gave.

    Raises:
        FileError: half b is missing, or a half is a folder.
    """
    for path in (options.a, options.b):
        if path is not None and Path(path).is_dir():
            raise FileError(f"{path}: expected half a and half b, but got a folder; {_in_folder(Path(path))}")
    if options.b is None:
        raise FileError(f"{options.a}: expected half a and half b, but got one file; {_in_file(options.a)}")


def _in_folder(folder: Path) -> str:
    """What to give instead of a folder."""
    names = sorted(path.name for path in folder.iterdir() if path.suffix.lower() == ".exr")
    pairs = [pair for name in names if (pair := _pair(name, names)) is not None]
    if not names:
        return "there is no EXR file in it"
    if not pairs:
        return f"name two of its files, such as {shlex.quote(str(folder / names[0]))}"
    shots = [pair for pair in pairs if _NUMBER.search(pair[0])]
    if len(shots) > 1:
        numbers = [int(found[0]) for pair in shots if (found := _NUMBER.search(pair[0]))]
        a, b = (shlex.quote(str(folder / _NUMBER.sub("####", name))) for name in shots[0])
        return f"for a shot, run: selfcorrect sequence {a} {b} -o 'OUT.####.exr' --frames {min(numbers)}-{max(numbers)}"
    a, b = (shlex.quote(str(folder / name)) for name in pairs[0])
    return f"for a frame, run: selfcorrect frame {a} {b} -o OUT.exr"


def _pair(name: str, names: Sequence[str]) -> tuple[str, str] | None:
    """A half a with its half b, where both are among the names."""
    for found in _HALF_A.finditer(name):
        other = name[: found.start()] + ("b" if found[0] == "a" else "B") + name[found.end() :]
        if other in names:
            return name, other
    return None


def _in_file(path: str) -> str:
    """What to give instead of one file: its layers where it has two, which may be the halves."""
    file = path.partition("::")[0]
    parts, _ = headers(file)
    named = [(part.name, [channel.name for channel in part.channels]) for part in parts]
    names = [name for names in channels.full_names(named, parts[0].views) for name in names]
    layers = channels.layers(names)
    colored = sorted(
        above
        for name in names
        if (above := name.removesuffix(".R")) != name and {f"{above}.G", f"{above}.B"} <= {*names}
    )
    pair = next(filter(None, (_pair(layer, [*layers, *colored]) for layer in [*layers, *colored])), tuple(layers[:2]))
    if len(pair) < 2:
        return _ANOTHER_SEED
    a, b = (shlex.quote(f"{file}::{layer}" if layer else file) for layer in pair)
    return f"if two of its layers are the halves, name them, such as {a} {b}; if none are, {_ANOTHER_SEED}"
