"""Cross-buffer regression: the published numbers, its gain, and which half a fit is independent of."""

import pytest
import torch
from helpers.tolerances import near
from torch import Tensor

import denoisers
from selfcorrect.errors import FrameError
from selfcorrect.frame import Frame, Half
from selfcorrect.kernel.regression import reference as regression_reference
from selfcorrect.stages import regression
from selfcorrect.stages.regression import bandwidth, cross_buffer_regression, own_buffer_regression

SIZE = (72, 80)


def scene() -> tuple[Tensor, dict[str, Tensor]]:
    """Textured radiance, and the G-buffers it comes from."""
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float32) for n in SIZE), indexing="ij")
    albedo = (0.5 + 0.3 * torch.sin(x / 3) * torch.sin(y / 5))[..., None].expand(*SIZE, 3).contiguous()
    normal = torch.stack([torch.sin(x / 20), torch.cos(y / 17), torch.ones(SIZE)], -1)
    depth = (x / SIZE[1])[..., None]
    return albedo * (1 + 0.5 * torch.sin((x + 2 * y) / 11))[..., None], {
        "albedo": albedo,
        "normal": normal,
        "depth": depth,
    }


def noise(seed: int, sigma: float = 0.3) -> Tensor:
    return sigma * torch.randn(*SIZE, 3, generator=torch.Generator().manual_seed(seed))


def halves_of(errors: tuple[Tensor, Tensor], denoiser: str) -> tuple[Half, Half]:
    truth, features = scene()
    frame = Frame(
        color=(truth + errors[0], truth + errors[1]), **{name: (f, f.clone()) for name, f in features.items()}
    )
    return frame.denoise(denoisers.create(denoiser, threads=1), full=False).halves


def test_published_numbers() -> None:
    assert regression.WINDOW == 51
    assert regression.STRIDE == 1
    a, b = torch.full((2, 2, 3), 1.0), torch.full((2, 2, 3), 1.2)
    assert bandwidth((a, b)) == pytest.approx(2 * 0.2**2 / 2 + 0.01)
    assert bandwidth((a, a)) == 0.01


def test_twelve_coefficients() -> None:
    """Denoised 3, albedo 3, normal 3, depth 1, visibility 1, and the constant."""
    halves = [half._replace(visibility=half.depth.flip(0)) for half in halves_of((noise(1), noise(2)), "box")]
    got = cross_buffer_regression((halves[0], halves[1]), window=7)
    by = halves[1]
    features = [f.double() for f in (by.denoised, by.albedo, by.normal, by.depth, by.visibility)]
    assert sum(f.shape[2] for f in features) + 1 == 12
    h = bandwidth((halves[0].denoised, halves[1].denoised))
    expected = regression_reference.regress(
        features, halves[0].color.double(), window=7, ridge=regression.RIDGE, bandwidth=h
    )
    torch.testing.assert_close(got[0].double(), expected.clamp(min=0), **near("regression by hand"))


def test_texture_that_the_denoiser_lost_comes_back() -> None:
    truth, _ = scene()
    halves = halves_of((noise(1), noise(2)), "box")
    fitted = cross_buffer_regression(halves, stride=2)
    before, after = (float(((x - truth) ** 2).mean()) for x in (halves[0].denoised, fitted[0]))
    assert after < 0.15 * before


@pytest.mark.parametrize(
    ("denoiser", "of_target", "of_features"), [("box", 0.013, 0.000), ("joint-bilateral", 0.023, 0.030)]
)
def test_what_a_fit_knows_of_each_half(denoiser: str, of_target: float, of_features: float) -> None:
    """Covariance with each half's noise over its variance: why halves that have a witness are fitted by their own."""
    truth, _ = scene()
    crossed, own = torch.zeros(2), torch.zeros(2)
    rounds = 4
    for seed in range(rounds):
        errors = (noise(2 * seed), noise(2 * seed + 1))
        halves = halves_of(errors, denoiser)
        for sums, fits in (
            (crossed, cross_buffer_regression(halves, stride=2)),
            (own, own_buffer_regression(halves, stride=2)),
        ):
            for fit, target, other in zip(fits, errors, errors[::-1], strict=True):
                shares = [float(((fit - truth) * error).mean() / error.var()) for error in (target, other)]
                sums.add_(torch.tensor(shares) / (2 * rounds))
    assert float(crossed[0]) == pytest.approx(of_target, abs=0.005)
    assert float(crossed[1]) == pytest.approx(of_features, abs=0.01)
    assert abs(float(own[1])) < 0.0015  # of chance: 12 numbers are fitted to thousands
    assert float(own[0]) > float(crossed[0]) + 0.001


def test_needs_denoised_halves() -> None:
    a, b = halves_of((noise(1), noise(2)), "box")
    with pytest.raises(FrameError, match="denoised halves"):
        cross_buffer_regression((a._replace(denoised=None), b))
