"""Cut rendered frames that have references into views: a training set without any rendering, to try a recipe on.

    .venv/bin/python scripts/train/cut_frames.py FRAMES -o DATASET
    .venv/bin/python scripts/train/train.py deep-combiner --data DATASET --hold-out bathroom --out RUN --minutes 10

The target is the mean of both references. A frame has halves only: a view's sub-images 0 and 1 are both half a, 2 and 3
half b, which is right for networks of one or both halves, and wrong for those of four sub-images. Every view is in both
parts, with its references in the validation part: train with ``--hold-out``, or a network is judged by what it knows.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import torch
from dataset import View, save
from torch import Tensor

import denoisers
from selfcorrect import Frame
from selfcorrect.frame import mean

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "bench"))

from quality import load as load_frame

DENOISERS = ("oidn", "oidn:none", "oidn:fast", "joint-bilateral")


def main(arguments: list[str] | None = None) -> None:
    options = parse(arguments)
    torch.set_num_threads(1)
    for part in ("train", "validation"):
        (options.output / part).mkdir(parents=True, exist_ok=True)
    for name in sorted({path.name.split("_")[0] for path in options.frames.glob("*_ref_A.exr")}):
        for spp in options.spp:
            frame, references = load_frame(options.frames, name, spp)
            made = {spec: denoised(frame, spec) for spec in options.denoisers}
            a, b, smooth = map(torch.from_numpy, references)
            for view in views(f"{name}-{spp:03}", frame, made, torch.stack([a, b]), smooth, options.size):
                of_scene = view._replace(scene=name, spp=spp)
                save(options.output / "validation" / f"{view.name}.safetensors", of_scene, {})
                save(options.output / "train" / f"{view.name}.safetensors", of_scene._replace(reference=None), {})
            print(f"{name}, {spp} spp", flush=True)


def denoised(frame: Frame, spec: str) -> Tensor:
    """Half a twice, half b twice, a, b, and the frame: (7, H, W, 3)."""
    found = frame.denoise(denoisers.create(spec, threads=1))
    assert found.denoised is not None  # denoise() makes them
    assert found.denoised_full is not None
    a, b = found.denoised
    return torch.stack([a, a, b, b, a, b, found.denoised_full])


def views(
    name: str, frame: Frame, made: dict[str, Tensor], reference: Tensor, smooth: Tensor, size: int
) -> Iterator[View]:
    """Pieces of size² pixels that do not overlap, as many as the frame has room for; scene and spp are left open."""
    a, b = frame.color
    color = torch.stack([a, a, b, b, reference.mean(0)])
    albedo, normal, depth = (mean(pair) for pair in (frame.albedo, frame.normal, frame.depth) if pair is not None)
    height, width = depth.shape[:2]
    for top in range((height % size) // 2, height - size + 1, size):
        for left in range((width % size) // 2, width - size + 1, size):
            at = (..., slice(top, top + size), slice(left, left + size), slice(None))
            yield View(
                f"{name}-{top:04}-{left:04}",
                "",
                0,
                *(image[at] for image in (color, albedo, normal)),
                depth[at][..., 0],
                {spec: images[at] for spec, images in made.items()},
                smooth[at],
                reference[at],
            )


def parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("frames", type=Path, metavar="FRAMES", help="as ../shared/frames has them")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DATASET")
    parser.add_argument("--spp", type=int, nargs="*", default=[16, 64, 256])
    parser.add_argument("--denoisers", nargs="*", default=DENOISERS)
    parser.add_argument("--size", type=int, default=128)
    return parser.parse_args(arguments)


if __name__ == "__main__":
    main()
