"""The command `inspect`: which channels a file has, and which would be used for what."""

import argparse
from typing import Any

from selfcorrect import exr
from selfcorrect.cli.terminal import answer
from selfcorrect.errors import printable

__all__ = ["add"]


def add(commands: Any) -> None:
    """Add the command to argparse's subparsers."""
    parser = commands.add_parser("inspect", help="which channels a file has, and which would be used for what")
    parser.add_argument("file", metavar="FILE.exr", help="any OpenEXR file")
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    parser.set_defaults(run=_inspect)


def _inspect(options: argparse.Namespace) -> None:
    found = exr.inspect(options.file)
    if options.json:
        answer(found.to_dict())
    else:
        print("\n".join(map(printable, found.lines())))
