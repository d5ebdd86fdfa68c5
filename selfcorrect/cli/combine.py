"""The command `combine`: independent with correlated renders of one frame."""

import argparse
import time

from selfcorrect import exr, renders
from selfcorrect.cli.terminal import answer, log
from selfcorrect.stages import uncorrelated

__all__ = ["run"]


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    start = time.perf_counter()
    exr.check_target(options.output)
    four = renders.load_images([*options.independent, *options.correlated])
    log(*(f"warning: {line}" for line in four.lost))
    image, gamma = uncorrelated.combine(
        four.images[:4],
        four.images[4:],
        samples=options.samples,
        crossed=options.crossed,
        kernel=options.kernel,
    )
    report = {"kernel": options.kernel, "gamma": gamma, "samples": options.samples, "crossed": options.crossed}
    clipped = renders.save_combined(options.output, four, image, details=report)
    log(f"{options.output}: written after {time.perf_counter() - start:.1f} s (gamma {gamma:g})")
    if clipped:
        log(f"{options.output}: {clipped} values beyond the range of half floats were clipped")
    if options.json:
        answer({"output": options.output, **report})
