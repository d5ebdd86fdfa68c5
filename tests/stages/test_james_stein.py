"""James–Stein: the published formula by hand, its promise in simulation and on every development frame, extremes."""

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.tolerances import EXACT
from torch import Tensor

import denoisers
from selfcorrect import Frame, exr, metrics
from selfcorrect.errors import FrameError, SettingsError
from selfcorrect.frame import mean
from selfcorrect.image.windows import box_mean, gaussian_mean, reflect, reflected
from selfcorrect.stages.james_stein import SIGMA, WINDOW, james_stein, relative_weight, variance_of_mean

FRAMES = ("bathroom", "classroom", "dining-room", "living-room-2", "staircase")


def noise(size: tuple[int, int], seed: int, sigma: float = 1.0) -> Tensor:
    return sigma * torch.randn(*size, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_blocks_are_15_by_15() -> None:
    assert WINDOW == 15
    assert WINDOW**2 == 225


@pytest.mark.parametrize("size", [1, 2, 3, 7, 40])
def test_border_is_numpy_reflect(size: int) -> None:
    expected = np.pad(np.arange(size), 13, mode="reflect")
    assert reflect(-13, size + 13, size).tolist() == expected.tolist()


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (4, 6), (20, 17)])
def test_window_means(size: tuple[int, int]) -> None:
    planes = noise(size, 0).permute(2, 0, 1)
    windows = reflected(planes, 2).unfold(1, 5, 1).unfold(2, 5, 1)
    torch.testing.assert_close(box_mean(planes, 5), windows.mean((-1, -2)))
    offsets = torch.arange(-3, 4, dtype=torch.float64)
    line = torch.exp(-(offsets**2) / 2)
    weights = line[:, None] * line / line.sum() ** 2
    around = reflected(planes, 3).unfold(1, 7, 1).unfold(2, 7, 1)
    torch.testing.assert_close(gaussian_mean(planes, 1.0), (around * weights).sum((-1, -2)))


@pytest.mark.parametrize("weighted", [False, True])
def test_eq13_by_hand(weighted: bool) -> None:
    """The published formula with plain loops over blocks and pixels; with a weight, every sum carries it."""
    size, window = (6, 7), 5
    x, y, s2 = noise(size, 1), noise(size, 2, 0.3), noise(size, 3).abs()
    q = noise(size, 4).abs()[..., :1] + 0.5 if weighted else None
    got = james_stein(x, y, s2, q, window=window, sigma=0)
    rows, columns = (np.pad(np.arange(n), 4, mode="reflect") for n in size)
    weights = torch.ones(*size, 1, dtype=torch.float64) if q is None else q

    def block(row: int, column: int) -> list[tuple[int, int]]:
        return [(rows[row + i + 4], columns[column + j + 4]) for i in range(-2, 3) for j in range(-2, 3)]

    for row, column, channel in ((0, 0, 0), (3, 3, 1), (5, 6, 2), (2, 6, 0)):
        factors = []
        for c in block(row, column):
            distance = sum(float(weights[i] * (x[i] - y[i])[channel] ** 2) for i in block(*c))
            factors.append(max(0.0, 1 - (25 - 2) * float(weights[c] * s2[c][channel]) / distance))
        at = (row, column, channel)
        assert float(got[at]) == pytest.approx(float(y[at] + np.mean(factors) * (x[at] - y[at])), rel=EXACT, abs=0)


def test_variance_of_the_mean_of_halves() -> None:
    truth = torch.full((100, 100, 3), 5.0, dtype=torch.float64)
    halves = (truth + noise((100, 100), 1, 0.7), truth + noise((100, 100), 2, 0.7))
    assert float(variance_of_mean(halves).mean()) == pytest.approx(0.7**2 / 2, rel=0.03)
    assert float(((mean(halves) - truth) ** 2).mean()) == pytest.approx(0.7**2 / 2, rel=0.02)


@pytest.mark.parametrize("offset", [0.0, 0.3, 1.0, 5.0, 1e3, 1e6])
def test_never_worse_than_the_noise(offset: float) -> None:
    """Stein's promise, for blocks of even noise and any biased image that knows nothing of it."""
    size = (120, 120)
    truth = noise(size, 7)
    biased = truth + offset * noise(size, 8).sign()
    ratios = []
    for seed in range(4):
        error = noise(size, 10 + seed)
        result = james_stein(truth + error, biased, torch.ones_like(truth))
        ratios.append(float(((result - truth) ** 2).mean() / (error**2).mean()))
    assert np.mean(ratios) < 1 + 1e-9
    if offset <= 0.3:
        assert np.mean(ratios) < 0.3


