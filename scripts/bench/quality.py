"""Error of noisy, denoised and corrected frames against two references, with the mean radiance beside it.

    .venv/bin/python scripts/bench/quality.py ../shared/frames [--preset paper] [--denoiser oidn] [--spp 64] [--seeds 3]

Prints one row for each frame and number of samples, mean over the seeds: relMSE of the noisy image, of the denoised
full buffer and of the corrected image, their ratio with its standard error (bootstrap over 16x16 tiles of the first
seed) and its range over the seeds, mean radiance over that of the noisy image, denoised and corrected, and what
the guard, which knows no reference, estimates for the relMSE of denoised and corrected. The preset's candidates are
taken as the command takes them; seconds are of them and of the correction.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch

import denoisers
from selfcorrect import Frame, Settings, correct, exr, metrics
from selfcorrect.candidates import with_candidates

ROLES = ("color", "albedo", "normal", "visibility", "depth")


def load(folder: Path, name: str, spp: int) -> tuple[Frame, list[np.ndarray]]:
    """A frame and its references: two independent ones, and the smooth one.

    With 0 samples the two references become the halves of the best frame there is, and the halves of 256 samples,
    which are as independent, its references. Where there is no smooth one, it is OIDN's image of both references.
    """
    a, b = (exr.load_half(folder / f"{name}_{spp or 256:03d}spp_{half}.exr").buffers for half in "AB")
    first, second = (exr.load_half(folder / f"{name}_ref_{r}.exr").buffers for r in "AB")
    smooth = folder / f"{name}_ref_smooth.exr"
    weight = exr.load_half(smooth).buffers["color"] if smooth.exists() else denoised_mean(first, second)
    references = [first["color"], second["color"], weight]
    if not spp:
        for half, reference in ((a, 0), (b, 1)):
            half["color"], references[reference] = references[reference], half["color"]
    return Frame(**{role: (a[role], b[role]) for role in ROLES if role in a}), references


def denoised_mean(first: dict[str, np.ndarray], second: dict[str, np.ndarray]) -> np.ndarray:
    """OIDN's image of two halves together."""
    aids = {role: (first[role], second[role]) for role in ("albedo", "normal") if role in first}
    halves = Frame(color=(first["color"], second["color"]), **aids)
    return halves.denoise(denoisers.create("oidn")).denoised_full.numpy()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", nargs="*", help="names; by default all in the folder")
    parser.add_argument("--spp", type=int, nargs="*", default=[64], help="0: the references as halves")
    parser.add_argument("--denoiser", nargs="*", default=["oidn"])
    parser.add_argument("--preset", nargs="*", default=list(Settings.presets())[:1])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    names = options.frames or sorted({p.name.split("_")[0] for p in options.folder.glob("*_ref_A.exr")})
    for preset in options.preset:
        for denoiser in options.denoiser:
            print(f"\npreset {preset}, denoiser {denoiser}, {options.seeds} seed(s)")
            print("| frame | spp | noisy | denoised | corrected | ratio ± s.e. | range | means | estimate | seconds |")
            print("|---|---|---|---|---|---|---|---|---|---|")
            ratios = [row(options, name, spp, denoiser, preset) for name in names for spp in options.spp]
            print(f"geometric mean of the ratio {np.exp(np.mean(np.log(ratios))):.3f}, worst {max(ratios):.3f}")


def row(options: argparse.Namespace, name: str, spp: int, denoiser: str, preset: str) -> float:
    """Print one row; returns corrected over denoised."""
    frame, references = load(options.folder, name, spp)
    frame = frame.denoise(denoisers.create(denoiser, threads=options.threads))
    noisy = (frame.color[0] + frame.color[1]) / 2
    start = time.perf_counter()
    wanted = Settings.preset(preset).candidates
    further = (
        {}
        if wanted == "none"
        else {spec: denoisers.create(spec, threads=options.threads) for spec in denoisers.variants(denoiser)}
    )
    frame, _ = with_candidates(frame, further, every=wanted == "all")
    results = [correct(frame, Settings.preset(preset, seed=seed)) for seed in range(options.seeds)]
    images = [result.image for result in results]
    seconds = (time.perf_counter() - start) / options.seeds
    before, denoised = (metrics.relmse(image, *references) for image in (noisy, frame.denoised_full))
    after = [metrics.relmse(image, *references) for image in images]
    error = metrics.relmse_ratio(images[0], frame.denoised_full, *references).standard_error
    means = [float(image.mean() / noisy.mean()) for image in (frame.denoised_full, images[0])]
    ratio = float(np.mean(after)) / denoised
    estimate = results[0].estimate
    estimated = f"{estimate.denoised:.5f} {estimate.corrected:.5f}" if estimate else "none"
    print(
        f"| {name} | {spp} | {before:.5f} | {denoised:.5f} | {np.mean(after):.5f} | {ratio:.3f} ± {error:.3f} "
        f"| {min(after) / denoised:.3f} … {max(after) / denoised:.3f} | {means[0]:.4f} {means[1]:.4f} "
        f"| {estimated} | {seconds:.1f} |",
        flush=True,
    )
    return ratio


if __name__ == "__main__":
    main()
