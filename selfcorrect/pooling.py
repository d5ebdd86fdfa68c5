"""How far candidates are blended in: evidence of the witness pooled from the frame to ever smaller tiles.

n and d are those of :mod:`selfcorrect.guard`. With several candidates g_k there is an n_k of each and a d_km of each
two, and the weights α_k ≥ 0 are those of a small least-squares problem. Locally n is mostly noise, and a single firefly
in the witness can turn its sign. So the evidence is pooled from coarse to fine: the whole frame first, then tiles of
128, 64, 32 and 16 pixels. Each level starts from what the level above found, moves as far as its own evidence is
certain, and then takes off one standard error.
"""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from selfcorrect.image.bands import enlarged_rows, shares, tile_means

__all__ = ["pairs", "pooled", "taken_off"]

_LEVELS = (128, 64, 32, 16)  # sides of the tiles
_LARGEST_SPREAD = 0.25  # of a tile's α about that of the tile around it, squared
_LEAST_SPREAD = 0.01
_ROUNDS = 8  # of the frame's robust fit
_OUTLYING = 3.0  # usual rests
_MEDIAN_OF_NORMAL = 0.6745  # of the size of a normal variable, in standard deviations
_SWEEPS = 16  # over several candidates
_FLOOR = torch.finfo(torch.float64).tiny


def pairs(candidates: int) -> list[tuple[int, int]]:
    """The order in which d of each two candidates is kept.

    >>> pairs(2)
    [(0, 0), (0, 1), (1, 1)]
    """
    return [(k, m) for k in range(candidates) for m in range(k, candidates)]


def _place(k: int, m: int, candidates: int) -> int:
    """Where d of two candidates is among those of :func:`pairs`."""
    return pairs(candidates).index((min(k, m), max(k, m)))


def taken_off(alpha: Tensor, nd: Tensor) -> Tensor:
    """What each of the weights α takes off half the squared error, in the shape of α.

    α_k (n_k − Σ_m α_m d_km / 2), whose sum is Σ_k α_k n_k − Σ_km α_k α_m d_km / 2: what two candidates have in common
    is shared between them.
    """
    count = len(alpha)
    return alpha * (nd[:count] + _left(nd[:count], nd[count:], alpha)) / 2


def pooled(size: tuple[int, int], nd: Callable[[slice], Tensor], count: int) -> Tensor:
    """α over the smallest tiles, (K, h, w), from evidence pooled over the frame, then over ever smaller tiles."""
    alpha = _of_frame(tile_means(size[0], nd), size, count)
    for side in _LEVELS:
        if side > max(size):
            continue
        moments = tile_means(size[0], partial(_moments, size, nd, alpha), side)
        n, d, around, scatter = moments.split([count, count * (count + 1) // 2, count, count])
        variance = scatter / side**2
        curvature = torch.stack([d[_place(k, k, count)] for k in range(count)])
        spread = _spread(_left(n, d, around), curvature, variance)
        ridge = (variance / (spread * curvature).clamp(min=_FLOOR)).clamp(max=1 / _FLOOR)
        alpha = _solved(n, d, around, ridge, variance.sqrt())
    return alpha


def _of_frame(tiles: Tensor, size: tuple[int, int], count: int) -> Tensor:
    """One α of each candidate for the whole frame, (K, 1, 1), by a least-squares fit that outlying tiles cannot lead.

    A firefly in the witness makes n of its tile larger than that of all others together. So tiles are weighed down by
    what the fit leaves of their n, 1 / (1 + (rest / 3s)²) with s the usual rest (Cauchy weights, fitted in rounds).
    """
    n, d = tiles[:count].flatten(1), tiles[count:].flatten(1)
    weight = shares(tiles, size).flatten()
    trust = torch.ones_like(weight)
    nothing = tiles.new_zeros(count, 1, 1)
    alpha = nothing
    for _ in range(_ROUNDS):
        share = weight * trust / (weight * trust).sum()
        means = [(planes * share).sum(1).reshape(-1, 1, 1) for planes in (n, d)]
        variance = ((n - means[0].flatten(1)) ** 2 * share).sum(1) * (share**2).sum()
        chance = variance.sqrt() if n.shape[1] > 1 else n[:, 0].abs()
        alpha = _solved(means[0], means[1], nothing, nothing, chance.reshape(-1, 1, 1))
        rest = _left(n, d, alpha.flatten(1))
        usual = _median(rest.abs()).clamp(min=_FLOOR) / _MEDIAN_OF_NORMAL
        trust = 1 / (1 + ((rest / (_OUTLYING * usual)) ** 2).amax(0))
    return alpha


def _spread(left: Tensor, curvature: Tensor, variance: Tensor) -> Tensor:
    """How far α of a tile lies from that of the tile around it, squared, as a mean over all tiles, (K, 1, 1).

    What the tiles' own estimates differ by, less what chance explains; tiles count by how certain they are. Where it is
    small, as with an image that is as good everywhere, tiles keep to what the frame says.
    """
    certain = (variance + _LARGEST_SPREAD * curvature**2).clamp(min=_FLOOR)
    found = ((left**2 - variance) / certain).clamp(max=1 / _LARGEST_SPREAD).sum((1, 2), keepdim=True)
    weights = (curvature**2 / certain).sum((1, 2), keepdim=True).clamp(min=_FLOOR)
    return (found / weights).clamp(_LEAST_SPREAD, _LARGEST_SPREAD)


def _left(n: Tensor, d: Tensor, alpha: Tensor) -> Tensor:
    """n_k − Σ_m α_m d_km: what the weights α leave of n, in the shape of n."""
    count = len(n)
    rest = list(n)
    for k in range(count):
        for m in range(count):
            rest[k] = rest[k] - alpha[m] * d[_place(k, m, count)]
    return torch.stack(rest)


def _solved(n: Tensor, d: Tensor, around: Tensor, ridge: Tensor, chance: Tensor) -> Tensor:
    """The α ≥ 0 of sum ≤ 1 at which Σ α_k n_k − Σ α_k α_m d_km / 2 − Σ ridge_k (α_k − around_k)² / 2 is largest.

    One after the other, each is moved to where the others leave it; less its chance, one standard error of n.
    """
    count = len(n)
    alpha = list(around)
    for k in list(range(count)) * (1 if count == 1 else _SWEEPS):
        left, share = n[k], torch.ones_like(n[k])
        for m in range(count):
            if m != k:
                left = left - alpha[m] * d[_place(k, m, count)]
                share = share - alpha[m]
        curvature = (d[_place(k, k, count)] + ridge[k]).clamp(min=_FLOOR)
        moved = (left + ridge[k] * around[k] - chance[k]) / curvature
        alpha[k] = torch.minimum(moved.clamp(min=0), share.clamp(min=0))
    return torch.stack(alpha)


def _moments(size: tuple[int, int], nd: Callable[[slice], Tensor], alpha: Tensor, rows: slice) -> Tensor:
    """What a level needs the means of: n, d, the α of the level above, and the squared rest that this α leaves."""
    evidence, around = nd(rows), enlarged_rows(alpha, size, rows)
    count = len(alpha)
    return torch.cat([evidence, around, _left(evidence[:count], evidence[count:], around) ** 2])


def _median(values: Tensor) -> Tensor:
    """Over the last of two dimensions, kept; the lower one of two. By sorting, which is deterministic on any device."""
    return values.sort(1).values[:, (values.shape[1] - 1) // 2, None]
