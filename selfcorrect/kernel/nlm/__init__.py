"""Non-local means with variance cancellation (Rousselle et al. 2012): validated here, computed by one form beside.

There is no form for another device: what lies there comes to the CPU, and the means go back.
"""

from collections.abc import Iterator

import torch
from torch import Tensor

from selfcorrect.errors import FrameError, SettingsError
from selfcorrect.kernel.backend import choose
from selfcorrect.kernel.nlm import cpu, reference
from selfcorrect.kernel.nlm.strip import Strip

__all__ = ["Strip", "non_local_means", "strips"]

_DTYPES = (torch.float16, torch.float32, torch.float64)


def non_local_means(
    values: Tensor,
    guide: Tensor,
    variance: Tensor,
    *,
    radius: int,
    patch_radius: int,
    k: float,
    threads: int = 1,
    backend: str | None = None,
) -> Tensor:
    """Means of ``values`` (H, W, C ≤ 4) with the weights of :func:`strips`; arguments and errors are the same.

    Args:
        values: what is averaged.
        guide, variance, radius, patch_radius, k, threads: see :func:`strips`.
        backend: as for :func:`selfcorrect.kernel.backend.choose`; the reference holds the windows of some rows.
    """
    _validate(guide, variance, radius, patch_radius, k)
    if values.shape[:2] != guide.shape[:2] or not 1 <= values.shape[2] <= 4:
        raise FrameError(f"expected values of shape {tuple(guide.shape[:2])} + (1 … 4,), but got {tuple(values.shape)}")
    there = values.device
    if backend is None:
        values, guide, variance = values.cpu(), guide.cpu(), variance.cpu()
    if choose(backend, [values, guide, variance], dtypes=_DTYPES) == "reference":
        return reference.non_local_means(values, guide, variance, radius=radius, patch_radius=patch_radius, k=k)
    means = cpu.non_local_means(values, guide, variance, radius=radius, patch_radius=patch_radius, k=k, threads=threads)
    return means.to(there)


def strips(
    guide: Tensor, variance: Tensor, *, radius: int, patch_radius: int, k: float, threads: int = 1
) -> Iterator[Strip]:
    """Weights exp(−max(0, d²)) of the (2·radius+1)² pixels around each pixel, strip by strip.

    d² is the mean over channels and the patch of ((u_p − u_q)² − (v_p + min(v_p, v_q))) / (1e-10 + k² (v_p + v_q)) with
    u the guide and v its variance: what noise alone explains does not count. The border is mirrored without repeating
    the edge pixel.

    Args:
        guide: u, (H, W, C).
        variance: v, of each pixel of the guide, (H, W, C) ≥ 0.
        radius: of the window, 0 … 15.
        patch_radius: of the patches, 0 … 7.
        k: the larger, the stronger the filter; > 0.
        threads: of the compiled form.

    Raises:
        FrameError: the shapes differ.
        SettingsError: a number is out of range.
    """
    _validate(guide, variance, radius, patch_radius, k)
    guide, variance = guide.cpu(), variance.cpu()
    if choose(None, [guide, variance], dtypes=_DTYPES) == "reference":
        return reference.strips(guide, variance, radius=radius, patch_radius=patch_radius, k=k)
    return cpu.strips(guide, variance, radius=radius, patch_radius=patch_radius, k=k, threads=threads)


def _validate(guide: Tensor, variance: Tensor, radius: int, patch_radius: int, k: float) -> None:
    if guide.shape != variance.shape or guide.ndim != 3:
        raise FrameError(f"expected guide and variance of one shape, but got {guide.shape} and {variance.shape}")
    if not 0 <= radius <= 15 or not 0 <= patch_radius <= 7 or not k > 0:
        raise SettingsError(
            f"expected a radius to 15, a patch radius to 7 and k > 0, but got {radius}, {patch_radius} and {k}"
        )
