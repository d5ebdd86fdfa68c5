"""The guard: takes what is better where it is better, and nothing else; its estimate is what it claims."""

import pytest
import torch
import torch.nn.functional as F
from helpers.tolerances import EXACT, LIGHT, near
from torch import Tensor

from selfcorrect.guard import Estimate, Evidence, Guarded, Pair, keep_above_, keep_light_
from selfcorrect.guard import guard as guard_by_evidence
from selfcorrect.image import bands
from selfcorrect.stages.core.transfer import gained_by_both

SIZE = (160, 192)

Halves = tuple[Tensor, Tensor]


def scene(seed: int = 0) -> Tensor:
    """A smooth image of mean near 1 with fine stripes."""
    y, x = torch.meshgrid(torch.arange(SIZE[0]), torch.arange(SIZE[1]), indexing="ij")
    stripes = 0.2 * torch.sin(1.9 * x + 0.3 * y)
    return (1 + 0.3 * torch.sin(y / 40) + stripes)[..., None].expand(*SIZE, 3).contiguous()


def noise(sigma: float, seed: int) -> Tensor:
    return sigma * torch.randn(*SIZE, 3, generator=torch.Generator().manual_seed(seed))


def run(corrected_error: Tensor, *, sigma: float = 0.5, seed: int = 0, fireflies: int = 0) -> tuple[Guarded, Tensor]:
    """Guard between a denoised image that lost its stripes and one with ``corrected_error``; returns the truth too."""
    truth = scene()
    smooth = (1 + 0.3 * torch.sin(torch.arange(SIZE[0]) / 40))[:, None, None].expand(*SIZE, 3)
    color = [truth + noise(sigma, 10 * seed + i) for i in (1, 2)]
    if fireflies:
        generator = torch.Generator().manual_seed(seed)
        for half in color:
            where = torch.randint(0, SIZE[0] * SIZE[1], (fireflies,), generator=generator)
            half.reshape(-1, 3)[where] += 300.0
    denoised = [smooth + noise(0.02, 10 * seed + i) for i in (3, 4)]
    corrected = [truth + corrected_error + noise(0.02, 10 * seed + i) for i in (5, 6)]
    full, corrected_full = ((pair[0] + pair[1]) / 2 for pair in (denoised, corrected))
    return guard(tuple(color), tuple(denoised), tuple(corrected), full, corrected_full), truth


def guard(color: Pair, denoised: Pair, corrected: Halves, full: Tensor, image: Tensor, scale: float = 1.0) -> Guarded:
    """The guard on whole corrected halves."""
    evidence = Evidence(color, denoised)
    evidence.add(slice(0, image.shape[0]), corrected)
    blend = image.clone()
    return guard_by_evidence(evidence, full, [blend], scale=scale, out=blend)


def error(image: Tensor, truth: Tensor) -> float:
    return float(((image - truth) ** 2).mean())


def denoised_error() -> float:
    return 0.02  # stripes of amplitude 0.2


@pytest.mark.parametrize("seed", range(3))
def test_a_better_image_is_taken(seed: int) -> None:
    guarded, truth = run(torch.zeros(*SIZE, 3), seed=seed)
    assert guarded.estimate.improved
    assert error(guarded.image, truth) < 0.15 * denoised_error()
    assert guarded.estimate.change < -0.7


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("size", [0.3, 1.0, 30.0])
def test_a_worse_image_is_left(size: float, seed: int) -> None:
    """Errors of the corrected image that have nothing to do with those of the denoised one."""
    guarded, truth = run(noise(size, 99), seed=seed)
    assert error(guarded.image, truth) < 1.02 * denoised_error()


