"""A pixel that both halves show and nothing around it speaks for: a firefly of both, or a star; nobody can tell.

The scenes and their references are made here. Each adversary is held against both of what it may be.
"""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.commands import BALANCED as FLAGS
from helpers.commands import call, write_half
from helpers.synthetic import BALANCED, Array, Pair, noisy, plain, twice

import denoisers
from selfcorrect import Frame, Settings, correct
from selfcorrect.correct import Result
from selfcorrect.frame import Half
from selfcorrect.lone_pixels import lone_pixels, set_aside, unjudged
from selfcorrect.metrics import relmse

pytestmark = pytest.mark.usefixtures("one_thread")

SIZE = (96, 128)
AT = (40, 50)
SPREAD = [(40, 50), (20, 90), (70, 30), (80, 100)]
DENOISERS = ["oidn", "box"]


def smooth() -> Array:
    """Coloured waves between 0.2 and 1, which a denoiser keeps."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    waves = 0.6 + 0.4 * np.sin(0.2 * x) * np.cos(0.1 * y)
    return (waves[..., None] * np.array([1.0, 0.8, 0.6])).astype(np.float32)


def seen(value: float, places: list[tuple[int, int]], albedo: bool = False) -> tuple[Pair, Pair]:
    """Noisy halves that both show this at these places, about; and their albedo, which shows it or does not."""
    halves, surfaces = noisy(smooth()), twice(smooth())
    for number, place in enumerate(places):
        for half, luck, surface in zip(halves, (1.2, 0.8), surfaces, strict=True):
            half[place] = value * luck * (1 + 0.2 * number)
            if albedo:
                surface[place] = 1.5
    return halves, surfaces


@cache
def corrected(denoiser: str, value: float, places: tuple[tuple[int, int], ...]) -> tuple[Frame, Result]:
    color, albedo = seen(value, list(places))
    frame = Frame(color=color, albedo=albedo).denoise(denoisers.create(denoiser, threads=1))
    return frame, correct(frame, BALANCED)


def errors(frame: Frame, result: Result, truth: Array) -> tuple[float, float]:
    return relmse(plain(frame.denoised_full), truth), relmse(plain(result.image), truth)


@pytest.mark.parametrize("denoiser", DENOISERS)
@pytest.mark.parametrize("value", [1e3, 1e4, 1e6])
@pytest.mark.parametrize("places", [[AT], SPREAD])
def test_a_firefly_of_both_halves_is_not_put_back(denoiser: str, value: float, places: list[tuple[int, int]]) -> None:
    """Without this rule four of 10³ came out ten thousand times as wrong as OIDN's image, with a gain claimed."""
    frame, result = corrected(denoiser, value, tuple(places))
    before, after = errors(frame, result, smooth())
    assert result.lone == len(places)
    assert after <= 1.01 * before
    for place in places:
        assert plain(result.image)[place].max() <= 1.1 * plain(frame.denoised_full)[place].max() + 0.1


@pytest.mark.parametrize("denoiser", DENOISERS)
@pytest.mark.parametrize("places", [[AT], SPREAD])
def test_a_star_that_the_denoiser_has_lost_is_no_worse(denoiser: str, places: list[tuple[int, int]]) -> None:
    truth = smooth()
    for number, place in enumerate(places):
        truth[place] = 1e4 * (1 + 0.2 * number)
    before, after = errors(*corrected(denoiser, 1e4, tuple(places)), truth)
    assert after <= 1.01 * before


@pytest.mark.parametrize("places", [[AT], SPREAD])
def test_the_gain_that_is_claimed_is_there(places: list[tuple[int, int]]) -> None:
    """What OIDN has left of fireflies is an error that stays, though no half speaks against it."""
    frame, result = corrected("oidn", 1e4, tuple(places))
    before, after = errors(frame, result, smooth())
    assert result.estimate is not None
    assert result.estimate.change >= after / before - 1 - 0.15
    left = unjudged(frame.denoised_full, frame.halves, torch.tensor(places))
    z, truth = (image.mean(-1) for image in (plain(frame.denoised_full), smooth()))
    expected = sum((z[p] - truth[p]) ** 2 / (truth[p] ** 2 + 0.01) for p in places) / truth.size
    assert expected / 2 < left < 2 * expected, "what lies around is known from noisy pixels"
    assert result.estimate.denoised > left


@pytest.mark.parametrize("places", [[AT], SPREAD])
def test_no_gain_is_claimed_for_it(places: list[tuple[int, int]]) -> None:
    """Where the rest of the frame has nothing to gain, there is no gain."""
    color, albedo = twice(smooth())[0].copy(), twice(smooth())
    for place in places:
        color[place] = 1e4
    frame = Frame(color=twice(color), albedo=albedo, denoised=twice(smooth()), denoised_full=smooth())
    result = correct(frame, BALANCED)
    assert result.lone == len(places)
    assert result.estimate is not None
    assert not result.estimate.improved
    np.testing.assert_array_equal(plain(result.image), smooth())


def test_a_star_that_the_denoiser_has_kept_stays() -> None:
    truth = smooth()
    truth[AT] = 1e4
    frame = Frame(color=seen(1e4, [AT])[0], denoised=noisy(truth, 0.05), denoised_full=truth)
    result = correct(frame, BALANCED)
    assert result.lone == 1
    assert plain(result.image)[AT] == pytest.approx(truth[AT], rel=0.05)
    assert relmse(plain(result.image), truth) <= relmse(plain(frame.denoised_full), truth) + 1e-4


