"""Composition: any order, what is recorded, what a half may know, and what is refused."""

import dataclasses
import importlib

import pytest
import torch
from helpers.witness import share_of_witness
from torch import Tensor

import denoisers
from selfcorrect import Frame, Settings, correct
from selfcorrect.errors import FrameError, SettingsError
from selfcorrect.frame import Candidate, mean
from selfcorrect.guard import Guarded
from selfcorrect.settings import STAGE_NAMES
from selfcorrect.stages import STAGES
from selfcorrect.stages.james_stein import JamesStein, james_stein, relative_weight, variance_of_mean

SMALL = {"patch": 16, "batch": 2, "steps": 2, "window": 5, "layers": 3, "regression_stride": 4}


def make_frame(size: tuple[int, int] = (40, 44), sigma: float = 0.3) -> Frame:
    generator = torch.Generator().manual_seed(0)
    y, x = torch.meshgrid(*(torch.arange(n) for n in size), indexing="ij")
    albedo = (0.5 + 0.3 * torch.sin(x / 2))[..., None].expand(*size, 3).contiguous()
    truth = albedo * (1 + 0.5 * torch.sin(y / 9))[..., None]
    color = tuple(truth * (1 + sigma * torch.randn(*size, 3, generator=generator)) for _ in "ab")
    return Frame(color=color, albedo=(albedo, albedo.clone())).denoise(denoisers.create("box"))


def settings(**changes: object) -> Settings:
    return Settings.preset("balanced", **SMALL | changes)


@pytest.mark.parametrize("stages", ["core", "james-stein", "regression", "regression,core,james-stein"])
@pytest.mark.parametrize("guard", [True, False])
def test_compositions_run(stages: str, guard: bool) -> None:
    chosen = settings(stages=stages, guard=guard)
    result = correct(make_frame(), chosen)
    assert result.image.isfinite().all()
    assert (result.network is not None) == ("core" in stages)
    assert (result.estimate is not None) == guard
    ran = [{"train": "core"}.get(name, name) for name in result.seconds if name not in ("infer", "guard", "fireflies")]
    assert ran == list(chosen.stage_names)
    assert Settings.from_dict(chosen.to_dict()).stages == stages


def test_the_order_counts() -> None:
    frame = make_frame()
    one, other = (
        correct(frame, settings(stages=stages, guard=False)).image
        for stages in ("regression,james-stein", "james-stein,regression")
    )
    assert not torch.equal(one, other)


def test_james_stein_alone_is_the_combiner() -> None:
    frame = make_frame()
    got = correct(frame, settings(stages="james-stein", guard=False, input_scale=1.0)).image
    noisy = mean(frame.color)
    expected = james_stein(noisy, frame.denoised_full, variance_of_mean(frame.color), relative_weight(noisy))
    torch.testing.assert_close(got, expected.clamp(min=0))


def test_the_guard_compares_with_what_the_denoiser_gave(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not with what an earlier stage made of it."""
    module = importlib.import_module("selfcorrect.correct")  # the package has a function of this name

    seen: list[tuple[Tensor, ...]] = []
    real = module.guard

    def spy(*arguments: object, **options: object) -> Guarded:
        seen.append(arguments)
        return real(*arguments, **options)

    monkeypatch.setattr(module, "guard", spy)
    frame = make_frame()
    correct(frame, settings(stages="regression,james-stein", input_scale=1.0))
    ((evidence, full, _),) = seen
    assert torch.equal(evidence.denoised[0][:], frame.denoised[0])
    assert torch.equal(full[:], frame.denoised_full)
    assert torch.equal(evidence.color[1][:], frame.color[1])
    assert evidence.complete
    assert evidence.both(slice(0, frame.size[0]))[1].mean() > 0, "the stages have changed something"


@pytest.mark.parametrize("stages", ["", "core,", "cor", "core,core", "core;james-stein"])
def test_wrong_stages_are_named(stages: str) -> None:
    with pytest.raises(SettingsError, match="regression,core,james-stein"):
        settings(stages=stages)


def test_warm_start_without_core_is_refused() -> None:
    network = correct(make_frame(), settings()).network
    with pytest.raises(FrameError, match="core"):
        correct(make_frame(), settings(stages="regression"), warm_start=network)


@pytest.mark.parametrize("heavy", [False, True])
def test_a_james_stein_half_knows_little_of_its_witness(heavy: bool) -> None:
    """Through the smoothed variance alone."""
    assert abs(share_of_witness(JamesStein(settings()), heavy=heavy)) < 0.005


def test_the_settings_know_the_stages_that_there_are() -> None:
    assert tuple(STAGES) == STAGE_NAMES


def test_further_candidates_are_judged_with_the_stages() -> None:
    """The truth among them is taken, noise is left, and the output is the better for it."""
    frame = make_frame()
    truth = Frame(color=make_frame(sigma=0.0).color)
    noise = 3 * frame.color[0].flip(0)
    right = Candidate("right", truth.color, mean(truth.color))
    wrong = Candidate("wrong", (noise, noise), noise)
    chosen = settings(stages="regression")
    alone = correct(frame, chosen)
    for more in ((right,), (wrong, right), (right, wrong)):
        helped = correct(dataclasses.replace(frame, more=more), chosen)
        error, error_alone = (float(((r.image - right.full) ** 2).mean()) for r in (helped, alone))
        assert error < 0.3 * error_alone
        assert helped.maps["blend"].max() <= 1 + 1e-6
    left = correct(dataclasses.replace(frame, more=(wrong,)), chosen)
    assert float(((left.image - right.full) ** 2).mean()) <= 1.02 * error_alone


def test_a_candidate_of_another_size_is_refused() -> None:
    image = torch.zeros(3, 4, 3)
    with pytest.raises(FrameError, match=r"candidate odd of shape \(40, 44, 3\), but got \(3, 4, 3\)"):
        dataclasses.replace(make_frame(), more=(Candidate("odd", (image, image), image),))
