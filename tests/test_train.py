"""The optimiser against torch's own."""

import math

import pytest
import torch

from selfcorrect.train import Adam


@pytest.mark.parametrize("limit", [math.inf, 0.5])
def test_adam_is_that_of_torch(limit: float) -> None:
    generator = torch.Generator().manual_seed(0)
    ours = [torch.randn(4, 3, 3, 3, generator=generator).requires_grad_(), torch.zeros(4).requires_grad_()]
    theirs = [p.detach().clone().requires_grad_() for p in ours]
    adam, reference = Adam(ours, 1e-7, limit), torch.optim.Adam(theirs, eps=1e-7)
    for step in range(20):
        rate = 0.01 * (1 + math.cos(step))
        for parameters in (ours, theirs):
            sum(((p - 1) ** 2).sum() * (1 + step % 3) for p in parameters).backward()
        adam.step(rate)
        torch.nn.utils.clip_grad_norm_(theirs, limit)
        reference.param_groups[0]["lr"] = rate
        reference.step()
        reference.zero_grad()
    for mine, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-5, atol=1e-6)


def test_a_gradient_that_is_not_finite_is_not_followed() -> None:
    parameter = torch.ones(3, requires_grad=True)
    adam = Adam([parameter], 1e-7, 1.0)
    parameter.grad = torch.tensor([1.0, float("nan"), 0.0])
    adam.step(0.1)
    assert torch.equal(parameter.detach(), torch.ones(3))
    parameter.grad = torch.tensor([1.0, 0.0, 0.0])
    adam.step(0.1)
    assert parameter[0] < 1
    assert parameter.grad is None
