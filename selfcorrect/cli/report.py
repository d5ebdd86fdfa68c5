"""The command `report`: a page of a frame that was corrected before, from its files."""

import argparse
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import denoisers
from selfcorrect import exr, files, metrics, report
from selfcorrect.cli import flags, pages
from selfcorrect.cli.terminal import log
from selfcorrect.errors import FrameError, SettingsError
from selfcorrect.frame import Frame, mean
from selfcorrect.image.repair import repaired

__all__ = ["add"]

_AGAIN = tuple(name for name in denoisers.names() if ":" not in name)
"""What may run because a file names it: no command and no code of anyone's."""


def add(commands: Any) -> None:
    """Add the command to argparse's subparsers."""
    parser = commands.add_parser("report", help="a page to look at a corrected frame, for any browser")
    flags.add_halves(parser)
    parser.add_argument("corrected", metavar="OUT.exr", help="what `selfcorrect frame` wrote; with --aov, it has maps")
    parser.add_argument("-o", "--output", required=True, metavar="PAGE.html")
    parser.add_argument("--reference", metavar="REF.exr", help="a reference to look at and to measure against")
    parser.add_argument("--denoiser", metavar="NAME", help="who denoises again; by default who did it for OUT.exr")
    parser.add_argument("--threads", type=int, metavar="N", help="CPU threads, by default all")
    parser.add_argument("--map", action="append", default=[], metavar="ROLE=CHANNEL", help="albedo=MyAlbedo, …")
    parser.set_defaults(run=_report)


def _report(options: argparse.Namespace) -> None:
    page = exr.check_target(options.output, ".html")
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    sources = files.Sources(options.a, options.b, **flags.denoised(options), mapping=flags.mapping(options))
    loaded = files.load(sources)
    frame, out = loaded.frame, exr.load_half(options.corrected)
    facts = pages.facts_of(out.file)
    images = {"corrected": _like(frame, options.a, out.buffers["color"], options.corrected)}
    if options.reference is not None:
        reference = exr.load_half(options.reference).buffers["color"]
        images["reference"] = _like(frame, options.a, reference, options.reference)
    images = {"noisy": mean(frame.color), "denoised": _denoised(options, frame, facts.get("denoiser")), **images}
    names = {name: f"selfcorrect.{name}" for name in pages.MAPS}
    maps = {name: out.file.pixels(c) for name, c in names.items() if c in out.file.channel_names}
    if not maps:
        log(f"{options.corrected}: no maps of error and blend weight; `frame --aov error,blend` writes them")
    facts |= {
        "title": Path(options.corrected.partition("::")[0]).name,
        "size": {"width": frame.size[1], "height": frame.size[0]},
        "channels": loaded.origin.taken,
        "repairs": {name: repairs._asdict() for name, repairs in frame.repairs.items()},
        "constant": frame.constant,
    }
    if "reference" in images:
        shown = ("noisy", "denoised", "corrected")
        facts["relmse"] = {name: metrics.relmse(images[name], images["reference"]) for name in shown}
    small = {name: report.shrunk(image) for name, image in images.items()}
    pages.write(page, report.frame_page(small, {name: report.shrunk(one) for name, one in maps.items()}, facts))
    log(f"{options.output}: written")


def _like(frame: Frame, half: str, image: Any, path: str) -> Tensor:
    """An image of the frame's size, repaired."""
    if image.shape[:2] != frame.size:
        height, width = frame.size
        raise FrameError(
            f"{path}: expected {width}x{height} pixels like {half}, but got {image.shape[1]}x{image.shape[0]}"
        )
    return repaired(image, path).clamp(min=0)


def _denoised(options: argparse.Namespace, frame: Frame, known: str | None) -> Tensor:
    """The denoised image that the output was made from: named, in the halves' files, or denoised again."""
    if options.denoiser is None:
        if frame.denoised_full is not None:
            full: Tensor = frame.denoised_full
            return full
        named = options.denoised_a is not None
        if frame.denoised is not None and (named or known in (None, "given")):
            return frame.candidates[0].full
        if known not in _AGAIN:
            told = "does not say who denoised it" if known is None else f"was denoised by {known!r}"
            raise SettingsError(
                f"{options.corrected}: expected --denoised D.exr or --denoiser NAME, as the file {told}, "
                "but got neither"
            )
    name = options.denoiser or str(known)
    log(f"denoiser: {name}")
    return frame.denoise(denoisers.create(name, threads=options.threads)).candidates[0].full
