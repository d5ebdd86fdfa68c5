"""What becomes of pixels that both halves show and nothing around them: fireflies of both, stars, glints, lamps.

    python scripts/bench/lone_pixels.py [--denoiser oidn] [--threads 1]

Synthetic frames of 96x128 pixels with their references: coloured waves, gamma noise of 30 %, albedo. A row has the
relMSE of the denoised image and of the output against what was meant, the change, the change that is claimed, and how
many pixels were set aside.
"""

import argparse
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

import denoisers
from selfcorrect import Frame, Settings, correct
from selfcorrect.metrics import relmse

SIZE = (96, 128)
ONE, FOUR = [(40, 50)], [(40, 50), (20, 90), (70, 30), (80, 100)]
LINE = [(38 + i, 48 + i) for i in range(5)]
BLOCK = [(40 + i, 50 + j) for i in range(4) for j in range(4)]
SETTINGS = {"steps": 60, "patch": 32, "batch": 4, "window": 11}

Image = NDArray[np.float32]


class Case(NamedTuple):
    """What is seen at some pixels of both halves, and whether it is there."""

    name: str
    places: Sequence[tuple[int, int]]
    shape: Sequence[float] = (1.0,)
    real: bool = True
    in_albedo: bool = False


CASES = (
    Case("nothing", []),
    Case("a firefly of both", ONE, real=False),
    Case("four fireflies of both", FOUR, (1.0, 0.6, 1.4, 0.8), real=False),
    Case("a star", ONE),
    Case("four stars", FOUR, (1.0, 0.6, 1.4, 0.8)),
    Case("a lamp of one pixel, bright in albedo", ONE, in_albedo=True),
    Case("a lamp of 4x4 pixels", BLOCK, in_albedo=True),
    Case("a glint of five pixels", LINE, (0.1, 0.4, 1.0, 0.5, 0.1)),
)


def made(case: Case, value: float) -> tuple[Image, tuple[Image, Image], tuple[Image, Image]]:
    """What is meant, the noisy halves and their albedo."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    waves = 0.6 + 0.4 * np.sin(0.2 * x) * np.cos(0.1 * y)
    truth = (waves[..., None] * np.array([1.0, 0.8, 0.6])).astype(np.float32)
    generator = np.random.default_rng(0)
    albedo = truth.copy()
    halves = [(truth * generator.gamma(11, 1 / 11, truth.shape)).astype(np.float32) for _ in "ab"]
    for number, place in enumerate(case.places):
        light = value * case.shape[number % len(case.shape)]
        for half, luck in zip(halves, (1.1, 0.9), strict=True):
            half[place] = light * luck
        if case.real:
            truth[place] = light
        if case.in_albedo:
            albedo[place] = 1.5
    return truth, (halves[0], halves[1]), (albedo, albedo.copy())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--denoiser", default="oidn")
    parser.add_argument("--values", type=float, nargs="*", default=[30.0, 1e3, 1e4], help="radiance; the mean is 0.5")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    denoise = denoisers.create(options.denoiser, threads=options.threads)
    settings = Settings.preset("balanced", **SETTINGS)
    print("| | radiance | denoised | corrected | change | claimed | set aside |\n|---|---|---|---|---|---|---|")
    for case in CASES:
        for value in options.values if case.places else [0.0]:
            truth, color, albedo = made(case, value)
            frame = Frame(color=color, albedo=albedo).denoise(denoise)
            result = correct(frame, settings)
            before, after = relmse(frame.denoised_full, truth), relmse(result.image, truth)
            claimed = "" if result.estimate is None else f"{100 * result.estimate.change:+.0f} %"
            print(
                f"| {case.name} | {value:g} | {before:.4g} | {after:.4g} | {100 * (after / before - 1):+.0f} % "
                f"| {claimed} | {result.lone} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
