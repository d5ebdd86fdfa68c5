"""The trained stages: exposure, what a half is made of, what they agree with, extremes, what cannot be run."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.tolerances import near
from helpers.trained import make_both, make_frame, planes, settings, state_of
from helpers.witness import share_of_witness

import denoisers
from selfcorrect import Frame, correct
from selfcorrect.errors import FileError, FrameError, SettingsError
from selfcorrect.frame import mean
from selfcorrect.stages import STAGES, opened, weights
from selfcorrect.stages.deep_combiner import feature_planes
from selfcorrect.stages.deep_combiner_4 import SubImages
from selfcorrect.stages.images import StageImages
from selfcorrect.stages.james_stein import james_stein, relative_weight, variance_of_mean
from selfcorrect.stages.neural_james_stein import NeuralJamesStein, VarianceNetwork, neural_blend
from selfcorrect.stages.stage import Work


@pytest.mark.parametrize(
    "stages", ["neural-james-stein", "deep-combiner", "deep-combiner-4", "deep-combiner-4,neural-james-stein"]
)
@pytest.mark.parametrize("features", [True, False])
def test_exposure_changes_nothing(stages: str, features: bool, weight_files: dict[str, str]) -> None:
    chosen = settings(weight_files, stages=stages)
    (frame, subs), (bright, bright_subs) = (make_both(features=features, scale=scale) for scale in (1.0, 1000.0))
    plain = correct(frame, chosen, extra={"deep-combiner-4": subs}).image
    brighter = correct(bright, chosen, extra={"deep-combiner-4": bright_subs}).image
    torch.testing.assert_close(brighter / 1000, plain, **near("trained and exposure"))
    assert not torch.allclose(plain, frame.denoised_full, atol=1e-3)


def test_composition_with_the_core_and_the_guard(weight_files: dict[str, str]) -> None:
    small = {"patch": 16, "batch": 2, "steps": 2, "window": 5, "layers": 3}
    chosen = settings(weight_files, stages="deep-combiner,core,neural-james-stein", **small | {"guard": True})
    result = correct(make_frame(), chosen)
    assert list(result.seconds) == ["deep-combiner", "train", "infer", "neural-james-stein", "guard", "fireflies"]
    assert result.image.isfinite().all()
    assert result.estimate is not None


@pytest.mark.parametrize("name", ["deep-combiner", "deep-combiner-4"])
def test_a_combined_half_knows_nothing_of_its_witness(name: str, weight_files: dict[str, str]) -> None:
    """Not a bit of half a changes with anything of half b; the full image does."""
    frame, subs = make_both()
    other = Frame(
        color=(frame.color[0], 2 * frame.color[1]),
        denoised=(frame.denoised[0], 3 * frame.denoised[1]),
        albedo=(frame.albedo[0], 0.1 * frame.albedo[1]),
        normal=(frame.normal[0], frame.normal[0]),
        depth=(frame.depth[0], frame.depth[1] ** 2),
        denoised_full=2 * frame.denoised_full,
    )
    others = replace(
        subs,
        images=(*subs.images[:2], *(2 * image for image in subs.images[2:])),
        denoised=(*subs.denoised[:2], *subs.denoised[:2]),
    )
    stage = STAGES[name](settings(weight_files, stages=name))
    one, changed = (
        stage.run(state_of(each, scale=1.5), Work(extra=extra)).state
        for each, extra in ((frame, subs), (other, others))
    )
    assert torch.equal(one.images[0], changed.images[0])
    assert not torch.equal(one.images[1], changed.images[1])
    assert not torch.equal(one.full, changed.full)


@pytest.mark.parametrize("heavy", [False, True])
def test_a_james_stein_half_knows_little_of_its_witness(heavy: bool, weight_files: dict[str, str]) -> None:
    """As for the classical variant: of half b it sees the variance alone, never the image."""
    assert abs(share_of_witness(NeuralJamesStein(settings(weight_files)), heavy=heavy, side=96)) < 0.005


def test_neural_james_stein_by_hand(weight_files: dict[str, str]) -> None:
    """The full image mixes the halves' images, moved by what the full one has beyond their mean."""
    frame = make_frame()
    state = state_of(frame)._replace(full=frame.denoised_full + 0.1)
    stage = NeuralJamesStein(settings(weight_files))
    got, network = stage.run(state, Work()).state, stage.network
    beyond = frame.denoised_full + 0.1 - mean(frame.denoised)
    x, variance = mean(frame.color), variance_of_mean(frame.color).float()
    given = [planes(image) for image in (x, variance, *(image + beyond for image in frame.denoised))]
    torch.testing.assert_close(planes(got.full), neural_blend(*network(*given), *given), **near("neural by hand"))
    own = [planes(image) for image in (frame.color[1], 2 * variance, frame.denoised[1], frame.denoised[1])]
    torch.testing.assert_close(planes(got.images[1]), neural_blend(*network(*own), *own), **near("neural by hand"))


