"""Draw the before/after picture of the README: one crop noisy, denoised, corrected and of the reference.

Needs Pillow beside selfcorrect (pip install pillow). Files are EXR with the channels R, G and B; where an
option takes several files, they are averaged, as the two halves of a noisy frame are. relMSE is that of the
whole frame.

    python scripts/bench/picture.py --noisy A.exr B.exr --denoised D.exr --corrected C.exr \
        --reference REF_A.exr REF_B.exr --weight SMOOTH.exr --crop 120 40 64 64 -o picture.png
"""

import argparse
import os
from pathlib import Path

import numpy as np
import OpenEXR
from PIL import Image, ImageDraw, ImageFont

from selfcorrect import metrics
from selfcorrect.errors import ChannelError, FileError, FrameError, SelfcorrectError

GAP = 8
TEXT = 16
Crop = tuple[int, int, int, int]


def main() -> None:
    """Read the frames, measure them, draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name in ("noisy", "denoised", "corrected", "reference"):
        parser.add_argument(f"--{name}", type=Path, nargs="+", required=True, metavar="EXR")
    parser.add_argument("--weight", type=Path, metavar="EXR", help="smooth reference, for relMSE's weight")
    parser.add_argument("--crop", type=int, nargs=4, required=True, metavar=("X", "Y", "WIDTH", "HEIGHT"))
    parser.add_argument("--scale", type=int, default=3, help="enlargement of the crops (default 3)")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="PNG")
    args = parser.parse_args()
    try:
        references = [read(path) for path in args.reference]
        if len(references) > 2:
            raise FrameError(f"expected one or two --reference files, but got {len(references)}")
        reference, reference_b = references[0], references[1] if len(references) == 2 else None
        weight = read(args.weight) if args.weight else None
        images = {name: mean(getattr(args, name)) for name in ("noisy", "denoised", "corrected")}
        labels = {
            name: f"relMSE {metrics.relmse(image, reference, reference_b, weight):.4f}"
            for name, image in images.items()
        }
        images["reference"], labels["reference"] = np.mean(references, axis=0), ""
        picture = draw(images, labels, check_crop(args.crop, images["corrected"], args.scale), args.scale)
        write(picture, args.output)
    except SelfcorrectError as error:
        parser.error(str(error))


def read(path: Path) -> np.ndarray:
    """Read R, G and B of an EXR file as (H, W, 3) float32."""
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = file.channels()
            planes = [channels[name].pixels.astype(np.float32) for name in "RGB"]
    except KeyError as error:
        raise ChannelError(f"{path}: expected channels R, G and B, but got {', '.join(channels)}") from error
    except (OSError, RuntimeError) as error:
        raise FileError(f"{path}: expected a readable EXR file, but got: {error}") from error
    return np.stack(planes, axis=2)


def mean(paths: list[Path]) -> np.ndarray:
    """Average several files of one size."""
    images = [read(path) for path in paths]
    for path, image in zip(paths, images, strict=True):
        if image.shape != images[0].shape:
            raise FrameError(f"{path}: expected the size of {paths[0]}, but got another")
    return sum(images[1:], start=images[0]) / len(images)


def check_crop(crop: list[int], image: np.ndarray, scale: int) -> Crop:
    """Return the crop as (left, top, right, bottom), inside the image."""
    x, y, width, height = crop
    rows, columns = image.shape[:2]
    if min(x, y) < 0 or min(width, height, scale) < 1 or x + width > columns or y + height > rows:
        raise FrameError(f"expected --crop within {columns}×{rows} and --scale ≥ 1, but got {crop}, {scale}")
    return x, y, x + width, y + height


def draw(images: dict[str, np.ndarray], labels: dict[str, str], crop: Crop, scale: int) -> Image.Image:
    """Put the whole corrected frame at the left, as high as the crops, and the crops beside it."""
    width, height = scale * (crop[2] - crop[0]), scale * (crop[3] - crop[1])
    shown = {name: encode(image) for name, image in images.items()}
    frame = shown["corrected"].copy()
    shrink = height / frame.height
    box = [round(edge * shrink) for edge in crop]
    frame = frame.resize((round(frame.width * shrink), height), Image.Resampling.LANCZOS)
    ImageDraw.Draw(frame).rectangle(box, outline="white", width=2)

    size = (frame.width + len(shown) * (GAP + width), height + 3 * TEXT)
    picture = Image.new("RGB", size, "white")
    pen, font = ImageDraw.Draw(picture), ImageFont.load_default(TEXT - 2)
    picture.paste(frame, (0, 0))
    for column, (name, image) in enumerate(shown.items()):
        left = frame.width + GAP + column * (GAP + width)
        picture.paste(image.crop(crop).resize((width, height), Image.Resampling.NEAREST), (left, 0))
        pen.text((left, height + 4), f"{name}\n{labels[name]}", fill="black", font=font)
    return picture


def encode(image: np.ndarray) -> Image.Image:
    """Tone-map to 8 bits."""
    return Image.fromarray((metrics.tone_map(image).numpy() * 255).round().astype(np.uint8))


def write(picture: Image.Image, path: Path) -> None:
    """Write under a temporary name, then rename: a failure leaves an older picture as it was."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        picture.save(temporary, format="PNG", optimize=True)
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise FileError(f"{path}: cannot be written: {error.strerror}") from error


if __name__ == "__main__":
    main()
