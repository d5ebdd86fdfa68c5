"""Windowed first-order regression: validated here, computed by one of the forms beside; the maths is in reference.py.

The compiled form's cost is that of its centres: a model for every pixel is 114 sums over 2,601 pixels at the paper's
window. Every pixel takes the mean of all models around it, so that models at every second or fourth pixel of every
second or fourth row (``stride``) say nearly the same for a fourth or a sixteenth of the time.

There is no form for another device: what lies there comes to the CPU, and the fit goes back.
"""

import math
from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from selfcorrect.errors import FrameError, SettingsError
from selfcorrect.kernel.backend import choose
from selfcorrect.kernel.nlm import Strip
from selfcorrect.kernel.regression import cpu, reference

__all__ = ["regress", "regress_non_local"]

LARGEST_WINDOW = 63
_DTYPES = (torch.float16, torch.float32, torch.float64)


def regress(
    features: list[Tensor],
    targets: Tensor,
    *,
    window: int,
    ridge: float,
    bandwidth: float,
    stride: int = 1,
    threads: int = 1,
    backend: str | None = None,
) -> Tensor:
    """Targets as a first-order function of features, fitted by weighted least squares in every window.

    Each feature group is divided by its largest distance to the centre in the window; the weight of a pixel in the
    window is exp(−‖z_i − z_c‖² / bandwidth) with z the first group; every pixel takes the mean of the models around it
    with the same weights. The border is mirrored without repeating the edge pixel.

    Args:
        features: groups (H, W, 1) or (H, W, 3), those of three first, at most three of them and two of one.
        targets: (H, W, 3).
        window: side of the window in pixels, odd, at most 63.
        ridge: added to the diagonal of the scaled system, whose weights sum to 1; > 0.
        bandwidth: > 0.
        stride: models are solved at every stride-th pixel of every stride-th row, 1 … 16 and at most the window.
        threads: of the compiled form.
        backend: as for :func:`selfcorrect.kernel.backend.choose`; the reference holds the windows of some rows.

    Returns:
        (H, W, 3), float32 from the compiled form.

    Raises:
        FrameError: shapes do not fit.
        SettingsError: a number is out of range, or no such backend for these tensors.
    """
    if window % 2 == 0 or not 1 <= window <= LARGEST_WINDOW:
        raise SettingsError(f"expected an odd window from 1 to {LARGEST_WINDOW}, but got {window}")
    if not 1 <= stride <= min(16, window) or not (ridge > 0 and bandwidth > 0 and math.isfinite(ridge + bandwidth)):
        raise SettingsError(
            f"expected a stride from 1 to 16 and to the window, a ridge > 0 and a bandwidth > 0, "
            f"but got {stride}, {ridge}, {bandwidth}"
        )
    _check_shapes(features, targets)
    there = targets.device
    if backend is None:
        features, targets = [feature.cpu() for feature in features], targets.cpu()
    if choose(backend, [*features, targets], dtypes=_DTYPES) == "reference":
        return reference.regress(features, targets, window=window, ridge=ridge, bandwidth=bandwidth, stride=stride)
    fitted = cpu.regress(
        features, targets, window=window, ridge=ridge, bandwidth=bandwidth, stride=stride, threads=threads
    )
    return fitted.to(there)


def regress_non_local(
    features: list[Tensor],
    targets: Tensor,
    weights: Callable[[], Iterable[Strip]],
    *,
    radius: int,
    ridge: float,
    threads: int = 1,
) -> Tensor:
    """As :func:`regress` with a model at every pixel, but with given weights, those of non-local means.

    Args:
        features: as for :func:`regress`.
        targets: (H, W, 3).
        weights: gives :func:`selfcorrect.kernel.nlm.strips` of this radius; called twice.
        radius: of the window.
        ridge, threads: as for :func:`regress`.
    """
    _check_shapes(features, targets)
    features, targets, there = [feature.cpu() for feature in features], targets.cpu(), targets.device
    if choose(None, [*features, targets], dtypes=_DTYPES) == "reference":
        fitted = reference.regress_non_local(features, targets, weights, radius=radius, ridge=ridge)
    else:
        fitted = cpu.regress_non_local(features, targets, weights, radius=radius, ridge=ridge, threads=threads)
    return fitted.to(there)


def _check_shapes(features: list[Tensor], targets: Tensor) -> None:
    channels = [feature.shape[2] for feature in features]
    vectors, scalars = channels.count(3), channels.count(1)
    known = channels == [3] * vectors + [1] * scalars and vectors <= 3 and scalars <= 2
    fitting = all(feature.shape[:2] == targets.shape[:2] for feature in features)
    if not features or not known or not fitting or targets.shape[2] != 3:
        shapes = ", ".join(str(tuple(image.shape)) for image in (*features, targets))
        raise FrameError(f"expected features (H, W, 3), then (H, W, 1), and targets (H, W, 3), but got {shapes}")
