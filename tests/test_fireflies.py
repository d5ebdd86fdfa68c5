"""Fireflies of one half go; what both halves have seen, and what their noise explains, stays."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from selfcorrect import Frame, Settings, correct
from selfcorrect.fireflies import Removed, Rule, remove_fireflies_
from selfcorrect.metrics import relmse

SIZE = (96, 112)
NOTHING = Removed(0, 0, 0, 0)
Pair = tuple[Tensor, Tensor]


def truth(size: tuple[int, int] = SIZE) -> Tensor:
    """Coloured waves between 0.2 and 1."""
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float32) for n in size), indexing="ij")
    waves = 0.6 + 0.4 * torch.sin(0.2 * x) * torch.cos(0.1 * y)
    return waves[..., None] * torch.tensor([1.0, 0.8, 0.6])


def halves(image: Tensor, deviation: float = 0.03, seed: int = 0) -> list[Tensor]:
    """Denoised halves: the truth times log-normal noise of this deviation."""
    generator = torch.Generator().manual_seed(seed)
    return [image * torch.exp(deviation * torch.randn(image.shape, generator=generator)) for _ in "ab"]


def spot(size: tuple[int, int], y: int, x: int, energy: float = 80.0, width: float = 1.5) -> Tensor:
    """What a denoiser leaves of a firefly: a small blob, (H, W, 1)."""
    rows, columns = torch.meshgrid(*(torch.arange(n, dtype=torch.float32) for n in size), indexing="ij")
    square = (rows - y) ** 2 + (columns - x) ** 2
    return (energy / (2 * math.pi * width**2) * torch.exp(-square / (2 * width**2)))[..., None]


def error(image: Tensor, reference: Tensor) -> float:
    return relmse(image, reference, reference, reference)


def removed(pair: list[Tensor], color: list[Tensor] | None = None, **changes: Any) -> tuple[Tensor, Removed]:
    """From the mean of denoised halves; their noisy ones are by default the same."""
    full = (pair[0] + pair[1]) / 2
    image, noisy = full.clone(), pair if color is None else color
    found = remove_fireflies_(image, (noisy[0], noisy[1]), (pair[0], pair[1]), full, **changes)
    return image, found


@pytest.mark.parametrize("half", [0, 1])
@pytest.mark.parametrize("place", [(40, 50), (0, 0), (95, 60), (48, 111)])
def test_a_firefly_of_one_half_goes(half: int, place: tuple[int, int]) -> None:
    clean, pair = truth(), halves(truth())
    noise = error((pair[0] + pair[1]) / 2, clean)
    pair[half] = pair[half] + spot(SIZE, *place)
    before = error((pair[0] + pair[1]) / 2, clean)
    image, found = removed(pair)
    assert error(image, clean) - noise < 0.02 * before
    assert 0 < found.pixels < 0.02
    assert found.error == pytest.approx(before, rel=0.2), "what it says it was is what it was"


def test_its_surroundings_stay_bit_by_bit() -> None:
    pair = halves(truth())
    pair[0] = pair[0] + spot(SIZE, 40, 50)
    before = (pair[0] + pair[1]) / 2
    image, found = removed(pair)
    changed = (image != before).any(-1)
    assert float(changed.float().mean()) == pytest.approx(found.pixels, abs=1e-6)
    ys, xs = torch.nonzero(changed, as_tuple=True)
    assert int(((ys - 40) ** 2 + (xs - 50) ** 2).max()) <= 14**2
    assert bool((image <= before).all()), "nothing becomes brighter"
    assert found.light == pytest.approx(float((before - image).double().mean() / before.double().mean()), rel=1e-4)


def test_a_lamp_that_both_have_seen_stays() -> None:
    """However different: what a few samples see of a star is a matter of luck."""
    lamp = spot(SIZE, 40, 50, 400.0)
    pair = [half + share * lamp for half, share in zip(halves(truth()), (1.0, 0.25), strict=True)]
    before = (pair[0] + pair[1]) / 2
    image, found = removed(pair)
    assert torch.equal(image, before)
    assert found == NOTHING


def test_noise_explains_itself() -> None:
    """Halves that disagree everywhere by a factor of two or three have no fireflies, though a fixed factor says so."""
    pair = halves(truth(), 0.7)
    ratio = (pair[0].mean(-1) / pair[1].mean(-1)).log().abs()
    assert float((ratio > math.log(3)).float().mean()) > 0.02
    image, found = removed(pair)
    assert found.pixels < 1e-3
    torch.testing.assert_close(image.mean(), (pair[0].mean() + pair[1].mean()) / 2, rtol=1e-3, atol=0)


@pytest.mark.parametrize(("energy", "goes"), [(70.0, False), (20.0, True)])
def test_light_that_the_other_half_has_met_beside_it_stays(energy: float, goes: bool) -> None:
    """A caustic of few paths: the denoiser has taken one half's for noise, noisy pixels tell; a lesser one does not."""
    clean, pair = truth(), halves(truth())
    noisy = [half.clone() for half in pair]
    pair[0] = pair[0] + spot(SIZE, 40, 50)
    noisy[0][40, 50] += 80.0
    noisy[1][43, 46] += energy
    before = (pair[0] + pair[1]) / 2
    image, found = removed(pair, noisy)
    assert (found.pixels > 0) == goes
    assert goes or torch.equal(image, before)
    assert not goes or error(image, clean) < 0.1 * error(before, clean)


