"""Nonlinearly weighted first-order regression (Bitterli et al. 2016), the classical denoiser with G-buffers.

1. Each feature is freed of its noise by non-local means in itself.
2. In a window around every pixel the radiance is fitted, to first order, by the features; how much a neighbour counts
   is given by non-local means of the radiance. Every pixel takes the mean of the models around it.
3. Step 2 is done with two bandwidths. The other half, which neither has seen, shows which has the smaller error; its
   evidence is smoothed over some pixels, as is the choice.

The paper fits each half with weights of the other. Here a half's weights are its own: then it is independent of the
other half, which stays its witness. It costs nothing: relMSE with own and with crossed weights was 0.0320 and 0.0344
(bathroom, 64 spp), 0.052 and 0.064 (classroom, 64), 0.028 and 0.059 (dining-room, 64), 0.00221 and 0.00225
(living-room-2, 256), 0.00113 and 0.00118 (staircase, 256). The only thing that a half knows of the
other is what was pooled: the smoothed variance, and which bandwidth serves an area better.
"""

from functools import partial

import torch
from torch import Tensor

from denoisers.nlm import Pair, half_variance
from selfcorrect.image.windows import gaussian_mean
from selfcorrect.kernel.nlm import non_local_means, strips
from selfcorrect.kernel.regression import regress_non_local

__all__ = ["Nfor"]

RADIUS, PATCH_RADIUS = 9, 3  # windows of 19×19, patches of 7×7
BANDWIDTHS = (0.5, 1.0)  # k of the weights
FEATURE_RADIUS, FEATURE_K = 5, 1.0
RIDGE = 1e-4  # 1e-2, 1e-3 and 1e-4 were tried
SIGMA = 2.0  # pixels, of the Gaussian that smooths the radiance's variance; 0.7, 2 and 4 were tried
FEATURE_SIGMA = 1.0  # the features' own
SELECTION_SIGMAS = (8.0, 2.0)  # of the evidence for a bandwidth, and of the choice
DARKEST = 0.1  # of the mean radiance: darker pixels' errors count no more


class Nfor:
    """First-order regression on albedo, normal, depth and visibility, those that there are.

    Args:
        threads: CPU threads, at least 1; None takes as many as torch.
    """

    name = "nfor"
    multiple = 1
    features = frozenset({"albedo", "normal", "depth", "visibility"})
    dual = True

    def __init__(self, threads: int | None = None):
        self.threads = threads

    def denoise_pair(self, color: Pair, features: dict[str, Pair]) -> Pair:
        """Each half denoised with weights and features of its own; see :class:`denoisers.host.DualPlugin`."""
        threads = self.threads or torch.get_num_threads()
        variance = half_variance(color, SIGMA)
        order = [name for name in ("albedo", "normal", "depth", "visibility") if name in features]
        smooth = [_prefiltered(features[name], threads) for name in order]

        def fit(i: int, k: float) -> Tensor:
            own = [pair[i] for pair in smooth]
            return _fit(own, color[i], variance, k, threads)

        narrow, wide = ((fit(0, k), fit(1, k)) for k in BANDWIDTHS)
        share = _share_of_second(color, narrow, wide)
        a, b = (torch.lerp(one, other, share) for one, other in zip(narrow, wide, strict=True))
        return a, b


def _fit(features: list[Tensor], color: Tensor, variance: Tensor, k: float, threads: int) -> Tensor:
    """Radiance by first-order regression on the features; without any, by non-local means."""
    if not features:
        return non_local_means(color, color, variance, radius=RADIUS, patch_radius=PATCH_RADIUS, k=k, threads=threads)
    weights = partial(strips, color, variance, radius=RADIUS, patch_radius=PATCH_RADIUS, k=k, threads=threads)
    fitted = regress_non_local(features, color, weights, radius=RADIUS, ridge=RIDGE, threads=threads)
    return fitted.clamp(min=0)


def _prefiltered(feature: Pair, threads: int) -> Pair:
    # a feature without noise has variance 0 and stays as it is; the floor only keeps flat areas together
    floor = 1e-6 * float((feature[0].double() ** 2).mean())
    variance = half_variance(feature, FEATURE_SIGMA) + min(floor, 1e30)

    def one(half: Tensor) -> Tensor:
        return non_local_means(
            half, half, variance, radius=FEATURE_RADIUS, patch_radius=PATCH_RADIUS, k=FEATURE_K, threads=threads
        )

    return one(feature[0]), one(feature[1])


def _share_of_second(color: Pair, first: Pair, second: Pair) -> Tensor:
    """Where the second result is nearer to the other half's radiance: (H, W, 1), 0 … 1, smooth.

    The noise of that radiance adds the same to both squared distances, and so need not be known.
    """
    level = gaussian_mean(((color[0].double() + color[1].double()) / 2).mean(-1)[None], SELECTION_SIGMAS[1])
    floor = max(DARKEST * float(level.mean()), torch.finfo(torch.float32).tiny)
    gained = torch.zeros_like(level)
    for i in (0, 1):
        witness, one, other = (image.double() for image in (color[1 - i], first[i], second[i]))
        gained += ((one - witness) ** 2 - (other - witness) ** 2).mean(-1)
    evidence = gaussian_mean(gained / (level**2 + floor**2), SELECTION_SIGMAS[0])
    return gaussian_mean((evidence > 0).double(), SELECTION_SIGMAS[1])[0, :, :, None].float()
