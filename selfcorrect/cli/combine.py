"""The command `combine`: independent with correlated renders of one frame."""

import argparse
import time
from typing import Any

from selfcorrect import exr, files
from selfcorrect.cli.terminal import answer, log
from selfcorrect.stages import uncorrelated

__all__ = ["add"]


def add(commands: Any) -> None:
    """Add the command to argparse's subparsers."""
    parser = commands.add_parser("combine", help="combine independent with correlated renders of one frame")
    parser.add_argument("independent", nargs=4, metavar="Y.exr", help="four renders with independent samples")
    parser.add_argument("--correlated", nargs=4, required=True, metavar="Z.exr", help="four with common random numbers")
    parser.add_argument("-o", "--output", required=True, metavar="OUT.exr", help="the combined image")
    parser.add_argument("--samples", type=int, required=True, metavar="N", help="per pixel, of each render")
    parser.add_argument("--crossed", action="store_true", help="for a Z that was made from the Y of its number")
    parser.add_argument(
        "--kernel", default=uncorrelated.KERNELS[0], choices=uncorrelated.KERNELS, help="of the weights"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    parser.set_defaults(run=_combine)


def _combine(options: argparse.Namespace) -> None:
    start = time.perf_counter()
    exr.check_target(options.output)
    four = files.load_images([*options.independent, *options.correlated])
    log(*(f"warning: {line}" for line in four.lost))
    image, gamma = uncorrelated.combine(
        four.images[:4],
        four.images[4:],
        samples=options.samples,
        crossed=options.crossed,
        kernel=options.kernel,
    )
    report = {"kernel": options.kernel, "gamma": gamma, "samples": options.samples, "crossed": options.crossed}
    clipped = files.save_combined(options.output, four, image, details=report)
    log(f"{options.output}: written after {time.perf_counter() - start:.1f} s (gamma {gamma:g})")
    if clipped:
        log(f"{options.output}: {clipped} values beyond the range of half floats were clipped")
    if options.json:
        answer({"output": options.output, **report})
