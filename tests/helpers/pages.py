"""Pages of the report: what they show, and what they hold."""

import base64
import json
import re
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

SIZE = (12, 16)
ESTIMATE = {
    "noisy": 0.4,
    "denoised": 0.04,
    "corrected": 0.0276,
    "change": -0.31,
    "standard_error": 0.02,
    "improved": True,
}
FACTS: dict[str, Any] = {
    "title": "out.exr",
    "estimate": ESTIMATE,
    "preset": "fast",
    "denoiser": "oidn",
    "channels": {"color": ["R", "G", "B"]},
    "repairs": {"color": {"non_finite": 3, "negative": 1}},
    "seconds": {"train": 1.5, "total": 2.25},
}


def images(size: tuple[int, int] = SIZE) -> dict[str, NDArray[np.float16]]:
    """Radiance that is another one in every image, pixel and channel."""
    generator = np.random.default_rng(7)
    names = ("noisy", "denoised", "corrected", "reference")
    return {name: generator.gamma(2.0, 0.2, (*size, 3)).astype(np.float16) for name in names}


def maps(size: tuple[int, int] = SIZE) -> dict[str, NDArray[np.float16]]:
    generator = np.random.default_rng(8)
    before = generator.random(size).astype(np.float16)
    return {"error.before": before, "error.after": before / 2, "blend": generator.random(size).astype(np.float16)}


def data_of(page: str) -> Any:
    """What a page hands to its scripts."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    return json.loads(found[1])


def unpacked(layer: Any) -> NDArray[np.float16]:
    """An image of a page, number by number as the page's script does it; (C, H, W)."""
    width, height, channels = layer["width"], layer["height"], layer["channels"]
    data = zlib.decompress(base64.b64decode(layer["data"]))
    size = channels * width * height
    planes = np.zeros((channels, height, width), np.int64)
    for at in range(size):
        c, y, x = at // (width * height), at // width % height, at % width
        above = planes[c, y - 1, x] if y else 0
        left = planes[c, y, x - 1] if x else above
        corner = (planes[c, y - 1, x - 1] if y else 0) if x else above
        guess = sorted((left, above, left + above - corner))[1]
        folded = data[at] | data[size + at] << 8
        planes[c, y, x] = _wrapped(guess, folded)
    if channels == 3:
        green, red, blue = planes
        planes = np.stack([red + green, green, blue + green])
    return (planes << (10 - layer["bits"])).astype(np.uint16).view(np.float16)


def _wrapped(guess: int, folded: int) -> int:
    """The guess and what is left over, in 16 bits with a sign."""
    return (int(guess) + (folded >> 1 ^ -(folded & 1)) + 0x8000) % 0x10000 - 0x8000


def shown(radiance: Any, stops: float = 0.0) -> NDArray[np.int64]:
    """The bytes that a display of sRGB gets."""
    v = np.clip(np.asarray(radiance, np.float64) * 2.0**stops, 0, None)
    encoded = np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1 / 2.4) - 0.055)
    return np.round(255 * np.clip(encoded, 0, 1)).astype(np.int64)
