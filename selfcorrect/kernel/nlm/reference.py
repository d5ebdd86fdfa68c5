"""Non-local means in plain torch, any dtype; the weights are made for some rows at a time."""

from collections.abc import Iterator

import torch
from torch import Tensor

from selfcorrect.image.windows import reflected
from selfcorrect.kernel.nlm.strip import Strip

__all__ = ["non_local_means", "strips", "weights"]

_HELD = 1 << 22  # weights at a time


def weights(
    guide: Tensor, variance: Tensor, *, radius: int, patch_radius: int, k: float, rows: range | None = None
) -> Tensor:
    """Rousselle et al. 2012, Eqs. 3–5: (rows, W, taps) from (H, W, C); see :func:`selfcorrect.kernel.nlm.strips`."""
    height, width, channels = guide.shape
    rows = range(height) if rows is None else rows
    side, patch = 2 * radius + 1, 2 * patch_radius + 1
    planes = reflected(torch.cat([guide, variance], -1).permute(2, 0, 1), radius + patch_radius)
    u, v = planes[:, rows.start : rows.stop + 2 * (radius + patch_radius)].split(channels)
    shape = (len(rows) + 2 * patch_radius, width + 2 * patch_radius)

    def cut(image: Tensor, top: int, left: int) -> Tensor:
        return image[:, top : top + shape[0], left : left + shape[1]]

    u_p, v_p = cut(u, radius, radius), cut(v, radius, radius)
    result = []
    for tap in range(side**2):
        u_q, v_q = (cut(image, tap // side, tap % side) for image in (u, v))
        d = ((u_p - u_q) ** 2 - (v_p + torch.minimum(v_p, v_q))) / (1e-10 + k**2 * (v_p + v_q))
        patches = d.unfold(1, patch, 1).unfold(2, patch, 1).mean((0, -1, -2))
        result.append(torch.exp(-patches.clamp(min=0)))
    return torch.stack(result, -1)


def strips(guide: Tensor, variance: Tensor, *, radius: int, patch_radius: int, k: float) -> Iterator[Strip]:
    """The weights, some rows at a time."""
    height, width, _ = guide.shape
    step = max(1, _HELD // (width * (2 * radius + 1) ** 2))
    for first in range(0, height, step):
        rows = range(first, min(height, first + step))
        w = weights(guide, variance, radius=radius, patch_radius=patch_radius, k=k, rows=rows)
        yield Strip(first, w.permute(2, 0, 1))


def non_local_means(
    values: Tensor, guide: Tensor, variance: Tensor, *, radius: int, patch_radius: int, k: float
) -> Tensor:
    """Means of ``values`` (H, W, C) over each window."""
    side, parts = 2 * radius + 1, []
    padded = reflected(values.permute(2, 0, 1), radius)
    for strip in strips(guide, variance, radius=radius, patch_radius=patch_radius, k=k):
        w, first = strip.weights, strip.first_row
        windows = padded[:, first : first + w.shape[1] + 2 * radius].unfold(1, side, 1).unfold(2, side, 1)
        parts.append(torch.einsum("thw,chwt->hwc", w / w.sum(0), windows.flatten(-2)))
    return torch.cat(parts)