def test_consistent() -> None:
    """Without noise the result is the unbiased image, whatever the biased one is."""
    x = noise((20, 30), 1)
    torch.testing.assert_close(james_stein(x, x + 3, torch.zeros_like(x)), x)
    torch.testing.assert_close(james_stein(x, x, torch.zeros_like(x)), x)
    errors = [
        float((james_stein(x + e, 0 * x, torch.full_like(x, s**2)) - x).abs().mean())
        for s in (1.0, 0.1, 0.01)
        for e in (noise((20, 30), 2, s),)
    ]
    assert errors[0] > 5 * errors[1] > 25 * errors[2]


@pytest.mark.parametrize("size", [(1, 1), (1, 3), (30, 2)])
@pytest.mark.parametrize("extreme", [0.0, 1e20, 3e38])
def test_extremes_stay_finite(size: tuple[int, int], extreme: float) -> None:
    a, b = noise(size, 1).abs().float(), noise(size, 2).abs().float()
    a[0, 0, 0] = extreme
    x = mean((a, b))
    for biased in (torch.zeros_like(x), x, torch.full_like(x, 3e38), -x):
        for weight in (None, relative_weight(x)):
            result = james_stein(x, biased, variance_of_mean((a, b)), weight)
            assert result.isfinite().all()
            assert result.dtype == torch.float32


def test_black_frame() -> None:
    black = torch.zeros(9, 9, 3)
    assert james_stein(black, black, black, relative_weight(black)).eq(0).all()


def test_exposure_changes_nothing() -> None:
    a, b = noise((30, 30), 1).abs(), noise((30, 30), 2).abs()
    x = mean((a, b))
    plain = james_stein(x, x / 2, variance_of_mean((a, b)), relative_weight(x))
    bright = james_stein(1e4 * x, 1e4 * x / 2, variance_of_mean((1e4 * a, 1e4 * b)), relative_weight(1e4 * x))
    torch.testing.assert_close(bright / 1e4, plain)


def test_bad_arguments_are_named() -> None:
    x = torch.zeros(5, 5, 3)
    with pytest.raises(FrameError, match="one shape"):
        james_stein(x, x[:4], x)
    with pytest.raises(SettingsError, match="odd window"):
        james_stein(x, x, x, window=4)
    with pytest.raises(SettingsError, match="sigma"):
        james_stein(x, x, x, sigma=-SIGMA)


@pytest.mark.shared
@pytest.mark.parametrize("spp", [16, 64, 256])
@pytest.mark.parametrize("name", FRAMES)
def test_dominance_on_development_frames(name: str, spp: int, shared: Path) -> None:
    """Below the noisy input's error for a box filter, a constant, an inverted image, another scene, and 10⁶."""

    def color(which: str) -> Tensor:
        return torch.from_numpy(exr.load_half(shared / "frames" / f"{which}.exr").buffers["color"])

    frame = Frame(color=(color(f"{name}_{spp:03d}spp_A"), color(f"{name}_{spp:03d}spp_B")))
    references = [color(f"{name}_ref_{r}") for r in ("A", "B", "smooth")]
    other = color(f"{FRAMES[FRAMES.index(name) - 1]}_ref_smooth").permute(2, 0, 1)[None]
    x = mean(frame.color)
    biased = {
        "box": denoisers.create("box")(x),
        "constant": torch.full_like(x, 0.5),
        "inverted": (1 - x).clamp(min=0),
        "another scene": torch.nn.functional.interpolate(other, frame.size)[0].permute(1, 2, 0),
        "1e6": torch.full_like(x, 1e6),
    }
    noisy = metrics.relmse(x, *references)
    variance, weight = variance_of_mean(frame.color), relative_weight(x)
    for what, y in biased.items():
        ratio = metrics.relmse(james_stein(x, y, variance, weight), *references) / noisy
        assert ratio <= 1 + 1e-6, f"{what}: {ratio}"
        if what == "box":
            assert ratio < 0.8
