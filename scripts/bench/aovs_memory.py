"""Peak memory and time of `selfcorrect frame --aovs auto` with 20 float AOVs at 1920x1080, measured.

    .venv/bin/python scripts/bench/aovs_memory.py [--size 1920x1080] [--aovs 20] [--steps 20] [--threads 1]

Writes two halves of that many AOVs of 32-bit floats that sum to the picture, albedo and normal beside them, corrects
them by the real command in a process of its own with `--set steps=…` (memory does not hang on how many), and prints the
largest resident set of that process (`getrusage`), the AOVs' part of the time, and OIDN's for one image of this size.
The AOVs are synthetic: smooth light of random direction and colour times noise, 0 where a mask says so.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import OpenEXR
import torch

import denoisers
from selfcorrect import exr

GIB = 2**30


def write_half(path: Path, size: tuple[int, int], count: int, seed: int) -> None:
    """One half: AOVs `light_NN`, their sum, albedo and normal."""
    height, width = size
    chance, shape = np.random.default_rng(seed), np.random.default_rng(7)
    y, x = np.mgrid[0:height, 0:width].astype(np.float32) / np.float32(max(size))
    total, channels = np.zeros((height, width, 3), np.float32), {}
    albedo = (0.5 + 0.4 * np.sin(40 * x[:, :, None] + np.arange(3, dtype=np.float32))).astype(np.float32)
    for k in range(count):
        fx, fy, phase = shape.uniform(1, 12, 3)
        smooth = 1 + np.sin(np.float32(fx) * x + np.float32(phase)) * np.cos(np.float32(fy) * y)
        light = smooth[:, :, None] * albedo * shape.random(3, dtype=np.float32) / count
        light *= chance.gamma(0.5 + k % 4, 1 / (0.5 + k % 4), (height, width, 1)).astype(np.float32)
        light[(x + y) % 1 < 0.03 * (k % 5)] = 0
        total += light
        channels[f"light_{k:02d}"] = light.astype(np.float32)
    channels[""] = total
    channels["Denoising Albedo"] = albedo
    planes = {
        f"{name}.{letter}".lstrip("."): np.ascontiguousarray(image[:, :, i])
        for name, image in channels.items()
        for i, letter in enumerate("RGB")
    }
    normal = np.stack([np.cos(6 * x), np.sin(6 * x), np.ones_like(x)], -1) / np.sqrt(np.float32(2))
    planes |= {f"N.{letter}": np.ascontiguousarray(normal[:, :, i]) for i, letter in enumerate("XYZ")}
    header = {"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, planes).write(str(path))


def seconds_of_denoiser(size: tuple[int, int], threads: int) -> float:
    """OIDN's own time for one image with albedo and normal, prefiltered before."""
    chance = torch.Generator().manual_seed(0)
    image, albedo = (torch.rand(*size, 3, generator=chance) for _ in "ab")
    normal = torch.nn.functional.normalize(torch.rand(*size, 3, generator=chance) - 0.5, dim=-1)
    denoiser = denoisers.create(denoisers.default(), threads=threads)
    denoiser(image, albedo, normal, prefiltered=True)
    start = time.perf_counter()
    denoiser(image, albedo, normal, prefiltered=True)
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--aovs", type=int, default=20)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--maxmem", default="", help="passed on")
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    with tempfile.TemporaryDirectory() as away:
        halves = [Path(away) / f"{half}.exr" for half in "ab"]
        for path, seed in zip(halves, (1, 2), strict=True):
            write_half(path, (height, width), options.aovs, seed)
        out = Path(away) / "out.exr"
        command = [sys.executable, "-m", "selfcorrect", "frame", *map(str, halves), "-o", str(out), "--json"]
        command += ["--preset", "fast", "--set", f"steps={options.steps}", "--threads", str(options.threads)]
        command += ["--aovs", "auto", *(["--maxmem", options.maxmem] if options.maxmem else [])]
        start = time.perf_counter()
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        wall = time.perf_counter() - start
        if done.returncode:
            raise SystemExit(done.stderr)
        peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
        told = [line for line in done.stderr.splitlines() if line.startswith("AOVs")]
        print("\n".join(told))
        left = {name: fact["left"] for name, fact in json.loads(done.stdout)["aovs"].items()}
        file = exr.read(out)
        print(f"{options.aovs} AOVs, {width}x{height}, {len(file.channel_names)} channels: closing {left}")
    print(f"peak {peak / GIB:.2f} GiB, {wall:.0f} s in all")
    print(f"OIDN: {seconds_of_denoiser((height, width), options.threads):.1f} s an image")


if __name__ == "__main__":
    main()
