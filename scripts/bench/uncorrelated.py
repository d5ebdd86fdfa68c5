"""Squared bias against relMSE of the uncorrelated weighting and its baselines, on the Cornell box.

    .venv/bin/python scripts/bench/uncorrelated.py [--rounds 64] [--size 64] [--spp 8]

Every round renders four images with independent samples and four with common random numbers, of seeds of their own. The
squared bias is the product of the mean errors of the even and of the odd rounds, so that what noise is left in them
does not enter; the reference's own noise does, and is given beside. Both are over mean_rgb(reference)² + 0.01.
Needs the extra ``render``.
"""

import argparse
import importlib
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from selfcorrect.stages.uncorrelated import KERNELS, combine

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "render"))

import variants
from screened_poisson import screened_poisson

Image = np.ndarray[Any, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=64)
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--spp", type=int, default=8, help="of each of the eight renders")
    parser.add_argument("--reference", type=int, default=64, help="renders of 256 samples")
    options = parser.parse_args()
    if variants.failure() is not None:
        parser.error(variants.refusal("common random numbers"))
    crn = importlib.import_module("common_random_numbers")  # fails where there is no LLVM library
    scenes = {common: crn.cornell_box(common=common, size=options.size) for common in (False, True)}
    references = np.stack([crn.render(scenes[False], 256, 100_000 + i) for i in range(options.reference)])
    reference = references.mean(0)
    weight = 1 / (reference.mean(-1, keepdims=True) ** 2 + 0.01)
    noise = float((weight * references.var(0, ddof=1)).mean()) / options.reference
    results: dict[str, list[Image]] = defaultdict(list)
    for first in range(0, 8 * options.rounds, 8):
        y, z = ([crn.render(scenes[c], options.spp, first + 4 * c + i) for i in range(4)] for c in (False, True))
        for name, image in combined(y, z, options.spp).items():
            results[name].append(image - reference)
    print(f"{options.rounds} rounds, {options.size}x{options.size}, 4 x {options.spp} spp of each kind; ", end="")
    print(f"relative variance of the reference {noise:.2g}\n| | relMSE | squared bias |\n|---|---|---|")
    for name, errors in results.items():
        even, odd = np.mean(errors[::2], 0), np.mean(errors[1::2], 0)
        mse, bias = (float((weight * product).mean()) for product in (np.square(errors).mean(0), even * odd))
        print(f"| {name} | {mse:.6f} | {bias:.7f} |")


def combined(y: list[Image], z: list[Image], spp: int) -> dict[str, Image]:
    """What each kernel makes of four independent and four correlated renders, and of screened Poisson images."""
    poisson = [screened_poisson(own, common) for own, common in zip(y, z, strict=True)]
    images = {"y": np.mean(y, 0), "z": np.mean(z, 0), "screened Poisson": np.mean(poisson, 0)}
    independent, correlated, made = (tuple(torch.from_numpy(i) for i in four) for four in (y, z, poisson))
    for kernel in KERNELS:
        images[kernel] = combine(independent, correlated, samples=spp, kernel=kernel)[0].numpy()
    images["uncorrelated, screened Poisson crossed"] = combine(independent, made, samples=spp, crossed=True)[0].numpy()
    return images


if __name__ == "__main__":
    main()
