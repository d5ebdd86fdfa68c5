"""The four sub-images of deep-combiner-4: checked, repaired, denoised, counted as memory."""

import pytest
import torch
from helpers.trained import make_both

import denoisers
from selfcorrect import Frame, Settings
from selfcorrect.cli import memory
from selfcorrect.errors import FrameError
from selfcorrect.files import Sources
from selfcorrect.stages.deep_combiner_4 import SubImages


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
    assert grown == [4 * image, 8 * image, 8 * image, 0]
