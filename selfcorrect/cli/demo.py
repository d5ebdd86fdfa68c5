"""The command `demo`: the main job on the packaged frame, with what it brought beside its references."""

import argparse
import tempfile
from importlib import resources
from pathlib import Path
from typing import Any

from selfcorrect import exr, files, metrics
from selfcorrect.cli import flags
from selfcorrect.cli.frame import correct_files
from selfcorrect.cli.terminal import answer, show
from selfcorrect.frame import Frame

__all__ = ["run"]


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    with resources.as_file(resources.files("selfcorrect") / "data") as data, tempfile.TemporaryDirectory() as away:
        folder = Path(options.output or away)
        folder.mkdir(parents=True, exist_ok=True)
        report = _report(options, data, folder)
    if options.json:
        answer(report)
        return
    for name, error in report["relmse"].items():
        show(f"{name:10} relMSE {error:.5f}   mean radiance {report['mean'][name]:.4f} of the reference")
    change = report["relmse"]["corrected"] / report["relmse"]["denoised"] - 1
    show(f"corrected against denoised: {change:+.0%}" + (f"; image in {folder}" if options.output else ""))


def _report(options: argparse.Namespace, data: Path, folder: Path) -> dict[str, Any]:
    """The facts of the run, with error and mean of the noisy, the denoised and the corrected image."""
    names = {name: str(data / f"demo_{name}.exr") for name in ("064spp_A", "064spp_B", "ref_A", "ref_B", "ref_smooth")}
    sources = files.Sources(names["064spp_A"], names["064spp_B"], mapping=flags.mapping(options))
    frames: list[Frame] = []
    written = correct_files(options, sources, str(folder / "corrected.exr"), show=frames.append)
    a, b = frames[0].color
    images = {
        "noisy": (a + b) / 2,
        "denoised": frames[0].denoised_full,
        "corrected": exr.load_half(written.output).buffers["color"],
    }
    references = [exr.load_half(names[name]).buffers["color"] for name in ("ref_A", "ref_B", "ref_smooth")]
    return written.to_dict() | {
        "relmse": {name: metrics.relmse(image, *references) for name, image in images.items()},
        "mean": {name: metrics.mean_radiance_ratio(image, references[2]) for name, image in images.items()},
    }
