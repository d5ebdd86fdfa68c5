"""The readable form of the kernel: plain torch, any dtype, any device, differentiable by autograd.

Back et al. 2022, "Self-Supervised Post-Correction for Monte Carlo Denoising", Eqs. 3, 10 and 11. Every fast
kernel is tested against this file. c is the centre pixel, i a neighbour; y noisy, z denoised, ρ albedo,
n normal, v visibility.
"""

from collections.abc import Iterator
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from selfcorrect.kernel.guides import Guides

__all__ = ["EPSILON", "Heads", "activate", "cross_bilateral"]

EPSILON = 1e-4  # ε of Eq. 11; the published code adds the same to τ
_SMALLEST_SUM = 1e-5  # the published code's bound on Σw; never reached, as w_c ≥ EPSILON


class Heads(NamedTuple):
    """The network's outputs after their activations, each (N, C, h, w); None where the frame has no such buffer."""

    beta_z: Tensor
    beta_albedo: Tensor | None
    beta_normal: Tensor | None
    gamma_y: Tensor
    gamma_z: Tensor
    gamma_albedo: Tensor | None
    gamma_normal: Tensor | None
    gamma_visibility: Tensor | None
    tau: Tensor


def activate(raw: Tensor, guides: Guides, combination: str) -> Heads:
    """Split the raw outputs (N, heads, h, w) into β = tanh, γ = softplus, τ = softplus."""
    betas = guides.betas if combination == "eq10" else 0
    beta = torch.tanh(raw[:, :betas])
    gamma = F.softplus(raw[:, betas : betas + guides.gammas])
    tau = F.softplus(raw[:, betas + guides.gammas :])
    next_beta = iter(beta.split(3, dim=1)) if betas else iter(())
    next_gamma = iter(gamma.split(1, dim=1))

    def scale(present: bool) -> Tensor | None:
        return next(next_beta, torch.zeros_like(tau)) if present else None

    def bandwidth(present: bool) -> Tensor | None:
        return next(next_gamma) if present else None

    return Heads(
        next(next_beta, torch.ones_like(tau)),  # Eq. 3 is Eq. 10 with β^z = 1 and no other term
        scale(guides.has_albedo),
        scale(guides.has_normal),
        next(next_gamma),
        next(next_gamma),
        bandwidth(guides.has_albedo),
        bandwidth(guides.has_normal),
        bandwidth(guides.has_visibility),
        tau,
    )


class _Pixels(NamedTuple):
    """Guides at the centres (N, C, 1, h, w) or at T neighbours of each (N, C, T, h, w)."""

    y: Tensor
    albedo: Tensor | None
    visibility: Tensor | None
    normal: Tensor | None
    z: Tensor


def _pixels(stacked: Tensor, guides: Guides) -> _Pixels:
    channels = iter(
        stacked.split([3] + [3] * guides.has_albedo + [1] * guides.has_visibility + [3] * guides.has_normal + [3], 1)
    )
    y = next(channels)
    albedo = next(channels) if guides.has_albedo else None
    visibility = next(channels) if guides.has_visibility else None
    normal = next(channels) if guides.has_normal else None
    return _Pixels(y, albedo, visibility, normal, next(channels))


def _weight(c: _Pixels, i: _Pixels, heads: Heads) -> Tensor:
    """Eq. 11: w_i, (N, 1, T, h, w)."""

    def term(a: Tensor | None, b: Tensor | None, gamma: Tensor | None, logarithmic: bool = False) -> Tensor:
        if a is None or b is None or gamma is None:
            return torch.zeros((), device=c.y.device, dtype=c.y.dtype)
        distance = ((a - b) ** 2).sum(1, keepdim=True)
        if logarithmic:
            distance = torch.log1p(distance)
        return distance / (gamma[:, :, None] ** 2 + EPSILON)

    return torch.exp(
        -term(c.y, i.y, heads.gamma_y, logarithmic=True)
        - term(c.z, i.z, heads.gamma_z, logarithmic=True)
        - term(c.albedo, i.albedo, heads.gamma_albedo)
        - term(c.normal, i.normal, heads.gamma_normal)
        - term(c.visibility, i.visibility, heads.gamma_visibility)
    )


