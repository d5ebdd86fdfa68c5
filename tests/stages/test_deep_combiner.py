"""The combiner's size, its equations by hand, what it does without weights, extremes and half precision."""

import pytest
import torch
from helpers.kernel import by_norm, worst
from helpers.tolerances import COMBINER_EXTREME, COMBINER_EXTREME_BF16, COMBINER_EXTREME_BF16_GRADIENT, near
from torch import Tensor

from selfcorrect.image.windows import reflect, reflected
from selfcorrect.stages.deep_combiner import DeepCombiner, combined

SMALL = {"width": 8, "window": 5, "layers": 3, "kernel": 3}


def images(size: tuple[int, int], buffers: int = 1, *, batch: int = 1, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """y, z (N, B, 3, H, W) and features (N, 7, H, W)."""
    generator = torch.Generator().manual_seed(seed)
    noisy, denoised = (1 + 0.3 * torch.randn(batch, buffers, 3, *size, generator=generator) for _ in "yz")
    return noisy, denoised, torch.rand(batch, 7, *size, generator=generator)


@pytest.mark.parametrize(("buffers", "count"), [(1, 1_595_725), (4, 3_328_900)])
def test_published_size(buffers: int, count: int) -> None:
    """1.59 M and 3.3 M in the paper; its extra output a pixel makes 1,598,226 of the first."""
    network = DeepCombiner(buffers)
    assert sum(parameter.numel() for parameter in network.parameters()) == count
    assert int(count / 1e4) / 100 == {1: 1.59, 4: 3.32}[buffers]
    first, *_, last = network.convolutions
    assert tuple(first.weight.shape) == (100, 6 * buffers + 7, 5, 5)
    assert tuple(last.weight.shape) == (225 * buffers, 100, 5, 5)
    assert len(network.convolutions) == 6
    assert network.reach == 12


def test_a_narrower_one() -> None:
    network = DeepCombiner(width=32, kernel=3)
    assert sum(parameter.numel() for parameter in network.parameters()) == 105_793
    assert network.reach == 6


@pytest.mark.parametrize("size", [(1, 1), (2, 7), (13, 11)])
@pytest.mark.parametrize(("buffers", "anchored"), [(1, 0), (4, 0), (1, 1), (4, 1), (1, 25)])
def test_eq_14_by_hand(size: tuple[int, int], buffers: int, anchored: int) -> None:
    """Eq. 8 is Eq. 14 with one buffer: window² weights, y_i − z_i + z_c under each, one sum of weights.

    An anchor is a weight more, with z_c under it.
    """
    noisy, denoised, features = (planes.double() for planes in images(size, buffers))
    network = DeepCombiner(buffers, **SMALL, anchored=anchored).double()
    weights = network.weights(noisy, denoised, features)
    got = network(noisy, denoised, features)
    assert got.shape == (1, 3, *size)
    rows, columns = (reflect(-2, n + 2, n).tolist() for n in size)
    for row, column in {(0, 0), (size[0] - 1, size[1] - 1), (size[0] // 2, size[1] // 2)}:
        total, weight = torch.zeros(3, dtype=torch.float64), 0.0
        for b in range(buffers):
            for tap in range(25):
                i = (rows[row + tap // 5], columns[column + tap % 5])
                w = weights[0, b, tap, row, column]
                moved = noisy[0, b, :, i[0], i[1]] - denoised[0, b, :, i[0], i[1]]
                total, weight = total + w * (moved + denoised[0, b, :, row, column]), weight + w
            if anchored:
                w = weights[0, b, 25, row, column]
                total, weight = total + w * denoised[0, b, :, row, column], weight + w
        torch.testing.assert_close(got[0, :, row, column], total / weight)


def test_it_is_linear_for_given_weights() -> None:
    noisy, denoised, features = images((9, 9))
    weights = DeepCombiner(**SMALL).weights(noisy, denoised, features)
    one, twice = (combined(weights, reflected(f * (noisy - denoised), 2), f * denoised, 5) for f in (1.0, 2.0))
    torch.testing.assert_close(2 * one, twice)


@pytest.mark.parametrize("buffers", [1, 4])
def test_without_weights_the_denoised_image_comes_back(buffers: int) -> None:
    noisy, denoised, _ = images((6, 7), buffers)
    weights = torch.zeros(1, buffers, 25, 6, 7)
    torch.testing.assert_close(combined(weights, reflected(noisy - denoised, 2), denoised, 5), denoised.mean(1))


def test_four_buffers_reject_an_outlier() -> None:
    """Where one buffer has no weight, nothing of it is seen: its radiance does not enter the common sum either."""
    noisy, denoised, _ = images((6, 7), 4)
    weights = torch.ones(1, 4, 25, 6, 7)
    weights[:, 2] = 0
    expected = combined(weights, reflected(noisy - denoised, 2), denoised, 5)
    noisy[:, 2], denoised[:, 2] = 50.0, 30.0
    got = combined(weights, reflected(noisy - denoised, 2), denoised, 5)
    torch.testing.assert_close(got, expected, **near("combiner and outlier"))


def test_a_scaled_one_starts_at_the_denoised_image() -> None:
    """The weights of the image as it is and of the centre start as the others' sum has it, from small outputs."""
    noisy, denoised, features = images((40, 40))
    network = DeepCombiner(**SMALL | {"width": 32}, anchored=25)
    with torch.no_grad():
        mean = network.weights(noisy, denoised, features)[0, 0].mean((1, 2))
        got = network(noisy, denoised, features)
    assert 3 < mean[25] / 25 < 5
    assert 0 < mean[12] / 25 < 0.2
    assert float((got - denoised[:, 0]).square().mean()) < 0.01 * float((noisy - denoised).square().mean())


def test_an_untrained_one_adds_the_local_mean_residual() -> None:
    noisy, denoised, features = images((40, 40))
    with torch.no_grad():
        got = DeepCombiner(**SMALL | {"width": 32})(noisy, denoised, features)
    flat = combined(torch.ones(1, 1, 25, 40, 40), reflected(noisy - denoised, 2), denoised, 5)
    assert float((got - flat).square().mean()) < 0.05 * float((got - denoised[:, 0]).square().mean())


@pytest.mark.parametrize("extreme", [0.0, 1e6, 1e15])
@pytest.mark.parametrize("buffers", [1, 4])
def test_extremes_give_the_values_and_gradients_of_double_precision(buffers: int, extreme: float) -> None:
    noisy, denoised, features = images((11, 10), buffers)
    if extreme:
        noisy[..., 4, 4], denoised[..., 2, 2] = extreme, extreme
    else:
        noisy, denoised, features = (torch.zeros_like(planes) for planes in (noisy, denoised, features))

    def image_and_gradients(kind: torch.dtype, *, autocast: bool = False) -> list[Tensor]:
        network = DeepCombiner(buffers, **SMALL).to(kind)
        inputs = [planes.to(kind, copy=True).requires_grad_() for planes in (noisy, denoised)]
        with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
            image = network(*inputs, features.to(kind))
        image.mean().backward()
        return [image, *(leaf.grad for leaf in (*network.parameters(), *inputs))]

    expected = image_and_gradients(torch.float64)
    for got, true in zip(image_and_gradients(torch.float32), expected, strict=True):
        assert worst(got, true) <= COMBINER_EXTREME
    image, *gradients = image_and_gradients(torch.float32, autocast=True)
    assert by_norm(image, expected[0]) <= COMBINER_EXTREME_BF16
    for got, true in zip(gradients, expected[1:], strict=True):
        assert by_norm(got, true) <= COMBINER_EXTREME_BF16_GRADIENT


def test_half_precision_is_near() -> None:
    noisy, denoised, features = images((30, 31), batch=2)
    network = DeepCombiner(width=32, kernel=3).to(memory_format=torch.channels_last)
    single = network(noisy, denoised, features)
    with torch.autocast("cpu", torch.bfloat16):
        half = network(noisy, denoised, features)
    assert half.dtype == torch.float32
    torch.testing.assert_close(half, single, **near("combiner in bfloat16"))


def test_seeds() -> None:
    before = torch.random.get_rng_state()
    one, same, other = (DeepCombiner(**SMALL, seed=seed).state_dict() for seed in (1, 1, 2))
    assert all(torch.equal(one[name], same[name]) for name in one)
    assert not torch.equal(one["convolutions.0.weight"], other["convolutions.0.weight"])
    assert torch.equal(before, torch.random.get_rng_state())
