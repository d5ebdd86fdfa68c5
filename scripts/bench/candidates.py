"""What each of OIDN's modes is worth beside the accurate one, without a correction; and the guard's constants.

    .venv/bin/python scripts/bench/candidates.py ../shared/frames [OUTLIERS] [--spp 16 64 256] [--choose]

Prints one row for each frame and number of samples: relMSE of OIDN's accurate image, over it that of the other modes
alone, what a few crops promise of each at most (what ``candidates=auto`` decides by), and what the guard makes of the
accurate image with each of them and with both, over the accurate image's error.

--choose tries each of the guard's constants at the values of GRID, the others as they are, with both modes, and tells
for each scene which value is best for the other scenes, and what it does to it.
"""

import argparse
from collections import defaultdict
from pathlib import Path
from types import ModuleType
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
import torch
from quality import load
from torch import Tensor

import denoisers
import selfcorrect.guard as guard_module
import selfcorrect.pooling as pooling_module
from selfcorrect import metrics
from selfcorrect.candidates import promises, with_candidate
from selfcorrect.frame import Candidate, Frame
from selfcorrect.guard import Evidence, guard, keep_light_
from selfcorrect.image.exposure import Scaled, scale_to_one

MODES = ("oidn:fast", "oidn:none")
GRID: tuple[tuple[ModuleType, str, tuple[float, ...]], ...] = (
    (guard_module, "_OUTERMOST", (0.0, 0.005, 0.02)),
    (guard_module, "CERTAIN", (1.0, 1.645, 2.326)),
    (pooling_module, "_LARGEST_SPREAD", (0.1, 0.25, 0.5)),
    (pooling_module, "_LEAST_SPREAD", (0.001, 0.01, 0.03)),
    (pooling_module, "_OUTLYING", (2.0, 3.0, 5.0)),
)


class Case(NamedTuple):
    """A frame with its accurate image and the other modes' as candidates, and its references."""

    scene: str
    spp: int
    frame: Frame
    scale: float
    references: list[np.ndarray]

    def error(self, image: Tensor) -> float:
        """relMSE."""
        return metrics.relmse(image, *self.references)

    def guarded(self, *modes: str) -> Tensor:
        """The accurate image with these modes blended in."""
        given, *others = self.frame.candidates
        more = [candidate for candidate in others if candidate.name in modes]

        def scaled(images: tuple[Tensor, Tensor]) -> tuple[Scaled, Scaled]:
            return Scaled(images[0], self.scale), Scaled(images[1], self.scale)

        evidence = Evidence(scaled(self.frame.color), scaled(given.halves), len(more))
        everything = slice(0, len(given.full))
        evidence.add(everything, *(scaled_halves(candidate, self.scale) for candidate in more))
        full, images = Scaled(given.full, self.scale), [Scaled(candidate.full, self.scale) for candidate in more]
        found = guard(evidence, full, images, scale=self.scale, out=torch.empty_like(given.full))
        if not found.estimate.improved:
            return given.full
        keep_light_(found.image, full, evidence.color)
        return (found.image / self.scale).clamp(min=0)


def scaled_halves(candidate: Candidate, scale: float) -> tuple[Tensor, Tensor]:
    """Its halves, multiplied."""
    a, b = candidate.halves
    return a * scale, b * scale


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--spp", type=int, nargs="*", default=[16, 64, 256])
    parser.add_argument("--choose", action="store_true", help="cross-validate the guard's constants over scenes")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    modes = {mode: denoisers.create(mode, threads=options.threads) for mode in MODES}
    cases = []
    print("| frame | spp | accurate | fast | none | promised: fast, none | guarded: fast | none | both |")
    print("|---|---|---|---|---|---|---|---|---|")
    for folder in options.folders:
        for scene in sorted({path.name.split("_")[0] for path in folder.glob("*_ref_A.exr")}):
            for spp in options.spp:
                if (folder / f"{scene}_{spp:03d}spp_A.exr").exists():
                    frame, references = load(folder, scene, spp)
                    frame = frame.denoise(denoisers.create("oidn", threads=options.threads))
                    promised = promises(frame, modes)
                    for mode, denoiser in modes.items():
                        frame = with_candidate(frame, mode, denoiser)
                    scale = scale_to_one(frame.candidates[0].halves)
                    cases.append(Case(scene, spp, frame, scale, references))
                    row(cases[-1], promised)
    if options.choose:
        for module, name, values in GRID:
            choose(cases, module, name, values)


def row(case: Case, promised: dict[str, float]) -> None:
    """Print what one frame says."""
    given, *others = case.frame.candidates
    base = case.error(given.full)
    alone = [case.error(candidate.full) / base for candidate in others]
    guarded = [case.error(case.guarded(*some)) / base for some in (MODES[:1], MODES[1:], MODES)]
    cells = [f"{value:.3f}" for value in alone]
    cells.append(", ".join(f"{promised[mode]:.1%}" for mode in MODES))
    cells += [f"{value:.3f}" for value in guarded]
    print(f"| {case.scene} | {case.spp} | {base:.5f} | {' | '.join(cells)} |", flush=True)


def choose(cases: list[Case], module: ModuleType, name: str, values: tuple[float, ...]) -> None:
    """Print for one constant each scene's error with the value that is best for the other scenes."""
    logs: dict[float, dict[str, list[float]]] = {value: defaultdict(list) for value in values}
    for value in values:
        with patch.object(module, name, value):
            for case in cases:
                ratio = case.error(case.guarded(*MODES)) / case.error(case.frame.candidates[0].full)
                logs[value][case.scene].append(float(np.log(ratio)))
    every = {value: [log for some in logs[value].values() for log in some] for value in values}
    print(
        f"\n{name}: "
        + ", ".join(f"{v}: {np.exp(np.mean(x)):.4f} (worst {np.exp(max(x)):.3f})" for v, x in every.items())
    )
    for scene in logs[values[0]]:
        others = {v: np.mean([x for s, some in logs[v].items() if s != scene for x in some]) for v in values}
        best = min(values, key=lambda v: others[v])
        print(f"  without {scene}: {best}, there {np.exp(np.mean(logs[best][scene])):.4f}")


if __name__ == "__main__":
    main()