def found(color: Pair, albedo: Pair | None = None) -> list[list[int]]:
    buffers = [Half(torch.from_numpy(half)) for half in color]
    if albedo is not None:
        buffers = [h._replace(albedo=torch.from_numpy(a)) for h, a in zip(buffers, albedo, strict=True)]
    places: list[list[int]] = lone_pixels((buffers[0], buffers[1]), 1.0).tolist()
    return places


@pytest.mark.parametrize("place", [(0, 0), (0, 60), (95, 127), (40, 0), AT])
def test_it_is_found_anywhere(place: tuple[int, int]) -> None:
    color, albedo = seen(1e4, [place])
    assert found(color, albedo) == [[*place]]


def test_it_is_found_beside_a_firefly_of_one_half() -> None:
    color, _ = seen(1e4, [AT])
    color[0][40, 51] = 1e6
    assert found(color) == [[*AT]]


def test_bands_do_not_matter() -> None:
    tall = tuple(np.full((300, 5, 3), 0.5, np.float32) for _ in "ab")
    rows = [0, 127, 129, 256, 299]
    for half in tall:
        half[rows, 2] = 1e4
    assert found(tall) == [[row, 2] for row in rows]
    for half in tall:
        half[128, 2] = 1e4
    assert found(tall) == [[row, 2] for row in (0, 256, 299)], "beside each other they are something"


def test_what_one_half_alone_shows_is_not_meant() -> None:
    color, _ = seen(1e4, [AT])
    color[1][AT] = 0.5
    assert found(color) == []


def test_a_lamp_is_bright_beside_itself() -> None:
    for shape in (np.s_[40:44, 50:54], np.s_[40:42, 50], np.s_[40, 50:52]):
        color, _ = seen(0, [])
        for half in color:
            half[shape] = 1e4
        assert found(color) == []


def test_a_glint_runs_out() -> None:
    """Each pixel of a line has a neighbour of a fifth of it or more."""
    color, _ = seen(0, [])
    for half in color:
        for i, value in enumerate((0.04, 0.2, 1.0, 0.2, 0.04)):
            half[38 + i, 48 + i] = 1e4 * value
    assert found(color) == []


def test_a_lamp_of_one_pixel_is_bright_in_albedo() -> None:
    color, albedo = seen(1e4, [AT], albedo=True)
    assert found(color, albedo) == []
    albedo[1][AT] = smooth()[AT]  # of one half only: noise
    assert found(color, albedo) == [[*AT]]


@pytest.mark.parametrize("value", [5.0, 30.0])
def test_below_a_hundred_times_two_halves_are_believed(value: float) -> None:
    assert found(seen(value, SPREAD)[0]) == []


def test_stars_in_a_black_sky_are_seen_against_the_frame() -> None:
    sky = tuple(np.zeros((*SIZE, 3), np.float32) for _ in "ab")
    for half in sky:
        half[10::20, 10::20] = 8.0
    assert found(sky) == []


@pytest.mark.parametrize("value", [0.0, 1.0, 1e30])
def test_flat_frames_have_none(value: float) -> None:
    assert found(twice(np.full((5, 6, 3), value, np.float32))) == []
    assert found(twice(np.full((1, 1, 3), min(value, 1.0), np.float32))) == []


def test_setting_aside_changes_these_pixels_only_and_nothing_of_the_caller() -> None:
    color, _ = seen(1e4, [AT])
    denoised = torch.from_numpy(smooth())
    a, b = (Half(torch.from_numpy(half), denoised * (i + 1)) for i, half in enumerate(color))
    kept = [half.color.clone() for half in (a, b)]
    places = torch.tensor([AT])
    for number, half in enumerate(set_aside((a, b), places)):
        changed = (half.color != kept[number]).any(-1).nonzero()
        assert changed.tolist() == [[*AT]]
        assert torch.equal(half.color[AT], denoised[AT] * (number + 1)), "its own denoised image: no half knows another"
    assert all(torch.equal(half.color, before) for half, before in zip((a, b), kept, strict=True))
    assert set_aside((a, b), torch.empty(0, 2)) == (a, b)


def test_exposure_does_not_matter() -> None:
    color, _ = seen(1e4, [AT])
    for scale in (1e-20, 1e20):
        halves = [Half(torch.from_numpy(half).double() * scale) for half in color]
        assert lone_pixels((halves[0], halves[1]), 1 / scale).tolist() == [[*AT]]


def test_without_the_guard_the_published_method_stays_what_it_is() -> None:
    color, albedo = seen(1e4, [AT])
    frame = Frame(color=color, albedo=albedo, denoised=twice(smooth()))
    settings = Settings.preset("balanced", steps=1, patch=16, batch=1, window=5, guard=False)
    assert correct(frame, settings).lone == 0


def test_the_command_tells_of_it(tmp_path: Path) -> None:
    channels = {}
    for seed, half in enumerate("ab"):
        plane = np.random.default_rng(seed).random((24, 30), dtype=np.float32)
        plane[12, 15] = 2e3
        channels[half] = write_half(tmp_path / f"{half}.exr", seed, **dict.fromkeys("RGB", plane))
    result = call("frame", channels["a"], channels["b"], "-o", tmp_path / "o.exr", *FLAGS)
    assert result.returncode == 0, result.stderr
    assert "left as the denoiser has them: 1 pixels that both halves show" in result.stderr
