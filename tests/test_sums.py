"""The picture and the sum of its AOVs: it moves only where the witness is certain that the sum is better."""

import numpy as np
import pytest
import torch

from selfcorrect import AovSum, Frame, Settings, correct, correct_aovs, denoiser_of
from selfcorrect.aovs import correct_sums
from selfcorrect.sums import toward_sum_

SIZE = (70, 83)  # no multiple of any tile
BIASED = (slice(16, 48), slice(16, 48))


def noisy(true, noise=0.3, seed=0):
    """Halves of unbiased, independent, skewed noise of this relative standard deviation."""
    generator = np.random.default_rng(seed)
    draws = [generator.gamma(1 / noise**2, noise**2, tuple(true.shape)) for _ in "ab"]
    return tuple(true * torch.from_numpy(draw).float() for draw in draws)


def biased(true, by=0.5):
    """An image that is wrong in one place."""
    image = true.clone()
    image[BIASED] += by
    return image


def moved(picture, total, color, halves=None, totals=None):
    """What becomes of a picture, and how far it went."""
    image = picture.clone()
    own = tuple(half.clone() for half in halves or (picture, picture))
    far = toward_sum_(image, own, total, totals or (total, total), color, 1.0)
    return image, own, far


def test_where_the_sum_is_better_the_picture_follows():
    true = torch.full((*SIZE, 3), 1.0)
    picture = biased(true)
    image, halves, far = moved(picture, true, noisy(true))
    wrong = 0.08 * ((picture - true) ** 2).mean()  # 0.062: α goes from tile to tile bilinearly
    assert all(((one - true) ** 2).mean() < wrong for one in (image, *halves))
    assert 0.15 < far < 0.5  # the place, and the tiles that it lies in


def test_where_the_picture_is_better_it_stays():
    true = torch.full((*SIZE, 3), 1.0)
    image, _, far = moved(true, biased(true), noisy(true))
    assert far < 0.01  # chance, in a few small tiles
    assert (image - true).abs().mean() < 0.01 * (biased(true) - true).abs().mean()


@pytest.mark.parametrize("seed", range(3))
def test_a_witness_that_cannot_tell_moves_little(seed):
    """The sum is worse by less than what the witness of a small tile can see."""
    true = torch.full((*SIZE, 3), 1.0)
    image, _, far = moved(true, true + 0.05, noisy(true, 2.0, seed))
    assert far < 0.15
    assert (image - true).abs().mean() < 0.15 * 0.05


def test_one_firefly_of_the_witness_moves_nothing():
    """Its own standard error hides what it says."""
    true = torch.full((*SIZE, 3), 1.0)
    hit = noisy(true, 0.05)
    hit[0][40, 40] = 1e4
    image, _, far = moved(true, true + 0.1, hit)
    assert far < 0.01
    assert (image - true).abs().max() < 0.1 * 0.1


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (64, 64), (65, 129)])
def test_any_size(size):
    true = torch.rand(*size, 3, generator=torch.Generator().manual_seed(1))
    image, _, far = moved(true + 0.1, true, noisy(true))
    assert image.isfinite().all()
    assert 0 <= far <= 1


def box(color, albedo=None, normal=None):
    """Mean over 5x5 pixels."""
    planes = torch.nn.functional.pad(color.permute(2, 0, 1)[None], (2, 2, 2, 2), mode="reflect")
    return torch.nn.functional.avg_pool2d(planes, 5, 1)[0].permute(1, 2, 0)


def lamp(seed=0):
    """Two AOVs, of which one has a sharp edge and no noise, and their frame: the denoiser blurs both together."""
    sharp = torch.zeros(*SIZE, 3)
    sharp[20:40, 30:50] = 4.0
    soft = torch.full((*SIZE, 3), 0.5)
    pairs = {"emission": (sharp, sharp.clone()), "diffuse": noisy(soft, 0.2, seed)}
    color = tuple(sum(pair[i] for pair in pairs.values()) for i in (0, 1))
    return {"emission": sharp, "diffuse": soft}, pairs, Frame(color=color).denoise(box)


def test_a_lamp_that_the_denoiser_blurs_in_the_picture_alone():
    """With its halves the picture becomes what the passes say, and no pass takes its blur on; both sums close."""
    true, pairs, frame = lamp()
    sums, denoise = AovSum("passes", pairs), denoiser_of(frame, box)
    image, halves = frame.denoised_full, frame.denoised
    before = correct_aovs(image, frame, sums, denoise)
    after = correct_aovs(image, frame, sums, denoise, halves)
    assert torch.equal(before.picture, image)
    assert after.moved > 0.05
    total = sum(true.values())
    assert ((after.picture - total) ** 2).mean() < 0.5 * ((image - total) ** 2).mean()
    errors = [((found.images["diffuse"] - true["diffuse"]) ** 2).mean() for found in (before, after)]
    assert errors[1] < 0.5 * errors[0]
    for found in (before, after):
        assert torch.allclose(sum(found.images.values()), found.picture, rtol=1e-5, atol=1e-6)
    assert torch.equal(image, frame.denoised_full)  # what was given is not changed
    assert torch.equal(halves[0], frame.denoised[0])


def test_two_sums_have_one_picture():
    _, pairs, frame = lamp()
    generator = torch.Generator().manual_seed(4)
    share = torch.rand(*SIZE, 1, generator=generator)
    groups = {"key": tuple(share * half for half in frame.color), "fill": tuple((1 - share) * h for h in frame.color)}
    both = [AovSum("passes", pairs), AovSum("groups", groups)]
    found = correct_sums(frame.denoised_full, frame, both, denoiser_of(frame, box), frame.denoised)
    assert found[0].picture is found[1].picture
    for one in found:
        assert torch.allclose(sum(one.images.values()), one.picture, rtol=1e-5, atol=1e-6)


def test_a_result_keeps_its_halves_where_they_are_asked_for():
    _, _, frame = lamp()
    settings = Settings.preset("fast", steps=2, patch=16, window=3, batch=1, fireflies="keep")
    plain, kept = (correct(frame, settings, keep_halves=keep) for keep in (False, True))
    assert plain.halves is None
    assert torch.equal(plain.image, kept.image)
    a, b = kept.halves
    assert a.shape == b.shape == kept.image.shape
    assert (a >= 0).all()
    assert (b >= 0).all()
    assert kept.estimate.improved
    assert not torch.equal(a, frame.denoised[0])
    assert ((a + b) / 2 - kept.image).abs().mean() < 0.1 * kept.image.mean()


def test_the_halves_are_the_denoised_ones_where_nothing_is_gained():
    """Noise alone around a constant, which the box denoises better than anything that is trained on two patches."""
    true = torch.full((*SIZE, 3), 1.0)
    frame = Frame(color=noisy(true, 0.05)).denoise(lambda color, **_: torch.full_like(color, 1.0))
    result = correct(frame, Settings.preset("fast", steps=1, patch=16, window=3, batch=1), keep_halves=True)
    assert not result.estimate.improved
    assert torch.allclose(result.halves[0], frame.denoised[0], atol=1e-6)
