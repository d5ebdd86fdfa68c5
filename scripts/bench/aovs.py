"""Light passes and light groups: error of each, what the sums miss, and a composite that is graded anew.

    .venv-blender/bin/python scripts/render/light_passes.py -o FOLDER --reference 4096
    .venv/bin/python scripts/bench/aovs.py FOLDER [FOLDER …] [--preset fast] [--threads 1]

Folders hold `passes_a.exr`, `passes_b.exr`, `passes_ref.exr`, and perhaps `passes_ref2.exr` of another seed. Of every
AOV, what it adds to the picture (light times its colour) is compared: the noisy mean of the halves; denoised, each AOV
by itself, as the picture is; the ratio method, each denoised AOV times the corrected picture over their sum; the
denoised AOVs reconciled with the picture without the guard; and ours, which is what `selfcorrect frame --aovs auto`
writes. The picture is compared without AOVs (`--aovs none`) and with them. relMSE is the metric of the frames,
|x - r|² / (mean_rgb(r)² + 0.01), the mean over pixels; with two references (x - r)(x - r2), which does not count their
noise. Closing: the root of the mean squared difference between the sum and the picture, relative to the picture: for
noisy and denoised that of the same kind, for the others the corrected one.
Alpha: mean squared error of half a's, of the mean of both halves and of the corrected one.
"""

import argparse
import math
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

import denoisers
from selfcorrect import cli, exr, files
from selfcorrect.aovs import denoiser_of, reconciled
from selfcorrect.exr.aovs import Group, Halves
from selfcorrect.exr.decompositions import radiance

Image = NDArray[np.float64]
REGRADE = {"key": 2.0, "fill": 0.5}
METHODS = ("noisy", "denoised", "ratio", "reconciled", "ours")


def relmse(image: Image, references: list[Image]) -> float:
    """Mean relative squared error of linear radiance, (H, W, 3), against one reference or two."""
    squared = (image - references[0]) * (image - references[-1])
    return float((squared.mean(-1) / (sum(references).mean(-1) ** 2 / len(references) ** 2 + 0.01)).mean())


def reconciled_alone(halves: list[tuple[Image, Image]], denoised: list[Image], picture: Image) -> list[Image]:
    """Denoised AOVs made to sum as `selfcorrect.aovs` does, without its guard."""
    dark = 0.3 * float(np.sqrt(np.maximum(picture.mean(-1), 0)).mean()) ** 4
    levels = [image.mean(-1, keepdims=True) ** 2 + dark for image in denoised]
    spreads = [((a - b) ** 2 / level).mean() for (a, b), level in zip(halves, levels, strict=True)]
    v = [(s + 1e-12) * level * np.ones(3) for s, level in zip(spreads, levels, strict=True)]
    found = reconciled(*(torch.from_numpy(np.stack(planes)) for planes in (denoised, v)), torch.from_numpy(picture))
    return list(found.numpy())


def closing(images: list[Image], picture: Image) -> float:
    """Root of the mean squared difference between a sum and the picture, relative to the picture."""
    return math.sqrt(float(((sum(images) - picture) ** 2).mean() / (picture**2).mean()))


def color_of(file: exr.ExrFile, names: list[str]) -> Image:
    """Three channels, (H, W, 3)."""
    return np.stack([file.pixels(name).astype(np.float64) for name in names], -1)


def corrected(folder: Path, options: argparse.Namespace, aovs: str) -> exr.ExrFile:
    """What the command writes."""
    with tempfile.TemporaryDirectory() as away:
        out = Path(away) / "out.exr"
        command = ["frame", str(folder / "passes_a.exr"), str(folder / "passes_b.exr"), "-o", str(out)]
        command += ["--preset", options.preset, "--threads", str(options.threads), "--aovs", aovs]
        if cli.main(command):
            raise SystemExit(1)
        return exr.read(out)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--alpha", action="store_true", help="also correct alpha")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    ratios: dict[str, list[float]] = {method: [] for method in METHODS}
    for folder in options.folders:
        one_frame(folder, options, ratios)
    print(f"all {len(options.folders)} frames, error over that of the denoised AOV:")
    for method, found in ratios.items():
        worse = sum(ratio > 1.02 for ratio in found)
        print(f"  {method}: geometric mean {geometric(found):.3f}, worst {max(found):.3f}, "
              f"more than 2 % worse {worse} of {len(found)}")  # fmt: skip


def geometric(ratios: list[float]) -> float:
    """Geometric mean."""
    return math.exp(sum(map(math.log, ratios)) / len(ratios))


