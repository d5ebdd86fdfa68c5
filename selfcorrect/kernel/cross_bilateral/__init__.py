"""The cross-bilateral kernel: one door, whichever device it runs on.

``reference.py`` is the mathematics, ``cpu.py`` the compiled kernel. A fused kernel for another device gets a file
of its own beside them and a line in :func:`_backend`.
"""

import torch
from torch import Tensor

from selfcorrect.errors import FrameError, SettingsError
from selfcorrect.kernel.cross_bilateral import cpu, reference
from selfcorrect.kernel.guides import Guides

__all__ = ["cross_bilateral", "cross_bilateral_loss", "heads_count"]

LARGEST_WINDOW = 31


def heads_count(guides: Guides, combination: str) -> int:
    """How many raw outputs the kernel takes per pixel: Eq. 10's β, Eq. 11's γ, and τ."""
    return (guides.betas if combination == "eq10" else 0) + guides.gammas + 1


def _backend(planes: Tensor, backend: str | None) -> str:
    if backend is not None:
        return backend
    return "cpu" if planes.device.type == "cpu" and planes.dtype == torch.float32 else "reference"


def _validate(guides: Guides, raw: Tensor, corners: Tensor, window: int, every: int, combination: str) -> None:
    if window % 2 == 0 or not 1 <= window <= LARGEST_WINDOW:
        raise SettingsError(f"expected an odd window from 1 to {LARGEST_WINDOW}, but got {window}")
    if every < 1:
        raise SettingsError(f"expected one tap in 1 or more, but got one in {every}")
    if combination not in ("eq3", "eq10"):
        raise SettingsError(f"expected the combination eq3 or eq10, but got {combination}")
    heads = heads_count(guides, combination)
    if raw.ndim != 4 or raw.shape[1] != heads:
        raise FrameError(f"expected raw heads of shape (N, {heads}, h, w), but got {tuple(raw.shape)}")
    if corners.shape != (raw.shape[0], 2) or corners.dtype != torch.int64:
        raise FrameError(f"expected int64 corners of shape ({raw.shape[0]}, 2), but got {tuple(corners.shape)}")
    if raw.dtype != guides.planes.dtype:
        raise FrameError(f"expected raw heads in {guides.planes.dtype}, but got {raw.dtype}")
    reach = guides.margin - window // 2
    bottom = (guides.stacked - 1) * guides.pitch + guides.height
    last = corners + torch.tensor([raw.shape[2] - bottom, raw.shape[3] - guides.width])
    if corners.numel() and (corners.min() < -reach or last.max() > reach):
        raise FrameError(f"expected patches at most {reach} pixels outside the image (margin {guides.margin})")


def cross_bilateral(
    guides: Guides,
    raw: Tensor,
    corners: Tensor,
    *,
    window: int,
    every: int = 1,
    combination: str = "eq10",
    threads: int = 1,
    backend: str | None = None,
) -> Tensor:
    """Corrected radiance of patches (Back et al. 2022, Eqs. 10 and 11), differentiable in ``raw``.

    Args:
        guides: padded buffers of one half, linear radiance.
        raw: network outputs before tanh and softplus, (N, heads, h, w), any strides.
        corners: image row and column of each patch's first pixel, (N, 2), int64; may lie outside the image.
        window: side of the window, odd, 1 … 31.
        every: 1 takes all taps of the window; n > 1 a lattice of one in n, the centre's weight divided by n.
        combination: "eq10" or "eq3".
        threads: of the compiled kernel.
        backend: "cpu" or "reference"; by default what the device and dtype allow.

    Returns:
        g, (N, 3, h, w), linear radiance.

    Raises:
        FrameError: shapes do not fit, or a patch reaches beyond the margin.
        SettingsError: window or combination out of range.
    """
    _validate(guides, raw, corners, window, every, combination)
    if _backend(guides.planes, backend) == "cpu":
        return cpu.cross_bilateral(
            guides, raw, corners, window=window, every=every, combination=combination, threads=threads
        )
    return reference.cross_bilateral(
        guides, raw, corners, window=window, every=every, combination=combination, taps_per_step=1
    )


def cross_bilateral_loss(
    guides: Guides,
    raw: Tensor,
    corners: Tensor,
    target: Tensor,
    weight: Tensor,
    *,
    window: int,
    every: int = 1,
    combination: str = "eq10",
    threads: int = 1,
    backend: str | None = None,
) -> Tensor:
    """One half of Eq. 8: the mean over pixels and channels of ½ weight (g − target)², a scalar.

    ``target`` (3, …) and ``weight`` (…) are padded like the guides' planes. The gradient at a pixel is known as
    soon as its output is, so that the compiled kernel visits each pixel once.
    """
    _validate(guides, raw, corners, window, every, combination)
    if _backend(guides.planes, backend) == "cpu":
        return cpu.cross_bilateral_loss(
            guides, raw, corners, target, weight, window=window, every=every, combination=combination, threads=threads
        )
    size = (raw.shape[2], raw.shape[3])
    padded = torch.cat([target, weight[None]])
    rows = corners[:, 0, None] + guides.margin + torch.arange(size[0])
    columns = corners[:, 1, None] + guides.margin + torch.arange(size[1])
    cut = padded[:, rows[:, :, None], columns[:, None, :]].transpose(0, 1)
    g = cross_bilateral(guides, raw, corners, window=window, every=every, combination=combination, backend=backend)
    return (0.5 * cut[:, 3:] * (g - cut[:, :3]) ** 2).mean()
