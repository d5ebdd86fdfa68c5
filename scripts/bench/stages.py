"""What the stages and the dual denoisers bring, each as a table in Markdown.

    .venv/bin/python scripts/bench/stages.py compositions ../shared/frames [--spp 64] [--denoiser oidn]
    .venv/bin/python scripts/bench/stages.py dominance ../shared/frames [--spp 16 64 256]
    .venv/bin/python scripts/bench/stages.py denoisers ../shared/frames [--spp 16 64 256]
    .venv/bin/python scripts/bench/stages.py regression ../shared/frames [--spp 64]
    .venv/bin/python scripts/bench/stages.py speed [--size 1024] [--stage NAME]

compositions: relMSE over that of the denoised image for each order of stages, behind the guard and without it; the
core is trained once for each image it gets, and only inferred for the stages around it. dominance: relMSE of
James–Stein's result over that of the noisy image, with relative block sums and with the published ones. denoisers:
relMSE of each. regression: relMSE over that of the denoised image for some ridges and strides. speed: CPU seconds,
seconds, and growth of the peak memory, each stage in a process of its own.
"""

import argparse
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from quality import load

import denoisers
from selfcorrect import Frame, Settings, correct, metrics
from selfcorrect.frame import mean
from selfcorrect.stages import STAGES
from selfcorrect.stages.images import StageImages
from selfcorrect.stages.james_stein import james_stein, relative_weight, variance_of_mean
from selfcorrect.stages.regression import cross_buffer_regression
from selfcorrect.stages.stage import Work

COMPOSITIONS = (
    *("core", "james-stein", "core,james-stein", "regression", "regression,james-stein"),
    *("regression,core", "regression,core,james-stein"),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=["compositions", "dominance", "denoisers", "regression", "speed"])
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--frames", nargs="*", help="names; by default all in the folder")
    parser.add_argument("--spp", type=int, nargs="*", default=[64])
    parser.add_argument("--denoiser", default="oidn")
    parser.add_argument("--compositions", nargs="*", default=COMPOSITIONS)
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--stage", help="of speed: only this one, in this process")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.table == "speed":
        speed(options)
        return
    names = options.frames or sorted({p.name.split("_")[0] for p in options.folder.glob("*_ref_A.exr")})
    row = {"compositions": compositions, "dominance": dominance, "denoisers": compare, "regression": ridges}
    results = [
        row[options.table](options, name, spp, header=name == names[0] and spp == options.spp[0])
        for name in names
        for spp in options.spp
    ]
    columns = list(zip(*results, strict=True))
    geometric = " | ".join(f"{np.exp(np.mean(np.log(np.maximum(column, 1e-9)))):.3f}" for column in columns)
    print(f"| geometric mean | | {geometric} |\n| worst | | " + " | ".join(f"{max(c):.3f}" for c in columns) + " |")


def head(columns: list[str]) -> None:
    print("| frame | spp | " + " | ".join(columns) + " |\n|---|---|" + "---|" * len(columns), flush=True)


def line(name: str, spp: int, values: list[float], digits: int = 3) -> list[float]:
    print(f"| {name} | {spp} | " + " | ".join(f"{value:.{digits}f}" for value in values) + " |", flush=True)
    return values


def compositions(options: argparse.Namespace, name: str, spp: int, *, header: bool) -> list[float]:
    if header:
        head([*(f"{c}" for c in options.compositions), *(f"{c}, no guard" for c in options.compositions)])
    frame, references = load(options.folder, name, spp)
    frame = frame.denoise(denoisers.create(options.denoiser, threads=options.threads))
    denoised = metrics.relmse(frame.denoised_full, *references)
    networks = {}
    ratios: dict[bool, list[float]] = {True: [], False: []}
    for stages in options.compositions:
        before, core, _ = stages.partition("core")
        if core and before not in networks:
            networks[before] = correct(frame, Settings.preset("balanced", stages=before + core)).network
        for guard, found in ratios.items():
            settings = Settings.preset("balanced", stages=stages, guard=guard, steps=0, epochs=0)
            image = correct(frame, settings, warm_start=networks[before] if core else None).image
            found.append(metrics.relmse(image, *references) / denoised)
    return line(name, spp, ratios[True] + ratios[False])