@pytest.mark.parametrize(("pixels", "goes"), [(1, True), (2, True), (3, False)])
def test_light_that_many_pixels_of_its_own_half_have_met_stays(pixels: int, goes: bool) -> None:
    """Of the same energy, a few pixels apart; the other half has met none."""
    clean, pair = truth(), halves(truth())
    noise = error((pair[0] + pair[1]) / 2, clean)
    noisy = [half.clone() for half in pair]
    for x in range(pixels):
        pair[0] = pair[0] + spot(SIZE, 40, 50 + 3 * x, 30.0)
        noisy[0][40, 50 + 3 * x] += 30.0
    before = (pair[0] + pair[1]) / 2
    image, found = removed(pair, noisy)
    assert (found.pixels > 0) == goes
    assert goes or torch.equal(image, before)
    assert not goes or error(image, clean) - noise < 0.1 * error(before, clean)


@pytest.mark.parametrize(("paths", "goes"), [(0, True), (1, True), (5, False)])
def test_light_that_neighbouring_frames_have_met_stays(paths: int, goes: bool) -> None:
    """Of nine other halves: what one has met, too, goes but for two ninths; what five have, is what the image shows."""
    clean, pair = truth(), halves(truth())
    noisy = [half.clone() for half in pair]
    pair[0] = pair[0] + spot(SIZE, 40, 50)
    noisy[0][40, 50] += 80.0
    seen = 0.02 * torch.randn(*SIZE, 8, generator=torch.Generator().manual_seed(3))
    seen[43, 46, :paths] += 80.0
    seen[43, 46, 0] *= 50.0  # a path of far greater energy is one path
    before = (pair[0] + pair[1]) / 2
    image, found = removed(pair, noisy, seen=seen)
    assert (found.pixels > 0) == goes
    assert goes or torch.equal(image, before)
    assert not goes or error(image, clean) < 0.1 * error(before, clean)


def test_a_caustic_explains_itself() -> None:
    """A region of 60 pixels where the halves disagree, and the noisy ones more, in a frame where they agree."""
    strength = torch.zeros(*SIZE, 1)
    strength[20:80, 30:90] = 0.7
    pair, noisy = (
        [
            truth() * torch.exp(times * strength * torch.randn(*SIZE, 1, generator=torch.Generator().manual_seed(i)))
            for i in seeds
        ]
        for times, seeds in ((1, (0, 1)), (3, (2, 3)))
    )
    _, found = removed(pair, noisy)
    assert found.pixels < 0.02 * 60 * 60 / (SIZE[0] * SIZE[1]), "of the region's"
    assert found.light < 1e-3


