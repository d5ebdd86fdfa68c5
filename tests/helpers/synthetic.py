"""Synthetic frames of which the truth is known, and what holds of every correction of them."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import denoisers
from selfcorrect import Frame, Settings, correct
from selfcorrect.correct import Result
from selfcorrect.metrics import relmse

Array = NDArray[Any]
Pair = tuple[Any, Any]

BALANCED = Settings.preset("balanced", steps=12, patch=32, batch=2, window=9)
SIZE = (48, 64)
MARGIN = 1.01  # of the denoised image's error, that an output may have


def scene(size: tuple[int, int] = SIZE) -> Array:
    """Coloured waves, finer than the box denoiser's window, between 0.12 and 1."""
    y, x = np.mgrid[: size[0], : size[1]]
    waves = 0.6 + 0.4 * np.sin(0.9 * x) * np.cos(0.35 * y)
    return (waves[..., None] * np.array([1.0, 0.8, 0.6])).astype(np.float32)


def noisy(truth: Array, deviation: float = 0.3, seed: int = 0) -> Pair:
    """Two halves with gamma noise of this relative deviation: never negative, and the more skewed the stronger."""
    generator = np.random.default_rng(seed)
    shape = deviation**-2
    return tuple((truth * generator.gamma(shape, 1 / shape, truth.shape)).astype(np.float32) for _ in "ab")


def twice(buffer: Array) -> Pair:
    return buffer, buffer.copy()


def swapped(pair: Pair) -> Pair:
    return pair[1], pair[0]


def boxed(color: Pair, **buffers: Pair) -> Frame:
    """A frame denoised by a 15×15 box: all detail lost, no noise, no light lost."""
    return Frame(color=color, **buffers).denoise(denoisers.create("box"))


def plain(image: Any) -> Array:
    return np.asarray(image.double() if isinstance(image, torch.Tensor) else image, dtype=np.float64)


def corrected(frame: Frame, preset: Settings = BALANCED) -> Result:
    """Correct, and check all that holds whatever the input is."""
    result = correct(frame, preset)
    image = plain(result.image)
    assert image.shape == (*frame.size, 3)
    assert np.isfinite(image).all()
    assert image.min() >= 0
    assert result.estimate is not None
    numbers = (
        getattr(result.estimate, name) for name in ("noisy", "denoised", "corrected", "change", "standard_error")
    )
    assert np.isfinite(list(numbers)).all()
    assert (result.estimate.change < 0) == result.estimate.improved  # what it says and what it did agree
    for name, aov in result.maps.items():
        assert bool(aov.isfinite().all()), name
        assert float(aov.min()) >= 0, name
    assert float(result.maps["blend"].max()) <= 1
    return result


def assert_not_worse(frame: Frame, truth: Array, settings: Settings = BALANCED) -> Result:
    result = corrected(frame, settings)
    assert relmse(plain(result.image), truth) <= MARGIN * relmse(plain(frame.denoised_full), truth)
    return result


def assert_light_kept(result: Result, frame: Frame) -> None:
    """The mean is within four standard errors of the noisy mean, or at least no further from it than the denoised."""
    a, b = (plain(half).mean(-1) for half in frame.color)
    error = np.sqrt(np.mean((a - b) ** 2 / 4) / a.size)
    mean = (a.mean() + b.mean()) / 2
    allowed = max(4 * error, abs(plain(frame.denoised_full).mean() - mean), 1e-6 * mean)
    assert abs(plain(result.image).mean() - mean) <= 1.000001 * allowed
