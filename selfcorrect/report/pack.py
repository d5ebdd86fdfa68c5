"""Linear images as text for the page: half floats, predicted from their neighbours, deflated, in base64.

The integers behind non-negative half floats are ordered like the numbers. Each is predicted by the median of its left
and upper neighbours and of the plane through them (Weinberger et al. 2000, "LOCO-I", Eq. 1), and green from the rest:
what is left over is small and deflates well. pixels.js undoes it, bit by bit.
"""

import base64
import zlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["LARGEST_PAGE", "Packed", "fitted", "pack", "reduced", "shrunk"]

LARGEST_PAGE = 8_000_000
"""Bytes of a page."""

_KEPT_PIXELS = 1 << 21  # of an image that waits for its page: no page could hold more
_BAND = 256  # rows that are worked on at once
_LARGEST, _LARGEST_HALF = 65504.0, 0x7BFF
_MANTISSA = 10  # bits
_ROUNDED = 7  # bits of mantissa where they must do: steps of 0.8 %, what 8 bits of sRGB show at white
_LEAST = 0.4  # bytes that a number takes at best, to spare trials that cannot fit

Array = NDArray[Any]


class Packed(NamedTuple):
    """An image as the page holds it.

    Attributes:
        width: in pixels.
        height: in pixels.
        channels: 3, or 1 for a map.
        bits: of each half float's mantissa that were kept.
        data: base64.
    """

    width: int
    height: int
    channels: int
    bits: int
    data: str


def pack(image: Any, bits: int = _MANTISSA) -> Packed:
    """Pack an image of shape (H, W, 3), or a map of shape (H, W), of values ≥ 0.

    Negative values and NaN become 0, infinity 65504. With less than 10 bits of mantissa values are rounded to those.
    """
    values = np.asarray(image)
    planes = values[None] if values.ndim == 2 else np.moveaxis(values, -1, 0)
    numbers = _integers(planes, bits)
    if len(numbers) == 3:
        red, green, blue = numbers
        numbers = np.stack([green, red - green, blue - green])
    left_over = (numbers - _predicted(numbers)).astype(np.int16).astype(np.int32)
    folded = ((left_over << 1) ^ (left_over >> 15)).astype(np.uint16)
    data = (folded & 255).astype(np.uint8).tobytes() + (folded >> 8).astype(np.uint8).tobytes()
    height, width = values.shape[:2]
    return Packed(width, height, len(planes), bits, base64.b64encode(zlib.compress(data, 7)).decode())


def _integers(planes: Array, bits: int) -> NDArray[np.int32]:
    # a page is looked at: what is no number is black there, and the run that wrote the file has counted it
    finite = np.nan_to_num(planes.astype(np.float32), nan=0.0, posinf=_LARGEST, neginf=0.0)
    half = np.clip(finite, 0, _LARGEST).astype(np.float16).view(np.uint16).astype(np.int32)
    dropped = _MANTISSA - bits
    rounded: NDArray[np.int32] = np.minimum((half + (1 << dropped >> 1)) >> dropped, _LARGEST_HALF >> dropped)
    return rounded


def _predicted(numbers: NDArray[np.int32]) -> NDArray[np.int32]:
    """Of (C, H, W); above the image there is 0, left of it what is above."""
    above = np.zeros_like(numbers)
    above[:, 1:] = numbers[:, :-1]
    left, corner = above.copy(), above.copy()
    left[:, :, 1:] = numbers[:, :, :-1]
    corner[:, :, 1:] = above[:, :, :-1]
    lowest, highest = np.minimum(left, above), np.maximum(left, above)
    clipped: NDArray[np.int32] = np.clip(left + above - corner, lowest, highest)
    return clipped


def reduced(image: Any, factor: int) -> Array:
    """Means over blocks of ``factor`` × ``factor`` pixels, smaller ones at the right and lower border; float32."""
    values: Array = np.asarray(image, dtype=np.float32)
    for axis in (0, 1):
        starts = np.arange(0, values.shape[axis], factor)
        counts = np.diff(np.append(starts, values.shape[axis]))
        shape = [-1 if i == axis else 1 for i in range(values.ndim)]
        values = np.add.reduceat(values, starts, axis=axis) / counts.astype(np.float32).reshape(shape)
    return values


def shrunk(*images: Any, pixels: int = _KEPT_PIXELS) -> Array:
    """A copy for a page: float16, of so many pixels at most; (H, W, 3) or (H, W), of arrays or tensors on any device.

    Of several images it is the mean. What has one size comes out in one size. No second copy in full is made.
    """
    height, width = images[0].shape[:2]
    factor = 1
    while -(-height // factor) * -(-width // factor) > pixels:
        factor += 1
    rows = factor * max(1, _BAND // factor)
    bands = [_band([image[top : top + rows] for image in images], factor) for top in range(0, height, rows)]
    return np.concatenate(bands)


def _band(images: Sequence[Any], factor: int) -> Array:
    plain = [np.asarray(image.detach().cpu() if hasattr(image, "detach") else image) for image in images]
    # as in _integers(), before NaN can spread to the pixels that are averaged with it
    finite = [np.nan_to_num(np.clip(one.astype(np.float32), 0, _LARGEST)) for one in plain]
    kept: Array = np.clip(reduced(sum(finite) / len(finite), factor), 0, _LARGEST).astype(np.float16)
    return kept


def fitted(images: Mapping[str, Any], budget: int) -> dict[str, Packed]:
    """Images and maps of one size, packed into so many bytes together: rounded, then reduced, until they fit.

    Whole pixels are worth more than the last bits of a number: those go first.
    """
    numbers = sum(int(np.asarray(image).size) for image in images.values())
    for factor, bits in _trials():
        if numbers / factor**2 * _LEAST > budget and min(_size(images)) > factor:
            continue
        small = images if factor == 1 else {name: reduced(image, factor) for name, image in images.items()}
        packed = {name: pack(image, bits) for name, image in small.items()}
        if sum(len(one.data) for one in packed.values()) <= budget or max(_size(small)) == 1:
            return packed
    raise AssertionError("unreachable: an image of one pixel fits")


def _trials() -> Iterator[tuple[int, int]]:
    factor = 1
    while True:
        yield factor, _MANTISSA
        yield factor, _ROUNDED
        factor += 1


def _size(images: Mapping[str, Any]) -> tuple[int, int]:
    height, width = np.asarray(next(iter(images.values()))).shape[:2]
    return height, width
