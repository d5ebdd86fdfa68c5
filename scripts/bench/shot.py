"""A shot, cold against warm: error of each frame against two references, seconds, flicker.

    .venv/bin/python scripts/bench/shot.py ../shared/shot [--preset balanced] [--variants cold warm warm:steps=50 key]

The folder holds ``NAME_a.####.exr``, ``NAME_b``, ``NAME_ref_a``, ``NAME_ref_b`` and perhaps ``NAME_ref_smooth``, else
the denoised mean of the references; ``scripts/render/ghosts.py`` makes such a folder. Frames without references are
neighbours only. ``--flow`` leaves motion passes out.

Variants: ``cold`` (each frame on its own), ``warm`` (each from the last one's network, with the preset's settings for
that), ``key`` (each from the first frame's network), ``history`` (warm, with the samples of the neighbours that are in
the folder; ``candidate`` is its image before any guard), and any of them with settings changed:
``warm:warm_steps=50``, commas between several; ``history:frame_radius=1`` takes fewer neighbours. Prints relMSE of
noisy, denoised and each variant for every frame, with the mean radiance over that of the smooth reference, the mean
over the frames after the first (which is cold in any case), and the temporal error
(:func:`selfcorrect.metrics.temporal_error`), the mean over all pairs of neighbours; and each as a share of the
denoised image's. ``--save FILE.npz`` keeps the images of the first variant for ``scripts/bench/slice.py``.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

import denoisers
from selfcorrect import Frame, Settings, correct, exr, metrics
from selfcorrect.history import Histories

ROLES = ("color", "albedo", "normal", "visibility", "depth", "motion")


def load(folder: Path, number: int, denoiser: str, threads: int, flow: bool = False) -> tuple[Frame, list[np.ndarray]]:
    """A denoised frame and its references: two independent ones, and the smooth one; none where the folder has none."""

    def file(kind: str) -> Path:
        shot = next(folder.glob("*_ref_a.*.exr")).name.partition("_ref_a")[0]
        return folder / f"{shot}_{kind}.{number:04d}.exr"

    plugin = denoisers.create(denoiser, threads=threads)
    roles = [role for role in ROLES if not (flow and role == "motion")]
    a, b = (exr.load_half(file(kind), shot=True).buffers for kind in "ab")
    frame = Frame(**{role: (a[role], b[role]) for role in roles if role in a}).denoise(plugin, keep_aids=True)
    if not file("ref_a").exists():
        return frame, []
    both = [exr.load_half(file(kind)).buffers for kind in ("ref_a", "ref_b")]
    references = [np.asarray(buffers["color"]) for buffers in both]
    if file("ref_smooth").exists():
        references.append(exr.load_half(file("ref_smooth")).buffers["color"])
    else:
        reference = Frame(**{role: (both[0][role], both[1][role]) for role in roles if role in both[0]})
        references.append(np.asarray(reference.denoise(plugin).denoised_full))
    return frame, references


def corrected(
    frames: dict[int, Frame], numbers: list[int], preset: str, variant: str, denoiser: Any
) -> tuple[list[Any], list[float]]:
    """Images of one variant of the frames of these numbers, and seconds of each."""
    how, _, changes = variant.partition(":")
    pairs = dict(change.split("=") for change in changes.split(",") if change)
    settings = Settings.preset(preset, **{k: int(v) if v.isdigit() else float(v) for k, v in pairs.items()})
    images, seconds, last, first = [], [], None, None
    histories = Histories(settings.frame_radius if how in ("history", "candidate") else 0, denoiser)
    for number in numbers:
        start, frame = time.process_time(), frames[number]
        if histories.reach:
            around = {n: other for n, other in frames.items() if abs(n - number) <= histories.reach}
            frame, history = histories.of(number, around)
            print(number, *history.lines(), sep="; ", file=sys.stderr)
        if how == "candidate":
            images.append(frame.candidates[-1].full)
            seconds.append(time.process_time() - start)
            continue
        result = correct(frame, settings, warm_start={"cold": None, "key": first}.get(how, last))
        last, first = result.network, first or result.network
        images.append(result.image)
        seconds.append(time.process_time() - start)
    return images, seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--preset", default=Settings.default())
    parser.add_argument("--denoiser", default="oidn")
    parser.add_argument("--variants", nargs="*", default=["cold", "warm"])
    parser.add_argument("--flow", action="store_true", help="leave motion passes out")
    parser.add_argument("--save", type=Path, metavar="NPZ", help="keep the first variant's images")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    found = sorted(int(p.name.split(".")[-2]) for p in options.folder.glob("*_a.*.exr") if "_ref_a" not in p.name)
    denoiser = denoisers.create(options.denoiser, threads=options.threads)
    loaded = {n: load(options.folder, n, options.denoiser, options.threads, options.flow) for n in found}
    numbers = [number for number, (_, references) in loaded.items() if references]
    shot = {number: frame for number, (frame, _) in loaded.items()}
    frames, references = [shot[number] for number in numbers], [loaded[number][1] for number in numbers]
    print(f"preset {options.preset}, denoiser {options.denoiser}: relMSE (mean radiance) of each frame; CPU seconds")
    print(f"| | {' | '.join(map(str, numbers))} | after the first | temporal | seconds |")
    print(f"|---|{'---|' * (len(numbers) + 3)}")
    noisy = [np.asarray((f.color[0] + f.color[1]) / 2) for f in frames]
    row("noisy", noisy, references, [0.0])
    denoised_images = [np.asarray(frame.denoised_full) for frame in frames]
    denoised = row(options.denoiser, denoised_images, references, [0.0])
    for variant in options.variants:
        images, seconds = corrected(shot, numbers, options.preset, variant, denoiser)
        measured = row(variant, images, references, seconds[1:])
        each = [a / b for a, b in zip(measured[0], denoised[0], strict=True)]
        of = f"of {options.denoiser}: {' '.join(f'{ratio:.3f}' for ratio in each)}, mean {np.mean(each):.3f}"
        print(f"{variant}, {of}, temporal {measured[1] / denoised[1]:.3f}", flush=True)
        if options.save is not None and variant == options.variants[0]:
            smooth = [(first + second) / 2 for first, second, _ in references]
            kinds = {"noisy": noisy, options.denoiser: denoised_images, "corrected": images, "reference": smooth}
            np.savez(options.save, **{name: np.stack(kind).astype(np.float16) for name, kind in kinds.items()})


def row(
    name: str, images: list[Any], references: list[list[np.ndarray]], seconds: list[float]
) -> tuple[list[float], float]:
    """Print one row of the table; its errors and the temporal one are returned."""
    errors = [metrics.relmse(image, *reference) for image, reference in zip(images, references, strict=True)]
    means = [metrics.mean_radiance_ratio(image, r[2]) for image, r in zip(images, references, strict=True)]
    flicker = []
    for t in range(1, len(images)):
        pairs = [(references[t][i], references[t - 1][i]) for i in range(3)]
        flicker.append(metrics.temporal_error(images[t], images[t - 1], *pairs))
    each = " | ".join(f"{error:.5f} ({mean:.3f})" for error, mean in zip(errors, means, strict=True))
    print(
        f"| {name} | {each} | {np.mean(errors[1:]):.5f} | {np.mean(flicker):.5f} | {np.mean(seconds):.1f} |", flush=True
    )
    return errors, float(np.mean(flicker))


if __name__ == "__main__":
    main()
