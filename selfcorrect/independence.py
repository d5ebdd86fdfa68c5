"""Are the halves what the method needs: independent of each other, and without correlation between pixels?"""

import torch
from torch import Tensor

from selfcorrect.frame import Frame

__all__ = ["doubts", "neighbour_correlation"]

# A box filter gives 0 ± 0.01 on 12,000 pixels, a Gaussian filter of 0.4 pixels 0.15, one of 0.5 pixels 0.29
# (tests/test_independence.py has the noise).
_LARGEST_CORRELATION = 0.05
_FEWEST_PIXELS = 4096  # below, chance alone gives such correlations


def doubts(frame: Frame) -> list[str]:
    """What speaks against the halves, one line each; empty where nothing does."""
    a, b = frame.color
    if torch.equal(a, b):
        if bool((a == a[0, 0]).all()):
            return []
        return ["the halves are identical: unless the frame has no noise, they were rendered with the same seed"]
    correlation = neighbour_correlation(a, b)
    if a.shape[0] * a.shape[1] >= _FEWEST_PIXELS and correlation > _LARGEST_CORRELATION:
        return [
            f"the noise of neighbouring pixels is correlated ({correlation:.2f}): render with a box pixel filter, "
            "else noise is taken for detail"
        ]
    return []


def neighbour_correlation(a: Tensor, b: Tensor) -> float:
    """Correlation of the signs of a − b in horizontally and vertically neighbouring pixels.

    The difference of the halves is noise and nothing else; signs, because a few fireflies would decide a covariance.
    """
    sign = (a - b).mean(-1).sign()
    pairs = torch.cat([(sign[:, 1:] * sign[:, :-1]).flatten(), (sign[1:] * sign[:-1]).flatten()])
    used = pairs[pairs != 0]
    return float(used.mean()) if len(used) else 0.0
