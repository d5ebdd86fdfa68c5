"""The readable form of the kernel: plain torch, any dtype, any device, differentiable by autograd.

Back et al. 2022, "Self-Supervised Post-Correction for Monte Carlo Denoising", Eqs. 3, 8, 10 and 11. Every fast
kernel is tested against this file. c is the centre pixel, i a neighbour, f^m one of the buffers that the frame has: y
noisy, z denoised, ρ albedo, n normal, v visibility (:data:`selfcorrect.buffers.TERMS`).
"""

from dataclasses import replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from selfcorrect.buffers import COLOR, DENOISED, Buffer
from selfcorrect.kernel.cross_bilateral.window import Window
from selfcorrect.kernel.guides import Guides

__all__ = ["EPSILON", "Heads", "activate", "cross_bilateral", "cross_bilateral_loss"]

EPSILON = 1e-4  # ε of Eq. 11; the published code adds the same to τ
_SMALLEST_SUM = 1e-5  # the published code's bound on Σw; never reached, as w_c ≥ EPSILON

Pixels = dict[Buffer, Tensor]
"""f^m at the centres (N, C, 1, h, w), or at T neighbours of each (N, C, T, h, w)."""


class Heads(NamedTuple):
    """The network's outputs after their activations.

    Attributes:
        beta: β^m of each buffer that Eq. 10 scales, (N, 3, h, w), −1 … 1.
        gamma: γ^m of each buffer, (N, 1, h, w), > 0.
        tau: τ, (N, 1, h, w), > 0.
    """

    beta: dict[Buffer, Tensor]
    gamma: dict[Buffer, Tensor]
    tau: Tensor


def activate(raw: Tensor, guides: Guides, combination: str) -> Heads:
    """Split the raw outputs (N, heads, h, w) into β = tanh, γ = softplus, τ = softplus."""
    scaled = guides.scaled if combination == "eq10" else ()
    *betas, gammas, tau = raw.split([3] * len(scaled) + [guides.gammas, 1], dim=1)
    beta = {m: torch.tanh(part) for m, part in zip(scaled, betas, strict=True)}
    gamma = {m: F.softplus(part) for m, part in zip(guides.terms, gammas.split(1, dim=1), strict=True)}
    if combination == "eq3":  # Eq. 10 with β^z = 1 and no other buffer
        beta = {DENOISED: torch.ones_like(tau).expand(-1, 3, -1, -1)}
    return Heads(beta, gamma, F.softplus(tau))


def _weight(c: Pixels, i: Pixels, heads: Heads) -> Tensor:
    """Eq. 11: w_i = exp(−Σ_m D(f^m_c, f^m_i) / ((γ^m)² + ε)) with D = ‖·‖², or ln(1 + ‖·‖²); (N, 1, T, h, w)."""
    exponent = torch.zeros((), device=c[COLOR].device, dtype=c[COLOR].dtype)
    for m, gamma in heads.gamma.items():
        distance = ((c[m] - i[m]) ** 2).sum(1, keepdim=True)
        if m.distance == "logarithmic":
            distance = torch.log1p(distance)
        exponent = exponent + distance / (gamma[:, :, None] ** 2 + EPSILON)
    return torch.exp(-exponent)


def _combined(c: Pixels, i: Pixels, heads: Heads) -> Tensor:
    """Eq. 10's bracket: y_i + Σ_m β^m∘(f^m_c − f^m_i), (N, 3, T, h, w)."""
    h = i[COLOR]
    for m, beta in heads.beta.items():
        h = h + beta[:, :, None] * (c[m] - i[m])
    return h


def cross_bilateral(
    guides: Guides,
    raw: Tensor,
    corners: Tensor,
    window: Window,
    *,
    threads: int = 1,
    taps_per_step: int | None = 1,
) -> Tensor:
    """Eq. 10: g = Σ w_i [y_i + Σ_m β^m∘(f^m_c − f^m_i)] / Σ w_i; the centre has the weight τ.

    Args:
        guides: the padded buffers of one half.
        raw: network outputs before their activations, (N, heads, h, w).
        corners: image row and column of each patch's first pixel, (N, 2), int64.
        window: taps and combination.
        threads: not looked at; torch has its own.
        taps_per_step: how many neighbours are gathered at a time. ``None`` gathers the whole window, which is
            the simplest form and needs window² times the memory; 1 is a loop over shifts. Fewer than all are
            recomputed in the backward pass, so that memory stays that of one step.

    Returns:
        The corrected radiance, (N, 3, h, w), in the units of y.
    """
    height, width, radius = raw.shape[2], raw.shape[3], window.radius
    heads = activate(raw, guides, window.combination)
    around = guides.patches(corners - radius, (height + 2 * radius, width + 2 * radius))

    def pixels(taps: list[tuple[int, int]]) -> Pixels:
        rows_columns = [(radius + dy, radius + dx) for dy, dx in taps]
        stacked = torch.stack([around[:, :, y : y + height, x : x + width] for y, x in rows_columns], 2)
        return {m: stacked[:, guides.channels(m)] for m in guides.terms}

    c = pixels([(0, 0)])

    def sums(taps: list[tuple[int, int]], heads: Heads) -> tuple[Tensor, Tensor]:
        i = pixels(taps)
        w = _weight(c, i, heads)
        return w.sum(2), (w * _combined(c, i, heads)).sum(2)

    w_sum = (heads.tau + EPSILON) / window.every  # w_c
    g_sum = w_sum * c[COLOR][:, :, 0]
    neighbours = window.neighbours
    step = taps_per_step or max(len(neighbours), 1)
    for first in range(0, len(neighbours), step):
        taps = neighbours[first : first + step]
        if taps_per_step is None:
            w, wh = sums(taps, heads)
        else:
            w, wh = checkpoint(sums, taps, heads, use_reentrant=False)
        w_sum, g_sum = w_sum + w, g_sum + wh
    return g_sum / w_sum.clamp(min=_SMALLEST_SUM)


def cross_bilateral_loss(
    guides: Guides,
    raw: Tensor,
    corners: Tensor,
    target: Tensor,
    weight: Tensor,
    window: Window,
    *,
    threads: int = 1,
    taps_per_step: int | None = 1,
) -> Tensor:
    """One half of Eq. 8: mean ½ weight (g − target)², with ``target`` (3, …) and ``weight`` (…) padded like planes."""
    g = cross_bilateral(guides, raw, corners, window, threads=threads, taps_per_step=taps_per_step)
    padded = replace(guides, planes=torch.cat([target, weight[None]]))
    cut = padded.patches(corners, (raw.shape[2], raw.shape[3]))
    return (0.5 * cut[:, 3:] * (g - cut[:, :3]) ** 2).mean()
