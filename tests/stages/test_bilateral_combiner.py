"""The combiner with bilateral weights: its equations by hand, the evidence it sees, extremes, borders."""

import pytest
import torch
from helpers.kernel import by_norm, worst
from helpers.tolerances import BILATERAL_EXTREME, BILATERAL_EXTREME_GRADIENT
from helpers.trained import wild
from torch import Tensor

from selfcorrect.image.windows import reflect
from selfcorrect.stages.bilateral_combiner import BilateralCombiner, evidence

SMALL = {"width": 8, "window": 5, "layers": 3}


def images(size: tuple[int, int], *, batch: int = 1, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """y, z (N, 1, 3, H, W) and features (N, 7, H, W)."""
    generator = torch.Generator().manual_seed(seed)
    noisy, denoised = (1 + 0.3 * torch.rand(batch, 1, 3, *size, generator=generator) for _ in "yz")
    return noisy, denoised, torch.rand(batch, 7, *size, generator=generator)


def test_size() -> None:
    network = BilateralCombiner()
    assert sum(parameter.numel() for parameter in network.parameters()) == 14_495
    assert network.reach == 13


@pytest.mark.parametrize("size", [(1, 1), (2, 7), (13, 11)])
def test_the_equations_by_hand(size: tuple[int, int]) -> None:
    noisy, denoised, features = (planes.double() for planes in images(size, batch=2))
    network = wild(BilateralCombiner(**SMALL)).double()
    raw = network.weights(noisy, denoised, features)
    got = network(noisy, denoised, features)
    assert got.shape == (2, 3, *size)
    beta, gamma = raw[:, :9].tanh().unflatten(1, (3, 3)), torch.nn.functional.softplus(raw[:, 9:13])
    tau = torch.nn.functional.softplus(raw[:, 13])
    share = 0.1 + 0.9 * raw[:, 14].sigmoid()
    normal, albedo = features[:, :3], features[:, 3:6]
    rows, columns = (reflect(-2, n + 2, n).tolist() for n in size)
    for n, row, column in {(0, 0, 0), (1, size[0] - 1, size[1] - 1), (1, size[0] // 2, size[1] // 2)}:
        y, z, rho, direction = noisy[n, 0], denoised[n, 0], albedo[n], normal[n]
        total, weight = torch.zeros(3, dtype=torch.float64), torch.zeros((), dtype=torch.float64)
        c = (slice(None), row, column)
        for tap in range(25):
            i = (slice(None), rows[row + tap // 5], columns[column + tap % 5])
            apart = [((f[c] - f[i]) ** 2).sum() for f in (y, z, rho, direction)]
            distances = torch.stack([apart[0].log1p(), apart[1].log1p(), *apart[2:]])
            w = torch.exp(-(distances / (gamma[n, :, row, column] ** 2 + 1e-4)).sum())
            if tap == 12:
                w = tau[n, row, column] + 1e-4
            corrections = torch.stack([z[c] - z[i], rho[c] - rho[i], direction[c] - direction[i]])
            total = total + w * (y[i] + (beta[n, :, :, row, column] * corrections).sum(0))
            weight = weight + w
        expected = z[c] + share[n, row, column] * (total / weight - z[c])
        torch.testing.assert_close(got[n, :, row, column], expected)


def test_an_untrained_one_stays_near_the_denoised_image() -> None:
    noisy, denoised, features = images((40, 40))
    with torch.no_grad():
        got = BilateralCombiner()(noisy, denoised, features)
    assert 0 < float((got - denoised[:, 0]).square().mean()) < 0.25 * float((noisy - denoised).square().mean())


def test_evidence_by_hand() -> None:
    """Of residuals that are all the same: as many standard errors as the root of the pixels, at the border, too."""
    denoised = torch.full((1, 3, 20, 20), 1.95)
    found = evidence(denoised + 0.2, denoised)
    assert found.shape == (1, 8, 20, 20)
    for first, side in ((0, 5), (4, 15)):
        torch.testing.assert_close(
            found[:, first : first + 3], torch.full((1, 3, 20, 20), side / 4.0), rtol=1e-3, atol=0
        )
        torch.testing.assert_close(found[:, first + 3], torch.full((1, 20, 20), 0.1).log() / 2, rtol=1e-3, atol=0)


def test_noise_is_no_evidence_and_a_firefly_is_bounded() -> None:
    noise = torch.randn(1, 3, 200, 200, generator=torch.Generator().manual_seed(0))
    denoised = torch.ones(1, 3, 200, 200)
    errors = 4 * evidence(denoised + 0.1 * noise, denoised)[0, 4:7]
    assert 0.9 < float(errors[:, 8:-8, 8:-8].square().mean().sqrt()) < 1.1
    denoised[..., 100, 100] = 0
    fired = denoised.clone()
    fired[..., 100, 100] = 1e15
    assert evidence(fired, denoised).abs().max() < 20


@pytest.mark.parametrize("extreme", [0.0, 1e6, 1e15])
def test_extremes_give_the_values_and_gradients_of_double_precision(extreme: float) -> None:
    noisy, denoised, features = images((11, 10))
    if extreme:
        noisy[..., 4, 4], denoised[..., 2, 2] = extreme, extreme
    else:
        noisy, denoised, features = (torch.zeros_like(planes) for planes in (noisy, denoised, features))

    def image_and_gradients(kind: torch.dtype) -> list[Tensor]:
        network = BilateralCombiner(**SMALL).to(kind)
        image = network(noisy.to(kind), denoised.to(kind), features.to(kind))
        image.mean().backward()
        return [image, *(parameter.grad for parameter in network.parameters())]

    expected = image_and_gradients(torch.float64)
    image, *gradients = image_and_gradients(torch.float32)
    assert worst(image, expected[0]) <= BILATERAL_EXTREME
    for got, true in zip(gradients, expected[1:], strict=True):
        assert by_norm(got, true) <= BILATERAL_EXTREME_GRADIENT


def test_seeds() -> None:
    before = torch.random.get_rng_state()
    one, same, other = (BilateralCombiner(**SMALL, seed=seed).state_dict() for seed in (1, 1, 2))
    assert all(torch.equal(one[name], same[name]) for name in one)
    assert not torch.equal(one["convolutions.0.weight"], other["convolutions.0.weight"])
    assert torch.equal(before, torch.random.get_rng_state())
