"""The command `report`: a page of a frame that was corrected before, from its files."""

import argparse
from pathlib import Path
from typing import Any

from torch import Tensor

import denoisers
from selfcorrect import exr, files, metrics, report
from selfcorrect.cli import flags, pages
from selfcorrect.cli.terminal import log
from selfcorrect.errors import FrameError, SettingsError
from selfcorrect.frame import Frame
from selfcorrect.image.repair import repaired

__all__ = ["run"]

_AGAIN = tuple(name for name in denoisers.names() if ":" not in name)
"""What may run because a file names it: no command and no code of anyone's."""


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    page = exr.check_target(options.output, ".html")
    sources = files.Sources(options.a, options.b, **flags.denoised(options), mapping=flags.mapping(options))
    loaded, out = files.load(sources), exr.load_half(options.corrected)
    size = loaded.frame.size
    facts = pages.facts_of(out.file)
    color = _like(size, options.a, out.buffers["color"], options.corrected)
    reference = None
    if options.reference is not None:
        reference = _like(size, options.a, exr.load_half(options.reference).buffers["color"], options.reference)
    frame = _denoised(options, loaded.frame, facts.get("denoiser"))
    images = pages.images_of(frame, color)
    names = {name: f"selfcorrect.{name}" for name in pages.MAPS}
    maps = {name: out.file.pixels(c) for name, c in names.items() if c in out.file.channel_names}
    if not maps:
        log(f"{options.corrected}: no maps of error and blend weight; `frame --diagnostics error,blend` writes them")
    facts |= {
        "title": Path(options.corrected.partition("::")[0]).name,
        "size": {"width": size[1], "height": size[0]},
        "channels": loaded.origin.taken,
        "repairs": {name: repairs._asdict() for name, repairs in frame.repairs.items()},
        "constant": frame.constant,
    }
    if reference is not None:
        facts["relmse"] = {name: metrics.relmse(sum(parts) / len(parts), reference) for name, parts in images.items()}
        images["reference"] = (reference,)
    small = {name: report.shrunk(*parts) for name, parts in images.items()}
    pages.write(page, report.frame_page(small, {name: report.shrunk(one) for name, one in maps.items()}, facts))
    log(f"{options.output}: written")


def _like(size: tuple[int, int], half: str, image: Any, path: str) -> Tensor:
    """An image of the frame's size, repaired."""
    if image.shape[:2] != size:
        raise FrameError(
            f"{path}: expected {size[1]}x{size[0]} pixels like {half}, but got {image.shape[1]}x{image.shape[0]}"
        )
    return repaired(image, path).clamp(min=0)


def _denoised(options: argparse.Namespace, frame: Frame, known: str | None) -> Frame:
    """The frame with the denoised image that the output was made from: named, in the files, or denoised again."""
    if options.denoiser is None:
        named = options.denoised_a is not None or frame.denoised_full is not None
        if named or (frame.denoised is not None and known in (None, "given")):
            return frame
        if known not in _AGAIN:
            told = "does not say who denoised it" if known is None else f"was denoised by {known!r}"
            raise SettingsError(
                f"{options.corrected}: expected --denoised D.exr or --denoiser NAME, as the file {told}, "
                "but got neither"
            )
    name = options.denoiser or str(known)
    log(f"denoiser: {name}")
    return frame.denoise(denoisers.create(name, threads=options.threads))
