"""The network's published size, the blend against the classical variant, extremes, half precision, and the loss."""

import pytest
import torch
from helpers.kernel import by_norm, worst
from helpers.tolerances import BLEND_EXTREME, BLEND_EXTREME_BF16, BLEND_EXTREME_BF16_GRADIENT, near
from torch import Tensor

from selfcorrect.image.windows import box_mean
from selfcorrect.stages.james_stein import WINDOW, james_stein, relative_weight
from selfcorrect.stages.neural_james_stein import ALIGNMENT, VarianceNetwork, neural_blend, tau_loss


def images(size: tuple[int, int], seed: int = 0, *, batch: int = 1) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """x, its variance, and two biased images, (N, 3, H, W) of a mean near 1."""
    generator = torch.Generator().manual_seed(seed)
    shape = (batch, 3, *size)
    truth = 1 + 0.5 * torch.rand(shape, generator=generator)
    halves = [(truth * (1 + 0.4 * torch.randn(shape, generator=generator))).clamp(min=0) for _ in "ab"]
    biased = [truth + 0.1 * torch.randn(shape, generator=generator) for _ in "ab"]
    return (halves[0] + halves[1]) / 2, ((halves[0] - halves[1]) / 2) ** 2, biased[0], biased[1]


def test_published_size() -> None:
    network = VarianceNetwork()
    assert sum(parameter.numel() for parameter in network.parameters()) == 539_426
    shapes = [tuple(p.shape[:2]) for name, p in network.named_parameters() if name.endswith("weight")]
    assert shapes[:4] == [(32, 12), (32, 32), (64, 32), (64, 64)]
    assert (226, 32) in shapes


def test_seeds() -> None:
    before = torch.random.get_rng_state()
    one, same, other = (VarianceNetwork(seed).state_dict() for seed in (1, 1, 2))
    assert all(torch.equal(one[name], same[name]) for name in one)
    assert not torch.equal(one["last.weight"], other["last.weight"])
    assert torch.equal(before, torch.random.get_rng_state()), "the caller's random numbers are left alone"


@pytest.mark.parametrize("size", [(1, 1), (2, 9), (13, 18), (ALIGNMENT * 5, ALIGNMENT * 4)])
def test_any_size(size: tuple[int, int]) -> None:
    given = images(size, batch=2)
    weights, alpha = VarianceNetwork()(*given)
    assert weights.shape == (2, WINDOW**2, *size)
    assert alpha.shape == (2, 1, *size)
    assert weights.min() >= 1e-4
    assert 0 <= alpha.min() <= alpha.max() <= 1
    assert neural_blend(weights, alpha, *given).shape == given[0].shape


def test_border_that_is_added_is_mirrored() -> None:
    """A size that four does not divide gives what its mirror image, completed by hand, gives."""
    given = images((14, 19), seed=3)
    by_hand = [torch.cat([planes, planes[..., [-2, -3], :]], -2) for planes in given]
    by_hand = [torch.cat([planes, planes[..., [-2]]], -1) for planes in by_hand]
    network = VarianceNetwork()
    for one, other in zip(network(*given), network(*by_hand), strict=True):
        torch.testing.assert_close(one, other[..., :14, :19])


@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("size", [(1, 1), (9, 20), (33, 26)])
def test_equal_weights_are_the_classical_variant(size: tuple[int, int], relative: bool) -> None:
    x, variance, y_a, y_b = (planes.double() for planes in images(size, seed=1, batch=2))
    weights = torch.full((2, WINDOW**2, *size), 0.7, dtype=torch.float64)
    alpha = torch.full((2, 1, *size), 0.5, dtype=torch.float64)
    got = neural_blend(weights, alpha, x, variance, y_a, y_b, relative=relative)
    for n in range(2):
        noisy, biased = x[n].permute(1, 2, 0), ((y_a + y_b) / 2)[n].permute(1, 2, 0)
        q = relative_weight(noisy) if relative else torch.ones(*size, 1, dtype=torch.float64)
        smoothed = box_mean((q * variance[n].permute(1, 2, 0)).permute(2, 0, 1), WINDOW).permute(1, 2, 0) / q
        expected = james_stein(noisy, biased, smoothed, q, sigma=0)
        torch.testing.assert_close(got[n].permute(1, 2, 0), expected)


def test_an_untrained_network_is_nearly_the_classical_variant() -> None:
    x, variance, y_a, y_b = images((48, 48), seed=2)
    with torch.no_grad():
        weights, alpha = VarianceNetwork()(x, variance, y_a, y_b)
    got = neural_blend(weights, alpha, x, variance, y_a, y_b)
    flat = neural_blend(torch.ones_like(weights), torch.full_like(alpha, 0.5), x, variance, y_a, y_b)
    assert float((got - flat).abs().mean()) < 0.02 * float((got - x).abs().mean())


def test_each_image_of_a_batch_is_on_its_own() -> None:
    given = images((16, 16), batch=2)
    given[0][1] *= 1e4  # its level must not become that of the other
    network = VarianceNetwork()
    both = neural_blend(*network(*given), *given)
    first = [planes[:1] for planes in given]
    torch.testing.assert_close(both[:1], neural_blend(*network(*first), *first), **near("neural blend in batches"))


