"""Numerical extremes of the default preset: finite and never negative out, and nothing worse than went in."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

import denoisers
from selfcorrect import Frame, Settings, correct
from selfcorrect.correct import Result
from selfcorrect.errors import FrameError
from selfcorrect.metrics import relmse

Array = NDArray[Any]
Pair = tuple[Any, Any]

BALANCED = Settings.preset("balanced", steps=12, patch=32, batch=2, window=9)
BRIEF = Settings.from_dict(BALANCED.to_dict() | {"steps": 4})
SIZE = (48, 64)
MARGIN = 1.01  # of the denoised image's error, that an output may have
FLOAT32 = torch.finfo(torch.float32)
EQUIVARIANCE = 1e-3  # of the mean; measured: 4e-6 for a factor, 5e-7 for swapped halves
FEW = settings(max_examples=12, deadline=None, database=None, derandomize=True, phases=(Phase.generate, Phase.shrink))


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def scene(size: tuple[int, int] = SIZE) -> Array:
    """Coloured waves, finer than the box denoiser's window, between 0.12 and 1."""
    y, x = np.mgrid[: size[0], : size[1]]
    waves = 0.6 + 0.4 * np.sin(0.9 * x) * np.cos(0.35 * y)
    return (waves[..., None] * np.array([1.0, 0.8, 0.6])).astype(np.float32)


def noisy(truth: Array, deviation: float = 0.3, seed: int = 0) -> Pair:
    """Two halves with gamma noise of this relative deviation: never negative, and the more skewed the stronger."""
    generator = np.random.default_rng(seed)
    shape = deviation**-2
    return tuple((truth * generator.gamma(shape, 1 / shape, truth.shape)).astype(np.float32) for _ in "ab")


def twice(buffer: Array) -> Pair:
    return buffer, buffer.copy()


def swapped(pair: Pair) -> Pair:
    return pair[1], pair[0]


def boxed(color: Pair, **buffers: Pair) -> Frame:
    """A frame denoised by a 15×15 box: all detail lost, no noise, no light lost."""
    return Frame(color=color, **buffers).denoise(denoisers.create("box"))


def plain(image: Any) -> Array:
    return np.asarray(image.double() if isinstance(image, torch.Tensor) else image, dtype=np.float64)


def corrected(frame: Frame, preset: Settings = BALANCED) -> Result:
    """Correct, and check all that holds whatever the input is."""
    result = correct(frame, preset)
    image = plain(result.image)
    assert image.shape == (*frame.size, 3)
    assert np.isfinite(image).all()
    assert image.min() >= 0
    assert result.estimate is not None
    numbers = (
        getattr(result.estimate, name) for name in ("noisy", "denoised", "corrected", "change", "standard_error")
    )
    assert np.isfinite(list(numbers)).all()
    assert (result.estimate.change < 0) == result.estimate.improved  # what it says and what it did agree
    for name, aov in result.aovs.items():
        assert bool(aov.isfinite().all()), name
        assert float(aov.min()) >= 0, name
    assert float(result.aovs["blend"].max()) <= 1
    return result


def assert_not_worse(frame: Frame, truth: Array, settings: Settings = BALANCED) -> Result:
    result = corrected(frame, settings)
    assert relmse(plain(result.image), truth) <= MARGIN * relmse(plain(frame.denoised_full), truth)
    return result


def assert_light_kept(result: Result, frame: Frame) -> None:
    """The mean is within four standard errors of the noisy mean, or at least no further from it than the denoised."""
    a, b = (plain(half).mean(-1) for half in frame.color)
    error = np.sqrt(np.mean((a - b) ** 2 / 4) / a.size)
    mean = (a.mean() + b.mean()) / 2
    allowed = max(4 * error, abs(plain(frame.denoised_full).mean() - mean), 1e-6 * mean)
    assert abs(plain(result.image).mean() - mean) <= 1.000001 * allowed


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
    corrected(Frame(**buffers))


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


# --- G-buffers ----------------------------------------------------------------------------------------------------


def noise(channels: int, scale: float = 1.0) -> Pair:
    generator = np.random.default_rng(11)
    return tuple((scale * generator.standard_normal((*SIZE, channels))).astype(np.float32) for _ in "ab")


GUIDES = {
    "normals of zero": {"normal": twice(np.zeros((*SIZE, 3), np.float32))},
    "normals of length 1000": {"normal": twice(1000 * scene())},
    "normals of length 1e-20": {"normal": twice(np.float32(1e-20) * scene())},
    "normals of noise": {"normal": noise(3)},
    "normals of 3e38": {"normal": noise(3, 1e37)},
    "albedo above 1": {"albedo": twice(50 * scene())},
    "albedo of 3e38": {"albedo": twice(np.float32(3e38) * scene())},
    "albedo below 0": {"albedo": twice(-scene())},
    "albedo constant": {"albedo": twice(np.full((*SIZE, 3), 0.5, np.float32))},
    "albedo of noise": {"albedo": noise(3)},
    "visibility of noise": {"visibility": noise(1)},
    "visibility of 1e20": {"visibility": noise(1, 1e20)},
    "the sky infinitely far": {"depth": twice(np.where(scene()[..., :1] > 0.5, np.inf, scene()[..., :1]))},
    "all of noise": {"albedo": noise(3), "normal": noise(3), "visibility": noise(1), "depth": noise(1)},
    "all black": {
        name: twice(np.zeros((*SIZE, channels), np.float32))
        for name, channels in (("albedo", 3), ("normal", 3), ("visibility", 1), ("depth", 1))
    },
}


