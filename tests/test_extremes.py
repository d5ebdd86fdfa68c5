"""Numerical extremes of the default preset: finite and never negative out, and nothing worse than went in."""

from typing import Any

import numpy as np
import pytest
import torch
from helpers.synthetic import (
    BALANCED,
    SIZE,
    assert_light_kept,
    assert_not_worse,
    boxed,
    corrected,
    noisy,
    plain,
    scene,
    twice,
)

from selfcorrect import Frame, correct
from selfcorrect.errors import FrameError
from selfcorrect.metrics import relmse

pytestmark = pytest.mark.usefixtures("one_thread")

FLOAT32 = torch.finfo(torch.float32)


# --- Nothing to correct -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [0.0, 1e-42, 1e-20, 1e-4, 1.0, 65504.0, 1e30, 3e38])
@pytest.mark.parametrize("with_full", [True, False])
def test_constant_comes_back_unchanged(value: float, with_full: bool) -> None:
    image = np.full((*SIZE, 3), value, np.float32)
    frame = Frame(color=twice(image), denoised=twice(image), denoised_full=image if with_full else None)
    np.testing.assert_array_equal(corrected(frame).image, image)


def test_black_comes_back_black_from_a_denoiser() -> None:
    result = corrected(boxed(twice(np.zeros((*SIZE, 3), np.float32))))
    assert not result.image.any()


@pytest.mark.parametrize("exposure", [1e-4, 1.0, 1e4])
def test_noise_free_comes_back_unchanged(exposure: float) -> None:
    truth = scene() * np.float32(exposure)
    frame = Frame(color=twice(truth), denoised=twice(truth), denoised_full=truth, albedo=twice(scene()))
    np.testing.assert_array_equal(corrected(frame).image, truth)


def test_halves_apart_by_1e_7_come_back_unchanged() -> None:
    truth = scene()
    color = (truth + np.float32(1e-7), truth - np.float32(1e-7))
    frame = Frame(color=color, denoised=color, denoised_full=truth)
    np.testing.assert_allclose(corrected(frame).image, truth, rtol=0, atol=2e-7)


@pytest.mark.parametrize("apart", [0.0, 1e-7])
@pytest.mark.parametrize("exposure", [1e-4, 1.0, 1e4])
def test_noise_free_gains_on_a_blurred_denoised_image(exposure: float, apart: float) -> None:
    truth = scene() * np.float32(exposure)
    color = (truth * np.float32(1 + apart), truth * np.float32(1 - apart))
    frame = boxed(color, albedo=twice(scene()))
    result = assert_not_worse(frame, truth)
    assert_light_kept(result, frame)
    assert relmse(result.image / exposure, scene()) < 0.1 * relmse(plain(frame.denoised_full) / exposure, scene())


# --- Outliers -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("half", [0, 1])
@pytest.mark.parametrize("value", [1e6, 1e20, 3e38])
def test_firefly_that_the_denoiser_spreads(value: float, half: int) -> None:
    color = noisy(scene())
    color[half][20, 30] = value
    frame = boxed(color, albedo=twice(scene()))
    assert_light_kept(assert_not_worse(frame, scene()), frame)


@pytest.mark.parametrize("half", [0, 1])
@pytest.mark.parametrize("value", [1e6, 1e20, 3e38])
def test_firefly_that_the_denoiser_removes(value: float, half: int) -> None:
    frame = boxed(noisy(scene()))
    color = tuple(buffer.numpy().copy() for buffer in frame.color)
    color[half][20, 30] = value
    denoised = {"denoised": frame.denoised, "denoised_full": frame.denoised_full}
    assert_not_worse(Frame(color=color, albedo=twice(scene()), **denoised), scene())


@pytest.mark.parametrize("value", [1e3, 1e6, 1e20, 3e38])
def test_lamp_that_both_halves_see(value: float) -> None:
    truth = scene()
    truth[20, 30] = value
    color = noisy(scene())
    for half in color:
        half[20, 30] = value
    assert_not_worse(boxed(color), truth)


def test_the_lights_of_both_halves_beside_a_hole() -> None:
    """The hole is filled from neighbours whose sum is beyond float32."""
    color = noisy(scene())
    for half in color:
        half[20:22, 30:32] = 3e38
        half[20, 30] = np.nan
    denoised = twice(scene())
    corrected(Frame(color=color, denoised=denoised, denoised_full=scene()))


# --- What is not finite -------------------------------------------------------------------------------------------

