"""Non-local means in plain torch, any dtype, for images small enough to hold every patch of every window at once."""

import torch
from torch import Tensor

from selfcorrect.image.windows import reflected

__all__ = ["non_local_means", "weights"]


def weights(guide: Tensor, variance: Tensor, *, radius: int, patch_radius: int, k: float) -> Tensor:
    """Rousselle et al. 2012, Eqs. 3–5: (H, W, taps) from (H, W, C); see :func:`selfcorrect.kernel.nlm.strips`."""
    height, width, channels = guide.shape
    side, patch = 2 * radius + 1, 2 * patch_radius + 1
    planes = torch.cat([guide, variance], -1).permute(2, 0, 1)
    u, v = reflected(planes, radius + patch_radius).split(channels)
    shape = (height + 2 * patch_radius, width + 2 * patch_radius)

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


def non_local_means(
    values: Tensor, guide: Tensor, variance: Tensor, *, radius: int, patch_radius: int, k: float
) -> Tensor:
    """Means of ``values`` (H, W, C) over each window."""
    w = weights(guide, variance, radius=radius, patch_radius=patch_radius, k=k)
    side = 2 * radius + 1
    windows = reflected(values.permute(2, 0, 1), radius).unfold(1, side, 1).unfold(2, side, 1)
    return torch.einsum("hwt,chwt->hwc", w / w.sum(-1, keepdim=True), windows.flatten(-2))
