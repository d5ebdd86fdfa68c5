"""How often training may see a pixel before it overfits the noise: small pieces of frames, several bounds.

    .venv/bin/python scripts/bench/small_frames.py ../shared/frames [--side 128] [--spp 16 64] [--visits 32 64 128 0]

Prints, for the piece in the middle of each frame, the error of the corrected image over that of the denoised one with
each bound (0: none), what the guard believes of it, and geometric means.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from quality import ROLES, load

import denoisers
from selfcorrect import Frame, Settings, correct, metrics


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--side", type=int, default=128, help="of the piece, pixels (default: %(default)s)")
    parser.add_argument("--spp", type=int, nargs="*", default=[16, 64])
    parser.add_argument("--visits", type=int, nargs="*", default=[32, 64, 128, 0])
    parser.add_argument("--denoiser", default="oidn")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    print(f"| frame | spp | {' | '.join(f'visits {visits}: ratio (believed)' for visits in options.visits)} |")
    print(f"|---|---|{'---|' * len(options.visits)}")
    ratios = []
    for name in sorted({path.name.split("_")[0] for path in options.folder.glob("*_ref_A.exr")}):
        for spp in options.spp:
            ratios.append(row(options, name, spp))
    means = np.exp(np.mean(np.log(ratios), axis=0))
    print("geometric means", *(f"{mean:.3f}" for mean in means), "worst", *(f"{r:.3f}" for r in np.max(ratios, axis=0)))


def row(options: argparse.Namespace, name: str, spp: int) -> list[float]:
    """Print a frame's row; returns its ratios."""
    whole, references = load(options.folder, name, spp)
    piece = tuple(slice((size - options.side) // 2, (size + options.side) // 2) for size in whole.size)
    buffers = {role: getattr(whole, role) for role in ROLES if getattr(whole, role) is not None}
    frame = Frame(**{role: tuple(image[piece].clone() for image in pair) for role, pair in buffers.items()})
    frame = frame.denoise(denoisers.create(options.denoiser, threads=options.threads))
    cut = [image[piece] for image in references]
    denoised, ratios, cells = metrics.relmse(frame.denoised_full, *cut), [], []
    for visits in options.visits:
        result = correct(frame, Settings.preset("balanced", visits=visits))
        assert result.estimate is not None  # the preset has the guard
        ratios.append(metrics.relmse(result.image, *cut) / denoised)
        believed = result.estimate.corrected / result.estimate.denoised
        cells.append(f"{ratios[-1]:.3f} ({believed:.2f})")
    print(f"| {name} | {spp} | {' | '.join(cells)} |", flush=True)
    return ratios


if __name__ == "__main__":
    main()
