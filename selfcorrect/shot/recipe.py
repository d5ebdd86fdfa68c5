"""By what an output was made, as a digest: an output of the same recipe need not be made again."""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

from selfcorrect import exr, files
from selfcorrect.errors import FileError
from selfcorrect.exr import channels
from selfcorrect.settings import Settings

__all__ = ["Digests", "recipe", "unlike"]


class Digests:
    """Digests of files: those of the frames around are asked for again and again, and read once."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, int, int, int], str] = {}

    def of(self, path: str) -> str:
        """Of a file's bytes.

        Raises:
            FileError: it cannot be read.
        """
        try:
            found = os.stat(path)
            key = path, found.st_ino, found.st_size, found.st_mtime_ns
            if key not in self._known:
                with open(path, "rb") as stream:
                    self._known[key] = hashlib.file_digest(stream, "blake2b").hexdigest()
            return self._known[key]
        except OSError as error:
            raise FileError(f"{path}: expected an OpenEXR file, but got: {error.strerror}") from None


def recipe(
    sources: files.Sources,
    settings: Settings,
    made_by: Mapping[str, Any],
    *,
    cold: bool = False,
    around: Sequence[files.Sources] = (),
    digests: Digests | None = None,
) -> str:
    """What an output is made by: version, settings, denoiser, layers, and the bytes of every input.

    Where the chain began is no part of it: the same frame may start cold in one chunk and warm in another.

    Args:
        sources: the inputs.
        settings: of the correction; the files they name are inputs, too.
        made_by: what else decides the output, such as the denoiser's name; plain values.
        cold: no frame starts from the one before.
        around: the neighbours, whose files need not be there.
        digests: those that are known already.

    Raises:
        FileError: an input cannot be read.
    """
    digests = Digests() if digests is None else digests
    parts = [path.partition("::") for path in sources.inputs if path]
    contents = [digests.of(path) for path in (*_files(sources), *settings.files)]
    how = {
        "version": version("selfcorrect"),
        "settings": settings.to_dict(),
        "cold": cold,
        "made by": dict(made_by),
        "layers": [layer for _, _, layer in parts],
        "given": [bool(path) for path in sources.inputs],
        "mapping": dict(sources.mapping or {}),
        "contents": contents,
        "around": [_there(neighbour, digests) for neighbour in around],
    }
    return hashlib.blake2b(json.dumps(how, sort_keys=True).encode(), digest_size=16).hexdigest()


def unlike(output: str, made: str) -> str:
    """Why an output that is there is not the one that this recipe makes; empty where it is."""
    try:
        header = exr.read(output).parts[0].header
    except FileError as error:
        return str(error)
    try:
        run = json.loads(header.get("selfcorrect/run", ""))
    except (ValueError, TypeError, RecursionError):  # no JSON, an attribute of another type, brackets without end
        run = None
    if not isinstance(run, dict) or "recipe" not in run:
        return f"{output}: expected an output of selfcorrect sequence, but got another file"
    if run["recipe"] != made:
        return f"{output}: expected an output of these inputs and settings, but got one of others"
    return ""


def _files(sources: files.Sources) -> list[str]:
    """The frame's own and those that lie beside its halves."""
    own = [path.partition("::")[0] for path in sources.paths]
    beside = [
        str(path) for half in (sources.a, sources.b) for path in channels.siblings(half.partition("::")[0]).values()
    ]
    return own + sorted(beside)


def _there(sources: files.Sources, digests: Digests) -> list[str] | None:
    """What a neighbour's files hold; None where one of them cannot be read."""
    try:
        return [digests.of(path) for path in _files(sources)]
    except FileError:
        return None
