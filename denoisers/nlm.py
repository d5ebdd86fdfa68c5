"""Dual-buffer non-local means (Rousselle et al. 2012): patches that differ by no more than their noise are averaged.

The noise is known from the two halves. Each half is filtered with weights of its own. Rousselle et al. take them from
the other half, which keeps noise from choosing its own weights, but then each half knows the other through its weights,
and could no longer be judged by it. So the weights are the half's own; what keeps noise from choosing
them is that its variance is smoothed over some pixels.
"""

import torch
from torch import Tensor

from selfcorrect.image.windows import gaussian_mean
from selfcorrect.kernel.nlm import non_local_means

__all__ = ["NonLocalMeans", "half_variance"]

RADIUS = 9  # of the window; Rousselle et al. use 7 to 10
PATCH_RADIUS = 3
K = 0.45
SIGMA = 2.0  # pixels, of the Gaussian that smooths the variance; 0.7, 2 and 4 were tried

Pair = tuple[Tensor, Tensor]


class NonLocalMeans:
    """Non-local means over 19×19 pixels in patches of 7×7; features unused.

    Args:
        threads: CPU threads, at least 1; None takes as many as torch.
    """

    name = "nlm"
    multiple = 1
    features: frozenset[str] = frozenset()
    dual = True

    def __init__(self, threads: int | None = None):
        self.threads = threads

    def denoise_pair(self, color: Pair, features: dict[str, Pair]) -> Pair:
        """Each half filtered with its own weights; see :class:`denoisers.host.DualPlugin`."""
        variance = half_variance(color, SIGMA)

        def one(half: Tensor) -> Tensor:
            threads = self.threads or torch.get_num_threads()
            return non_local_means(half, half, variance, radius=RADIUS, patch_radius=PATCH_RADIUS, k=K, threads=threads)

        return one(color[0]), one(color[1])


def half_variance(pair: Pair, sigma: float) -> Tensor:
    """Variance of the noise of each half, (x^a − x^b)² / 2 smoothed by a Gaussian of sigma pixels, (H, W, C)."""
    squared = (pair[0].double() - pair[1].double()) ** 2 / 2
    return gaussian_mean(squared.permute(2, 0, 1), sigma).permute(1, 2, 0).clamp(max=1e30).float()
