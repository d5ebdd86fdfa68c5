"""The four sub-images of deep-combiner-4: checked, repaired, denoised, counted as memory."""

import pytest
import torch
from helpers.trained import make_both, settings, state_of

import denoisers
from selfcorrect import Frame, Settings, correct
from selfcorrect.cli import memory
from selfcorrect.errors import FrameError
from selfcorrect.files import Sources
from selfcorrect.stages.deep_combiner_4 import DeepCombiner4, SubImages
from selfcorrect.stages.images import StageImages
from selfcorrect.stages.stage import Outcome, Work


def test_sub_images_are_checked() -> None:
    frame, subs = make_both()
    four = subs.images
    rounded = [image.half().float() for image in four]
    SubImages.of(Frame(color=tuple(half.half().float() for half in frame.color)), rounded)
    with pytest.raises(FrameError, match="four arrays"):
        SubImages.of(frame, four[:3])
    with pytest.raises(FrameError, match="mean is half a"):
        SubImages.of(frame, (*four[2:], *four[:2]))
    with pytest.raises(FrameError, match="mean is half b"):
        SubImages.of(frame, (*four[:2], four[2], four[2]))
    with pytest.raises(FrameError, match="sub_images of half b, second of 39x44"):
        SubImages.of(frame, (*four[:3], four[3][:-1]))


def test_sub_images_are_repaired() -> None:
    frame, subs = make_both()
    broken = [image.clone() for image in subs.images]
    broken[0][3, 4], broken[3][0, 0, 1] = float("nan"), float("inf")
    broken[1][8, 8] = -1
    repaired = SubImages.of(frame, broken)
    assert repaired.repairs["sub_images"] == (2, 1)
    assert all(image.isfinite().all() and image.min() >= 0 for image in repaired.images)
    assert torch.equal(repaired.images[2], subs.images[2])


def test_sub_images_are_denoised_each_on_its_own() -> None:
    """Also by a denoiser that takes two at once: those of half a are never shown with those of half b."""
    frame, subs = make_both()
    box, nlm = denoisers.create("box"), denoisers.create("nlm")
    for image, denoised in zip(subs.images, subs.denoised, strict=True):
        torch.testing.assert_close(denoised, box(image))
    dual = subs.denoise(frame, nlm).denoised
    features = {name: getattr(frame, name) for name in ("albedo", "normal", "depth")}
    own = nlm.pair(subs.images[2:], visibility=None, **{name: (p[1], p[1]) for name, p in features.items()})
    assert torch.equal(dual[2], own[0])
    assert torch.equal(dual[3], own[1])


def test_sub_images_count_as_memory(renders: list[str]) -> None:
    sources = Sources(*renders[:2])
    with_them, without = (memory.needs(sources, Settings(), extra=count) for count in (4, 0))
    image = 64 * 70 * 12  # bytes
    grown = [one - other for one, other in zip(with_them, without, strict=True)]
    assert grown == [4 * image, 8 * image, 8 * image, 0, 0]


def test_sub_images_move_with_the_frame(weight_files: dict[str, str]) -> None:
    """A frame elsewhere takes them along, whoever holds them; those that were given stay where they are."""
    frame, subs = make_both()
    chosen = settings(weight_files, stages="deep-combiner-4", input_scale=1.0, fireflies="keep")
    seen: list[SubImages] = []

    class Watched(DeepCombiner4):
        def run(self, state: StageImages, work: Work) -> Outcome:
            seen.append(work.extra)
            outcome = super().run(state, work)
            assert outcome.state.full.device.type == "meta"
            return Outcome(state_of(frame))

    correct(frame.to("meta"), chosen, opened=[Watched(chosen)], extra={"deep-combiner-4": subs})
    (moved,) = seen
    assert moved.denoised is not None
    assert {image.device.type for image in (*moved.images, *moved.denoised)} == {"meta"}
    assert {image.device.type for image in (*subs.images, *(subs.denoised or ()))} == {"cpu"}
