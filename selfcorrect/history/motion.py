"""Where the surface of a pixel is in another frame.

One convention: an offset is in pixels, x to the right and y downwards, from the pixel in this frame to the place of its
surface in the other one.
"""

import importlib
import importlib.util
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from selfcorrect.errors import MissingPackageError
from selfcorrect.frame import Frame, mean
from selfcorrect.image.bands import bands

__all__ = ["Motion", "available", "between", "features", "fetched", "optical_flow", "picture", "warped"]

_TOLERANCE = 1.5  # pixels that the flow forward and back may miss its start by
_SHARES = (0.4, 0.2, 0.4)  # of albedo, normal and tone-mapped radiance in the picture that flow is found in
_LIGHT = (0.5, 0.3, 0.2)  # a direction: shading by it turns normals into grey
_LEAST_SIDE = 16  # pixels: OpenCV's search fails below


class Motion(NamedTuple):
    """From a frame to another.

    Attributes:
        offset: (H, W, 2), x and y in pixels.
        known: (H, W), whether it is to be believed there, and leads to a pixel of the other.
    """

    offset: Tensor
    known: Tensor


def available() -> bool:
    """Whether optical flow can be computed here."""
    return importlib.util.find_spec("cv2") is not None


def features(frame: Frame) -> dict[str, Tensor]:
    """Albedo and normal of both halves together, as far as there are, prefiltered where the frame knows them so."""
    if frame.aids is not None:
        known = {name: frame.aids[0].get(name) for name in ("albedo", "normal")}
        return {name: image.float() for name, image in known.items() if image is not None}
    pairs = {name: getattr(frame, name) for name in ("albedo", "normal")}
    return {name: mean(pair) for name, pair in pairs.items() if pair is not None}


def picture(frame: Frame) -> Tensor:
    """What flow is found in: (H, W) in 0 … 1 of albedo, normal and tone-mapped denoised radiance, as far as known.

    Noise would be taken for motion, so the G-buffers are of both halves and the radiance is denoised.
    """
    full, known = frame.candidates[0].full, features(frame)
    parts = [_SHARES[2] * (full / (1 + full)).mean(-1)]
    used = _SHARES[2]
    if "albedo" in known:
        parts.append(_SHARES[0] * known["albedo"].clamp(0, 1).mean(-1))
        used += _SHARES[0]
    if "normal" in known:
        light = torch.tensor(_LIGHT, device=full.device)
        parts.append(_SHARES[1] * (known["normal"].clamp(-1, 1) @ light + 1) / 2)
        used += _SHARES[1]
    return (torch.stack(parts).sum(0) / used).clamp(0, 1)


def optical_flow(image: Tensor, other: Tensor) -> Tensor:
    """Offsets (H, W, 2) from one picture (H, W) in 0 … 1 to another: dense inverse search (Kroeger et al. 2016).

    A picture that the search finds too small for its patches has not moved.

    Raises:
        MissingPackageError: OpenCV is not installed.
    """
    try:
        cv2: Any = importlib.import_module("cv2")
    except ImportError as error:
        raise MissingPackageError("optical flow", "flow") from error
    if min(image.shape) < _LEAST_SIDE:
        return torch.zeros(*image.shape, 2, device=image.device)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # with several, its sums may depend on their number
    try:
        search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        first, second = ((x * 255).round().cpu().numpy().astype(np.uint8) for x in (image, other))
        flow = torch.from_numpy(search.calc(first, second, None))
    finally:
        cv2.setNumThreads(threads)
    return flow.to(image.device)


def between(image: Tensor, other: Tensor) -> tuple[Motion, Motion]:
    """Motion from one picture (see :func:`picture`) to another and back, by optical flow.

    Each is believed where the other leads back to where it began.
    """
    forward, backward = optical_flow(image, other), optical_flow(other, image)

    def believed(there: Tensor, back: Tensor) -> Motion:
        missed = (there + fetched(back, there)).square().sum(-1)
        return Motion(there, _inside(there) & (missed <= _TOLERANCE**2))

    return believed(forward, backward), believed(backward, forward)


def fetched(image: Tensor, offset: Tensor) -> Tensor:
    """Pixels of another frame's (H, W, C) at the nearest places that offsets lead to; beyond its border, the border's.

    The nearest pixel, no interpolation: noise stays noise of single pixels, independent of its neighbours.
    """
    height, width = offset.shape[:2]
    result = torch.empty_like(image)
    for rows in bands(height):
        x, y = _places(offset, rows).round().long().unbind(-1)
        result[rows] = image[y.clamp(0, height - 1), x.clamp(0, width - 1)]
    return result


def _inside(offset: Tensor) -> Tensor:
    """Whether offsets lead to a pixel of the other frame, (H, W)."""
    x, y = _places(offset, slice(0, offset.shape[0])).round().unbind(-1)
    return (y >= 0) & (y < offset.shape[0]) & (x >= 0) & (x < offset.shape[1])


def _places(offset: Tensor, rows: slice) -> Tensor:
    """Where rows of a frame lie in the other one, (rows, W, 2), x and y in pixels."""
    y = torch.arange(rows.start, rows.stop, device=offset.device)
    x = torch.arange(offset.shape[1], device=offset.device)
    return torch.stack(torch.meshgrid(y, x, indexing="ij")[::-1], -1) + offset[rows]


def warped(image: Tensor, offset: Tensor) -> Tensor:
    """A denoised image of another frame, (H, W, C), between its pixels where offsets lead to, by cubic interpolation.

    Its sharpness matters here, not its independence: the nearest pixel would shake edges by half a pixel.
    """
    height, width = offset.shape[:2]
    size = torch.tensor([width, height], device=image.device)
    result = torch.empty_like(image)
    source = image.permute(2, 0, 1)[None]
    for rows in bands(height):
        grid = (2 * _places(offset, rows) + 1) / size - 1
        result[rows] = F.grid_sample(source, grid[None], "bicubic", "border", align_corners=False)[0].permute(1, 2, 0)
    return result
