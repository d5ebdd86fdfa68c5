"""Where the surface of a pixel is in another frame.

One convention: an offset is in pixels, x to the right and y downwards, from the pixel in this frame to the place of its
surface in the other one.
"""

import importlib
import importlib.util
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from selfcorrect.errors import MissingPackageError
from selfcorrect.frame import Frame, mean
from selfcorrect.image.bands import bands

__all__ = ["Motion", "available", "between", "fetched", "optical_flow", "picture"]

_TOLERANCE = 1.5  # pixels that the way there and back may miss its start by
_SHARES = (0.4, 0.2, 0.4)  # of albedo, normal and tone-mapped radiance in the picture that flow is found in
_LIGHT = (0.5, 0.3, 0.2)  # a direction: shading by it turns normals into grey


class Motion(NamedTuple):
    """From a frame to another.

    Attributes:
        offset: (H, W, 2), x and y in pixels.
        known: (H, W), whether it is to be believed there.
    """

    offset: Tensor
    known: Tensor


def available() -> bool:
    """Whether optical flow can be computed here."""
    return importlib.util.find_spec("cv2") is not None


def picture(frame: Frame) -> Tensor:
    """What flow is found in: (H, W) in 0 … 1 of albedo, normal and tone-mapped denoised radiance, as far as known.

    Noise would be taken for motion, so the G-buffers are the mean of both halves and the radiance is denoised.
    """
    full = frame.candidates[0].full
    parts = [_SHARES[2] * (full / (1 + full)).mean(-1)]
    used = _SHARES[2]
    if frame.albedo is not None:
        parts.append(_SHARES[0] * mean(frame.albedo).clamp(0, 1).mean(-1))
        used += _SHARES[0]
    if frame.normal is not None:
        light = torch.tensor(_LIGHT, device=full.device)
        parts.append(_SHARES[1] * (mean(frame.normal).clamp(-1, 1) @ light + 1) / 2)
        used += _SHARES[1]
    return (torch.stack(parts).sum(0) / used).clamp(0, 1)


def optical_flow(image: Tensor, other: Tensor) -> Tensor:
    """Offsets (H, W, 2) from one picture (H, W) in 0 … 1 to another: dense inverse search (Kroeger et al. 2016).

    Raises:
        MissingPackageError: OpenCV is not installed.
    """
    try:
        cv2: Any = importlib.import_module("cv2")
    except ImportError as error:
        raise MissingPackageError("optical flow", "flow") from error
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # with several, its sums may depend on their number
    try:
        search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        first, second = ((x * 255).round().cpu().numpy().astype(np.uint8) for x in (image, other))
        flow = torch.from_numpy(search.calc(first, second, None))
    finally:
        cv2.setNumThreads(threads)
    return flow.to(image.device)


def between(image: Tensor, other: Tensor) -> Motion:
    """Motion from one picture (see :func:`picture`) to another by optical flow, believed where the flow back agrees."""
    there, back = optical_flow(image, other), optical_flow(other, image)
    returned, inside = fetched(back, there)
    missed = (there + returned).square().sum(-1)
    return Motion(there, inside & (missed <= _TOLERANCE**2))


def fetched(image: Tensor, offset: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels of another frame's (H, W, C) at the nearest places that offsets lead to, and (H, W) whether inside it.

    The nearest pixel, no interpolation: noise stays noise of single pixels, independent of its neighbours.
    """
    height, width = offset.shape[:2]
    result = image.new_empty(height, width, *image.shape[2:])
    inside = torch.empty(height, width, dtype=torch.bool, device=image.device)
    columns = torch.arange(width, device=image.device)
    for rows in bands(height):
        y = torch.arange(rows.start, rows.stop, device=image.device)[:, None] + offset[rows, :, 1]
        x = columns + offset[rows, :, 0]
        y, x = y.round().long(), x.round().long()
        inside[rows] = (y >= 0) & (y < height) & (x >= 0) & (x < width)
        result[rows] = image[y.clamp(0, height - 1), x.clamp(0, width - 1)]
    return result, inside
