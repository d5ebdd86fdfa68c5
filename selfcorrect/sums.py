"""What the picture takes from the sum of its AOVs, each of which was denoised by itself.

A denoiser that sees the passes one by one keeps what it blurs in the picture, such as a lamp's edge beside a bright
wall, and the other way round. Where the picture is worse than the sum, AOVs that have to sum to the picture take its
error on. So the sum is a candidate of the picture, as in :mod:`selfcorrect.guard`, with the same witness: over a tile,

    α = (n − 2 s) / d   in [0, 1],

n and d of the guard and s the standard error of n over the tile's own pixels; of tiles of 64, 32, 16 and 8 pixels the
one that moves furthest. Both directions sum much the same products of noise, so that s is taken for √2 times what
pixels say that were independent in both. No tile is moved by what the rest of the frame says: over the frame, fireflies
in the witness hide whether the sum is better, which over most tiles is plain.

Measured with `scripts/bench/aovs.py`.
"""

import torch
from torch import Tensor

from selfcorrect.guard import Evidence
from selfcorrect.image.bands import bands, enlarged_rows, shares, tile_means
from selfcorrect.image.exposure import Radiance, Scaled

__all__ = ["toward_sum_"]

_SIDES = (64, 32, 16, 8)  # of the tiles
_CERTAIN = 2.0  # standard errors
_FLOOR = torch.finfo(torch.float64).tiny

Pair = tuple[Tensor, Tensor]


def toward_sum_(
    picture: Tensor, halves: Pair, total: Radiance, totals: tuple[Radiance, Radiance], color: Pair, scale: float
) -> float:
    """Move the picture and its halves towards the sum of AOVs where each half's witness is certain, in place.

    Args:
        picture: the corrected picture, (H, W, 3) linear radiance ≥ 0.
        halves: the same made of each half alone.
        total: the sum of the AOVs.
        totals: the same of the AOVs made of each half alone.
        color: the noisy halves.
        scale: what brings radiance to a mean near 1.

    Returns:
        The mean of α over the frame.
    """
    size = (picture.shape[0], picture.shape[1])
    evidence = Evidence(_scaled(color, scale), _scaled(halves, scale))
    for rows in bands(size[0]):
        a, b = ((half[rows].double() * scale).float() for half in totals)
        evidence.add(rows, (a, b))
    levels = [_certain(evidence, side) for side in _SIDES]
    moved = 0.0
    for rows in bands(size[0]):
        alpha = torch.stack([enlarged_rows(level, size, rows)[0] for level in levels]).amax(0)
        moved += float(alpha.sum())
        for image, towards in ((picture, total), *zip(halves, totals, strict=True)):
            before = image[rows].double()
            image[rows] = (before + alpha[:, :, None] * (towards[rows].double() - before)).float()
    return moved / (size[0] * size[1])


def _scaled(images: Pair, scale: float) -> tuple[Scaled, Scaled]:
    return Scaled(images[0], scale), Scaled(images[1], scale)


def _certain(evidence: Evidence, side: int) -> Tensor:
    """α over tiles, (1, h, w)."""

    def moments(rows: slice) -> Tensor:
        both = evidence.both(rows)
        return torch.cat([both, both[:1] ** 2])

    means = tile_means(evidence.size[0], moments, side)
    n, d, squared = means
    pixels = side**2 * shares(means, evidence.size, side)
    error = (2 * (squared - n**2).clamp(min=0) / pixels).sqrt()
    alpha: Tensor = (n - _CERTAIN * error) / d.clamp(min=_FLOOR)
    return alpha.clamp(0, 1)[None]
