"""The command. Nothing else than the files cli*.py prints: results to stdout, everything else to stderr."""

import argparse
import json
import math
import tempfile
import time
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NoReturn

from selfcorrect import exr, files, metrics
from selfcorrect.cli import bench as cli_bench
from selfcorrect.cli import memory
from selfcorrect.cli import sequence as cli_sequence
from selfcorrect.cli.runner import EndOnInterrupt, Runner, add_halves, add_run_flags, answer, log, mapping, settings_of
from selfcorrect.errors import FrameError, SelfcorrectError, SettingsError, out_of_memory, printable
from selfcorrect.exr.file import one_line
from selfcorrect.frame import Frame
from selfcorrect.publish import remove_abandoned
from selfcorrect.stages import uncorrelated

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; the exit code is 0, 1 where frames of a shot failed, 2 for input that the user can mend."""
    parser = _parser()
    try:
        options = parser.parse_args(arguments)
        failed: int | None = options.run(options)
    except SelfcorrectError as error:
        log(f"selfcorrect: error: {error}")
        return 2
    except (MemoryError, RuntimeError) as error:
        if not out_of_memory(error):
            raise
        log(f"selfcorrect: error: expected enough memory for this frame, but got: {one_line(error)}; see --maxmem")
        return 2
    except KeyboardInterrupt:
        log("selfcorrect: interrupted; what was not finished is not written")
        return 130
    return 1 if failed else 0


class _Parser(argparse.ArgumentParser):
    """One line for a wrong flag, like for every other wrong input."""

    def error(self, message: str) -> NoReturn:
        raise SettingsError(f"{message}; see {self.prog} --help")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="selfcorrect", description="Gives denoised Monte Carlo renders their detail back.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    frame = commands.add_parser("frame", help="correct one frame")
    add_halves(frame)
    frame.add_argument(
        "--sub-images",
        nargs=4,
        metavar=("A1.exr", "A2.exr", "B1.exr", "B2.exr"),
        help="the two renders whose mean is half a, and those of half b, for the stage deep-combiner-4",
    )
    frame.add_argument("-o", "--output", required=True, metavar="OUT.exr")
    frame.add_argument(
        "--maxmem",
        metavar="SIZE",
        help="most memory to take, such as 6G; a frame that does not fit is refused at once. OIDN works in what is "
        "left, with the same result; other denoisers are not held to it",
    )
    add_run_flags(frame)
    frame.set_defaults(run=_frame)

    cli_sequence.add(commands)
    cli_bench.add(commands)

    inspect = commands.add_parser("inspect", help="which channels a file has, and which would be used for what")
    inspect.add_argument("file", metavar="FILE.exr")
    inspect.add_argument("--json", action="store_true", help="one JSON object on stdout")
    inspect.set_defaults(run=_inspect)

    compare = commands.add_parser("compare", help="error of an image against one or two references")
    compare.add_argument("image", metavar="IMAGE.exr")
    compare.add_argument("reference", metavar="REF.exr")
    compare.add_argument("reference_b", metavar="REF2.exr", nargs="?", help="an independent second reference")
    compare.add_argument("--weight", metavar="SMOOTH.exr", help="smooth reference for the weight of relMSE")
    compare.add_argument("--seed", type=int, default=0, help="of the bootstrap")
    compare.add_argument("--json", action="store_true", help="one JSON object on stdout")
    compare.set_defaults(run=_compare)

    combine = commands.add_parser("combine", help="combine independent with correlated renders of one frame")
    combine.add_argument("independent", nargs=4, metavar="Y.exr", help="four renders with independent samples")
    combine.add_argument(
        "--correlated", nargs=4, required=True, metavar="Z.exr", help="four with common random numbers"
    )
    combine.add_argument("-o", "--output", required=True, metavar="OUT.exr")
    combine.add_argument("--samples", type=int, required=True, metavar="N", help="per pixel, of each render")
    combine.add_argument("--crossed", action="store_true", help="for a Z that was made from the Y of its number")
    combine.add_argument("--kernel", default=uncorrelated.KERNELS[0], choices=uncorrelated.KERNELS)
    combine.add_argument("--json", action="store_true", help="one JSON object on stdout")
    combine.set_defaults(run=_combine)

    demo = commands.add_parser("demo", help="correct the packaged frame and show what was gained")
    demo.add_argument("-o", "--output", metavar="DIR", help="keep the images here")
    add_run_flags(demo)
    demo.set_defaults(run=_demo, maxmem=None)
    return parser


def _frame(options: argparse.Namespace) -> None:
    sources = files.Sources(
        options.a,
        options.b,
        options.denoised_a,
        options.denoised_b,
        options.denoised,
        mapping(options),
        tuple(options.sub_images or ()),
    )
    report = _run(options, sources, options.output)
    if options.json:
        answer(report)


def _run(
    options: argparse.Namespace, sources: files.Sources, output: str, show: Callable[[Frame], None] | None = None
) -> dict[str, Any]:
    """Correct one frame from files to file; returns what --json prints. ``show`` is called with the denoised frame."""
    start = time.perf_counter()
    scratch = None
    if options.maxmem is not None:
        scratch = memory.scratch_within(memory.parse_size(options.maxmem), sources, settings_of(options))
    runner = Runner(options, given=sources.denoised_a is not None, scratch=scratch)
    remove_abandoned(exr.check_target(output).parent)
    with EndOnInterrupt() as stop:
        corrected = runner.correct(files.load(sources), began=start, show=show, stop=stop)
        return runner.write(output, corrected, {})


def _inspect(options: argparse.Namespace) -> None:
    found = exr.inspect(options.file)
    if options.json:
        print(json.dumps(found.to_dict()))
    else:
        print("\n".join(map(printable, found.lines())))


def _compare(options: argparse.Namespace) -> None:
    image, reference = (exr.load_half(path).buffers["color"] for path in (options.image, options.reference))
    reference_b, weight = (
        None if path is None else exr.load_half(path).buffers["color"] for path in (options.reference_b, options.weight)
    )
    try:
        result = metrics.compare(image, reference, reference_b, weight, seed=options.seed)
    except FrameError as error:
        raise FrameError(f"{options.image}: {error}") from None
    if options.json:
        # JSON has no infinity (the PSNR of equal images) and no NaN (the standard error of one tile)
        print(json.dumps({name: value if math.isfinite(value) else None for name, value in vars(result).items()}))
        return
    print(f"relMSE               {result.relmse:.6g} ± {result.relmse_standard_error:.2g}")
    print(f"PSNR (tone-mapped)   {result.psnr:.2f} dB")
    print(f"SSIM (tone-mapped)   {result.ssim:.4f}")
    print(f"FLIP                 {result.flip:.4f}")
    print(f"mean radiance ratio  {result.mean_radiance_ratio:.4f}")


def _combine(options: argparse.Namespace) -> None:
    start = time.perf_counter()
    exr.check_target(options.output)
    four = files.load_images([*options.independent, *options.correlated])
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


def _demo(options: argparse.Namespace) -> None:
    """The main job on the packaged frame, with what it brought beside its references."""
    with resources.as_file(resources.files("selfcorrect") / "data") as data, tempfile.TemporaryDirectory() as away:
        folder = Path(options.output or away)
        folder.mkdir(parents=True, exist_ok=True)
        names = {
            name: str(data / f"demo_{name}.exr") for name in ("064spp_A", "064spp_B", "ref_A", "ref_B", "ref_smooth")
        }
        sources = files.Sources(names["064spp_A"], names["064spp_B"], mapping=mapping(options))
        frames: list[Frame] = []
        report = _run(options, sources, str(folder / "corrected.exr"), frames.append)
        frame = frames[0]
        color = [exr.load_half(names[n]).buffers["color"] for n in ("ref_A", "ref_B", "ref_smooth")]
        images = {
            "noisy": (frame.color[0] + frame.color[1]) / 2,
            "denoised": frame.denoised_full,
            "corrected": exr.load_half(report["output"]).buffers["color"],
        }
        report["relmse"] = {name: metrics.relmse(image, *color) for name, image in images.items()}
        report["mean"] = {name: metrics.mean_radiance_ratio(image, color[2]) for name, image in images.items()}
    if options.json:
        answer(report)
        return
    for name in images:
        print(
            f"{name:10} relMSE {report['relmse'][name]:.5f}   mean radiance {report['mean'][name]:.4f} of the reference"
        )
    change = report["relmse"]["corrected"] / report["relmse"]["denoised"] - 1
    print(f"corrected against denoised: {change:+.0%}" + (f"; image in {folder}" if options.output else ""))
