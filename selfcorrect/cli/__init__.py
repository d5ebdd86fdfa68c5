"""The command. Nothing outside this package prints: results go to stdout, everything else to stderr."""

import warnings
from collections.abc import Sequence
from importlib.metadata import version

from selfcorrect import start
from selfcorrect.cli import bench, combine, compare, completion, demo, frame, inspect, report, sequence, settings
from selfcorrect.cli.help import Parser
from selfcorrect.cli.terminal import log, terminable
from selfcorrect.errors import SelfcorrectError, out_of_memory
from selfcorrect.exr.file import one_line
from selfcorrect.kernel.compiled import MissingKernelsWarning

__all__ = ["main"]

_COMMANDS = (frame, sequence, bench, inspect, compare, report, combine, settings, demo, completion)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; the exit code is 0, 1 where frames of a shot failed, 2 for input that the user can fix."""
    warnings.simplefilter("ignore", MissingKernelsWarning)  # the runner tells of it, in a line of the log
    try:
        start.begun()
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


def _parser() -> Parser:
    parser = Parser(prog="selfcorrect", description="Gives denoised Monte Carlo renders their detail back.")
    parser.add_argument("--version", action="version", version=f"selfcorrect {version('selfcorrect')}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for command in _COMMANDS:
        command.add(commands)
    return parser
