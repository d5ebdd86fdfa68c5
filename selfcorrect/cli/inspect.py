"""The command `inspect`: which channels a file has, and which would be used for what."""

import argparse
from typing import Any

from selfcorrect import exr
from selfcorrect.cli import memory
from selfcorrect.cli.terminal import answer, show

__all__ = ["add"]

_MOST = "8G"
"""A file of some kilobytes may claim any number of pixels; 8K with forty channels of half floats takes 2.5 GiB."""


def add(commands: Any) -> None:
    """Add the command to argparse's subparsers."""
    parser = commands.add_parser("inspect", help="which channels a file has, and which would be used for what")
    parser.add_argument("file", metavar="FILE.exr", help="any OpenEXR file")
    parser.add_argument(
        "--maxmem",
        default=_MOST,
        metavar="SIZE",
        help="refuse a file of more pixels by its header (default: %(default)s)",
    )
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    parser.set_defaults(run=_inspect)


def _inspect(options: argparse.Namespace) -> None:
    memory.check_held(memory.parse_size(options.maxmem), options.file)
    found = exr.inspect(options.file)
    if options.json:
        answer(found.to_dict())
    else:
        show(*found.lines())
