"""Alarms of the test of independence, false and missed, over frames and shares of common noise.

    .venv/bin/python scripts/bench/independence.py ../shared/frames [--spp 16 64 256] [--shares 0 0.03 0.1 0.25 0.5 1]

A half b that shares a part of the noise of half a is made from independent halves and the mean of both references:
r + s (a − r) + √(1 − s²) (b − r), which has the noise variance of b and correlates with a by s. Independent halves
(share 0) and frames without noise must raise no alarm. Clean frames: the smooth references as they are, and shrunken
by 2 and 4, which makes their detail finer; the same with independent noise of 0.1 % to 30 %; and synthetic ones, a
gradient, waves, stripes, a chessboard of large squares, and the same rounded to half floats. One line for each frame:
the estimated share and "!" for an alarm.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from selfcorrect import exr
from selfcorrect.independence import dependence

SIZE = (270, 480)
NOISE = (0.001, 0.01, 0.1, 0.3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", nargs="*", help="names; by default all in the folder")
    parser.add_argument("--spp", type=int, nargs="*", default=[16, 64, 256])
    parser.add_argument("--shares", type=float, nargs="*", default=[0, 0.03, 0.1, 0.25, 0.5, 0.75, 0.9, 0.99, 1])
    options = parser.parse_args()
    torch.set_num_threads(1)
    names = options.frames or sorted({p.name.split("_")[0] for p in options.folder.glob("*_ref_A.exr")})
    print("| frame | " + " | ".join(f"share {share:g}" for share in options.shares) + " |")
    print("|---" * (1 + len(options.shares)) + "|")
    alarms = torch.zeros(len(options.shares), dtype=torch.int64)
    for name in names:
        for spp in options.spp:
            halves = [_color(options.folder / f"{name}_{spp:03d}spp_{half}.exr") for half in "AB"]
            truth = sum(_color(options.folder / f"{name}_ref_{half}.exr") for half in "AB") / 2
            cells = [_alarm(halves[0], _sharing(*halves, truth, share)) for share in options.shares]
            alarms += torch.tensor([cell.endswith("!") for cell in cells])
            print(f"| {name} {spp} | " + " | ".join(cells) + " |", flush=True)
    frames = len(names) * len(options.spp)
    print("| alarms | " + " | ".join(f"{int(count)} of {frames}" for count in alarms) + " |")

    print("\nclean frames, bit-equal halves and independent noise: none may raise an alarm")
    print("| frame | none | " + " | ".join(f"{noise:.1%}" for noise in NOISE) + " |")
    print("|---" * (2 + len(NOISE)) + "|")
    false = 0
    for name, image in _clean(options.folder, names):
        pairs = [(image, image.clone()), *((_noisy(image, noise, 1), _noisy(image, noise, 2)) for noise in NOISE)]
        cells = [_alarm(*pair) for pair in pairs]
        false += sum(cell.endswith("!") for cell in cells)
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)
    print(f"false alarms: {false}")


def _alarm(a: Tensor, b: Tensor) -> str:
    found = dependence(a, b)
    return f"{found.share:.2f} ({found.whiteness:.2f}){' !' if found.noisy else ''}"


def _sharing(a: Tensor, b: Tensor, truth: Tensor, share: float) -> Tensor:
    return (truth + share * (a - truth) + (1 - share**2) ** 0.5 * (b - truth)).clamp(min=0)


def _color(path: Path) -> Tensor:
    return torch.from_numpy(exr.load_half(path).buffers["color"]).float()


def _noisy(image: Tensor, deviation: float, seed: int) -> Tensor:
    noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(seed))
    return (image * (1 + deviation * noise)).clamp(min=0)


def _clean(folder: Path, names: list[str]) -> Iterator[tuple[str, Tensor]]:
    for name in names:
        smooth = _color(folder / f"{name}_ref_smooth.exr")
        for factor in (1, 2, 4):
            planes = torch.nn.functional.avg_pool2d(smooth.permute(2, 0, 1)[None], factor)
            yield f"{name} / {factor}", planes[0].permute(1, 2, 0).contiguous()
    y, x = torch.meshgrid(torch.arange(SIZE[0]).double(), torch.arange(SIZE[1]).double(), indexing="ij")
    shapes = {
        "gradient": 0.1 + (x + 0.7 * y) / 500,
        "waves": 0.6 + 0.4 * torch.sin(0.9 * x) * torch.cos(0.35 * y),
        "slanted stripes": 1 + 0.2 * torch.sin(1.9 * x + 0.3 * y),
        "rings": 1 + 0.5 * torch.sin(((x - 200) ** 2 + (y - 100) ** 2).sqrt() * 0.8),
        "chessboard": 0.2 + ((x + 0.31 * y) // 23 + (y - 0.27 * x) // 19) % 2,
    }
    for name, values in shapes.items():
        image = values.float()[..., None].expand(*SIZE, 3).contiguous()
        yield name, image
        yield f"{name}, half floats", image.half().float()


if __name__ == "__main__":
    main()
