"""Every command and its flags: all that help and wrong flags need, so that neither waits for torch.

What a command does stands in the module of its name, which is imported when the command runs.
"""

import argparse
from collections.abc import Callable
from importlib import import_module
from typing import Any

from selfcorrect import start
from selfcorrect.cli import completion, flags, settings
from selfcorrect.errors import SettingsError
from selfcorrect.settings import COMBINE_KERNELS

__all__ = ["add"]


def add(commands: Any) -> None:
    """Add the commands to argparse's subparsers."""
    for command in (_frame, _sequence, _bench, _inspect, _compare, _report, _combine, settings.add, _demo):
        command(commands)
    completion.add(commands)


def _later(module: str, check: Callable[[argparse.Namespace], None] | None = None) -> Callable[..., int | None]:
    """A command's function, by the module that has it; ``check`` of the options comes before the import."""

    def run(options: argparse.Namespace) -> int | None:
        if check is not None:
            check(options)
        command = import_module(f"selfcorrect.cli.{module}")
        start.begun()
        result: int | None = command.run(options)
        return result

    return run


def _check_frame(options: argparse.Namespace) -> None:
    if options.b is not None and options.output is None:  # what to do without half b, the command itself says
        raise SettingsError("expected --output, but got none; see --help")
    flags.check(options)


def _frame(commands: Any) -> None:
    parser = commands.add_parser("frame", usage="%(prog)s A.exr B.exr -o OUT.exr [flags]", help="correct one frame")
    flags.add_halves(parser)
    flags.add_extra(parser)
    parser.add_argument("-o", "--output", metavar="OUT.exr", help="half a with its colour corrected")
    flags.add_maxmem(parser)
    flags.add_report(parser)
    flags.add_aovs(parser)
    flags.add_layers(parser)
    flags.add_written(parser)
    flags.add_run_flags(parser, everyday=("time_budget",))
    parser.set_defaults(run=_later("frame", _check_frame))


def _sequence(commands: Any) -> None:
    parser = commands.add_parser("sequence", help="correct the frames of a shot, each from the last one's network")
    parser.add_argument("a", metavar="A.####.exr", help="half a; #### or %%04d stands for the frame number")
    parser.add_argument("b", metavar="B.####.exr", help="half b, rendered with another seed")
    parser.add_argument("-o", "--output", required=True, metavar="OUT.####.exr", help="one for each frame")
    parser.add_argument("--frames", required=True, metavar="RANGE", help="1-240, 1-240x2, 1-3,5,7-20:2, …")
    parser.add_argument("--denoised-a", metavar="DA.####.exr", help="denoised half a, instead of a denoiser")
    parser.add_argument("--denoised-b", metavar="DB.####.exr", help="denoised half b")
    parser.add_argument("--denoised-full", metavar="D.####.exr", help="denoised mean of both halves")
    parser.add_argument(
        "--skip-existing", action="store_true", help="leave out frames whose output is whole and made the same way"
    )
    parser.add_argument("--cold", action="store_true", help="no frame starts from the one before")
    parser.add_argument("--warm-start", metavar="STATE", help="state that the first frame starts from")
    parser.add_argument(
        "--save-state", metavar="STATE.safetensors", help="keep the last frame's state here; with ####, that of each"
    )
    parser.add_argument("--fail-fast", action="store_true", help="end with the first frame that fails")
    flags.add_maxmem(parser)
    flags.add_report(parser)
    flags.add_aovs(parser)
    flags.add_layers(parser)
    flags.add_written(parser)
    flags.add_run_flags(parser, everyday=("frame_radius", "time_budget"))
    parser.set_defaults(run=_later("sequence", flags.check))


