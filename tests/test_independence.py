"""What speaks against two halves is found and said."""

import pytest
import torch
import torch.nn.functional as F

from selfcorrect import Frame
from selfcorrect.independence import doubts, neighbour_correlation


def noisy(seed: int, filter_sigma: float = 0.0) -> torch.Tensor:
    """Heavy-tailed noise, as a pixel filter of that width leaves it."""
    generator = torch.Generator().manual_seed(seed)
    image = torch.randn(3, 1, 100, 120, generator=generator).exp() ** 2
    if filter_sigma:
        offsets = torch.arange(-3, 4)
        line = torch.exp(-(offsets**2) / (2 * filter_sigma**2))
        line = line / line.sum()
        image = F.conv2d(image, (line[:, None] * line)[None, None], padding=3)
    return image[:, 0].permute(1, 2, 0)


def test_independent_halves_raise_no_doubt() -> None:
    assert doubts(Frame(color=(noisy(1), noisy(2)))) == []


@pytest.mark.parametrize("sigma", [0.5, 1.0])
def test_a_wide_pixel_filter_is_found(sigma: float) -> None:
    assert neighbour_correlation(noisy(1, sigma), noisy(2, sigma)) > 0.25
    assert "box pixel filter" in doubts(Frame(color=(noisy(1, sigma), noisy(2, sigma))))[0]


def test_identical_halves_are_found() -> None:
    assert "identical" in doubts(Frame(color=(noisy(1), noisy(1))))[0]


def test_a_constant_frame_raises_no_doubt() -> None:
    assert doubts(Frame(color=(torch.zeros(80, 80, 3), torch.zeros(80, 80, 3)))) == []


def test_small_frames_raise_no_doubt_by_chance() -> None:
    assert doubts(Frame(color=(noisy(1)[:5, :5], noisy(2)[:5, :5]))) == []
