"""From the halves to the full buffer: what a denoiser gains from both is kept, and its noise is not."""

import pytest
import torch
from torch import Tensor

from selfcorrect.stages.core.transfer import gained_by_both

SIZE = (64, 48)


def noise(seed: int, sigma: float = 0.1) -> Tensor:
    return sigma * torch.randn(*SIZE, 3, generator=torch.Generator().manual_seed(seed))


def test_a_linear_denoiser_gains_nothing_beyond_the_mean() -> None:
    a, b = 1 + noise(1), 1 + noise(2)
    assert gained_by_both((a, b), (a + b) / 2).max() < 1e-10


def test_bias_that_both_halves_share_is_gained() -> None:
    a, b = 1.5 + noise(1), 1.5 + noise(2)
    assert gained_by_both((a, b), torch.ones(*SIZE, 3)).eq(1).all()


def test_only_where_it_is() -> None:
    a, b = 1 + noise(1), 1 + noise(2)
    full = (a + b) / 2
    full[:32] -= 0.5
    gained = gained_by_both((a, b), full)
    assert gained.shape == (1, 4, 3)
    assert gained[:, :2].eq(1).all()
    assert gained[:, 2:].max() < 1e-10


@pytest.mark.parametrize("share", [0.25, 0.5])
def test_it_is_the_share_of_the_noise(share: float) -> None:
    a, b = 1 + noise(1), 1 + noise(2)
    full = (a + b) / 2 + noise(3, 0.1 * (share / 2) ** 0.5)
    assert float(gained_by_both((a, b), full).mean()) == pytest.approx(share, rel=0.1)


def test_halves_that_are_alike_and_black_give_numbers() -> None:
    black = torch.zeros(*SIZE, 3)
    assert gained_by_both((black, black), black).eq(0).all()
    assert gained_by_both((black, black), black + 1).eq(1).all()
