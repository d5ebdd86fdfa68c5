"""What speaks against two halves is found and said."""

import pytest
import torch
import torch.nn.functional as F

import denoisers
from selfcorrect import Frame, Settings, correct
from selfcorrect.independence import dependence, doubts, neighbour_correlation


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


def lit() -> torch.Tensor:
    """A smooth picture with an edge, mean near 1."""
    y, x = torch.meshgrid(torch.arange(128), torch.arange(160), indexing="ij")
    shade = 0.6 + 0.4 * torch.sin(x / 25) * torch.cos(y / 31) + 0.5 * (x + 2 * y > 220)
    return shade[..., None] * torch.tensor([1.0, 0.8, 0.6])


def rendered(seed: int) -> torch.Tensor:
    """Gamma noise, heavy-tailed, as few samples leave it."""
    noise = torch.distributions.Gamma(torch.tensor(2.0), torch.tensor(2.0))
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return lit() * noise.sample((128, 160, 3))


def sharing(share: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Halves whose noise correlates by ``share``, each the mean of samples of which so many are common."""
    common, own_a, own_b = rendered(1), rendered(2), rendered(3)
    a, b = (lit() + share**0.5 * (common - lit()) + (1 - share) ** 0.5 * (own - lit()) for own in (own_a, own_b))
    return a.clamp(min=0), b.clamp(min=0)


@pytest.mark.parametrize("share", [0.3, 0.5, 0.75, 0.9, 0.99])
def test_shared_noise_is_measured_and_warned_of(share: float) -> None:
    halves = sharing(share)
    found = dependence(*halves)
    assert found.share == pytest.approx(share, abs=0.12)
    assert found.noisy
    (doubt,) = doubts(Frame(color=halves))
    assert "of their noise" in doubt
    assert "another seed" in doubt


@pytest.mark.parametrize("difference", [1e-6, 1e-3, 0.03])
def test_a_half_with_a_little_noise_of_its_own_is_no_second_half(difference: float) -> None:
    a = rendered(1)
    b = a * (1 + difference * torch.randn(a.shape, generator=torch.Generator().manual_seed(4)))
    assert dependence(a, b).share > 0.9
    assert dependence(a, b).noisy


def test_one_differing_pixel_makes_no_second_half() -> None:
    a = rendered(1)
    b = a.clone()
    b[60, 70] += 1
    assert dependence(a, b).noisy


@pytest.mark.parametrize("factor", [1e-30, 1.0, 1e30])
def test_exposure_does_not_matter(factor: float) -> None:
    assert dependence(*(half * factor for half in sharing(0.5))).noisy
    assert not dependence(*(half * factor for half in sharing(0.0))).noisy


@pytest.mark.parametrize("deviation", [0.0, 1e-6, 1e-3, 0.03, 0.3])
@pytest.mark.parametrize("half_floats", [False, True])
def test_a_frame_with_little_noise_raises_no_doubt(deviation: float, half_floats: bool) -> None:
    draws = (torch.randn(lit().shape, generator=torch.Generator().manual_seed(seed)) for seed in (1, 2))
    a, b = (lit() * (1 + deviation * draw) for draw in draws)
    if half_floats:
        a, b = a.half().float(), b.half().float()
    assert doubts(Frame(color=(a, b))) == []


@pytest.mark.parametrize("share", [0.5, 0.9, 1.0])
def test_halves_that_share_their_noise_give_the_denoised_image_and_no_claim(share: float) -> None:
    frame = Frame(color=sharing(share)).denoise(denoisers.create("box"))
    result = correct(frame)
    assert torch.equal(result.image, frame.denoised_full)
    assert result.estimate is not None
    assert not result.estimate.improved
    assert not result.estimate.independent
    assert (result.estimate.change, result.network, result.losses) == (0.0, None, [])
    assert "another seed" in str(result.estimate)
    assert all(aov.eq(0).all() for aov in result.maps.values())


def test_the_published_method_is_left_as_it_is() -> None:
    """Without the guard nothing is claimed, and nothing kept."""
    halves = sharing(1.0)
    frame = Frame(color=tuple(half[:32, :32] for half in halves)).denoise(denoisers.create("box"))
    result = correct(frame, Settings.preset("paper", epochs=1, patch=32, stride=32, window=3))
    assert result.estimate is None
    assert result.losses
