"""Draw one row of pixels over time, of each kind of image that ``scripts/bench/shot.py --save`` has kept.

Needs Pillow beside selfcorrect (pip install pillow).

    python scripts/bench/shot.py SHOT --variants history --save shot.npz
    python scripts/bench/slice.py shot.npz --row 90 --columns 40 200 -o slice.png

x goes to the right, and each frame is a stripe below the one before. What moves is slanted; what flickers is striped.
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

CAPTION = 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("images", type=Path, metavar="NPZ")
    parser.add_argument("--row", type=int, required=True)
    parser.add_argument("--columns", type=int, nargs=2, metavar=("FIRST", "END"), help="by default all")
    parser.add_argument("--enlarge", type=int, nargs=2, default=(4, 12), metavar=("X", "T"))
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="PNG")
    options = parser.parse_args()
    columns = slice(*(options.columns or (None, None)))
    with np.load(options.images) as kept:
        rows = {name: kept[name][:, options.row, columns].astype(np.float32) for name in kept.files}
    draw(rows, tuple(options.enlarge)).save(options.output, optimize=True)


def draw(rows: dict[str, np.ndarray], enlarge: tuple[int, int]) -> Image.Image:
    """Stripes of each kind below another: (frames, W, 3) linear radiance, exposed alike, by the last one's mean."""
    exposure = 0.5 / float(list(rows.values())[-1].mean())
    blocks = []
    for radiance in rows.values():
        display = np.clip(exposure * radiance, 0, 1) ** (1 / 2.2)
        blocks.append((255 * display).round().astype(np.uint8).repeat(enlarge[1], 0).repeat(enlarge[0], 1))
    height, width = blocks[0].shape[:2]
    picture = Image.new("RGB", (width, (height + CAPTION) * len(blocks)), "white")
    font = ImageFont.load_default(CAPTION - 6)
    for number, (name, block) in enumerate(zip(rows, blocks, strict=True)):
        top = number * (height + CAPTION)
        ImageDraw.Draw(picture).text((2, top + 1), name, fill="black", font=font)
        picture.paste(Image.fromarray(block), (0, top + CAPTION))
    return picture


if __name__ == "__main__":
    main()