@pytest.mark.parametrize("name", GUIDES)
def test_odd_guides(name: str) -> None:
    frame = boxed(noisy(scene()), **GUIDES[name])
    assert_light_kept(assert_not_worse(frame, scene()), frame)


# --- Halves -------------------------------------------------------------------------------------------------------


def test_swapped_halves() -> None:
    color, albedo = noisy(scene()), noisy(scene(), 0.1, seed=5)
    image = corrected(boxed(color, albedo=albedo)).image
    other = corrected(boxed(swapped(color), albedo=swapped(albedo))).image
    assert np.abs(other - image).max() < EQUIVARIANCE * image.mean()


def test_the_same_samples_in_both_halves() -> None:
    """Noise that both halves share cannot be told from detail; it can still be told from nonsense."""
    half, _ = noisy(scene())
    frame = boxed(twice(half))
    result = corrected(frame)
    assert_light_kept(result, frame)
    assert result.image.max() <= 1.01 * half.max()


def test_noise_that_neighbours_share() -> None:
    """A wide pixel filter: noise of neighbours is alike, but the halves are still independent."""
    wide = denoisers.create("box")
    color = tuple((half + wide(half)) / 2 for half in noisy(scene(), 0.5))
    truth = (scene() + wide(scene())) / 2
    assert_not_worse(boxed(color), truth)


def sparse(truth: Array, seed: int) -> Pair:
    """Most paths find no light: one pixel in 50 has it all."""
    generator = np.random.default_rng(seed)
    return tuple((truth * (generator.random((*truth.shape[:2], 1)) < 0.02) * 50).astype(np.float32) for _ in "ab")


def heavy_tailed(truth: Array, seed: int) -> Pair:
    """Noise without a variance: Pareto of exponent 1.5, of mean 1."""
    generator = np.random.default_rng(seed)
    return tuple((truth * generator.pareto(1.5, (*truth.shape[:2], 1)) / 2).astype(np.float32) for _ in "ab")


KINDS_OF_NOISE = {
    "hardly any": lambda truth, seed: noisy(truth, 0.01, seed),
    "little": lambda truth, seed: noisy(truth, 0.1, seed),
    "strong": lambda truth, seed: noisy(truth, 3.0, seed),
    "sparse": sparse,
    "heavy-tailed": heavy_tailed,
}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("exposure", [0.03, 1.0])
@pytest.mark.parametrize("denoiser", ["box", "joint-bilateral"])
@pytest.mark.parametrize("kind", KINDS_OF_NOISE)
def test_noise_of_any_kind(kind: str, denoiser: str, exposure: float, seed: int) -> None:
    """A denoised image that keeps some noise must not lend the guard a weight that knows the witness."""
    truth = scene() * np.float32(exposure)
    color = KINDS_OF_NOISE[kind](truth, seed)
    frame = Frame(color=color, albedo=noisy(scene(), 0.2, seed + 50)).denoise(denoisers.create(denoiser))
    assert_light_kept(assert_not_worse(frame, truth), frame)


@pytest.mark.parametrize("guides", [{}, {"albedo": twice(scene())}], ids=["alone", "albedo"])
@pytest.mark.parametrize("left", [0.5, 0.7, 0.9, 1.5])
def test_denoiser_that_changes_the_light(left: float, guides: dict[str, Pair]) -> None:
    frame = boxed(noisy(scene()), **guides)
    assert frame.denoised is not None
    a, b = frame.denoised
    dimmed = frame.with_denoised((left * a, left * b), left * frame.denoised_full)
    # Half-trained, a network brings back the light but not the stripes, and the guard, whose weight is as flat as the
    # denoised image, takes that for a gain: a quarter of the preset's 400 steps it must have.
    settings = Settings.from_dict(BALANCED.to_dict() | {"steps": 100})
    assert_light_kept(assert_not_worse(dimmed, scene(), settings), dimmed)


# --- Exposure -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("deviation", [0.3, 2.0])
@pytest.mark.parametrize("factor", [1e-4, 1e-2, 1e2, 1e4, 2.0**-13, 2.0**13, 1e-40, 1e-30, 1e20, 1e36])
def test_exposure_changes_nothing_else(factor: float, deviation: float) -> None:
    frame = boxed(noisy(scene(), deviation), albedo=twice(scene()))
    assert_same_but_for(factor, frame, BALANCED)


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
    assert np.abs(plain(got.image) / factor - image).max() < EQUIVARIANCE * image.mean()
    torch.testing.assert_close(got.aovs["blend"], expected.aovs["blend"], rtol=0, atol=EQUIVARIANCE)


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
    assert np.abs(other - image).max() <= EQUIVARIANCE * image.mean()


@FEW
@given(st.data(), sizes)
def test_anything_without_noise_comes_back_unchanged(data: st.DataObject, size: tuple[int, int]) -> None:
    radiance = st.floats(0, float(FLOAT32.max), width=32)
    truth = data.draw(arrays(np.float32, (*size, 3), elements=radiance, fill=radiance))
    frame = Frame(color=twice(truth), denoised=twice(truth), denoised_full=truth)
    np.testing.assert_array_equal(corrected(frame, BRIEF).image, truth)