def dominance(options: argparse.Namespace, name: str, spp: int, *, header: bool) -> list[float]:
    frame, references = load(options.folder, name, spp)
    x, variance = mean(frame.color), variance_of_mean(frame.color)
    other = next(p for p in sorted(options.folder.glob("*_ref_A.exr")) if not p.name.startswith(name))
    shown = load(options.folder, other.name.split("_")[0], spp)[0].color[0].permute(2, 0, 1)[None]
    biased = {
        "box": denoisers.create("box")(x),
        "constant": torch.full_like(x, 0.5),
        "inverted": (1 - x).clamp(min=0),
        "another scene": torch.nn.functional.interpolate(shown, frame.size)[0].permute(1, 2, 0),
        "1e6": torch.full_like(x, 1e6),
    }
    if header:
        head([*biased, *(f"{what}, published" for what in biased)])
    noisy = metrics.relmse(x, *references)
    values = [
        metrics.relmse(james_stein(x, y, variance, weight), *references) / noisy
        for weight in (relative_weight(x), None)
        for y in biased.values()
    ]
    return line(name, spp, values)


def compare(options: argparse.Namespace, name: str, spp: int, *, header: bool) -> list[float]:
    specs = ("oidn", "joint-bilateral", "nlm", "nfor")
    if header:
        head(["noisy", *specs, "nfor / oidn", "nfor / joint-bilateral"])
    frame, references = load(options.folder, name, spp)
    images = [frame.denoise(denoisers.create(spec, threads=options.threads)).denoised_full for spec in specs]
    errors = [metrics.relmse(image, *references) for image in (mean(frame.color), *images)]
    return line(name, spp, [*errors, errors[4] / errors[1], errors[4] / errors[2]], 4)


def ridges(options: argparse.Namespace, name: str, spp: int, *, header: bool) -> list[float]:
    choices = [{"ridge": r, "stride": 2} for r in (1e-2, 1e-3, 1e-4, 1e-5)]
    choices += [{"ridge": 1e-4, "stride": s} for s in (1, 4, 8)]
    if header:
        head([f"ridge {c['ridge']:g}, stride {c['stride']}" for c in choices])
    frame, references = load(options.folder, name, spp)
    frame = frame.denoise(denoisers.create(options.denoiser, threads=options.threads))
    denoised = metrics.relmse(frame.denoised_full, *references)
    fits = [cross_buffer_regression(frame.halves, **c, threads=options.threads) for c in choices]
    return line(name, spp, [metrics.relmse(mean(fit), *references) / denoised for fit in fits])


def speed(options: argparse.Namespace) -> None:
    names = [*(s for s in STAGES if s != "core"), "regression, stride 1", "regression, stride 4", "nlm", "nfor"]
    if options.stage is None:
        print(
            f"{options.size}x{options.size}, {options.threads} thread(s)\n| | CPU s | s | peak MB |\n|---|---|---|---|"
        )
        for name in names:
            arguments = ["speed", "--size", str(options.size), "--threads", str(options.threads), "--stage", name]
            subprocess.run([sys.executable, __file__, *arguments], check=True)
        return
    generator = torch.Generator().manual_seed(0)
    shapes = {"color": 3, "denoised": 3, "albedo": 3, "normal": 3, "visibility": 1, "depth": 1}
    frame = Frame(
        **{
            name: tuple(torch.rand(options.size, options.size, channels, generator=generator) for _ in "ab")
            for name, channels in shapes.items()
        }
    )
    before, start, cpu = peak(), time.perf_counter(), time.process_time()
    work(options.stage, frame, options.threads)()
    spent = time.process_time() - cpu, time.perf_counter() - start
    print(f"| {options.stage} | {spent[0]:.1f} | {spent[1]:.1f} | {peak() - before:.0f} |", flush=True)


def work(stage: str, frame: Frame, threads: int) -> Callable[[], object]:
    """One stage on a frame, ready to be timed."""
    if stage in ("nlm", "nfor"):
        return lambda: frame.denoise(denoisers.create(stage, threads=threads))
    name, _, stride = stage.partition(", stride ")
    settings = Settings.preset("balanced", **({"regression_stride": int(stride)} if stride else {}))
    state = StageImages(frame.halves, mean(frame.denoised))
    step = STAGES[name](settings)
    return lambda: step.run(state, Work())


def peak() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
