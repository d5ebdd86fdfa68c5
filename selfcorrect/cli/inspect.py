"""The command `inspect`: which channels a file has, and which would be used for what."""

import argparse
from typing import Any

from selfcorrect import exr
from selfcorrect.cli import memory
from selfcorrect.cli.terminal import answer, log, show
from selfcorrect.exr.file import headers
from selfcorrect.exr.limits import stored_bytes

__all__ = ["add"]

# A file of some kilobytes may claim any number of pixels; those of renders take up to so many times their file.
_MOST = memory.GIB // 4
_BLOWN_UP = 32


def add(commands: Any) -> None:
    """Add the command to argparse's subparsers."""
    parser = commands.add_parser("inspect", help="which channels a file has, and which would be used for what")
    parser.add_argument("file", metavar="FILE.exr", help="any OpenEXR file")
    parser.add_argument(
        "--maxmem",
        metavar="SIZE",
        help="of pixels that take more, tell only what the header says (default: 256M, or 32 times the file's size)",
    )
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    parser.set_defaults(run=_inspect)


def _inspect(options: argparse.Namespace) -> None:
    taken, size = stored_bytes(options.file), headers(options.file.partition("::")[0])[1]
    most = max(_MOST, _BLOWN_UP * size) if options.maxmem is None else memory.parse_size(options.maxmem) - memory.BASE
    found = exr.inspect(options.file, most=int(most))
    if taken > most:
        log(
            f"warning: {options.file}: its pixels are not read: by its header they take {taken / memory.GIB:.1f}G; "
            f"--maxmem {memory.rounded(taken + memory.BASE)} reads them"
        )
    if options.json:
        answer(found.to_dict())
    else:
        show(*found.lines())