def _bench(commands: Any) -> None:
    parser = commands.add_parser(
        "bench",
        usage="%(prog)s A.exr B.exr [flags]",
        help="what each second buys on this frame, and the preset to take",
    )
    flags.add_halves(parser)
    parser.add_argument(
        "--points",
        nargs="+",
        action="extend",
        metavar="POINT",
        help="try these: presets, base (the settings given), SETTING=VALUE,…, PRESET:SETTING=VALUE,…",
    )
    parser.add_argument(
        "--previous", nargs=2, metavar=("A.exr", "B.exr"), help="the frame before: also try a warm start from it"
    )
    parser.add_argument("--csv", metavar="OUT.csv", help="keep the measurements here, after each point")
    parser.add_argument("--plot", metavar="OUT.png", help="seconds against error (needs the extra bench)")
    flags.add_report(parser)
    flags.add_run_flags(parser)
    parser.set_defaults(run=_later("bench", flags.check), diagnostics=[])  # it writes no image


def _inspect(commands: Any) -> None:
    parser = commands.add_parser("inspect", help="which channels a file has, and which would be used for what")
    parser.add_argument("file", metavar="FILE.exr", help="any OpenEXR file")
    parser.add_argument(
        "--maxmem",
        metavar="SIZE",
        help="of pixels that take more, tell only what the header says (default: 256M, or 32 times the file's size)",
    )
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    parser.set_defaults(run=_later("inspect"))


def _compare(commands: Any) -> None:
    parser = commands.add_parser("compare", help="error of an image against one or two references")
    parser.add_argument("image", metavar="IMAGE.exr", help="what is compared")
    parser.add_argument("reference", metavar="REF.exr", help="what it should be")
    parser.add_argument("reference_b", metavar="REF2.exr", nargs="?", help="an independent second reference")
    parser.add_argument("--weight", metavar="SMOOTH.exr", help="smooth reference for the weight of relMSE")
    parser.add_argument("--seed", type=int, default=0, help="of the bootstrap")
    parser.add_argument(
        "--shot",
        action="store_true",
        help="names hold #### for the frame number: errors of every frame and of the change from frame to frame",
    )
    parser.add_argument("--maxmem", metavar="SIZE", help="refuse images that need more memory, such as 6G")
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    parser.set_defaults(run=_later("compare"))


def _report(commands: Any) -> None:
    parser = commands.add_parser("report", help="a page to look at a corrected frame, for any browser")
    flags.add_halves(parser, alone=False)
    parser.add_argument(
        "corrected", metavar="OUT.exr", help="what `selfcorrect frame` wrote; with --diagnostics, it has maps"
    )
    parser.add_argument("-o", "--output", required=True, metavar="PAGE.html", help="the page")
    parser.add_argument("--reference", metavar="REF.exr", help="a reference to look at and to measure against")
    parser.add_argument("--denoiser", metavar="NAME", help="who denoises again; by default who did it for OUT.exr")
    parser.add_argument("--threads", type=int, metavar="N", help="CPU threads of the denoiser, by default all")
    parser.add_argument("--map", action="append", default=[], metavar="ROLE=CHANNEL", help="albedo=MyAlbedo, …")
    parser.set_defaults(run=_later("report"))


def _combine(commands: Any) -> None:
    parser = commands.add_parser("combine", help="combine independent with correlated renders of one frame")
    parser.add_argument("independent", nargs=4, metavar="Y.exr", help="four renders with independent samples")
    parser.add_argument("--correlated", nargs=4, required=True, metavar="Z.exr", help="four with common random numbers")
    parser.add_argument("-o", "--output", required=True, metavar="OUT.exr", help="the combined image")
    parser.add_argument("--samples", type=int, required=True, metavar="N", help="per pixel, of each render")
    parser.add_argument("--crossed", action="store_true", help="for a Z that was made from the Y of its number")
    parser.add_argument("--kernel", default=COMBINE_KERNELS[0], choices=COMBINE_KERNELS, help="of the weights")
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    parser.set_defaults(run=_later("combine"))


def _demo(commands: Any) -> None:
    parser = commands.add_parser("demo", help="correct the packaged frame and show what was gained")
    parser.add_argument("-o", "--output", metavar="DIR", help="keep the images here")
    flags.add_written(parser)
    flags.add_run_flags(parser, everyday=("time_budget",))
    parser.set_defaults(run=_later("demo", flags.check))
