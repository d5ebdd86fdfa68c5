"""By what an output was made, as a digest: an output of the same recipe need not be made again."""

import hashlib
import json
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

from selfcorrect import exr, files
from selfcorrect.errors import FileError
from selfcorrect.exr import channels
from selfcorrect.settings import Settings

__all__ = ["recipe", "unlike"]


def recipe(sources: files.Sources, settings: Settings, made_by: Mapping[str, Any], *, cold: bool = False) -> str:
    """What an output is made by: version, settings, denoiser, layers, and the bytes of every input.

    Where the chain began is no part of it: the same frame may start cold in one chunk and warm in another.

    Args:
        sources: the inputs.
        settings: of the correction; the files they name are inputs, too.
        made_by: what else decides the output, such as the denoiser's name; plain values.
        cold: no frame starts from the one before.

    Raises:
        FileError: an input cannot be read.
    """
    parts = [path.partition("::") for path in sources.inputs if path]
    beside = [
        str(path) for half in (sources.a, sources.b) for path in channels.siblings(half.partition("::")[0]).values()
    ]
    contents = [_digest(path) for path in (*(path for path, _, _ in parts), *sorted(beside), *settings.files)]
    how = {
        "version": version("selfcorrect"),
        "settings": settings.to_dict(),
        "cold": cold,
        "made by": dict(made_by),
        "layers": [layer for _, _, layer in parts],
        "given": [bool(path) for path in sources.inputs],
        "mapping": dict(sources.mapping or {}),
        "contents": contents,
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


def _digest(path: str) -> str:
    try:
        with open(path, "rb") as stream:
            return hashlib.file_digest(stream, "blake2b").hexdigest()
    except OSError as error:
        raise FileError(f"{path}: expected an OpenEXR file, but got: {error.strerror}") from None