@pytest.mark.parametrize("seed", range(3))
def test_only_the_better_part_is_taken(seed: int) -> None:
    worse = noise(1.0, 98)
    worse[:, : SIZE[1] // 2] = 0
    guarded, truth = run(worse, seed=seed)
    left, right = guarded.maps()[0][:, : SIZE[1] // 2 - 16], guarded.maps()[0][:, SIZE[1] // 2 + 16 :]
    assert left.mean() > 0.8
    assert right.mean() < 0.15
    assert error(guarded.image, truth) < 0.7 * denoised_error()


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("size", [0.0, 1.0])
def test_fireflies_in_the_witness_do_no_harm(size: float, seed: int) -> None:
    guarded, truth = run(noise(size, 97), seed=seed, fireflies=40)
    assert error(guarded.image, truth) < 1.02 * denoised_error()


@pytest.mark.parametrize("filter_width", [0.0, 0.5])
@pytest.mark.parametrize("reach", [1, 4])
def test_a_mean_of_its_own_half_s_noise_is_seldom_taken(reach: int, filter_width: float) -> None:
    """Nothing is to be gained; the noise of both halves is the evidence, with a wide pixel filter also in its tiles.

    A judgement of one direction by the other would see a gain nearly always: both sum the same products of noise.
    """
    truth, taken, seeds = scene(), 0, 20
    for seed in range(seeds):
        color = [truth + filtered(noise(0.5, 10 * seed + i), filter_width) for i in (1, 2)]
        a, b = (truth + 0.3 * filtered(half - truth, reach / 2) / (2 * reach) for half in color)
        guarded = guard((color[0], color[1]), (truth, truth), (a, b), truth, (a + b) / 2)
        taken += guarded.estimate.improved
    assert taken <= 5, "one in twenty, were the tiles independent"


def filtered(image: Tensor, width: float) -> Tensor:
    """Filtered by a Gaussian of this deviation in pixels; white noise keeps its variance."""
    if not width:
        return image
    at = torch.arange(-4.0, 5.0)
    weights = torch.exp(-(at**2) / (2 * width**2))
    weights /= weights.square().sum().sqrt()
    planes = F.pad(image.permute(2, 0, 1)[:, None], (4, 4, 4, 4), mode="replicate")
    rows = F.conv2d(planes, weights.reshape(1, 1, 1, 9))
    return F.conv2d(rows, weights.reshape(1, 1, 9, 1))[:, 0].permute(1, 2, 0)


def test_nothing_to_gain_gives_the_denoised_image() -> None:
    color = (scene() + noise(0.3, 1), scene() + noise(0.3, 2))
    denoised = (scene(), scene())
    guarded = guard(color, denoised, denoised, scene(), scene())
    assert not guarded.estimate.improved
    assert torch.equal(guarded.image, scene())
    assert guarded.maps()[0].eq(0).all()
    assert "no gain" in str(guarded.estimate)


def test_the_estimate_of_the_halves_is_unbiased() -> None:
    """Denoised images that do not depend on the noise: the true error is known."""
    truth = scene()
    for seed in range(3):
        guarded, _ = run(torch.zeros(*SIZE, 3), sigma=0.3, seed=seed)
        smooth = (1 + 0.3 * torch.sin(torch.arange(SIZE[0]) / 40))[:, None, None].expand(*SIZE, 3)
        weight = 1 / (smooth.mean(-1) ** 2 + 0.01)
        true = float((weight[..., None] * (smooth - truth) ** 2).mean())
        assert guarded.estimate.denoised == pytest.approx(true, rel=0.1)
        assert guarded.estimate.noisy == pytest.approx(float(weight.mean()) * 0.3**2 / 2, rel=0.05)
        assert guarded.maps()[1].mean() == pytest.approx(true, rel=0.15)
        assert guarded.maps()[2].mean() < 0.5 * guarded.maps()[1].mean()


def test_the_estimate_is_in_the_units_of_the_frame() -> None:
    """A frame of a tenth of the radiance, scaled by ten before the guard, has the relMSE of the dark frame.

    Relative to the output, the best image there is.
    """
    truth = scene()
    color = (truth + noise(0.3, 1), truth + noise(0.3, 2))
    denoised = (truth + 0.1, truth + 0.1)
    guarded = guard(color, denoised, (truth, truth), denoised[0], truth, scale=10.0)
    weight = 1 / ((guarded.image / 10).mean(-1) ** 2 + 0.01)
    assert guarded.estimate.denoised == pytest.approx(float((weight * 0.01**2).mean()), rel=0.1)


def test_light_is_kept() -> None:
    color = (scene() + noise(0.1, 1), scene() + noise(0.1, 2))
    mean = float((color[0] + color[1]).mean() / 2)
    certainty = 0.1 / 2**0.5 / (SIZE[0] * SIZE[1] * 3) ** 0.5
    for factor in (0.985, 1.015):
        kept = keep_light_(scene() * factor, scene() * factor, color)
        assert float(kept.mean()) == pytest.approx(mean, abs=3.2 * certainty)
    for factor in (0.8, 1.2):
        kept = keep_light_(scene() * factor, scene(), color)
        assert float(kept.mean()) == pytest.approx(mean, abs=3.2 * certainty), "the denoised image has kept the light"
        alone = keep_light_(scene() * factor, scene() * factor, color)
        change = float(alone.mean() / scene().mean()) / factor
        assert change == pytest.approx(1.02 if factor < 1 else 1 / 1.02, rel=LIGHT), "never scaled by more"
    assert torch.equal(keep_light_(scene(), scene(), color), scene())
    black = torch.zeros(*SIZE, 3)
    assert torch.equal(keep_light_(black, scene(), color), black)


@pytest.mark.parametrize("at", [(0, 0), (31, 7), (32, 8), (SIZE[0] - 1, SIZE[1] - 1)])
def test_no_pixel_is_darker_than_all_that_was_seen(at: tuple[int, int]) -> None:
    """Neither than the denoised image; what the halves have met in their mean, and all that is brighter, stays."""
    color, denoised = (torch.full((*SIZE, 3), 0.5), torch.full((*SIZE, 3), 0.7)), torch.ones(*SIZE, 3)
    image = torch.full((*SIZE, 3), 0.6)
    image[at] = torch.tensor([0.0, 0.599, 3.0])
    kept = keep_above_(image.clone(), denoised, color)
    assert kept[at].tolist() == pytest.approx([0.6, 0.6, 3.0])
    changed = (kept != image).any(-1)
    assert changed.nonzero().tolist() == [list(at)]

    dim = denoised.clone()
    dim[at] = 0.2
    assert keep_above_(image.clone(), dim, color)[at].tolist() == pytest.approx([0.2, 0.599, 3.0])
    dark = tuple(half.clone() for half in color)
    for half in dark:
        half[min(at[0] + 1, SIZE[0] - 1), max(at[1] - 1, 0)] = 0.1
    assert keep_above_(image.clone(), denoised, (dark[0], dark[1]))[at].tolist() == pytest.approx([0.1, 0.599, 3.0])


@pytest.mark.parametrize("improves", [True, False])
def test_bands_of_rows_give_what_the_whole_image_gives(improves: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A frame of many bands, whose last tiles are smaller, with fireflies on both sides of a band's border."""
    size = (301, 90)

    def draw(sigma: float, seed: int) -> Tensor:
        return sigma * torch.randn(*size, 3, generator=torch.Generator().manual_seed(seed))

    truth = 1 + 0.3 * torch.linspace(0, 40, size[0]).sin()[:, None, None].expand(*size, 3)
    color = (truth + draw(0.2, 1), truth + draw(0.2, 2))
    denoised = (1 + draw(0.02, 3).abs(), 1 + draw(0.02, 4).abs())
    denoised[0][126:130, 40] = 30
    full = (denoised[0] + denoised[1]) / 2
    image = truth if improves else full
    corrected = (truth + draw(0.02, 5), truth + draw(0.02, 6)) if improves else denoised

    def run() -> tuple[Guarded, Tensor, Tensor]:
        guarded = guard(color, denoised, corrected, full, image, scale=0.7)
        return guarded, gained_by_both(denoised, full + 0.01), keep_light_(0.9 * guarded.image, full, color)

    (banded, gained, lit), _ = run(), monkeypatch.setattr(bands, "_BAND", 1024)
    whole, gained_whole, lit_whole = run()
    assert whole.estimate.improved == improves
    assert 0 < gained_whole.min() < gained_whole.max()
    torch.testing.assert_close(gained, gained_whole, rtol=1e-9, atol=0)
    torch.testing.assert_close(banded.image, whole.image, rtol=2e-7, atol=1e-9)
    torch.testing.assert_close(torch.stack(banded.maps()), torch.stack(whole.maps()), **near("guard in bands"))
    torch.testing.assert_close(lit, lit_whole, rtol=2e-7, atol=1e-9)
    for name, value in vars(whole.estimate).items():
        assert getattr(banded.estimate, name) == pytest.approx(value, rel=EXACT, abs=0), name


def test_fireflies_that_are_gone_were_an_error_of_the_denoised_image() -> None:
    estimate = Estimate(0.5, 0.02, 0.02, 0.0, 0.0, improved=False).without(0.06, 0.04)
    assert (estimate.denoised, estimate.corrected, estimate.improved) == (0.08, 0.02, True)
    assert estimate.change == pytest.approx(-0.75)
    assert estimate.standard_error == pytest.approx(0.25 * 0.04 / 0.08), "of one minus 0.02 over the error before"
    huge = Estimate(0.5, 1e36, 1e36, 0.0, 0.0, improved=False)
    assert huge.without(1e3, 1e3) is huge, "no gain is claimed that rounding hides"


def test_an_error_that_nothing_judges_makes_a_claim_smaller() -> None:
    claimed = Estimate(1.0, 0.2, 0.1, -0.5, 0.1, improved=True)
    told = claimed.with_unjudged(0.3)
    assert (told.denoised, told.corrected, told.improved) == (pytest.approx(0.5), pytest.approx(0.4), True)
    assert told.change == pytest.approx(0.4 / 0.5 - 1)
    assert told.standard_error == pytest.approx(0.1 * 0.2 / 0.5)
    assert claimed.with_unjudged(0.0) == claimed
    nothing = Estimate(0.0, 0.0, 0.0, 0.0, 0.0, improved=False)
    assert nothing.with_unjudged(0.0) == nothing
    assert claimed.with_unjudged(1e30).change < 0, "what was improved stays so"