def _combined(c: _Pixels, i: _Pixels, heads: Heads) -> Tensor:
    """Eq. 10's bracket: y_i + β^z∘(z_c − z_i) + β^ρ∘(ρ_c − ρ_i) + β^n∘(n_c − n_i), (N, 3, T, h, w)."""
    h = i.y + heads.beta_z[:, :, None] * (c.z - i.z)
    if c.albedo is not None and i.albedo is not None and heads.beta_albedo is not None:
        h = h + heads.beta_albedo[:, :, None] * (c.albedo - i.albedo)
    if c.normal is not None and i.normal is not None and heads.beta_normal is not None:
        h = h + heads.beta_normal[:, :, None] * (c.normal - i.normal)
    return h


def _neighbours(window: int, every: int, taps_per_step: int) -> Iterator[list[tuple[int, int]]]:
    radius, slope = window // 2, 1 if every < 4 else 2
    side = range(-radius, radius + 1)
    taps = [(dy, dx) for dy in side for dx in side if (dy or dx) and (dx - slope * dy) % every == 0]
    for start in range(0, len(taps), taps_per_step):
        yield taps[start : start + taps_per_step]


def cross_bilateral(
    guides: Guides,
    raw: Tensor,
    corners: Tensor,
    *,
    window: int,
    every: int = 1,
    combination: str = "eq10",
    taps_per_step: int | None = None,
) -> Tensor:
    """Eq. 10: g = Σ w_i [y_i + β^z∘(z_c−z_i) + β^ρ∘(ρ_c−ρ_i) + β^n∘(n_c−n_i)] / Σ w_i.

    Args:
        guides: the padded buffers of one half.
        raw: network outputs before their activations, (N, heads, h, w).
        corners: image row and column of each patch's first pixel, (N, 2), int64.
        window: side of the window, odd.
        every: 1 takes all taps; n > 1 a lattice of one in n, the centre's weight divided by n.
        combination: "eq10", or "eq3" for z_c + Σ w_i (y_i − z_i) / Σ w_i.
        taps_per_step: how many neighbours are gathered at a time. ``None`` gathers the whole window, which is
            the simplest form and needs window² times the memory; 1 is a loop over shifts. Fewer than all are
            recomputed on the way back, so that memory stays that of one step.

    Returns:
        The corrected radiance, (N, 3, h, w), in the units of y.
    """
    height, width, radius = raw.shape[2], raw.shape[3], window // 2
    heads = activate(raw, guides, combination)
    around = guides.patches(corners - radius, (height + 2 * radius, width + 2 * radius))

    def shifted(dy: int, dx: int) -> Tensor:
        return around[:, :, radius + dy : radius + dy + height, radius + dx : radius + dx + width]

    c = _pixels(shifted(0, 0)[:, :, None], guides)

    def sums(taps: list[tuple[int, int]], heads: Heads) -> tuple[Tensor, Tensor]:
        i = _pixels(torch.stack([shifted(*tap) for tap in taps], 2), guides)
        w = _weight(c, i, heads)
        return w.sum(2), (w * _combined(c, i, heads)).sum(2)

    w_sum = (heads.tau + EPSILON) / every  # w_c
    g_sum = w_sum * c.y[:, :, 0]
    for taps in _neighbours(window, every, taps_per_step or window * window):
        if taps_per_step is None:
            w, wh = sums(taps, heads)
        else:
            w, wh = checkpoint(sums, taps, heads, use_reentrant=False)
        w_sum, g_sum = w_sum + w, g_sum + wh
    return g_sum / w_sum.clamp(min=_SMALLEST_SUM)
