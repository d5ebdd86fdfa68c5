"""Cross-buffer regression: noisy radiance as a first-order function of features (Gu et al. 2022, Eqs. 10–12).

Each half's radiance is fitted by the other half's features: fitted by its own, whose denoised image shares its noise,
it takes some of that noise back.

Which half is a fit then independent of? Of neither: the fit of x^a by features of b sees b through the denoised image
among them, and a as its target, where every pixel has a share of its own fit. ``tests/stages/test_regression.py``
measures both by simulation, as the covariance of the fit with each half's noise over the variance of that noise: with
OIDN 0.026 of a and 0.006 of b, with joint-bilateral 0.024 and 0.036, where the whole squared error of the fit is 0.02
and 0.03. Halves that are to be judged by their witness therefore need :func:`own_buffer_regression`.
"""

import torch
from torch import Tensor

from selfcorrect.errors import FrameError
from selfcorrect.frame import Half, mean
from selfcorrect.image.exposure import scale_
from selfcorrect.kernel.regression import regress
from selfcorrect.stages.images import StageImages
from selfcorrect.stages.stage import Outcome, Stage, Work

__all__ = ["RIDGE", "STRIDE", "WINDOW", "Regression", "bandwidth", "cross_buffer_regression", "own_buffer_regression"]

WINDOW = 51
RIDGE = 1e-4  # of features scaled to at most 1 and weights of sum 1; measured by scripts/bench/stages.py
STRIDE = 1
EPSILON = 0.01  # added to the bandwidth, as published

Halves = tuple[Half, Half]
Pair = tuple[Tensor, Tensor]


def bandwidth(denoised: Pair) -> float:
    """2κ + 0.01 of Eq. 11, κ the mean over pixels and channels of (z^a − z^b)² / 2."""
    kappa = float(((denoised[0].double() - denoised[1].double()) ** 2 / 2).mean())
    return 2 * min(kappa, 1e30) + EPSILON


def cross_buffer_regression(
    halves: Halves, *, window: int = WINDOW, ridge: float = RIDGE, stride: int = STRIDE, threads: int = 1
) -> Pair:
    """Y^A and Y^B: the radiance of half a fitted by the features of half b, and of half b by those of half a.

    The features are the denoised radiance, and those of albedo, normal, depth and visibility that there are: with all
    of them a model has 12 coefficients.

    Args:
        halves: buffers of both halves with denoised images; radiance of a mean near 1 (the published 0.01 in the
            bandwidth is absolute).
        window: side of the window, odd, at most 63.
        ridge: of the least squares, > 0.
        stride: distance in pixels of the models' centres, 1 as published.
        threads: of the compiled kernel.

    Returns:
        two images (H, W, 3) of linear radiance ≥ 0.

    Raises:
        FrameError: a half has no denoised image.
    """
    return _fits(halves, halves[::-1], window, ridge, stride, threads)


def own_buffer_regression(
    halves: Halves, *, window: int = WINDOW, ridge: float = RIDGE, stride: int = STRIDE, threads: int = 1
) -> Pair:
    """Each half's radiance fitted by its own features; arguments as for :func:`cross_buffer_regression`."""
    return _fits(halves, halves, window, ridge, stride, threads)


def _fits(targets: Halves, by: Halves, window: int, ridge: float, stride: int, threads: int) -> Pair:
    a, b = by[0].denoised, by[1].denoised
    if a is None or b is None:
        raise FrameError("expected a frame with denoised halves, but got none; call frame.denoise(denoiser) first")
    h = bandwidth((a, b))

    def fit(target: Half, by: Half) -> Tensor:
        assert by.denoised is not None  # seen above; tells the type checker
        features = [by.denoised, *by.features.values()]
        fitted = regress(
            features, target.color, window=window, ridge=ridge, bandwidth=h, stride=stride, threads=threads
        )
        return fitted.clamp(min=0)

    return fit(targets[0], by[0]), fit(targets[1], by[1])


class Regression(Stage):
    """Each half fitted by features of its own; the full image is the mean of the cross-buffer fits (Eqs. 10–12).

    A cross-buffer fit knows its witness through the other half's denoised image. The covariance with the witness's
    noise, over its variance, was 0.006 with OIDN and 0.03 with joint-bilateral, as much as the fit's whole error.
    """

    name = "regression"
    on_cpu = True

    def run(self, state: StageImages, work: Work) -> Outcome:
        """Fit at every ``regression_stride``-th pixel."""
        stride, threads = self.settings.regression_stride, torch.get_num_threads()
        halves, back = state.scaled().halves, 1 / state.scale
        a, b = (scale_(image, back) for image in own_buffer_regression(halves, stride=stride, threads=threads))
        crossed = cross_buffer_regression(halves, stride=stride, threads=threads)
        return Outcome(state.then((a, b), scale_(mean(crossed), back)))