@pytest.mark.parametrize("offset", [0.0, 1.0, 1e3])
def test_dominance_whatever_the_network_says(offset: float) -> None:
    """Weights and α of chance, even noise, and a biased image that knows nothing of it: never worse than the noise."""
    generator = torch.Generator().manual_seed(0)
    size = (64, 64)
    truth = 2 + torch.rand(4, 3, *size, generator=generator)
    error = torch.randn(4, 3, *size, generator=generator)
    biased = truth + offset * torch.randn(4, 3, *size, generator=generator).sign()
    weights = torch.rand(4, WINDOW**2, *size, generator=generator) ** 4 + 1e-4
    alpha = torch.rand(4, 1, *size, generator=generator)
    theta = neural_blend(weights, alpha, truth + error, torch.ones_like(truth), biased, truth - offset, relative=False)
    assert float(((theta - truth) ** 2).mean() / (error**2).mean()) < 1 + 1e-6


EXTREMES = {
    "black": 0.0,
    "firefly": 1e6,
    "the largest that comes in": 1e15,
}


@pytest.mark.parametrize("what", EXTREMES)
def test_extremes_give_the_values_and_gradients_of_double_precision(what: str) -> None:
    if what == "black":
        x = torch.zeros(1, 3, 20, 21)
        given = [x, x, x, x]
    else:
        x, variance, y_a, y_b = images((20, 21))
        x[..., 5, 5], variance[..., 5, 5] = EXTREMES[what], EXTREMES[what] ** 2 / 4
        y_a[..., 7, 7] = EXTREMES[what]
        given = [x, variance, y_a, y_b]

    def image_and_gradients(kind: torch.dtype, *, autocast: bool = False) -> list[Tensor]:
        network = VarianceNetwork().to(kind)
        inputs = [planes.to(kind, copy=True).requires_grad_() for planes in given]
        with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
            weights, alpha = network(*inputs)
        theta = neural_blend(weights, alpha, *inputs)
        tau_loss(theta, torch.ones_like(theta)).backward()
        return [theta, *(leaf.grad for leaf in (*network.parameters(), *inputs))]

    expected = image_and_gradients(torch.float64)
    for got, true in zip(image_and_gradients(torch.float32), expected, strict=True):
        assert worst(got, true) <= BLEND_EXTREME
    image, *gradients = image_and_gradients(torch.float32, autocast=True)
    assert by_norm(image, expected[0]) <= BLEND_EXTREME_BF16
    for got, true in zip(gradients, expected[1:], strict=True):
        assert by_norm(got, true) <= BLEND_EXTREME_BF16_GRADIENT


def test_gradients() -> None:
    """Of Eqs. 6 and 13 and the loss, in double precision; a fixed relative weight stands outside."""
    given = [planes.double() for planes in images((3, 4), seed=5)]
    generator = torch.Generator().manual_seed(1)
    weights = (torch.rand(1, WINDOW**2, 3, 4, generator=generator, dtype=torch.float64) + 0.1).requires_grad_()
    alpha = torch.rand(1, 1, 3, 4, generator=generator, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda w, a: tau_loss(neural_blend(w, a, *given), given[2]), (weights, alpha), fast_mode=True
    )


def test_half_precision_is_near() -> None:
    given = images((40, 40), seed=4)
    network = VarianceNetwork().to(memory_format=torch.channels_last)
    weights, alpha = network(*given)
    with torch.autocast("cpu", torch.bfloat16):
        half, half_alpha = network(*given)
    assert half.dtype == torch.bfloat16
    torch.testing.assert_close(half.float(), weights, rtol=0.04, atol=0.016)
    single, rounded = neural_blend(weights, alpha, *given), neural_blend(half, half_alpha, *given)
    torch.testing.assert_close(rounded, single, **near("neural blend in bfloat16"))


def test_loss() -> None:
    theta, target = torch.tensor([[[[3.0]]]]), torch.tensor([[[[-1.0]]]])
    by_hand = (torch.log(torch.tensor(4.0)) + torch.log(torch.tensor(2.0))) ** 2
    by_hand /= torch.log(torch.tensor(2.0)) ** 2 + 0.01
    torch.testing.assert_close(tau_loss(theta, target), by_hand)


def test_with_a_level_a_noisy_target_is_as_good_as_a_clean_one() -> None:
    """The best constant for noisy targets: with a level their mean, by the published formula something darker."""
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(1, 1, 500, 500, generator=generator).log().neg()  # exponential, mean 1
    level = torch.full_like(target, 1.3)

    def best(level: Tensor | None) -> float:
        theta = torch.linspace(0, 2, 201)
        losses = [tau_loss(value.expand_as(target), target, level) for value in theta]
        return float(theta[torch.stack(losses).argmin()])

    assert best(level) == pytest.approx(float(target.mean()), abs=0.009)
    assert best(None) < 0.7