def one_frame(folder: Path, options: argparse.Namespace, ratios: dict[str, list[float]]) -> None:
    """The tables of one frame."""
    sources = files.Sources(str(folder / "passes_a.exr"), str(folder / "passes_b.exr"), aovs="auto")
    loaded = files.load(sources)
    a, b = loaded.origin.reopened()
    assert b is not None
    start = time.perf_counter()
    alone = corrected(folder, options, "none")
    between = time.perf_counter()
    ours = corrected(folder, options, "auto,alpha" if options.alpha else "auto")
    seconds = (time.perf_counter() - between) - (between - start)
    references = [exr.read(path) for path in sorted(folder.glob("passes_ref*.exr"))]
    names = loaded.origin.taken["color"]
    picture, true = color_of(ours, names), [color_of(reference, names) for reference in references]
    noisy_picture = (color_of(a, names) + color_of(b, names)) / 2
    denoiser = denoisers.create(denoisers.default(), threads=options.threads)
    frame = loaded.frame.denoise(denoiser)
    denoised_picture = np.asarray(frame.denoised_full, np.float64)
    print(f"\n{folder.name}: picture noisy {relmse(noisy_picture, true):.3g}, denoised "
          f"{relmse(denoised_picture, true):.3g}, corrected {relmse(color_of(alone, names), true):.3g}, "
          f"corrected with AOVs {relmse(picture, true):.3g}; AOVs took {seconds:.0f} s")  # fmt: skip
    denoise = denoiser_of(frame, denoiser)
    for group in loaded.origin.plan.groups:
        start = time.perf_counter()
        halves = Halves(a, b, group.aovs)
        found = [denoise(tuple(torch.from_numpy(h).clamp(min=0) for h in halves[x.name])) for x in group.aovs]
        denoised = [np.asarray(full, np.float64) for _, full in found]
        pairs = [tuple(np.asarray(half, np.float64) for half in both) for both, _ in found]
        own = (time.perf_counter() - start) / len(group.aovs)
        total = np.maximum(sum(denoised), 1e-12)
        images = {
            "noisy": [(radiance(a, x) + radiance(b, x)) / 2 for x in group.aovs],
            "denoised": denoised,
            "ratio": [image * (picture / total) for image in denoised],
            "reconciled": reconciled_alone(pairs, denoised, picture),
            "ours": [radiance(ours, x) for x in group.aovs],
        }
        pictures = {"noisy": noisy_picture, "denoised": denoised_picture}
        true_aovs = [[radiance(reference, x) for reference in references] for x in group.aovs]
        table(group, images, true_aovs, ratios)
        print(
            "closing: "
            + ", ".join(f"{name} {closing(images[name], pictures.get(name, picture)):.1e}" for name in METHODS)
        )
        print(f"{own:.2f} s an AOV to denoise (both halves and their mean)")
        regrade(group, images, true_aovs)
    if options.alpha:
        alpha_table(a, b, ours, references, f"{names[0].rpartition('.')[0]}.A")


def alpha_table(a: exr.ExrFile, b: exr.ExrFile, ours: exr.ExrFile, references: list[exr.ExrFile], name: str) -> None:
    """Mean squared error of alpha."""
    true = [reference.pixels(name).astype(np.float64) for reference in references]
    first, second, corrected = (file.pixels(name).astype(np.float64) for file in (a, b, ours))
    shown = {"half a": first, "mean": (first + second) / 2, "ours": corrected}
    told = ", ".join(f"{what} {((x - true[0]) * (x - true[-1])).mean():.3g}" for what, x in shown.items())
    print(f"alpha: {told}; ours from {corrected.min():g} to {corrected.max():g}")


def table(
    group: Group, images: dict[str, list[Image]], references: list[list[Image]], ratios: dict[str, list[float]]
) -> None:
    """relMSE of each AOV, and how much less than denoised."""
    print(f"\n| {group.name} | " + " | ".join(METHODS) + " | ours / denoised |\n|---|" + "---|" * (len(METHODS) + 1))
    own: dict[str, list[float]] = {method: [] for method in METHODS}
    for i, aov in enumerate(group.aovs):
        errors = {method: relmse(images[method][i], references[i]) for method in METHODS}
        if errors["denoised"] <= 0:
            continue  # nothing in it
        for method, error in errors.items():
            own[method].append(error / errors["denoised"])
        told = " | ".join(f"{error:.2e}" for error in errors.values())
        print(f"| {aov.name} | {told} | {own['ours'][-1]:.3f} |")
    means = " | ".join(f"{geometric(own[method]):.3f}" for method in METHODS)
    print(f"| geometric mean over denoised | {means} | {geometric(own['ours']):.3f} |")
    for method in METHODS:
        ratios[method] += own[method]


def regrade(group: Group, images: dict[str, list[Image]], references: list[list[Image]]) -> None:
    """The composite of light groups, one brighter and one darker."""
    factors = [next((f for n, f in REGRADE.items() if x.name.endswith(f"_{n}")), None) for x in group.aovs]
    if any(factor is None for factor in factors):
        return
    wanted = [sum(f * r for f, r in zip(factors, each, strict=True)) for each in zip(*references, strict=True)]
    told = ", ".join(
        f"{method} {relmse(sum(f * x for f, x in zip(factors, images[method], strict=True)), wanted):.3g}"
        for method in METHODS
    )
    print(f"regraded ({', '.join(f'{name} ×{f:g}' for name, f in REGRADE.items())}): {told}")


if __name__ == "__main__":
    main()
