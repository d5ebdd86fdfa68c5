"""What the trained networks bring: relMSE of every method on validation views and on frames, and what they cost.

    .venv/bin/python scripts/train/evaluate.py quality --data DATASET [--frames ../shared/frames] --out TABLE.csv
    .venv/bin/python scripts/train/evaluate.py table --out TABLE.csv
    .venv/bin/python scripts/train/evaluate.py speed [--size 1024] [--threads 2] [--methods oidn …]

quality: one row a frame and method, written at once; rows that the file has are not measured again. relMSE is that of
``selfcorrect.metrics`` with two references and the smooth one. Denoisers are run on the mean of both halves; all else
starts from OIDN's images. The guard is on where the core runs, else off.
``box,…`` are a box filter's images in place of OIDN's: a bad biased image for James–Stein. table: geometric means as
Markdown, over the noisy image and over OIDN. speed: seconds of the networks, and the sizes of their weights.
"""

import argparse
import csv
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import dataset
import torch
from torch import Tensor

import denoisers
from selfcorrect import Frame, Settings, correct, metrics
from selfcorrect.errors import FileError
from selfcorrect.frame import mean
from selfcorrect.stages import opened, weights
from selfcorrect.stages.core.network import Network
from selfcorrect.stages.deep_combiner_4 import SubImages

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "bench"))

from quality import load as load_frame

DENOISERS = ("oidn", "joint-bilateral", "nfor", "onnx")
STAGES = (
    *("deep-combiner", "deep-combiner-4", "core", "james-stein", "neural-james-stein"),
    *("regression,james-stein", "regression,neural-james-stein", "box,james-stein", "box,neural-james-stein"),
    *("deep-combiner,core", "core,james-stein", "core,neural-james-stein"),
    "deep-combiner,core,neural-james-stein",
)
METHODS = ("noisy", *DENOISERS, *STAGES)
COLUMNS = ("set", "frame", "spp", "method", "relmse", "standard_error", "radiance")
FRAME_SPP = (16, 64, 256)

References = tuple[Tensor, Tensor, Tensor]


class Case(NamedTuple):
    """A frame to measure: with OIDN's images where they are stored, else None."""

    part: str
    name: str
    spp: int
    frame: Frame
    references: References
    sub_images: SubImages | None = None


def main(arguments: list[str] | None = None) -> None:
    options = parse(arguments)
    torch.set_num_threads(options.threads)
    if options.verb == "speed":
        speed(options.size, options.threads, options.methods)
        return
    if options.verb == "quality":
        methods = [method for method in options.methods if available(method)]
        done = {(row["set"], row["frame"], row["spp"], row["method"]) for row in rows(options.out)}
        for case in cases(options):
            measure(case, [m for m in methods if (case.part, case.name, str(case.spp), m) not in done], options)
    print(table(rows(options.out)))


def available(method: str) -> bool:
    """Whether a method has its weights; says so where it hasn't."""
    try:
        if method == "onnx":
            denoisers.create("onnx")
        elif method in STAGES:
            opened(Settings.preset("balanced", stages=method.removeprefix("box,")))
    except FileError as error:
        print(f"{method} is left out: {error}")
        return False
    return True


def cases(options: argparse.Namespace) -> Iterator[Case]:
    """Validation views, then frames."""
    if options.data:
        for path in dataset.views(options.data / "validation")[: options.views]:
            yield of_view(dataset.load(path))
    if options.frames:
        for name in sorted({path.name.split("_")[0] for path in options.frames.glob("*_ref_A.exr")}):
            for spp in options.spp:
                frame, references = load_frame(options.frames, name, spp)
                yield Case("frames", name, spp, frame, tuple(map(torch.from_numpy, references)))


def of_view(view: dataset.View) -> Case:
    """A view as a frame with sub-images, denoised by OIDN."""
    assert view.reference is not None  # a view for validation has references
    inputs, images = dataset.inputs_of(view.color), view.denoised["oidn"]
    frame = Frame(
        color=(inputs[4], inputs[5]),
        denoised=(images[4], images[5]),
        denoised_full=images[6],
        albedo=(view.albedo, view.albedo),
        normal=(view.normal, view.normal),
        depth=(view.depth, view.depth),
    )
    subs = replace(SubImages.of(frame, tuple(inputs[:4])), denoised=tuple(images[:4]))
    return Case(f"views: {view.scene}", view.name, view.spp, frame, (*view.reference, view.smooth), subs)


def measure(case: Case, methods: list[str], options: argparse.Namespace) -> None:
    """Append a row for each method."""
    made: dict[str, Frame] = {}
    networks: dict[str, Network | None] = {}

    def denoised(spec: str) -> Frame:
        if spec not in made:
            stored = spec == "oidn" and case.frame.denoised is not None
            made[spec] = case.frame if stored else case.frame.denoise(denoisers.create(spec, threads=options.threads))
        return made[spec]

    for method in methods:
        if method == "deep-combiner-4" and case.sub_images is None:
            continue
        image = result_of(method, case, denoised, networks)
        error = metrics.relmse(image, *case.references)
        spread = metrics.relmse_standard_error(image, *case.references)
        radiance = metrics.mean_radiance_ratio(image, mean(case.references[:2]))
        row = (case.part, case.name, case.spp, method, f"{error:.6g}", f"{spread:.3g}", f"{radiance:.5g}")
        new = not options.out.exists()
        with options.out.open("a", newline="") as file:
            csv.writer(file).writerows([COLUMNS, row] if new else [row])
        print(*row, sep="  ", flush=True)


