"""Are the halves what the method needs: independent of each other, and without correlation between pixels?

How much of the noise the halves share cannot be read off their difference, which holds only what they do not share.
But noise is white, and what a camera sees is not: the finest frequencies of smooth places hold hardly anything else
than noise. If the halves are independent, their signs there agree as often as not. So each half is cut into blocks of
4×4 pixels, whose cosine transform (DCT-II) has three coefficients that no slope and no straight edge along an axis
reaches; over a tile of 4×4 blocks these tell the correlation of the halves. Detail correlates too, so only the
quarter of the tiles that correlates least is believed: chosen by every other block, measured by the others, lest the
choice should decide the result. Detail everywhere, as in a frame without noise, is told from shared noise by its
spectrum, which falls, and is not held against the halves.

Not seen: noise that is shared but not white (wide pixel filters, light caches), less than 0.2 % of the radiance
(indistinguishable from the rounding of half floats), and what is shared in less than three quarters of the frame.

`scripts/bench/independence.py` has the alarms, false and missed, over frames and shares.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from selfcorrect.frame import Frame
from selfcorrect.image.bands import average, tile_means
from selfcorrect.image.channels import channel_mean

__all__ = ["Dependence", "dependence", "doubts", "neighbour_correlation"]

# A box filter gives 0 ± 0.01 on 12,000 pixels, a Gaussian filter of 0.4 pixels 0.15, one of 0.5 pixels 0.29
# (tests/test_independence.py has the noise).
_LARGEST_CORRELATION = 0.05
_FEWEST_PIXELS = 4096  # below, chance alone gives such correlations

_BLOCK, _TILE = 4, 16  # sides, pixels
_MOST_TILES = 4096  # looked at, in rows spread evenly over the frame: a million pixels say enough
_FINEST = ((2, 3), (3, 2), (3, 3))
_COARSER = (1, 1)
_SMALLEST = 2e-3  # coefficient of the logarithm: seven times the rounding noise of half floats
_FEWEST_SIGNS = 12  # of each kind of block in a tile that is judged, of 24
_BELIEVED = 0.25  # share of the tiles
_LARGEST_SHARE = 0.15  # of independent halves at most 0.10 was seen
_CERTAIN = 2.0  # standard errors above that: of halves that share nothing, five of a frame of 20,000 pixels
_DETAIL_FIRST = 0.2  # how much a tile that looks like noise is believed less, in correlation
_WHITE = 0.22  # power of the finest over a coarser coefficient: of shared noise 0.25 … 1.1, of clean frames up to 0.22
_WHITE_CHANCE = 0.3  # of one tile: added over the root of the tiles that are believed
_DARK = 0.1  # of the usual radiance: below, the logarithm turns linear

_ADVICE = "render one of them again with another seed"


@dataclass(frozen=True)
class Dependence:
    """What two halves share.

    Attributes:
        identical: they are equal to the bit.
        share: how much of the noise variance they share, 0 … 1; 0 where it cannot be told.
        standard_error: of ``share``; infinite where it cannot be told.
        whiteness: of what they share: 1 of noise, near 0 of detail and of nothing; 1 where the frame is too small.
        tiles: how many tell this.
    """

    identical: bool
    share: float
    standard_error: float
    whiteness: float
    tiles: int

    @property
    def noisy(self) -> bool:
        """Whether what they share is certainly noise, and too much of it."""
        white = self.whiteness > _WHITE + _WHITE_CHANCE / math.sqrt(max(self.tiles, 1))
        return white and self.share - _CERTAIN * self.standard_error > _LARGEST_SHARE

    @property
    def tells_nothing(self) -> bool:
        """Whether one half says nothing about the error of the other: no gain may be claimed.

        Equal halves do so but where they hold detail and no noise.
        """
        return self.noisy or (self.identical and self.whiteness > _WHITE)


def doubts(frame: Frame) -> list[str]:
    """What speaks against the halves, one line each; empty where nothing does."""
    a, b = frame.color
    found = dependence(a, b)
    if found.noisy:
        what = "are identical" if found.identical else f"share {found.share:.0%} of their noise"
        return [f"the halves {what}: no gain can be told and the denoised image is kept; {_ADVICE}"]
    if found.identical:
        return []
    correlation = neighbour_correlation(a, b)
    if a.shape[0] * a.shape[1] >= _FEWEST_PIXELS and correlation > _LARGEST_CORRELATION:
        return [
            f"the noise of neighbouring pixels is correlated ({correlation:.2f}): render with a box pixel filter, "
            "else noise is taken for detail"
        ]
    return []


def dependence(a: Tensor, b: Tensor) -> Dependence:
    """How much of their noise two noisy halves share.

    Args:
        a: linear radiance, (H, W, 3), ≥ 0.
        b: the same frame.
    """
    identical = torch.equal(a, b)
    fine, coarse = _coefficients(a, b)
    (fine_a, fine_b), seen = fine, fine[0].abs().maximum(fine[1].abs()) > _SMALLEST
    agreement = fine_a.sign() * fine_b.sign() * seen
    block = torch.arange(16, device=a.device)
    even = (block // 4 + block) % 2 == 0  # every other block, like a chessboard
    judged = (seen[:, even].sum((1, 2)) >= _FEWEST_SIGNS) & (seen[:, ~even].sum((1, 2)) >= _FEWEST_SIGNS)
    kept = math.ceil(_BELIEVED * int(judged.sum()))
    if not kept:
        return Dependence(identical, 0.0, math.inf, float(not len(judged)), 0)
    agreed, counted, fine_power, coarse_power = (
        torch.stack([x[:, even].sum((1, 2)), x[:, ~even].sum((1, 2))])[:, judged]
        for x in (agreement, seen, fine_a * fine_b / len(_FINEST), coarse[0] * coarse[1])
    )
    whiteness = torch.where(coarse_power > 0, fine_power / coarse_power, 1.0).clamp(0, 1)
    # chosen by one kind of block, of equal ones those that look like detail; measured by the other
    least = (agreed / counted + _DETAIL_FIRST * whiteness).argsort(dim=1, stable=True)[:, :kept]
    agreed, counted, fine_power, coarse_power = (
        x.flip(0).gather(1, least) for x in (agreed, counted, fine_power, coarse_power)
    )
    signs = float(counted.sum())
    share = float(agreed.sum()) / signs
    usual_fine, usual_coarse = float(fine_power.median()), float(coarse_power.median())
    # Signs of two normal variables of correlation ρ agree on average by (2/π) asin ρ (Sheppard 1899).
    return Dependence(
        identical,
        max(math.sin(math.pi / 2 * share), 0.0),
        math.pi / 2 * math.sqrt(max(1 - share**2, 1 / signs) / signs),
        usual_fine / usual_coarse if usual_coarse > 0 else float(usual_fine > 0),
        2 * kept,
    )


def _coefficients(a: Tensor, b: Tensor) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Of both halves the finest coefficients (tiles, 16 blocks, 3) and the coarser one (tiles, 16 blocks, 1)."""
    height, width = (side // _TILE * _TILE for side in a.shape[:2])
    rows = height // _TILE
    step = max(math.ceil(rows * (width // _TILE) / _MOST_TILES), 1)
    scale = _usual(a, b)
    order = torch.arange(_BLOCK, dtype=torch.float64, device=a.device)
    cosines = torch.cos((order + 0.5) * order[:, None] * math.pi / _BLOCK) / math.sqrt(_BLOCK / 2)

    def one(half: Tensor) -> tuple[Tensor, Tensor]:
        strips = [channel_mean(half[top : top + _TILE, :width].double()) for top in range(0, height, step * _TILE)]
        if not (strips and width):
            nothing = half.new_zeros(0, 16, 3, dtype=torch.float64)
            return nothing, nothing[..., :1]
        # the same function of both halves leaves independent halves independent, and takes fireflies their weight
        radiance = torch.log1p(torch.cat(strips) / scale)
        blocks = radiance.reshape(-1, 4, _BLOCK, width // _TILE, 4, _BLOCK).permute(0, 3, 1, 4, 2, 5)
        transformed = cosines @ blocks.reshape(-1, 16, _BLOCK, _BLOCK) @ cosines.T
        finest = torch.stack([transformed[..., u, v] for u, v in _FINEST], -1)
        return finest, transformed[..., _COARSER[0], _COARSER[1], None]

    (fine_a, coarse_a), (fine_b, coarse_b) = one(a), one(b)
    return (fine_a, fine_b), (coarse_a, coarse_b)


def _usual(a: Tensor, b: Tensor) -> float:
    """Radiance below which a pixel is dark; by the mean of roots, which a few bright pixels do not move."""
    size = (a.shape[0], a.shape[1])

    def roots(rows: slice) -> Tensor:
        return torch.stack([channel_mean(half[rows].double()).clamp(min=0).sqrt() for half in (a, b)])

    root = sum(average(tile_means(size[0], roots), size)) / 2
    return _DARK * root**2 if root > 0 else 1.0


def neighbour_correlation(a: Tensor, b: Tensor) -> float:
    """Correlation of the signs of a − b in horizontally and vertically neighbouring pixels.

    The difference of the halves is noise and nothing else; signs, because a few fireflies would decide a covariance.
    """
    sign = channel_mean(a - b).sign()
    pairs = torch.cat([(sign[:, 1:] * sign[:, :-1]).flatten(), (sign[1:] * sign[:-1]).flatten()])
    used = pairs[pairs != 0]
    return float(used.mean()) if len(used) else 0.0