def test_flat_weights_are_the_classical_stage(tmp_path: Path) -> None:
    """With all weights equal, both halves' shares ½ and a flat variance, neural and classical step agree."""
    network = VarianceNetwork()
    with torch.no_grad():
        network.last.weight.zero_()
    weights.save(tmp_path / "flat.safetensors", network, settings={}, data="", attribution="")
    frame = make_frame()
    a, b = frame.color[0], frame.color[0] + 0.3
    state = StageImages((frame.halves[0], frame.halves[1]._replace(color=b)), mean(frame.denoised))
    stage = NeuralJamesStein(settings({}, james_stein_weights=str(tmp_path / "flat.safetensors")))
    got = stage.run(state, Work()).state.full
    x, variance = mean((a, b)), variance_of_mean((a, b))
    q = relative_weight(x)
    smoothed = torch.nn.functional.avg_pool2d(
        torch.nn.functional.pad(planes(q * variance), (7, 7, 7, 7), mode="reflect"), 15, stride=1
    )
    expected = james_stein(x, state.full, smoothed[0].permute(1, 2, 0) / q, q, sigma=0)
    torch.testing.assert_close(got, expected, **near("neural blend, flat"))


def test_g_buffers_as_the_combiner_sees_them() -> None:
    normal, albedo = torch.rand(2, 3, 3), torch.rand(2, 3, 3, dtype=torch.float16)
    depth = torch.tensor([[0.0, 1.0, 4.0], [2.0, 1e10, -1.0]])[..., None]
    got = feature_planes((2, 3), normal=normal, albedo=albedo, depth=depth)
    assert torch.equal(got[:3], normal.permute(2, 0, 1))
    assert torch.equal(got[3:6], albedo.float().permute(2, 0, 1))
    assert torch.equal(got[6], torch.tensor([[0, 0.25, 1], [0.5, 0, 0]]))
    assert feature_planes((2, 3), normal=None, albedo=None, depth=None).eq(0).all()
    assert feature_planes((2, 3), normal=None, albedo=None, depth=0 * depth).isfinite().all()


@pytest.mark.parametrize("stages", ["neural-james-stein", "deep-combiner", "deep-combiner-4"])
@pytest.mark.parametrize("extreme", [0.0, 1e20])
def test_extremes_stay_finite(stages: str, extreme: float, weight_files: dict[str, str]) -> None:
    for size in ((1, 1), (9, 30)):
        four = [torch.rand(*size, 3) if extreme else torch.zeros(*size, 3) for _ in range(4)]
        four[0][0, 0] = extreme
        box = denoisers.create("box")
        frame = Frame(color=(mean(four[:2]), mean(four[2:]))).denoise(box)
        extra = {"deep-combiner-4": SubImages.of(frame, four).denoise(frame, box)}
        for precision in ("fp32", "bf16"):
            image = correct(frame, settings(weight_files, stages=stages, precision=precision), extra=extra).image
            assert image.isfinite().all()
            assert image.min() >= 0


def test_what_cannot_be_run_is_refused(weight_files: dict[str, str]) -> None:
    frame, subs = make_both()
    plain, four = Frame(color=frame.color, denoised=frame.denoised), settings(weight_files, stages="deep-combiner-4")
    with pytest.raises(FrameError, match="sub-images for the stage deep-combiner-4, but got none"):
        correct(plain, four)
    with pytest.raises(FrameError, match="not denoised"):
        correct(plain, four, extra={"deep-combiner-4": SubImages.of(plain, subs.images)})
    with pytest.raises(SettingsError, match="as the first stage"):
        opened(settings(weight_files, stages="core,deep-combiner-4"))
    with pytest.raises(FileError, match="--combiner-weights"):
        correct(frame, settings(weight_files, stages="deep-combiner", combiner_weights="missing.safetensors"))