def result_of(method: str, case: Case, denoised: Callable[[str], Frame], networks: dict[str, Network | None]) -> Tensor:
    """A method's image; the core is trained once for each image it gets, and kept in ``networks``."""
    if method == "noisy":
        return mean(case.frame.color)
    if method in DENOISERS:
        image = denoised(method).denoised_full
        assert isinstance(image, Tensor)  # denoise() makes one
        return image
    stages = method.removeprefix("box,")
    given = denoised("oidn" if stages == method else "box")
    before, core, _ = stages.partition("core")
    if core and before not in networks:
        networks[before] = correct(given, Settings.preset("balanced", stages=before + core, guard=False)).network
    settings = Settings.preset(
        "balanced", stages=stages, guard=bool(core), **({"steps": 0, "epochs": 0} if core else {})
    )
    extra = {"deep-combiner-4": case.sub_images}
    result: Tensor = correct(given, settings, warm_start=networks[before] if core else None, extra=extra).image
    return result


def rows(path: Path) -> list[dict[str, str]]:
    """What the table holds so far."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def table(measured: list[dict[str, str]]) -> str:
    """Geometric means as Markdown, each method over the noisy image and over OIDN on the same frames."""
    errors = {(r["set"], r["frame"], r["spp"], r["method"]): max(float(r["relmse"]), 1e-6) for r in measured}
    radiance = {(r["set"], r["frame"], r["spp"], r["method"]): float(r["radiance"]) for r in measured}
    lines = []
    for part in ("views", "frames"):
        lines += [
            f"| {part} | count | relMSE | to noisy | worst to noisy | to OIDN | worst to OIDN | mean radiance |",
            "|---|---|---|---|---|---|---|---|",
        ]
        for method in METHODS:
            keys = [key for key in errors if key[0].startswith(part) and key[3] == method]
            keys = [key for key in keys if all((*key[:3], other) in errors for other in ("noisy", "oidn"))]
            if not keys:
                continue
            to = {other: [errors[key] / errors[(*key[:3], other)] for key in keys] for other in ("noisy", "oidn")}
            numbers = [geometric([errors[key] for key in keys])]
            for ratios in to.values():
                numbers += [geometric(ratios), max(ratios)]
            light = sorted(radiance[key] for key in keys)[len(keys) // 2]
            cells = [f"{number:.4g}" for number in (*numbers, light)]
            lines.append(f"| {method} | {len(keys)} | {' | '.join(cells)} |")
        lines.append("")
    return "\n".join(lines)


def geometric(values: list[float]) -> float:
    return math.exp(sum(map(math.log, values)) / len(values))


def speed(size: int, threads: int, methods: Sequence[str]) -> None:
    """Seconds at size × size pixels of random numbers, and megabytes of the weights."""
    generator = torch.Generator().manual_seed(0)

    def pair(channels: int = 3) -> tuple[Tensor, Tensor]:
        a, b = (torch.rand(size, size, channels, generator=generator) for _ in "ab")
        return a, b

    frame = Frame(color=pair(), denoised=pair(), albedo=pair(), normal=pair(), depth=pair(1))
    print(f"| {size}×{size}, {threads} thread(s) | s |\n|---|---|")
    for spec in ("onnx", "oidn"):
        if spec in methods and available(spec):
            denoise = denoisers.create(spec, threads=threads)
            arguments = [pairs[0] for pairs in (frame.color, frame.albedo, frame.normal) if pairs is not None]
            denoise(arguments[0], albedo=arguments[1], normal=arguments[2])  # the first call is slower
            begun = time.perf_counter()
            denoise(arguments[0], albedo=arguments[1], normal=arguments[2])
            print(f"| {spec} | {time.perf_counter() - begun:.2f} |", flush=True)
    for stage in ("james-stein", "neural-james-stein", "deep-combiner"):
        if stage in methods and available(stage):
            begun = time.perf_counter()
            correct(frame, Settings.preset("balanced", stages=stage, guard=False))
            print(f"| {stage}, both halves and the full image | {time.perf_counter() - begun:.2f} |", flush=True)
    packages = Path(denoisers.__file__).parent, weights.PACKAGED.parent
    for path in sorted(file for package in packages for file in package.glob("weights/*.*")):
        print(f"{path.name}: {path.stat().st_size / 1e6:.2f} MB")


def parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("verb", choices=["quality", "table", "speed"])
    parser.add_argument("--data", type=Path)
    parser.add_argument("--frames", type=Path)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=METHODS)
    parser.add_argument("--views", type=int, help="the first so many; by default all")
    parser.add_argument("--spp", type=int, nargs="*", default=FRAME_SPP)
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args(arguments)
    if options.verb != "speed" and options.out is None:
        parser.error("expected --out TABLE.csv")
    return options


if __name__ == "__main__":
    main()
