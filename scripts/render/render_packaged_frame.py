"""Render the frame that is packaged with selfcorrect, from the scene in `scene.py`.

Run it with the extra `render`, which brings Mitsuba 3 and Open Image Denoise; Mitsuba's LLVM backend also needs the
LLVM shared library (`apt-get install libllvm19`; the variable DRJIT_LIBLLVM_PATH names it where it is not found).
Without one that renders, `scalar_rgb` does it more slowly, from other samples::

    pip install -e '.[render]'
    python scripts/render/render_packaged_frame.py  # as shipped, about eight minutes on two cores
    python scripts/render/render_packaged_frame.py --out /tmp --size 128 --ref-spp 64  # a quick look

It writes five half-float EXR files into --out:

    demo_064spp_A.exr, _B.exr   two independent halves of --spp samples per pixel in total: R G B, albedo.R/G/B,
                                nn.X/Y/Z (world-space shading normal, bump included), dd.T (distance)
    demo_ref_A.exr, _B.exr      two independent references of --ref-spp samples each: R G B
    demo_ref_smooth.exr         their mean, denoised: for the weight of the metric and for nothing else

Each carries `samplesPerPixel`, `renderer` and, where rendered, the `seed` of its first pass as attributes. The same
arguments give the same files on the same machine; the scene itself does not depend on --seed.
"""

import argparse
import itertools
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi
import mitsuba_oidn
import numpy as np
import OpenEXR
from numpy.typing import NDArray
from scene import still_life
from variants import LLVM, SCALAR, VariantError, chosen

SHIPPED = Path(__file__).resolve().parents[2] / "selfcorrect" / "data"
SIZE = 260  # just over 4 × 64: 25 patches of the paper's grid and two optimiser steps per epoch, where 256 has one
SAMPLES_PER_PASS = 32  # bounds memory: one wavefront holds size² × this many paths
PATH = {"type": "path", "max_depth": 12}
GBUFFERS = {"type": "aov", "aovs": "albedo:albedo,nn:sh_normal,dd:depth", "beauty": PATH}
COLOUR = ("R", "G", "B")
ALBEDO = ("albedo.R", "albedo.G", "albedo.B")
NORMAL = ("nn.X", "nn.Y", "nn.Z")
CHANNELS = (*COLOUR, *ALBEDO, *NORMAL, "dd.T")  # in the order of the film

Image = NDArray[np.float64]


def positive(text: str) -> int:
    """Positive integer of the command line."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected a positive integer, but got {text}")
    return value


def arguments() -> argparse.Namespace:
    """Read the command line; --spp must be even."""
    parser = argparse.ArgumentParser(description="Render the frame that is packaged with selfcorrect.")
    parser.add_argument("--out", type=Path, default=SHIPPED, help="folder for the files (default: selfcorrect/data)")
    parser.add_argument("--size", type=positive, default=SIZE, help="width and height, pixels (default: %(default)s)")
    parser.add_argument(
        "--spp", type=positive, default=64, help="samples of both halves together (default: %(default)s)"
    )
    parser.add_argument(
        "--ref-spp", type=positive, default=1024, help="samples of each reference (default: %(default)s)"
    )
    parser.add_argument("--seed", type=positive, default=1, help="of the first pass; the rest count up (default: 1)")
    parser.add_argument(
        "--variant",
        choices=(LLVM, SCALAR),
        help=f"of Mitsuba (default: {LLVM}, or {SCALAR} where LLVM does not render)",
    )
    options = parser.parse_args()
    if options.spp % 2:
        parser.error(f"argument --spp: expected an even number, to halve it, but got {options.spp}")
    return options


def render(scene: Any, integrator: Any, spp: int, seeds: Iterator[int], label: str) -> Image:
    """Mean radiance and G-buffers over `spp` samples, (H, W, C) float64, in passes with a seed each."""
    started, done = time.perf_counter(), 0
    total: Image = np.zeros(())
    while done < spp:
        samples = min(SAMPLES_PER_PASS, spp - done)
        image = mi.render(scene, integrator=integrator, spp=samples, seed=next(seeds))
        total = total + np.array(image, dtype=np.float64) * samples
        done += samples
        print(f"{label}: {done}/{spp} spp, {time.perf_counter() - started:.1f} s", flush=True)
    return total / spp


def write(path: Path, image: Image, names: tuple[str, ...], attributes: dict[str, int | str]) -> None:
    """Write channels as half-float EXR under a temporary name, then rename."""
    halves = image.astype(np.float16)
    if not np.isfinite(halves).all():
        raise ValueError(f"{path.name}: expected finite half-float radiance, but got NaN or more than 65504")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **attributes}
    temporary = path.with_suffix(".tmp.exr")
    channels = {name: np.ascontiguousarray(halves[..., k]) for k, name in enumerate(names)}
    OpenEXR.File(header, channels).write(str(temporary))
    os.replace(temporary, path)
    print(f"{path}: {path.stat().st_size / 1e6:.2f} MB", flush=True)


def smooth(references: Image, halves: Image) -> Image:
    """Mean of the references (2, H, W, 3), denoised with the G-buffers of the halves (2, H, W, C)."""
    mean = halves.mean(axis=0).astype(np.float32)
    albedo = np.ascontiguousarray(mean[..., 3:6])
    normal = np.ascontiguousarray(mean[..., 6:9])
    colour = references.mean(axis=0).astype(np.float32)
    return np.asarray(mitsuba_oidn.denoise(colour, albedo=albedo, normal=normal, hdr=True), dtype=np.float64)


def main() -> int:
    """Render halves and references, denoise the mean of the references, write all."""
    options = arguments()
    try:
        variant = chosen(options.variant)
    except VariantError as error:
        print(f"render_packaged_frame: error: {error}", file=sys.stderr)
        return 2
    mi.set_variant(variant)
    options.out.mkdir(parents=True, exist_ok=True)
    scene = mi.load_dict(still_life(options.size) | {"integrator": GBUFFERS})
    beauty = mi.load_dict(PATH)
    seeds = itertools.count(options.seed)
    renderer = f"Mitsuba {mi.__version__}, {variant}, path, depth {PATH['max_depth']}"

    def save(stem: str, integrator: Any, spp: int, names: tuple[str, ...]) -> Image:
        first = next(seeds)
        image = render(scene, integrator, spp, itertools.chain([first], seeds), stem)
        write(options.out / f"{stem}.exr", image, names, {"samplesPerPixel": spp, "seed": first, "renderer": renderer})
        return image

    frame = f"demo_{options.spp:03d}spp"
    halves = [save(f"{frame}_{half}", scene.integrator(), options.spp // 2, CHANNELS) for half in "AB"]
    references = [save(f"demo_ref_{half}", beauty, options.ref_spp, COLOUR) for half in "AB"]
    denoised = smooth(np.stack(references), np.stack(halves))
    origin = f"{renderer}; mean of demo_ref_A and _B, Open Image Denoise"
    attributes: dict[str, int | str] = {"samplesPerPixel": 2 * options.ref_spp, "renderer": origin}
    write(options.out / "demo_ref_smooth.exr", denoised, COLOUR, attributes)
    return 0


if __name__ == "__main__":
    sys.exit(main())
