"""The textures of the packaged frame's scene: (rows, columns[, 3]) arrays, linear, 0…1, from a generator passed in."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Rng = np.random.Generator


def cloud(shape: tuple[int, int], stretch: float, falloff: float, rng: Rng) -> Array:
    """Periodic random field of mean 0 and deviation 1: a power spectrum of slope `falloff`, `stretch`ed along x."""
    frequency = np.hypot(np.fft.fftfreq(shape[0])[:, None], stretch * np.fft.fftfreq(shape[1])[None])
    frequency[0, 0] = np.inf
    field = np.fft.ifft2(np.fft.fft2(rng.standard_normal(shape)) * frequency**-falloff).real
    return np.asarray((field - field.mean()) / field.std())


def blend(mask: Array, low: tuple[float, ...], high: tuple[float, ...]) -> Array:
    """Colours from `low` to `high`, (rows, columns, 3), as `mask` goes from 0 to 1."""
    return np.asarray(low) + np.clip(mask, 0.0, 1.0)[..., None] * np.subtract(high, low)


def planks(rng: Rng, count: int = 9, size: int = 1024) -> tuple[Array, Array]:
    """Wooden boards along x: colour (size, size, 3) and height (size, size), with dark joints and fine pores."""
    rows = size // count
    colour, height = np.zeros((size, size, 3)), np.zeros((size, size))
    for board in range(count):
        lines = slice(board * rows, size if board == count - 1 else (board + 1) * rows)
        shape = (lines.stop - lines.start, size)
        rings = 0.5 + 0.5 * np.sin(5 * cloud(shape, 14, 1.4, rng) + 0.4 * np.arange(shape[0])[:, None])
        pores = cloud(shape, 30, 0.35, rng) > 1.3
        tone = rng.uniform(0.75, 1.15)
        colour[lines] = tone * blend(0.75 * rings - 0.5 * pores + 0.2, (0.13, 0.055, 0.022), (0.42, 0.22, 0.10))
        height[lines] = 0.6 * rings - 0.8 * pores
        joint = slice(lines.start, lines.start + 5)
        colour[joint] *= 0.15
        height[joint] = -4
    return np.clip(colour, 0, 1), height


def wallpaper(rng: Rng, size: int = 512) -> tuple[Array, Array]:
    """Ogee lattice with a flower in each cell over pinstripes, printed and slightly embossed; periodic."""
    v, u = np.meshgrid(*2 * [np.arange(size) / size * 2 * np.pi], indexing="ij")
    ogee = np.abs(np.sin(2 * u + 0.9 * np.sin(2 * v)) * np.sin(2 * u - 0.9 * np.sin(2 * v))) < 0.035
    x, y = np.sin(2 * u), np.sin(2 * v)
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    flower = (np.cos(2 * u) * np.cos(2 * v) > 0.1) & (np.cos(8 * angle) > radius / 0.45 - 0.9)
    stripes = np.sin(48 * u) > 0.2
    ink = np.maximum.reduce([ogee * 1.0, flower * 0.9, stripes * 0.22]) + 0.05 * cloud((size, size), 1, 0.3, rng)
    return blend(ink, (0.06, 0.19, 0.20), (0.75, 0.62, 0.33)), ink + 0.15 * cloud((size, size), 1, 0.2, rng)


def books(rng: Rng, rows: int = 5, size: int = 1024) -> Array:
    """A wall of book spines, (size, size, 3): shelves of random widths, heights, colours and gilded bands."""
    image = np.full((size, size, 3), 0.012)
    shelf = size // rows
    inks = np.array([[0.5, 0.05, 0.04], [0.04, 0.12, 0.32], [0.05, 0.25, 0.1], [0.7, 0.6, 0.42], [0.4, 0.2, 0.05],
                     [0.75, 0.42, 0.05], [0.1, 0.1, 0.12], [0.6, 0.62, 0.6]])  # fmt: skip
    for row in range(rows):
        bottom, left = row * shelf, 0
        while left < size:
            width, tall = int(rng.integers(9, 30)), int(shelf * rng.uniform(0.62, 0.88))
            spine = image[bottom : bottom + tall, left + 1 : left + width]
            spine[:] = inks[rng.integers(len(inks))] * rng.uniform(0.7, 1.2)
            for band in rng.integers(4, tall - 8, size=3):
                spine[band : band + int(rng.integers(2, 7))] = (0.8, 0.62, 0.25)
            left += width
        image[bottom + int(0.93 * shelf) : bottom + shelf] = (0.22, 0.11, 0.05)
    return np.asarray(image.clip(0, 1))


def print_page(rng: Rng, rows: int = 512, columns: int = 384) -> Array:
    """A page of made-up words, (rows, columns, 3), in justified lines of a serif-like texture."""
    ink = np.zeros((rows, columns))
    for line in range(40, rows - 40, 16):
        left, last = 36, columns - 36 - int(rng.integers(0, 150)) * (rng.random() < 0.2)
        while left < last - 12:
            word = min(int(rng.integers(12, 60)), last - left)
            strokes = np.repeat(rng.random((4, word // 3 + 1)) > 0.3, 2, axis=0)
            ink[line : line + 8, left : left + word] = np.repeat(strokes, 3, axis=1)[:, :word]
            left += word + 8
    return blend(ink, (0.66, 0.61, 0.51), (0.03, 0.03, 0.04))


def weave(rng: Rng, threads: int = 96, size: int = 768) -> tuple[Array, Array]:
    """Plain-woven cloth with a striped border: colour (size, size, 3) and height (size, size)."""
    y, x = np.meshgrid(*2 * [(np.arange(size) + 0.5) / size * threads], indexing="ij")
    over = (x.astype(int) + y.astype(int)) % 2 == 0
    across, along = np.where(over, x % 1, y % 1), np.where(over, y % 1, x % 1)
    height = np.sin(np.pi * across) * (0.4 + 0.6 * np.sin(np.pi * along))
    edge = np.minimum(np.minimum(x, threads - x), np.minimum(y, threads - y)).astype(int)
    checks = (x.astype(int) // 2 % 9 == 0) ^ (y.astype(int) // 2 % 9 == 0)
    dyed = np.isin(edge, (5, 6, 7, 9, 12, 13, 14)) | checks
    colour = np.where(dyed[..., None], (0.45, 0.06, 0.05), (0.62, 0.56, 0.44))
    return colour * (0.45 + 0.55 * height + 0.04 * cloud((size, size), 1, 0, rng))[..., None].clip(0, 1), height


def majolica(rows: int = 256, columns: int = 1024) -> Array:
    """Blue brushwork on white glaze, (rows, columns, 3): bands, scrolls and dots around a bowl."""
    v, u = np.meshgrid(np.arange(rows) / rows, np.arange(columns) / columns * 2 * np.pi, indexing="ij")
    bands = np.isin((v * 40).astype(int), (3, 5, 17, 20, 36))
    scroll = np.abs(np.sin(14 * u) * 0.05 + 0.285 - v) < 0.012
    petals = np.cos(14 * u) * np.cos(np.pi * (v - 0.285) / 0.11) > 0.55
    dots = np.cos(40 * u) * np.cos(60 * np.pi * (v - 0.1)) > 0.5
    petals &= abs(v - 0.285) < 0.11
    dots &= (abs(v - 0.11) < 0.012) | (v > 0.55)
    ink = bands | scroll | petals | dots
    return blend(ink.astype(float), (0.80, 0.79, 0.74), (0.02, 0.06, 0.33))
