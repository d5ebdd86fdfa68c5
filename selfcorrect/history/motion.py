"""Where the surface of a pixel is in another frame.

One convention: an offset is in pixels, x to the right and y downwards, from the pixel in this frame to the place of its
surface in the other one.

The renderer's own motion, where the files hold it, is exact on surfaces, and wrong where it was not set up as it was
taken for, and in mirrors and glass, whose pictures move otherwise. Optical flow is about right in most places. So each
is judged by what it brings, the other frame's albedo, normal and radiance: pixel by pixel the renderer's is taken
unless flow fits clearly better around, and over the frame it is not used at all where it mostly does not fit.
"""

import importlib
import importlib.util
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from selfcorrect.errors import MissingPackageError
from selfcorrect.frame import Frame, mean
from selfcorrect.image.bands import bands

__all__ = ["Motion", "available", "between", "chained", "features", "fetched", "optical_flow", "picture", "warped"]

_TOLERANCE = 1.5  # pixels that the flow forward and back may miss its start by
_SHARES = (0.4, 0.2, 0.4)  # of albedo, normal and tone-mapped radiance in the picture that flow is found in
_LIGHT = (0.5, 0.3, 0.2)  # a direction: shading by it turns normals into grey
_LEAST_SIDE = 16  # pixels: OpenCV's search fails below
_AROUND = 5  # side of the window whose mean squared difference is compared
_BETTER = 2.0  # times smaller than that of the files' motion flow's must be, to be taken: of noise it is somewhat
_UNFIT = 1.5  # times flow's median, above which the files' motion is no motion of this frame. In the ghost shot it is
# 0.6 … 1.0, and 1.7 … 7 if zero, 3 … 54 if negated, 1.3 … 2 if halved
_ROUNDING = 1e-6  # squared: below a quarter of the 8 bits that flow sees, all fits


class Motion(NamedTuple):
    """From a frame to another.

    Attributes:
        offset: (H, W, 2), x and y in pixels.
        known: (H, W), whether it is to be believed there, and leads to a pixel of the other.
        told: share of the pixels whose offset the files told, 0 … 1.
    """

    offset: Tensor
    known: Tensor
    told: float = 0.0


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


def chained(frames: Sequence[Frame], side: int) -> Tensor | None:
    """Offsets (H, W, 2) from the first of neighbouring frames to the last, by what the files of all but that tell.

    Args:
        frames: two or more of one size.
        side: −1 where each is the one before the other, else 1.

    Returns:
        NaN where it is unknown; None where a frame tells nothing.
    """
    offset = None
    for frame in frames[:-1]:
        if frame.motion is None:
            return None
        told = mean(frame.motion)[..., :2] if side < 0 else mean(frame.motion)[..., 2:]
        # what is unknown is fetched from anywhere: the sum stays NaN there
        offset = told if offset is None else offset + fetched(told, offset.nan_to_num())
    return offset


def between(
    image: Tensor, other: Tensor, told: tuple[Tensor | None, Tensor | None] = (None, None)
) -> tuple[Motion, Motion]:
    """Motion from one picture (see :func:`picture`) to another and back.

    Each is believed where the other leads back to where it began.

    Args:
        image: (H, W) in 0 … 1.
        other: the same size.
        told: offsets there and back that the files tell (:func:`chained`), taken where they fit; else it is optical
            flow.
    """
    forward, share_forward = _fitting(image, other, optical_flow(image, other), told[0])
    backward, share_backward = _fitting(other, image, optical_flow(other, image), told[1])

    def believed(there: Tensor, back: Tensor, share: float) -> Motion:
        missed = (there + fetched(back, there)).square().sum(-1)
        return Motion(there, _inside(there) & (missed <= _TOLERANCE**2), share)

    return believed(forward, backward, share_forward), believed(backward, forward, share_backward)


def _fitting(image: Tensor, other: Tensor, flow: Tensor, told: Tensor | None) -> tuple[Tensor, float]:
    """Of flow and of what the files tell, what fits; and the share of the latter."""
    if told is None:
        return flow, 0.0
    known = told.isfinite().all(-1)
    told = told.nan_to_num()  # taken only where known
    by_files, by_flow = (_difference(image, other, offset) for offset in (told, flow))
    if not bool(known.any()) or by_files[known].median() > _UNFIT * by_flow[known].median() + _ROUNDING:
        return flow, 0.0
    taken = known & (by_files <= _BETTER * by_flow + _ROUNDING)
    return torch.where(taken[..., None], told, flow), float(taken.float().mean())


def _difference(image: Tensor, other: Tensor, offset: Tensor) -> Tensor:
    """Of a picture (H, W) and of another that offsets bring here, squared, the mean around each pixel."""
    squared = (warped(other[..., None], offset)[..., 0] - image).square()
    return F.avg_pool2d(squared[None], _AROUND, 1, _AROUND // 2, count_include_pad=False)[0]


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