HOLES = {
    "pixel": np.s_[20, 30],
    "channel": np.s_[20, 30, 1],
    "row": np.s_[20],
    "column": np.s_[:, 30],
    "block": np.s_[10:26, 20:36],
    "corner": np.s_[:9, :9],
}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("hole", HOLES)
def test_hole_in_the_colour_of_a_half(hole: str, value: float, dtype: type) -> None:
    color = tuple(half.astype(dtype) for half in noisy(scene()))
    color[0][HOLES[hole]] = value
    broken = np.isnan(color[0]) | np.isinf(color[0])
    frame = boxed(color, albedo=twice(scene()))
    assert frame.repairs["color"].non_finite == broken.any(-1).sum()
    assert_not_worse(frame, scene())


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["albedo", "normal", "visibility", "depth"])
@pytest.mark.parametrize("hole", ["pixel", "block", "everywhere"])
def test_hole_in_a_guide(name: str, hole: str, value: float) -> None:
    buffer = scene()[..., :1] if name in ("visibility", "depth") else scene()
    pair = twice(buffer)
    pair[0][HOLES.get(hole, np.s_[:])] = value
    pair[1][HOLES.get(hole, np.s_[:])] = value
    assert_not_worse(boxed(noisy(scene()), **{name: pair}), scene())


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("hole", ["pixel", "row", "block"])
def test_hole_in_the_denoised_images(hole: str, value: float) -> None:
    frame = boxed(noisy(scene()))
    assert frame.denoised is not None
    images = [image.numpy().copy() for image in (*frame.denoised, frame.denoised_full)]
    for image in images:
        image[HOLES[hole]] = value
    denoised = {"denoised": (images[0], images[1]), "denoised_full": images[2]}
    broken = Frame(color=frame.color, albedo=twice(scene()), **denoised)
    assert_not_worse(broken, scene())


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("halves", ["a", "ab"])
@pytest.mark.parametrize("names", [("color",), ("denoised",), ("color", "denoised", "albedo")])
def test_nothing_finite_at_all(names: tuple[str, ...], halves: str, value: float) -> None:
    buffers = {"color": noisy(scene()), "denoised": twice(scene()), "albedo": twice(scene())}
    for name in names:
        for half, _ in enumerate(halves):
            buffers[name][half][:] = value
    with pytest.raises(FrameError, match=f"channel R of {names[0]} of half a, but got NaN or infinity at 3072 of 3072"):
        Frame(**buffers)


# --- Other values -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("exposure", [1e-2, 1.0, 1e2])
def test_negative_lobes(exposure: float) -> None:
    truth = scene() * np.float32(exposure)
    generator = np.random.default_rng(3)
    color = tuple(
        truth + 0.3 * np.float32(exposure) * generator.standard_normal(truth.shape).astype("f4") for _ in "ab"
    )
    frame = boxed(color, albedo=twice(scene()))
    assert frame.repairs["color"].negative > 0
    assert_not_worse(frame, truth)


def test_denoised_images_that_are_negative() -> None:
    denoised = twice(scene() - np.float32(0.5))
    corrected(Frame(color=noisy(scene()), denoised=denoised, denoised_full=denoised[0]))


def test_output_that_dips_below_black() -> None:
    """Black stripes beside bright ones: corrections overshoot where the output has to end at 0."""
    truth = np.zeros((*SIZE, 3), np.float32)
    truth[:, ::3] = 1.0
    assert_not_worse(boxed(noisy(truth), albedo=twice(truth)), truth)


@pytest.mark.parametrize("kind", ["NumPy", "torch"])
def test_values_at_the_limit_of_half_floats(kind: str) -> None:
    truth = np.where(scene() > 0.5, np.float32(65504), np.float32(6e4))
    color = tuple(half.clip(0, 65504).astype(np.float16) for half in noisy(truth, 0.05))
    pair = color if kind == "NumPy" else tuple(torch.from_numpy(half) for half in color)
    assert_not_worse(boxed(pair, albedo=twice(truth)), truth)


def test_denoised_image_beyond_the_limit_of_half_floats() -> None:
    """The colour is in half floats and so is the output; a denoiser's overshoot has to end at the largest of them."""
    color = tuple(half.clip(0, 65504).astype(np.float16) for half in noisy(6e4 * scene()))
    denoised = 6e4 * scene()
    denoised[20, 30] = 7e4
    corrected(Frame(color=color, denoised=twice(denoised), denoised_full=denoised))


def test_denoised_halves_are_needed() -> None:
    with pytest.raises(FrameError, match="denoised halves"):
        correct(Frame(color=noisy(scene())), BALANCED)


@pytest.mark.parametrize("value", [1e6, 1e20, 1e26, 3e38])
def test_denoiser_that_made_a_pixel_up(value: float) -> None:
    """Its squared error may be beyond float32; the maps of the error may not."""
    frame = boxed(noisy(scene()), albedo=twice(scene()))
    assert frame.denoised is not None
    a, b = (image.clone() for image in frame.denoised)
    b[20, 30] = value
    corrected(frame.with_denoised((a, b)))
    corrected(Frame(color=frame.color, albedo=frame.albedo, denoised=(a, b)))


# --- Kinds of arrays ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_kinds_of_tensors(dtype: torch.dtype) -> None:
    color = tuple(torch.from_numpy(half).to(dtype) for half in noisy(scene()))
    albedo = torch.from_numpy(scene()).to(dtype)
    frame = boxed(color, albedo=(albedo, albedo))
    result = assert_not_worse(frame, scene())
    assert result.image.dtype == dtype
    same = boxed(tuple(half.float() for half in color), albedo=(albedo.float(), albedo.float()))
    np.testing.assert_allclose(
        plain(result.image), plain(corrected(same).image), rtol=torch.finfo(dtype).eps, atol=FLOAT32.eps
    )


@pytest.mark.parametrize("dtype", [np.float16, np.float64, np.dtype(">f4")])
def test_kinds_of_arrays(dtype: Any) -> None:
    color = tuple(half.astype(dtype) for half in noisy(scene()))
    result = assert_not_worse(boxed(color, albedo=twice(scene().astype(dtype))), scene())
    assert result.image.dtype == dtype


# --- Sizes --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "size",
    [(1, 1), (1, 2), (1, 47), (47, 1), (2, 64), (5, 7), (19, 19), (31, 31), (32, 32), (33, 33), (31, 65), (33, 17)],
)
def test_sizes(size: tuple[int, int]) -> None:
    truth = scene(size)
    assert_not_worse(boxed(noisy(truth), albedo=twice(truth), normal=twice(truth)), truth)
