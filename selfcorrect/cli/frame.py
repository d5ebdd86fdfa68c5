"""The command `frame`: one frame, from files to file."""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace

from selfcorrect import exr, files
from selfcorrect.cli import flags, halves, memory, pages
from selfcorrect.cli.runner import Corrected, Runner
from selfcorrect.cli.terminal import EndOnInterrupt, answer, log
from selfcorrect.errors import SettingsError
from selfcorrect.facts import Written
from selfcorrect.frame import Frame
from selfcorrect.publish import remove_abandoned
from selfcorrect.settings import ALL_LAYERS

__all__ = ["correct_files", "run"]


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    halves.check(options)
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
    """Correct one frame from files to file; ``show`` is called with the denoised frame, ``gather`` with that of
    each view layer and its result.
    """
    layers, told = sources.of_layers(getattr(options, "view_layers", ALL_LAYERS))
    log(*told)
    extra = sum(len(paths) for paths in flags.extra_files(options, flags.settings_of(options)).values())
    if extra and len(layers) > 1:
        raise SettingsError(
            f"{sources.a}: expected one view layer, FILE.exr::LAYER, beside images of a stage, but got {len(layers)}"
        )
    scratch = memory.fitted(options, maxmem, layers[0][1], extra=extra, layers=len(layers))
    runner = Runner(options, given=sources.denoised_a is not None, scratch=scratch, layers=len(layers))
    remove_abandoned(exr.check_target(output).parent)
    done = list[Corrected]()
    with EndOnInterrupt() as stop:
        for layer, own in layers:  # one after the other: only what they become is kept
            start = time.perf_counter()
            loaded = replace(files.load(own), layer=layer)
            denoised = runner.denoise(loaded, start)
            del loaded
            first = not done
            done.append(runner.correct(denoised, show=show if first else None, stop=stop, gather=gather))
            del denoised
        return runner.write(output, done[0], done[1:])
