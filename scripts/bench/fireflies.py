"""What the removal of fireflies does to OIDN's image, against two references; its constants, one scene left out.

    .venv/bin/python scripts/bench/fireflies.py ../shared/frames [--spp 16 64 256] [--choose]

Prints one row for each frame and number of samples: relMSE of the denoised full buffer, over it that of the same image
without fireflies, with its standard error (bootstrap over 16x16 tiles), the share of pixels changed and of light
removed, and what the rule, which knows no reference, says that the fireflies were, over the true error.

--choose tries all constants of GRID, and tells for each scene the best for the other scenes, and what they do to it.
"""

import argparse
import itertools
import math
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from quality import load
from torch import Tensor

import denoisers
from selfcorrect import metrics
from selfcorrect.fireflies import Removed, Rule, remove_fireflies_
from selfcorrect.image.exposure import scale_to_one

GRID = {"least": (2.0, 3.0), "spreads": (4.0, 6.0), "doubts": (2.0, 4.0), "usual": (0.9, 0.99, 0.999)}


class Case(NamedTuple):
    """A denoised frame with its references."""

    scene: str
    spp: int
    color: tuple[Tensor, Tensor]
    denoised: tuple[Tensor, Tensor]
    full: Tensor
    scale: float
    references: list[np.ndarray]

    def without(self, rule: Rule) -> tuple[Tensor, Removed]:
        """The full buffer's image without fireflies."""
        image = self.full.clone()
        return image, remove_fireflies_(image, self.color, self.denoised, self.full, scale=self.scale, rule=rule)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--scenes", nargs="*", help="names; by default all in the folders")
    parser.add_argument("--spp", type=int, nargs="*", default=[16, 64, 256])
    parser.add_argument("--denoiser", default="oidn")
    parser.add_argument("--choose", action="store_true", help="cross-validate the constants over scenes")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    denoise = denoisers.create(options.denoiser, threads=options.threads)
    cases = [case for folder in options.folders for case in cases_of(folder, options, denoise)]
    print("| frame | spp | denoised | without fireflies, over it | pixels | light | said to be |")
    print("|---|---|---|---|---|---|---|")
    ratios = [row(case) for case in cases]
    print(f"geometric mean of the ratio {np.exp(np.mean(np.log(ratios))):.3f}, worst {max(ratios):.3f}")
    if options.choose:
        choose(cases)


def cases_of(folder: Path, options: argparse.Namespace, denoise: denoisers.Denoise) -> list[Case]:
    """Those of a folder, denoised."""
    names = sorted({path.name.removesuffix("_ref_A.exr") for path in folder.glob("*_ref_A.exr")})
    cases = []
    for name in names:
        if options.scenes and name not in options.scenes:
            continue
        for spp in options.spp:
            frame, references = load(folder, name, spp)
            frame = frame.denoise(denoise)
            scale = scale_to_one(frame.denoised)  # as correct() does
            cases.append(Case(name, spp, frame.color, frame.denoised, frame.denoised_full, scale, references))
    return cases


def row(case: Case) -> float:
    """Print one row; returns the error without fireflies over that with them."""
    image, removed = case.without(Rule())
    before = metrics.relmse(case.full, *case.references)
    ratio = metrics.relmse_ratio(image, case.full, *case.references)
    print(
        f"| {case.scene} | {case.spp} | {before:.5f} | {ratio.value:.3f} ± {ratio.standard_error:.3f} "
        f"| {removed.pixels:.2%} | {removed.light:.2%} | {removed.error / before:.2f} |",
        flush=True,
    )
    return ratio.value


def choose(cases: list[Case]) -> None:
    """Leave one scene out: the constants that are best for the others, judged by it."""
    rules = [Rule(**dict(zip(GRID, values, strict=True))) for values in itertools.product(*GRID.values())]
    logs: dict[str, list[np.ndarray]] = defaultdict(list)  # of a scene's frames: the ratio's logarithm for each rule
    for case in cases:
        before = metrics.relmse(case.full, *case.references)
        ratios = [metrics.relmse(case.without(rule)[0], *case.references) / before for rule in rules]
        logs[case.scene].append(np.log(ratios))
    print("\n| scene left out | best for the others | ratios of its frames |\n|---|---|---|")
    for scene, own in logs.items():
        others = [log for name, frames in logs.items() if name != scene for log in frames]
        best = int(np.argmin(np.mean(others, axis=0)))
        constants = ", ".join(f"{name} {getattr(rules[best], name):g}" for name in GRID)
        print(f"| {scene} | {constants} | {' '.join(f'{math.exp(log[best]):.3f}' for log in own)} |", flush=True)


if __name__ == "__main__":
    main()
