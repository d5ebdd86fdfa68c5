"""Equal time: is correcting a frame worth its seconds, or would more samples have brought more?

    .venv/bin/python scripts/bench/equal_time.py ../shared/frames [--frames …] [--spp 16 64 256]
        [--points fast balanced] [--cost bathroom=1.99 …]

For each frame and number of samples: relMSE of the denoised full buffer and of the corrected frame against two
references; the seconds that correcting takes on top (two more denoisings, training, inference); the samples per pixel
that the renderer gives for them; and the denoised relMSE with those samples added, on straight lines in the logarithms
of relMSE and spp between the measured numbers of samples (beyond the last one on the last line: marked «beyond»).
The ratio of corrected to denoised-with-more-samples is below 1 where correcting wins. At the end, for each frame and
point, the spp from which it stays so.

Seconds are CPU seconds, all threads together, as the renderer's are (seconds of one core, from the README of the
frames): they do not grow where other processes use the machine. --cost overrides the renderer's.
"""

import argparse
import time
from pathlib import Path

import power_laws
import torch
from quality import load

import denoisers
from selfcorrect import Settings, correct, metrics, tradeoff


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", nargs="*", help="names; by default all in the folder")
    parser.add_argument("--spp", type=int, nargs="*", default=[16, 64, 256], help="two or more, increasing")
    quick = [name for name in Settings.presets() if name in ("fast", "balanced")]
    parser.add_argument("--points", nargs="*", default=quick, help="presets, or settings as tradeoff.py has them")
    parser.add_argument("--denoiser", default="oidn")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--cost", nargs="*", default=[], metavar="FRAME=SECONDS", help="of one sample per pixel")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    costs = renderer_seconds(options.folder) | {k: float(v) for k, _, v in (c.partition("=") for c in options.cost)}
    names = options.frames or sorted({p.name.split("_")[0] for p in options.folder.glob("*_ref_A.exr")})
    print(f"denoiser {options.denoiser}; seconds of the processor, {options.threads} thread(s)")
    print("| frame | spp | denoised | point | corrected | seconds on top | extra spp | denoised, with them | ratio |")
    print("|---|---|---|---|---|---|---|---|---|", flush=True)
    found = [line for name in names for line in one_frame(options, name, costs[name])]
    print("\n" + "\n".join(found))


def renderer_seconds(folder: Path) -> dict[str, float]:
    """Frame → seconds of one sample per pixel on one core, from the table in the folder's README."""
    costs = {}
    for line in (folder / "README.md").read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip("| \n").split("|")]
        if len(cells) == 4 and cells[3].replace(".", "", 1).isdigit():
            costs[cells[0]] = float(cells[3])
    return costs


def one_frame(options: argparse.Namespace, name: str, cost: float) -> list[str]:
    """Print the rows of one frame; returns what they say of each preset."""
    denoised: list[float] = []
    corrected: dict[str, list[tuple[float, float]]] = {point: [] for point in options.points}
    denoise = denoisers.create(options.denoiser, threads=options.threads)
    for spp in options.spp:
        frame, references = load(options.folder, name, spp)
        if not denoised:
            tradeoff.warm_up(frame.denoise(denoise))
        start = time.process_time()
        frame = frame.denoise(denoise)
        more_denoising = (time.process_time() - start) * 2 / 3  # the full buffer's would be done in any case
        denoised.append(metrics.relmse(frame.denoised_full, *references))
        for point in options.points:
            settings = tradeoff.point(point, Settings.preset(Settings.default())).settings
            start = time.process_time()
            image = correct(frame, settings).image
            seconds = time.process_time() - start + more_denoising
            corrected[point].append((metrics.relmse(image, *references), seconds))
    lines = []
    for point, results in corrected.items():
        ratios = []
        for spp, before, (after, seconds) in zip(options.spp, denoised, results, strict=True):
            extra = seconds / cost
            instead = power_laws.interpolated(options.spp, denoised, spp + extra)
            ratios.append(after / instead)
            beyond = " (beyond)" if spp + extra > options.spp[-1] else ""
            print(
                f"| {name} | {spp} | {before:.5f} | {point} | {after:.5f} | {seconds:.1f} | {extra:.1f} "
                f"| {instead:.5f}{beyond} | {ratios[-1]:.3f} |",
                flush=True,
            )
        lines.append(f"{name}, {point}: {verdict(options.spp, ratios)}")
    return lines


def verdict(spp: list[int], ratios: list[float]) -> str:
    crossing = power_laws.wins_from(spp, ratios)
    if crossing is None:
        return f"more samples win at {spp[-1]} spp"
    if max(ratios) < 1:
        return f"correcting wins from {spp[0]} spp or fewer"
    return f"correcting wins from {crossing:.0f} spp"


if __name__ == "__main__":
    main()
