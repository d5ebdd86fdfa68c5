"""The command `settings`: every setting with its value, what it means and where the value comes from."""

import argparse
import shutil
import textwrap
from dataclasses import fields
from itertools import zip_longest
from typing import Any

from selfcorrect.cli import flags
from selfcorrect.cli.terminal import answer, show
from selfcorrect.settings import Settings

__all__ = ["add"]

_LEAST_WIDTH = 100  # of the table, characters
_SOURCE = 34  # of its last column


def add(commands: Any) -> None:
    """Add the command to argparse's subparsers."""
    parser = commands.add_parser("settings", help="every setting of a preset: value, meaning, source")
    flags.add_preset(parser)
    flags.add_settings(parser)
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout: names and values")
    parser.set_defaults(run=_settings)


def _settings(options: argparse.Namespace) -> None:
    settings = flags.settings_of(options)
    if options.json:
        answer(settings.to_dict())
        return
    width = max(shutil.get_terminal_size().columns, _LEAST_WIDTH)
    rows = [("setting", "value", "meaning", "source")]
    rows += [(f.name, _shown(getattr(settings, f.name)), _meaning(f), f.metadata["source"]) for f in fields(Settings)]
    name, value = (max(len(row[i]) for row in rows) for i in (0, 1))
    widths = name, value, width - name - value - _SOURCE - 6, _SOURCE
    show(*(line for row in rows for line in _lines(row, widths)))


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    return str(value) or "–"


def _meaning(setting: Any) -> str:
    help_, choices = setting.metadata["help"], setting.metadata["choices"]
    return f"{help_} ({' | '.join(choices)})" if choices else str(help_)


def _lines(row: tuple[str, ...], widths: tuple[int, ...]) -> list[str]:
    """A row of the table, each cell wrapped to its width."""
    cells = [textwrap.wrap(cell, width) for cell, width in zip(row, widths, strict=True)]
    return [
        "  ".join(part.ljust(width) for part, width in zip(parts, widths, strict=True)).rstrip()
        for parts in zip_longest(*cells, fillvalue="")
    ]
