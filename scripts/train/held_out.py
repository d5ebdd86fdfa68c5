"""What the deep combiner brings to scenes that it has not been trained on, over several denoisers.

    for scene in bathroom classroom ...; do
        .venv/bin/python scripts/train/train.py bilateral-combiner --data CUTS --hold-out $scene --out RUNS/$scene ...
        .venv/bin/python scripts/train/export.py RUNS/$scene --out RUNS/$scene.safetensors
    done
    .venv/bin/python scripts/train/held_out.py measure FRAMES --weights RUNS --out TABLE.csv [--stages core --spp 64]
    .venv/bin/python scripts/train/held_out.py table --out TABLE.csv
    .venv/bin/python scripts/train/held_out.py curve --weights RUNS --out CURVE.png

measure: a row for each frame, denoiser and chain of stages, written at once; rows that the file has are not measured
again. A scene's weights are RUNS/SCENE.safetensors. Everything is unguarded unless a stage is the core. table: the
error over the denoiser's, geometric mean (worst), and the median of the mean radiance over the reference's. curve: the
last validation of runs in folders RUNS/SCENE-VIEWS, trained with ``--hold-out SCENE --at-most VIEWS``.
"""

import argparse
import csv
import sys
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import torch
from evaluate import FRAME_SPP, geometric, rows
from train import publish

import denoisers
from selfcorrect import Frame, Settings, correct, metrics
from selfcorrect.frame import mean

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "bench"))

from quality import load as load_frame

mpl.use("Agg")

DENOISERS = ("joint-bilateral", "nfor", "oidn")
COLUMNS = ("frame", "spp", "denoiser", "stages", "relmse", "radiance")
ALONE = "none"  # no stage: the denoised image


def main(arguments: list[str] | None = None) -> None:
    options = parse(arguments)
    torch.set_num_threads(options.threads)
    if options.verb == "measure":
        done = {tuple(row[name] for name in COLUMNS[:4]) for row in rows(options.out)}
        for name in sorted({path.name.split("_")[0] for path in options.frames.glob("*_ref_A.exr")}):
            for spp in options.spp:
                for denoiser in options.denoisers:
                    chains = [c for c in (ALONE, *options.stages) if (name, str(spp), denoiser, c) not in done]
                    measure(name, spp, denoiser, chains, options)
    if options.verb == "curve":
        draw_curve(options.weights, options.out)
    else:
        print(table(rows(options.out)))


def measure(name: str, spp: int, denoiser: str, chains: list[str], options: argparse.Namespace) -> None:
    """Append a row for each chain of stages."""
    if not chains:
        return
    frame, references = load_frame(options.frames, name, spp)
    judges = [torch.from_numpy(reference) for reference in references]
    frame = frame.denoise(denoisers.create(denoiser, threads=options.threads))
    for stages in chains:
        image = image_of(frame, stages, options.weights / f"{name}.safetensors", options.preset)
        error, radiance = metrics.relmse(image, *judges), metrics.mean_radiance_ratio(image, mean(judges[:2]))
        row = (name, spp, denoiser, stages, f"{error:.6g}", f"{radiance:.5g}")
        new = not options.out.exists()
        with options.out.open("a", newline="") as file:
            csv.writer(file).writerows([COLUMNS, row] if new else [row])
        print(*row, sep="  ", flush=True)


def image_of(frame: Frame, stages: str, weights: Path, preset: str) -> torch.Tensor:
    """What a chain of stages makes of a frame."""
    image: torch.Tensor
    if stages == ALONE:
        assert isinstance(frame.denoised_full, torch.Tensor)  # denoise() makes one
        return frame.denoised_full
    settings = {"guard": "core" in stages, "candidates": "none", "combiner_weights": str(weights)}
    image = correct(frame, Settings.preset(preset, stages=stages, **settings)).image
    return image


def table(measured: list[dict[str, str]]) -> str:
    """Error over the denoiser's as Markdown, by denoiser and stages."""
    errors = {(r["denoiser"], r["stages"], r["frame"], r["spp"]): r for r in measured}
    lines = ["| over | stages | frames | error: mean (worst) | mean radiance |", "|---|---|---|---|---|"]
    for denoiser, stages in sorted({key[:2] for key in errors if key[1] != ALONE}):
        found = [row for key, row in errors.items() if key[:2] == (denoiser, stages)]
        ratios = [
            max(float(row["relmse"]), 1e-6) / float(errors[denoiser, ALONE, row["frame"], row["spp"]]["relmse"])
            for row in found
        ]
        light = sorted(float(row["radiance"]) for row in found)[len(found) // 2]
        cells = (denoiser, stages, str(len(found)), f"{geometric(ratios):.3f} ({max(ratios):.2f})", f"{light:.4f}")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def draw_curve(runs: Path, path: Path) -> None:
    """Error over the denoised images' of each held-out scene, against the number of views trained on."""
    found: dict[str, list[tuple[int, float]]] = {}
    for folder in sorted(runs.glob("*-[0-9]*")):
        scene, _, views = folder.name.rpartition("-")
        if not (folder / "validation.csv").exists():
            continue
        last = rows(folder / "validation.csv")[-1]
        found.setdefault(scene, []).append((int(views), float(last["to_baseline"])))
        print(folder.name, last["to_baseline"])
    figure, axes = plt.subplots(figsize=(5, 3.5), layout="constrained")
    for scene, points in found.items():
        axes.plot(*zip(*sorted(points), strict=True), "o-", label=f"{scene}, held out")
    axes.axhline(1, color="gray", linewidth=0.8)
    axes.set(xlabel="views trained on", ylabel="error over the denoised images'", xscale="log")
    axes.legend()
    publish(path, lambda temporary: figure.savefig(temporary, dpi=100))


def parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("verb", choices=["measure", "table", "curve"])
    parser.add_argument("frames", type=Path, nargs="?", metavar="FRAMES")
    parser.add_argument("--weights", type=Path, metavar="RUNS", help="with a file SCENE.safetensors for each")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--denoisers", nargs="*", default=DENOISERS)
    parser.add_argument("--stages", nargs="*", default=["deep-combiner"])
    parser.add_argument("--spp", type=int, nargs="*", default=FRAME_SPP)
    parser.add_argument("--preset", default=Settings.default(), help="of the core; a table is of one")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args(arguments)
    if options.verb == "measure" and not (options.frames and options.weights):
        parser.error("expected FRAMES and --weights RUNS")
    return options


if __name__ == "__main__":
    main()
