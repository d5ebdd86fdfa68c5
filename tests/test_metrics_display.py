"""The metrics of images as a display shows them, PSNR, SSIM and ꟻLIP, against plain NumPy or a closed form."""

import math
from pathlib import Path

import flip_evaluator
import numpy as np
import pytest
from helpers.images import SHAPE, radiance
from helpers.tolerances import EXACT, FLIP, FLIP_EXPOSURE, SSIM

from selfcorrect import metrics
from selfcorrect.errors import FrameError


def srgb(x: np.ndarray) -> np.ndarray:
    x = np.clip(x, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def test_tone_map() -> None:
    x = radiance() * 2 - 0.3
    assert x.min() < 0
    assert x.max() > 1
    np.testing.assert_allclose(metrics.tone_map(x).numpy(), srgb(x), rtol=0, atol=EXACT)


def test_psnr_of_a_known_difference() -> None:
    black = np.zeros(SHAPE)
    # 0.001 lies on the linear part of the transfer function, whose slope is 12.92.
    assert metrics.psnr(black + 0.001, black) == pytest.approx(-20 * math.log10(0.01292), rel=EXACT, abs=0)
    assert metrics.psnr(black + 1, black) == pytest.approx(0, abs=EXACT)
    assert metrics.psnr(black + 9, black + 5) == math.inf
    x, r = radiance(0), radiance(1)
    assert metrics.psnr(x, r) == pytest.approx(-10 * math.log10(np.mean((srgb(x) - srgb(r)) ** 2)), rel=EXACT, abs=0)


def test_ssim_against_plain_windows() -> None:
    x, r = radiance(0, (13, 15, 3)), radiance(1, (13, 15, 3))
    taps = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    window = np.outer(taps, taps) / taps.sum() ** 2
    values = []
    for i, j, k in np.ndindex(3, 5, 3):
        p, q = (srgb(each)[i : i + 11, j : j + 11, k] for each in (x, r))
        p_mean, q_mean = (window * p).sum(), (window * q).sum()
        p_var, q_var = (window * (p - p_mean) ** 2).sum(), (window * (q - q_mean) ** 2).sum()
        covariance = (window * (p - p_mean) * (q - q_mean)).sum()
        luminance = (2 * p_mean * q_mean + 1e-4) / (p_mean**2 + q_mean**2 + 1e-4)
        values.append(luminance * (2 * covariance + 9e-4) / (p_var + q_var + 9e-4))
    assert metrics.ssim(x, r) == pytest.approx(np.mean(values), abs=SSIM)
    assert metrics.ssim(x, x) == pytest.approx(1, abs=SSIM)


def test_ssim_needs_a_whole_window() -> None:
    x = radiance(0, (20, 10, 3))
    with pytest.raises(FrameError, match=r"at least 11×11 pixels for SSIM, but got 10×20$"):
        metrics.ssim(x, x)


def test_flip() -> None:
    r = radiance()
    assert metrics.flip(r, r) == 0
    assert metrics.flip(r - 0.2, np.maximum(r - 0.2, 0)) == 0
    slightly, much, black = (metrics.flip(r * factor, r) for factor in (0.9, 0.5, 0.0))
    assert 0 < slightly < much < black <= 1
    # The exposures follow the reference: another unit of radiance changes nothing, another order does.
    assert metrics.flip(r * 50, r * 100) == pytest.approx(much, rel=FLIP_EXPOSURE)
    assert metrics.flip(r, r * 0.5) != pytest.approx(much, rel=1e-2)
    error, _, _ = flip_evaluator.evaluate(r.astype("f4"), (r * 0.5).astype("f4"), "HDR", applyMagma=False)
    assert much == pytest.approx(error.mean(dtype=np.float64), rel=FLIP)


def test_flip_is_silent_and_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    metrics.flip(radiance(0), radiance(1))
    assert capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("brightest", [0.0, 1e-7, 9e-7])
def test_flip_refuses_a_black_reference(brightest: float) -> None:
    r = np.full(SHAPE, brightest)
    with pytest.raises(FrameError, match="expected a reference brighter than 1e-6 for FLIP, but got at most"):
        metrics.flip(radiance(), r)


def test_flip_of_the_darkest_reference_and_of_the_largest_values() -> None:
    r = radiance(0, (12, 12, 3))
    assert 0 < metrics.flip(0.5 * np.full(SHAPE, 1.1e-6), np.full(SHAPE, 1.1e-6)) <= 1
    firefly = r.copy()
    firefly[3, 4] = 1e300
    assert 0 < metrics.flip(firefly, r) < 0.1
    assert metrics.flip(r, firefly) > 0
