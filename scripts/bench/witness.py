"""Does the witness tell the truth: what the core changed in the halves, by the other half and by references.

    .venv/bin/python scripts/bench/witness.py ../shared/frames [--spp 64] [--features own mean] [--limits 0 8]

Half b judges what was made of half a, so its noise must not be in there. The script trains on a frame whose halves keep
their own G-buffers (``own``, what the tool does), or both get the mean of the two (``mean``, which is less noisy but
brings half b's noise into half a's correction), or have albedo and normal denoised by OIDN (``prefiltered``), and with
several bounds of the witness (the setting ``witness_limit``). It prints the change of the halves' relative squared
error, as a share of the denoised halves' error, by the references and by the witness, their difference with its
standard error over tiles of 16 pixels (negative: the witness promises what is not there), and the output's relMSE over
that of the denoised image, with what the guard believes of it.
"""

import argparse
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import torch
from quality import ROLES, load
from torch import Tensor

import denoisers
from denoisers.oidn import PrefilteringOidn
from selfcorrect import Frame, Settings, correct, metrics
from selfcorrect.image.bands import tile_means
from selfcorrect.stages.core.stage import Core
from selfcorrect.stages.images import StageImages
from selfcorrect.stages.stage import Outcome, Work

_DARKEST = 0.01  # squared radiance, as in the metric


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", nargs="*", help="names; by default all in the folder")
    parser.add_argument("--spp", type=int, nargs="*", default=[64])
    parser.add_argument("--features", nargs="*", choices=FEATURES, default=list(FEATURES))
    parser.add_argument("--limits", type=float, nargs="*", default=[Settings.preset("balanced").witness_limit])
    parser.add_argument("--denoiser", default="oidn")
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    print(
        "| frame | spp | G-buffers | limit | change by references | by the witness | difference | output (believed) |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for name in options.frames or sorted({path.name.split("_")[0] for path in options.folder.glob("*_ref_A.exr")}):
        for spp in options.spp:
            frame, references = load(options.folder, name, spp)
            frame = frame.denoise(denoisers.create(options.denoiser, threads=options.threads))
            for features, limit in product(options.features, options.limits):
                settings = Settings.preset(options.preset, candidates="none", fireflies="keep", witness_limit=limit)
                cells = row(settings, with_features(frame, features), references)
                print(f"| {name} | {spp} | {features} | {limit:g} | {cells} |", flush=True)


def row(settings: Settings, frame: Frame, references: list[np.ndarray]) -> str:
    """The cells of one training."""
    core = Recorded(settings)
    result = correct(frame, settings, opened=[core])
    reference_a, reference_b, smooth = (torch.as_tensor(image) for image in references)
    true, told = changes(frame, core.corrected, (reference_a + reference_b) / 2, smooth)
    error = (told - true).std() / len(true) ** 0.5
    ratio = metrics.relmse(result.image, *references) / metrics.relmse(frame.denoised_full, *references)
    assert result.estimate is not None  # the preset has the guard
    return (
        f"{true.mean():+.3f} | {told.mean():+.3f} | {(told - true).mean():+.3f} ± {error:.3f} "
        f"| {ratio:.3f} ({1 + result.estimate.change:.3f})"
    )


class Recorded(Core):
    """The core, and the halves that it made."""

    def __init__(self, settings: Settings):
        super().__init__(settings)
        self._strips: list[tuple[Tensor, Tensor]] = []

    @property
    def corrected(self) -> tuple[Tensor, Tensor]:
        """Of linear radiance."""
        a, b = (torch.cat(strips) for strips in zip(*self._strips, strict=True))
        return a, b

    def run(self, state: StageImages, work: Work) -> Outcome:
        """Strips come from top to bottom."""

        def keep(rows: slice, halves: tuple[Tensor, Tensor]) -> None:
            self._strips.append((halves[0] / state.scale, halves[1] / state.scale))
            if work.keep is not None:
                work.keep(rows, halves)

        return super().run(state, replace(work, keep=keep))


def with_features(frame: Frame, features: str) -> Frame:
    """The frame with its denoised images, and with other G-buffers."""
    pairs = FEATURES[features](frame)
    return Frame(color=frame.color, **pairs, denoised=frame.denoised, denoised_full=frame.denoised_full)


def features_of(frame: Frame) -> dict[str, tuple[Tensor, Tensor]]:
    """A frame's G-buffers by name, of both halves."""
    return {role: getattr(frame, role) for role in ROLES if role != "color" and getattr(frame, role) is not None}


def mean(frame: Frame) -> dict[str, tuple[Tensor, Tensor]]:
    """The mean of both halves' G-buffers, for both."""
    return {role: ((a + b) / 2,) * 2 for role, (a, b) in features_of(frame).items()}


def prefiltered(frame: Frame) -> dict[str, tuple[Tensor, Tensor]]:
    """Each half's G-buffers, albedo and normal denoised by OIDN, as its accurate mode does it."""
    filter_ = PrefilteringOidn(torch.get_num_threads())
    pairs = features_of(frame)
    clean = [filter_.prefilter(*(pairs[role][half] for role in ("albedo", "normal"))) for half in (0, 1)]
    return pairs | dict(zip(("albedo", "normal"), zip(*clean, strict=True), strict=True))


FEATURES = {"own": features_of, "mean": mean, "prefiltered": prefiltered}


def changes(frame: Frame, corrected: tuple[Tensor, Tensor], reference: Tensor, smooth: Tensor) -> tuple[Tensor, Tensor]:
    """Tiles' change of the halves' error, by the references and by the witness, over the denoised halves' error."""
    given = frame.candidates[0].halves
    weight = 1 / (smooth.double().mean(-1) ** 2 + _DARKEST)

    def error(image: Tensor, truth: Tensor, rows: slice) -> Tensor:
        return weight[rows] * ((image[rows].double() - truth[rows].double()) ** 2).mean(-1)

    def over_tiles(truths: tuple[Tensor, Tensor], images: tuple[Tensor, Tensor]) -> Tensor:
        pairs = list(zip(images, truths, strict=True))
        return tile_means(len(smooth), lambda rows: sum(error(*pair, rows) for pair in pairs)[None] / 2).flatten()

    denoised = over_tiles((reference, reference), given)
    true = over_tiles((reference, reference), corrected) - denoised
    witnesses = frame.color[::-1]
    told = over_tiles(witnesses, corrected) - over_tiles(witnesses, given)
    return true / denoised.mean(), told / denoised.mean()


if __name__ == "__main__":
    main()
