"""Sums over windows with a weight for every pixel and tap: against gathering, in values and in every gradient."""

import pytest
import torch
from torch import Tensor

from selfcorrect.stages.taps import windowed_sum, windowed_sum_reference


def draw(size: tuple[int, int], window: int, dtype: torch.dtype, *, innermost: bool) -> tuple[Tensor, ...]:
    """Weights, with the taps innermost in memory as the networks give them or not, padded values, and gradients."""
    generator = torch.Generator().manual_seed(0)
    height, width = size

    def normal(*shape: int) -> Tensor:
        return torch.randn(2, *shape, generator=generator, dtype=torch.float64)

    weights = normal(window**2, height, width).to(dtype)
    if innermost:
        weights = weights.contiguous(memory_format=torch.channels_last)
    kind = torch.float64 if dtype == torch.float64 else torch.float32
    others = normal(3, height + window - 1, width + window - 1), normal(3, *size), normal(1, *size)
    return weights, *(other.to(kind) for other in others)


def with_gradients(function: object, weights: Tensor, values: Tensor, upstream: tuple[Tensor, Tensor]) -> list[Tensor]:
    inputs = [weights.detach().clone().requires_grad_(), values.detach().clone().requires_grad_()]
    outputs = function(*inputs)
    return [*outputs, *torch.autograd.grad(outputs, inputs, upstream)]


@pytest.mark.parametrize("innermost", [False, True])
@pytest.mark.parametrize("window", [1, 3, 15])
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (17, 5), (33, 31)])
def test_values_and_gradients(size: tuple[int, int], window: int, innermost: bool) -> None:
    weights, values, *upstream = draw(size, window, torch.float32, innermost=innermost)
    got = with_gradients(lambda w, v: windowed_sum(w, v, window), weights, values, tuple(upstream))
    double = [tensor.double() for tensor in (weights, values, *upstream)]
    expected = with_gradients(lambda w, v: windowed_sum_reference(w, v, window), *double[:2], tuple(double[2:]))
    for one, other in zip(got, expected, strict=True):
        assert one.dtype == torch.float32
        torch.testing.assert_close(one.double(), other, rtol=1e-5, atol=1e-5)


def test_half_weights_are_summed_in_single_precision() -> None:
    weights, values, *upstream = draw((12, 13), 15, torch.bfloat16, innermost=True)
    got = with_gradients(lambda w, v: windowed_sum(w, v, 15), weights, values, tuple(upstream))
    single = [tensor.float() for tensor in (weights, values, *upstream)]
    expected = with_gradients(lambda w, v: windowed_sum(w, v, 15), *single[:2], tuple(single[2:]))
    assert got[0].dtype == torch.float32
    assert got[2].dtype == torch.bfloat16
    for one, other in zip(got, (*expected[:2], expected[2].bfloat16(), expected[3]), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("function", [windowed_sum, windowed_sum_reference])
def test_gradcheck(function: object) -> None:
    weights, values, *_ = draw((2, 3), 3, torch.float64, innermost=True)
    inputs = weights.requires_grad_(), values.requires_grad_()
    assert torch.autograd.gradcheck(lambda w, v: function(w, v, 3), inputs)


def test_only_the_gradients_that_are_asked_for() -> None:
    """Training asks for those of the weights alone: the image is given."""
    weights, values, *_ = draw((4, 5), 3, torch.float32, innermost=False)
    for asked in (weights, values):
        asked.requires_grad_()
        sums, _ = windowed_sum(weights, values, 3)
        (gradient,) = torch.autograd.grad(sums.sum(), asked)
        assert gradient.shape == asked.shape
        asked.requires_grad_(False)