def test_light_that_goes_is_bounded() -> None:
    """Of many fireflies only the worst go, and if one alone is too much, none."""
    pair = halves(truth())
    for number, energy in enumerate((1500.0, *[150.0] * 24)):
        pair[number % 2] = pair[number % 2] + spot(SIZE, 8 + 20 * (number // 5), 8 + 20 * (number % 5), energy)
    before = (pair[0] + pair[1]) / 2
    for most in (1.0, 0.3, 0.2, 0.01):
        image, found = removed(pair, rule=Rule(most=most))
        light = float((before - image).double().mean() / before.double().mean())
        assert light == pytest.approx(found.light, rel=1e-4, abs=1e-9)
        assert light <= most + 1e-9
    everything = removed(pair, rule=Rule(most=1.0))[1].light
    some = removed(pair, rule=Rule(most=0.9 * everything))[1].light
    assert 0 < some < everything
    assert removed(pair, rule=Rule(most=0.0))[1] == NOTHING


@pytest.mark.parametrize("size", [(1, 1), (5, 40), (37, 53), (300, 33)])
def test_it_is_the_rule_that_the_docstring_describes(size: tuple[int, int]) -> None:
    """Equation by equation, on the whole image; it is gone through in bands of 128 rows."""
    pair, noisy = halves(truth(size), 0.1), halves(truth(size), 0.4, seed=1)
    for y in range(0, size[0], 37):
        pair[0] = pair[0] + spot(size, y, size[1] // 2)
        noisy[0] = noisy[0] + spot(size, y, size[1] // 2)
        if y % 2:  # every other one is light that half b has met beside it
            noisy[1][y + 3, size[1] // 2 - 3] += 20
        elif y % 4:  # of the others, every other one half a itself has met thrice
            for shift in (-3, 0, 3):
                noisy[0][y + 2, size[1] // 2 + shift] += 60
    expected = ((pair[0] + pair[1]) / 2).double().numpy()
    (a, b), (ya, yb) = ([half.double().mean(-1).numpy() for half in two] for two in (pair, noisy))
    delta = np.abs(np.log((a + 0.1) / (b + 0.1)))
    usual = np.quantile(np.minimum(a, b), 0.99)
    found = (delta > np.maximum(math.log(3), 4 * spread_around(delta))) & (np.minimum(a, b) <= usual)
    bright, witness = np.where(a > b, windows(a, 2, np.mean), windows(b, 2, np.mean)), [yb, ya]
    mean, deviation = (np.where(a > b, *[windows(y, 2, which) for y in witness]) for which in (np.mean, np.std))
    found &= bright - mean > 2 * deviation / 5
    near = [windows(y, 4, np.max) for y in (ya, yb)]
    met = found & np.where(a > b, near[1] > 0.5 * near[0], near[0] > 0.5 * near[1])
    peaks = [np.where(y == windows(y, 1, np.max), y, 0) for y in (ya, yb)]
    alike = [windows(y, 4, lambda near: (near > 0.5 * near.max()).sum()) for y in peaks]
    many = found & (np.where(a > b, *alike) > 2)
    found &= ~windows(met | many, 4, np.max)
    found &= windows(found & (np.maximum(a, b) > usual), 4, np.max)
    weight = windows(windows(found, 2, np.max).astype(float), 2, np.mean)
    darker = np.where((a < b)[..., None], pair[0].double().numpy(), pair[1].double().numpy())
    expected -= weight[..., None] * np.maximum(expected - darker, 0)
    image, told = removed(pair, noisy, rule=Rule(most=1.0))
    np.testing.assert_allclose(image.numpy(), expected, rtol=1e-5, atol=1e-7)
    assert (told.pixels > 0) == (weight.max() > 0) == (min(size) > 1)


def windows(values: Any, reach: int, of: Any) -> Any:
    """``of`` every pixel and those around it that lie inside the image."""
    height, width = values.shape
    return np.array(
        [
            [of(values[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1]) for x in range(width)]
            for y in range(height)
        ]
    )


def spread_around(delta: Any) -> Any:
    """The third quartile of tiles of 16 pixels, of it the median over 5×5 tiles, enlarged."""
    size = delta.shape
    full = np.pad(delta, [(0, -n % 16) for n in size], mode="edge")
    rows, columns = (n // 16 for n in full.shape)
    tiles = full.reshape(rows, 16, columns, 16).transpose(0, 2, 1, 3).reshape(rows, columns, 256)
    near = np.pad(np.quantile(tiles, 0.75, axis=-1), 2, mode="edge")
    medians = [[np.median(near[i : i + 5, j : j + 5]) for j in range(columns)] for i in range(rows)]
    enlarged = torch.nn.functional.interpolate(torch.tensor(medians)[None, None], size=size, mode="bilinear")
    return enlarged[0, 0].numpy()


def test_exposure_does_not_matter() -> None:
    pair = halves(truth())
    pair[0] = pair[0] + spot(SIZE, 40, 50)
    image, found = removed(pair)
    brighter, again = removed([1024 * half for half in pair], scale=1 / 1024)
    assert torch.equal(brighter / 1024, image)
    assert again[:2] == found[:2]


@pytest.mark.parametrize("value", [0.0, 1e-30, 1e30])
def test_extremes_stay_finite(value: float) -> None:
    flat = torch.full((20, 30, 3), value)
    image, found = removed([flat, flat.clone()])
    assert torch.equal(image, flat)
    assert found == NOTHING
    other = flat.clone()
    other[4, 5] = 3e38
    image, found = removed([flat, other])
    assert bool(image.isfinite().all())
    assert all(math.isfinite(number) for number in found)


@pytest.mark.parametrize("guard", [True, False])
def test_correct_removes_or_keeps(guard: bool) -> None:
    clean = truth()
    denoised = halves(clean)
    color = halves(clean, 0.3, seed=1)
    color[0][40, 50] += 80.0
    denoised[0] = denoised[0] + spot(SIZE, 40, 50)
    frame = Frame((color[0], color[1]), denoised=(denoised[0], denoised[1]))
    settings = {"steps": 2, "patch": 16, "batch": 2, "window": 5, "guard": guard}
    kept = correct(frame, Settings.preset("balanced", fireflies="keep", **settings))
    gone = correct(frame, Settings.preset("balanced", fireflies="remove", **settings))
    assert kept.removed is None
    assert gone.removed is not None
    assert gone.removed.pixels > 0
    assert "fireflies" in gone.seconds
    assert error(gone.image, clean) < 0.1 * error(kept.image, clean)
    assert (gone.estimate is not None) == guard
    if gone.estimate is not None:
        assert gone.estimate.improved
        true = error((denoised[0] + denoised[1]) / 2, clean)
        assert gone.estimate.denoised == pytest.approx(true, rel=0.2)
        assert kept.estimate is not None
        assert kept.estimate.denoised < 0.5 * true, "a firefly hides from its own radiance"
