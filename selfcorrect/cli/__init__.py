"""The command. Nothing outside this package prints: results go to stdout, everything else to stderr."""

import argparse
import warnings
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from selfcorrect.cli import commands
from selfcorrect.cli.help import Parser
from selfcorrect.cli.terminal import log, show, terminable
from selfcorrect.errors import MissingKernelsWarning, SelfcorrectError, one_line, out_of_memory

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; the exit code is 0, 1 where frames of a shot failed, 2 for input that the user can fix."""
    warnings.simplefilter("ignore", MissingKernelsWarning)  # the runner tells of it, in a line of the log
    try:
        options = _parser().parse_args(arguments)
        with terminable():
            failed: int | None = options.run(options)
    except SelfcorrectError as error:
        log(f"selfcorrect: error: {error}")
        return 2
    except (MemoryError, RuntimeError) as error:
        if not out_of_memory(error):
            raise
        log(f"selfcorrect: error: expected enough memory for this frame, but got: {one_line(error)}; see --maxmem")
        return 2
    except OSError as error:
        named = f"{error.filename}: " if error.filename else ""
        log(f"selfcorrect: error: {named}expected a file to work with, but got: {error.strerror or one_line(error)}")
        return 2
    except KeyboardInterrupt:
        log("selfcorrect: interrupted; what was not finished is not written")
        return 130
    return 1 if failed else 0


class _Version(argparse.Action):
    """Looks the version up when it is asked for: what reads it is slow to import."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        show(f"selfcorrect {import_module('importlib.metadata').version('selfcorrect')}")
        parser.exit()


def _parser() -> Parser:
    parser = Parser(prog="selfcorrect", description="Gives denoised Monte Carlo renders their detail back.")
    parser.add_argument("--version", action=_Version, nargs=0, help="show program's version number and exit")
    commands.add(parser.add_subparsers(required=True, metavar="COMMAND"))
    return parser
