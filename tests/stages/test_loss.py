"""Gradients of Eq. 8 through the kernel and the network, with saturated heads and extreme radiance, against float64."""

import copy
from dataclasses import replace

import pytest
import torch
from helpers.tolerances import LOSS, LOSS_GRADIENT, LOSS_GRADIENT_UNSCALED
from torch import Tensor

from selfcorrect import Settings
from selfcorrect.image.exposure import LARGEST
from selfcorrect.kernel.guides import Guides
from selfcorrect.stages.core.loss import dual_buffer_loss, witnesses
from selfcorrect.stages.core.network import Network

SIZE, PATCH = (24, 28), (16, 16)
CORNERS = torch.tensor([[0, 0], [8, 10]])


def halves(case: str, value: float, seed: int) -> tuple[Guides, Guides]:
    """Guides with a firefly in one half, a lamp in both, another exposure, or nothing of the kind."""
    generator = torch.Generator().manual_seed(seed)

    def noise() -> Tensor:
        return torch.rand(*SIZE, 3, generator=generator)

    albedo, normal = noise(), noise()
    guides = []
    for half in range(2):
        color, denoised = 1 + noise(), 1 + 0.1 * noise()
        if case == "lamp" or (case == "firefly" and half == 0):
            color[12, 13] = value
        if case == "lamp":
            denoised[12, 13] = value
        if case == "exposure":
            color, denoised = value * color, value * denoised
        buffers = {"color": color, "denoised": denoised, "albedo": albedo, "normal": normal}
        guides.append(Guides.of_half(buffers, margin=10))
    return guides[0], guides[1]


def gradients(
    network: Network, guides: tuple[Guides, Guides], settings: Settings, dtype: torch.dtype
) -> tuple[float, Tensor]:
    """Eq. 8 and its gradient in all parameters: compiled in float32, plain torch in float64."""
    own = copy.deepcopy(network).to(dtype)
    a, b = (replace(half, planes=half.planes.to(dtype)) for half in guides)
    judges = witnesses((a, b), settings)
    patches = [patch for half in (a, b) for patch in half.views(CORNERS, PATCH)]
    loss = dual_buffer_loss(own(patches), CORNERS, (a, b), judges, settings)
    loss.backward()
    return float(loss.detach()), torch.cat([p.grad.flatten() for p in own.parameters() if p.grad is not None])


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    ("preset", "case", "value"),
    [
        ("balanced", "saturated", 30.0),
        ("balanced", "saturated", 300.0),
        ("balanced", "firefly", 1e4),
        ("balanced", "firefly", LARGEST),
        ("balanced", "lamp", 1e4),
        ("balanced", "lamp", LARGEST),
        ("balanced", "exposure", 1e-20),
        ("balanced", "exposure", 1e6),
        ("paper", "saturated", 30.0),
        ("paper", "saturated", 300.0),
        ("paper", "firefly", 1e4),
        ("paper", "lamp", 1e4),
        ("paper", "exposure", 1e-20),
    ],
)
def test_gradients_of_extremes_are_those_of_float64(preset: str, case: str, value: float, seed: int) -> None:
    settings = Settings.preset(preset, window=9, filters=16, layers=3, precision="fp32")
    guides = halves(case, value, seed)
    network = Network.for_guides(guides[0], settings, torch.Generator().manual_seed(seed + 1))
    if case == "saturated":
        with torch.no_grad():
            network.convolutions[-1].weight.mul_(value)
    loss, expected = gradients(network, guides, settings, torch.float64)
    got_loss, got = gradients(network, guides, settings, torch.float32)
    assert got_loss == pytest.approx(loss, rel=LOSS)
    bound = LOSS_GRADIENT_UNSCALED if (preset, case) == ("paper", "firefly") else LOSS_GRADIENT
    largest = float(expected.abs().max())
    assert largest > 0
    assert float((got - expected).abs().max()) <= bound * largest


LIMITED = Settings.preset("balanced")
ANY = Settings.preset("balanced", witness_limit=0.0)


def test_without_a_limit_the_witness_is_what_was_measured() -> None:
    a, b = halves("firefly", 1e4, 0)
    of_a, of_b = witnesses((a, b), ANY)
    assert torch.equal(of_a.radiance, b.radiance)
    assert torch.equal(of_b.radiance, a.radiance)


def test_a_firefly_of_the_witness_does_not_outweigh_the_frame() -> None:
    a, b = halves("firefly", 1e4, 0)  # in half a, which half b's correction is judged by
    there = (slice(None), 12 + a.margin, 13 + a.margin)
    bounded = witnesses((a, b), LIMITED)[1].radiance
    spread = float((b.radiance - b.denoised).square().mean().sqrt())
    assert float(a.radiance[there].max()) == 1e4
    assert float((bounded - a.denoised)[there].abs().max()) < 3 * LIMITED.witness_limit * spread
    ordinary = a.radiance < 10  # all but the firefly and its mirror images
    torch.testing.assert_close(bounded[ordinary], a.radiance[ordinary])


def test_no_pixel_moves_its_own_bound() -> None:
    """What the witness of half b measures at a pixel, half a's radiance there, may not say how far it may lie."""
    a, b = halves("firefly", 1e4, 0)
    brighter, _ = halves("firefly", 1e6, 0)
    assert torch.equal(witnesses((a, b), LIMITED)[1].radiance, witnesses((brighter, b), LIMITED)[1].radiance)
