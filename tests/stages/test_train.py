"""The optimiser against torch's own, and how long training lasts."""

import math
from pathlib import Path

import pytest
import torch
from helpers.tolerances import near
from quality import load

import denoisers
from selfcorrect import Frame, Settings, correct, metrics
from selfcorrect.stages.core.patches import steps_count
from selfcorrect.stages.core.train import Adam


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
        adam.step(rate, torch.tensor(1.0))
        torch.nn.utils.clip_grad_norm_(theirs, limit)
        reference.param_groups[0]["lr"] = rate
        reference.step()
        reference.zero_grad()
    for mine, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(mine, other, **near("Adam"))


def test_a_gradient_that_is_not_finite_is_not_followed() -> None:
    parameter = torch.ones(3, requires_grad=True)
    adam = Adam([parameter], 1e-7, 1.0)
    parameter.grad = torch.tensor([1.0, float("nan"), 0.0])
    adam.step(0.1, torch.tensor(1.0))
    parameter.grad = torch.tensor([1.0, 0.0, 0.0])
    adam.step(0.1, torch.tensor(float("inf")))
    assert torch.equal(parameter.detach(), torch.ones(3))
    parameter.grad = torch.tensor([1.0, 0.0, 0.0])
    adam.step(0.1, torch.tensor(1.0))
    assert parameter[0] < 1
    assert parameter.grad is None


@pytest.mark.parametrize(
    ("size", "changes", "steps"),
    [
        ((480, 270), {}, 400),
        ((260, 260), {}, 264),
        ((128, 128), {}, 64),
        ((128, 128), {"batch": 16}, 16),
        ((128, 128), {"visits": 0}, 400),
        ((20, 20), {}, 1),
        ((128, 128), {"steps": 5}, 5),
    ],
)
def test_a_small_frame_takes_fewer_steps(size: tuple[int, int], changes: dict[str, int], steps: int) -> None:
    assert steps_count(size, Settings.preset("balanced", **changes)) == steps


@pytest.mark.shared
def test_a_small_frame_is_not_overfitted(shared: Path) -> None:
    """A piece of which 400 steps made an image a sixth worse, and the guard believed it three times better."""
    whole, references = load(shared / "frames", "classroom", 16)
    piece = slice(71, 199), slice(176, 304)
    roles = {role: getattr(whole, role) for role in ("color", "albedo", "normal", "depth")}
    frame = Frame(**{role: tuple(image[piece].clone() for image in pair) for role, pair in roles.items()})
    frame = frame.denoise(denoisers.create("oidn", threads=1))
    result = correct(frame, Settings.preset("balanced"))
    cut = [image[piece] for image in references]
    left = metrics.relmse(result.image, *cut) / metrics.relmse(frame.denoised_full, *cut)
    assert left <= 1.01
    assert result.estimate is not None
    assert 1 + result.estimate.change > left - 2 * result.estimate.standard_error
