"""Guides of nonsense, noise of every kind, and denoisers that change the light: nothing worse than went in."""

import numpy as np
import pytest
from helpers.synthetic import (
    BALANCED,
    SIZE,
    Array,
    Pair,
    assert_light_kept,
    assert_not_worse,
    boxed,
    corrected,
    noisy,
    scene,
    swapped,
    twice,
)
from helpers.tolerances import SWAPPED

import denoisers
from selfcorrect import Frame, Settings

pytestmark = pytest.mark.usefixtures("one_thread")


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
    assert np.abs(other - image).max() < SWAPPED * image.mean()


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
