"""The command `frame`: one frame, from files to file."""

import argparse
import time
from collections.abc import Callable
from typing import Any

from selfcorrect import exr, files
from selfcorrect.cli import flags, halves, memory, pages
from selfcorrect.cli.runner import Runner
from selfcorrect.cli.terminal import EndOnInterrupt, answer
from selfcorrect.facts import Written
from selfcorrect.frame import Frame
from selfcorrect.publish import remove_abandoned

__all__ = ["add", "correct_files"]


def add(commands: Any) -> None:
    """Add the command to argparse's subparsers."""
    parser = commands.add_parser("frame", usage="%(prog)s A.exr B.exr -o OUT.exr [flags]", help="correct one frame")
    halves.add(parser)
    flags.add_extra(parser)
    parser.add_argument("-o", "--output", metavar="OUT.exr", help="half a with its colour corrected")
    flags.add_maxmem(parser)
    pages.add_flag(parser)
    flags.add_aovs(parser)
    flags.add_run_flags(parser)
    parser.set_defaults(run=_frame)


def _frame(options: argparse.Namespace) -> None:
    halves.check(options, "output")
    sources = files.Sources(
        options.a, options.b, **flags.denoised(options), mapping=flags.mapping(options), aovs=options.aovs
    )
    page = pages.FramePage.at(options.report)
    gather = None if page is None else page.gather
    written = correct_files(options, sources, options.output, maxmem=options.maxmem, gather=gather)
    if page is not None:
        page.write(written.to_dict())
    if options.json:
        answer(written.to_dict())


def correct_files(
    options: argparse.Namespace,
    sources: files.Sources,
    output: str,
    *,
    maxmem: str | None = None,
    show: Callable[[Frame], None] | None = None,
    gather: pages.Gather | None = None,
) -> Written:
    """Correct one frame from files to file; ``show`` is called with the denoised frame, ``gather`` with it and the
    result.
    """
    start = time.perf_counter()
    extra = sum(len(paths) for paths in flags.extra_files(options, flags.settings_of(options)).values())
    scratch = memory.fitted(options, maxmem, sources, extra=extra)
    runner = Runner(options, given=sources.denoised_a is not None, scratch=scratch)
    remove_abandoned(exr.check_target(output).parent)
    with EndOnInterrupt() as stop:
        denoised = runner.denoise(files.load(sources), start)
        corrected = runner.correct(denoised, show=show, stop=stop, gather=gather)
        return runner.write(output, corrected)
