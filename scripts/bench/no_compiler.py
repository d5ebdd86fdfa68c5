"""How much slower selfcorrect is without its compiled kernels, and whether it gives the same.

    python scripts/bench/no_compiler.py

Two processes correct a crop of the packaged frame with one thread: one with the compiled kernels, one that cannot
import them.
"""

import argparse
import json
import subprocess
import sys
import time
from importlib import resources
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

import denoisers
from selfcorrect import Frame, Settings, correct, files

PRESETS = ("fast", "balanced")
HIDDEN = """
import runpy, sys, warnings
sys.modules["selfcorrect.kernel._cpu"] = None
warnings.simplefilter("ignore")
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--side", type=int, default=48, help="of the crop, in pixels")
    parser.add_argument(
        "--steps", type=int, default=5, help="of the optimiser, both presets alike; 0 takes the presets'"
    )
    parser.add_argument("--images", type=Path, help="one process: write its images to this folder")
    options = parser.parse_args()
    if options.images is None:
        compare(options)
    else:
        print(json.dumps(measure(options)))


def compare(options: argparse.Namespace) -> None:
    """Both processes, and a line for each preset."""
    seconds, images = {}, {}
    with TemporaryDirectory() as away:
        for name, flags in (("compiled", []), ("torch", ["-c", HIDDEN])):
            folder = Path(away) / name
            folder.mkdir()
            size = ["--side", str(options.side), "--steps", str(options.steps), "--images", str(folder)]
            command = [sys.executable, *flags, __file__, *size]
            seconds[name] = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)
            images[name] = {preset: np.load(folder / f"{preset}.npy") for preset in PRESETS}
    for preset in PRESETS:
        fast, slow = seconds["compiled"][preset], seconds["torch"][preset]
        one, other = images["compiled"][preset], images["torch"][preset]
        apart = float(np.abs(one - other).max() / one.mean())
        parts = ", ".join(f"{part} {slow[part] / fast[part]:.0f}" for part in fast if part in ("train", "infer"))
        print(
            f"{preset}: {fast['all']:.2f} s compiled, {slow['all']:.2f} s by torch, "
            f"{slow['all'] / fast['all']:.0f} times as long ({parts}); largest difference {apart:.1e} of the mean"
        )


def measure(options: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Seconds of each preset."""
    torch.set_num_threads(1)
    data = resources.files("selfcorrect") / "data"
    paths = [str(data / f"demo_064spp_{half}.exr") for half in "AB"]
    frame = files.load(files.Sources(*paths)).frame
    size = (slice(options.side), slice(options.side))
    cropped = Frame(
        color=tuple(image[size] for image in frame.color),
        albedo=tuple(image[size] for image in frame.albedo),
        normal=tuple(image[size] for image in frame.normal),
    ).denoise(denoisers.create("box"))
    found = {}
    for preset in PRESETS:
        changes = {"steps": options.steps} if options.steps else {}
        start = time.perf_counter()
        result = correct(cropped, Settings.preset(preset, **changes))
        found[preset] = {**result.seconds, "all": time.perf_counter() - start}
        np.save(options.images / f"{preset}.npy", result.image.numpy())
    return found


if __name__ == "__main__":
    main()
