"""Another exposure changes nothing else, swapped halves change nothing, and whatever is generated comes out finite."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.synthetic import BALANCED, boxed, corrected, noisy, plain, scene, swapped, twice
from helpers.tolerances import (
    EXPOSURE,
    EXPOSURE_BF16,
    EXPOSURE_BF16_BLEND,
    EXPOSURE_BLEND,
    EXPOSURE_OF_TWO,
    EXPOSURE_TINY,
    EXPOSURE_TINY_BLEND,
    SWAPPED,
)
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from selfcorrect import Frame, Settings
from selfcorrect.errors import FrameError
from selfcorrect.kernel.convolution import cpu

pytestmark = pytest.mark.usefixtures("one_thread")

BRIEF = Settings.from_dict(BALANCED.to_dict() | {"steps": 4})
FEW = settings(max_examples=12, deadline=None, database=None, derandomize=True, phases=(Phase.generate, Phase.shrink))


# --- Exposure -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
@pytest.mark.parametrize("deviation", [0.3, 2.0])
@pytest.mark.parametrize("factor", [1e-4, 1e-2, 1e2, 1e4, 2.0**-13, 2.0**13, 1e-40, 1e-30, 1e20, 1e36])
def test_exposure_changes_nothing_else(factor: float, deviation: float, precision: str) -> None:
    frame = boxed(noisy(scene(), deviation), albedo=twice(scene()))
    assert_same_but_for(factor, frame, replace(BALANCED, precision=precision))


def assert_same_but_for(factor: float, frame: Frame, preset: Settings) -> None:
    """The frame and its multiple, both as what float32 keeps of the multiple: little where that is denormal."""

    def times(image: Any) -> Any:
        return (image.double() * factor).float()

    def kept(image: Any) -> Any:
        return (times(image).double() / factor).float()

    def through(change: Callable[[Any], Any]) -> Frame:
        assert frame.denoised is not None
        return Frame(
            color=(change(frame.color[0]), change(frame.color[1])),
            denoised=(change(frame.denoised[0]), change(frame.denoised[1])),
            denoised_full=change(frame.denoised_full),
            albedo=frame.albedo,
        )

    expected, got = corrected(through(kept), preset), corrected(through(times), preset)
    image = plain(expected.image)
    bound, of_blend = (EXPOSURE_TINY, EXPOSURE_TINY_BLEND) if factor < 1e-20 else (EXPOSURE, EXPOSURE_BLEND)
    if cpu.best_instruction_set(preset.precision) in cpu.BF16:
        bound, of_blend = EXPOSURE_BF16, EXPOSURE_BF16_BLEND
    if math.frexp(factor)[0] == 0.5:
        bound, of_blend = EXPOSURE_OF_TWO, EXPOSURE_OF_TWO
    assert np.abs(plain(got.image) / factor - image).max() < bound * image.mean()
    torch.testing.assert_close(got.maps["blend"], expected.maps["blend"], rtol=0, atol=of_blend)


# --- Generated frames ---------------------------------------------------------------------------------------------

sides = st.sampled_from([1, 2, 7, 16, 17, 31, 33, 40])
sizes = st.tuples(sides, sides)
any_float = st.floats(width=32)


@FEW
@given(st.data(), sizes, st.sets(st.sampled_from(["albedo", "normal", "visibility", "depth"])))
def test_anything_in_finite_out(data: st.DataObject, size: tuple[int, int], guides: set[str]) -> None:
    buffers = {}
    for name in ("color", "denoised", *sorted(guides)):
        channels = 1 if name in ("visibility", "depth") else 3
        image = arrays(np.float32, (*size, channels), elements=any_float, fill=any_float)
        buffers[name] = (data.draw(image), data.draw(image))
    share = min(np.isfinite(image).mean((0, 1)).min() for name in ("color", "denoised") for image in buffers[name])
    if share < 0.5:
        with pytest.raises(FrameError, match="expected finite radiance at 50% of the pixels or more"):
            Frame(**buffers)
    else:
        corrected(Frame(**buffers), BRIEF)


@FEW
@given(sizes, st.floats(0.01, 3.0), st.integers(0, 99), st.floats(-4, 4))
def test_any_exposure(size: tuple[int, int], deviation: float, seed: int, exponent: float) -> None:
    frame = boxed(noisy(scene(size), deviation, seed), albedo=twice(scene(size)))
    assert_same_but_for(10**exponent, frame, BRIEF)


@FEW
@given(sizes, st.floats(0.01, 3.0), st.integers(0, 99))
def test_any_halves_swapped(size: tuple[int, int], deviation: float, seed: int) -> None:
    color = noisy(scene(size), deviation, seed)
    image = corrected(boxed(color), BRIEF).image
    other = corrected(boxed(swapped(color)), BRIEF).image
    assert np.abs(other - image).max() <= SWAPPED * image.mean()


@FEW
@given(st.data(), sizes)
def test_anything_without_noise_comes_back_unchanged(data: st.DataObject, size: tuple[int, int]) -> None:
    radiance = st.floats(0, torch.finfo(torch.float32).max, width=32)
    truth = data.draw(arrays(np.float32, (*size, 3), elements=radiance, fill=radiance))
    frame = Frame(color=twice(truth), denoised=twice(truth), denoised_full=truth)
    np.testing.assert_array_equal(corrected(frame, BRIEF).image, truth)
