"""relMSE and other metrics against plain NumPy or a closed form; standard errors against the spread they predict."""

import dataclasses
import itertools
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
from helpers.images import SHAPE, radiance
from helpers.tolerances import EXACT, SSIM, STANDARD_ERROR, TEMPORAL

from selfcorrect import metrics
from selfcorrect.errors import FrameError


def tiled(values: np.ndarray) -> np.ndarray:
    """One value a tile to an image (16·rows, 16·columns, 3)."""
    return np.repeat(np.kron(values, np.ones((16, 16)))[:, :, None], 3, axis=2)


def test_relmse_with_one_reference() -> None:
    x, r = radiance(0), radiance(1)
    expected = sum(
        (x[i, j, k] - r[i, j, k]) ** 2 / (r[i, j].mean() ** 2 + 0.01) for i, j, k in np.ndindex(SHAPE)
    ) / math.prod(SHAPE)
    assert metrics.relmse(x, r) == pytest.approx(expected, rel=EXACT, abs=0)


def test_relmse_with_two_references_and_a_smooth_one() -> None:
    x, a, b, s = (radiance(seed) for seed in range(4))
    product = (x - a) * (x - b)
    smooth = np.mean(product / (s.mean(axis=2, keepdims=True) ** 2 + 0.01))
    mean = np.mean(product / (((a + b) / 2).mean(axis=2, keepdims=True) ** 2 + 0.01))
    assert metrics.relmse(x, a, b, s) == pytest.approx(smooth, rel=EXACT, abs=0)
    assert metrics.relmse(x, a, b) == pytest.approx(mean, rel=EXACT, abs=0)
    assert smooth != pytest.approx(mean, rel=0.01)


def test_temporal_error() -> None:
    x, y, *references = (radiance(seed) for seed in range(8))
    a, b, s = references[:2], references[2:4], references[4:]
    product = ((x - y) - (a[0] - a[1])) * ((x - y) - (b[0] - b[1]))

    def expected(weight: list[np.ndarray]) -> float:
        level = sum(w.mean(axis=2, keepdims=True) ** 2 for w in weight) / 2 + 0.01
        return float(np.mean(product / level))

    pairs = (tuple(a), tuple(b))
    assert metrics.temporal_error(x, y, *pairs, tuple(s)) == pytest.approx(expected(s), rel=EXACT, abs=0)
    means = [(a[i] + b[i]) / 2 for i in (0, 1)]
    assert metrics.temporal_error(x, y, *pairs) == pytest.approx(expected(means), rel=EXACT, abs=0)


def test_temporal_error_knows_flicker_and_no_static_error() -> None:
    """Unbiased with noisy references: a static error has none, independent errors add up."""
    truth = radiance(0, (128, 128, 3))
    rng = np.random.default_rng(1)

    def noise(size: float) -> np.ndarray:
        return rng.normal(0, size, truth.shape)

    references = [tuple(truth + noise(0.2) for _ in range(2)) for _ in "ab"]
    smooth = (truth, truth)
    static = noise(0.1)
    assert metrics.temporal_error(truth + static, truth + static, *references, smooth) == pytest.approx(0, abs=TEMPORAL)
    one, two = truth + noise(0.5), truth + noise(0.5)
    both = metrics.relmse(one, truth) + metrics.relmse(two, truth)
    assert metrics.temporal_error(one, two, *references, smooth) == pytest.approx(both, rel=0.05)


def test_relmse_is_unbiased_with_noisy_references() -> None:
    truth = radiance(0)
    x = truth * 1.1
    true = metrics.relmse(x, truth)
    two, one = [], []
    for seed in range(200):
        noise = np.random.default_rng(seed).normal(0, 0.2, (2, *SHAPE))
        two.append(metrics.relmse(x, truth + noise[0], truth + noise[1], truth))
        one.append(metrics.relmse(x, truth + noise[0], weight=truth))
    standard_error = np.std(two, ddof=1) / math.sqrt(len(two))
    assert standard_error < 0.05 * true
    assert abs(np.mean(two) - true) < 4 * standard_error
    assert np.mean(one) > 5 * true


def test_mean_of_the_references_as_weight_lets_a_dark_image_win() -> None:
    truth = np.ones((64, 64, 3))
    paths = np.random.default_rng(0).random((2, 64, 64, 1)) < 0.05
    a, b = np.where(paths, 20.0, 0.0) * truth  # rare bright paths of the right mean, missed by most pixels
    dark = 0.3 * truth
    assert metrics.relmse(dark, a, b) < 0.2 * metrics.relmse(truth, a, b)
    assert metrics.relmse(dark, a, b, truth) > metrics.relmse(truth, a, b, truth) + 0.3


@pytest.mark.parametrize(
    "convert",
    [
        lambda x: torch.from_numpy(x.copy()),
        lambda x: torch.from_numpy(x.copy()).float(),
        lambda x: torch.from_numpy(x.copy()).requires_grad_(),
        lambda x: x.astype(np.float32),
        lambda x: x.astype(">f4"),
        lambda x: x[::-1].copy()[::-1],
        np.asfortranarray,
    ],
    ids=["tensor", "tensor32", "tensor-grad", "float32", "big-endian", "flipped", "fortran"],
)
def test_every_kind_of_array_gives_the_same_numbers(convert: Callable[[np.ndarray], metrics.Image]) -> None:
    x, a, b, s = (np.round(radiance(seed) * 1024) / 1024 for seed in range(4))  # exact in single precision
    x.setflags(write=False)
    expected = metrics.compare(x, a, b, s)
    assert metrics.compare(convert(x), convert(a), convert(b), convert(s)) == expected


def test_input_is_left_as_it_is() -> None:
    x, r = radiance(0) - 0.2, torch.from_numpy(radiance(1) - 0.2)
    x_before, r_before = x.copy(), r.clone()
    metrics.compare(x, r)
    np.testing.assert_array_equal(x, x_before)
    torch.testing.assert_close(r, r_before, rtol=0, atol=0)


def test_standard_error_is_the_spread_over_images() -> None:
    reference = np.ones((128, 160, 3))
    offsets = (np.random.default_rng(seed).uniform(0, 1, (8, 10)) for seed in range(40))
    claims = [metrics.relmse_standard_error(reference + tiled(each), reference) for each in offsets]
    exact = math.sqrt((1 / 5 - 1 / 9) / 80) / 1.01  # the variance of the square of a uniform number; 80 tiles
    assert np.mean(claims) == pytest.approx(exact, rel=0.05)


def test_standard_error_of_equal_tiles_in_closed_form() -> None:
    reference = np.ones((128, 160, 3))
    values = np.random.default_rng(0).gamma(2.0, 0.3, (8, 10))
    errors = values**2 / 1.01
    x = reference + tiled(values)
    exact = np.std(errors) / math.sqrt(errors.size)
    assert metrics.relmse_standard_error(x, reference) == pytest.approx(exact, rel=STANDARD_ERROR)


def test_short_tiles_weigh_their_pixels() -> None:
    reference = np.zeros((37, 16, 3))  # tiles of 16, 16 and 5 rows
    x = reference.copy()
    x[:16], x[16:32], x[32:] = 0.1, 0.2, 0.6
    errors, pixels = np.array([1.0, 4.0, 36.0]), np.array([16, 16, 5])
    outcomes = [
        (errors * pixels)[list(drawn)].sum() / pixels[list(drawn)].sum()
        for drawn in itertools.product(range(3), repeat=3)
    ]
    assert metrics.relmse(x, reference) == pytest.approx((errors * pixels).sum() / 37, rel=EXACT, abs=0)
    assert metrics.relmse_standard_error(x, reference) == pytest.approx(np.std(outcomes), rel=0.08)
    across = metrics.relmse_standard_error(x.transpose(1, 0, 2), reference.transpose(1, 0, 2))
    assert across == metrics.relmse_standard_error(x, reference)


def test_single_tile_has_no_standard_error() -> None:
    x, r = radiance(0, (16, 16, 3)), radiance(1, (16, 16, 3))
    assert math.isnan(metrics.relmse_standard_error(x, r))
    ratio = metrics.relmse_ratio(x, 2 * x, r)
    assert ratio.value > 0
    assert math.isnan(ratio.standard_error)


def test_seed_decides_and_global_state_is_untouched() -> None:
    x, r = radiance(0), radiance(1)
    before = torch.get_rng_state()
    first = metrics.relmse_standard_error(x, r, seed=1)
    assert metrics.relmse_standard_error(x, r, seed=1) == first
    assert metrics.relmse_standard_error(x, r, seed=torch.Generator().manual_seed(1)) == first
    assert metrics.relmse_standard_error(x, r, seed=2) != first
    assert metrics.relmse_ratio(x, r * 1.1, r, seed=1) == metrics.relmse_ratio(x, r * 1.1, r, seed=1)
    torch.testing.assert_close(torch.get_rng_state(), before)


def test_ratio_of_errors_in_proportion_is_certain() -> None:
    r = radiance(0)
    offset = radiance(1)
    ratio = metrics.relmse_ratio(r + 0.5 * offset, r + offset, r)
    assert ratio.value == pytest.approx(0.25, rel=EXACT, abs=0)
    assert ratio.standard_error == pytest.approx(0, abs=EXACT)


def test_ratio_uses_every_reference() -> None:
    x, y, a, b, s = (radiance(seed) for seed in range(5))
    ratio = metrics.relmse_ratio(x, y, a, b, s).value
    assert ratio == pytest.approx(metrics.relmse(x, a, b, s) / metrics.relmse(y, a, b, s), rel=EXACT, abs=0)


def test_paired_standard_error_is_the_spread_of_the_ratio() -> None:
    reference = np.ones((128, 160, 3))
    ratios, claims = [], []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        hard = rng.uniform(0, 1, (8, 10))  # what is hard is hard for both
        a, b = (hard * rng.uniform(0.8, 1.0, (8, 10)) for _ in range(2))
        ratios.append((a**2).mean() / (b**2).mean())
        if seed < 30:
            estimate = metrics.relmse_ratio(reference + tiled(a), reference + tiled(b), reference)
            assert estimate.value == pytest.approx(ratios[-1], rel=EXACT, abs=0)
            claims.append(estimate.standard_error)
    assert np.mean(claims) == pytest.approx(np.std(ratios, ddof=1), rel=0.1)
    image = reference + tiled(a)
    alone = metrics.relmse_standard_error(image, reference) / metrics.relmse(image, reference)
    assert np.mean(claims) < 0.3 * alone


def test_ratio_to_an_uncertain_error_is_uncertain() -> None:
    r = np.ones((16, 48, 3))
    b = r.copy()
    b[:, :16] = 1.1  # a draw that misses this tile has no error to divide by
    assert metrics.relmse_ratio(r + 0.1, b, r).standard_error == math.inf


def test_ratio_to_no_error_is_refused() -> None:
    r = radiance()
    with pytest.raises(FrameError, match=r"image_b with a relMSE above 0 to divide by, but got 0$"):
        metrics.relmse_ratio(r * 2, r, r)


def test_mean_radiance_ratio() -> None:
    x, r = radiance(0), radiance(1)
    assert metrics.mean_radiance_ratio(x, r) == pytest.approx(x.sum() / r.sum(), rel=EXACT, abs=0)
    assert metrics.mean_radiance_ratio(r * 0.67, r) == pytest.approx(0.67, rel=EXACT, abs=0)
    with pytest.raises(FrameError, match=r"a mean radiance above 0, but got 0$"):
        metrics.mean_radiance_ratio(x, np.zeros(SHAPE))


def test_compare_is_the_sum_of_its_parts() -> None:
    x, a, b, s = (radiance(seed) for seed in range(4))
    mean = (a + b) / 2
    comparison = metrics.compare(x, a, b, s, seed=5)
    assert comparison == metrics.Comparison(
        relmse=metrics.relmse(x, a, b, s),
        relmse_standard_error=metrics.relmse_standard_error(x, a, b, s, seed=5),
        psnr=metrics.psnr(x, mean),
        ssim=metrics.ssim(x, mean),
        flip=metrics.flip(x, mean),
        mean_radiance_ratio=metrics.mean_radiance_ratio(x, mean),
    )
    assert metrics.compare(x, a).psnr == metrics.psnr(x, a)
    assert all(type(value) is float for value in dataclasses.asdict(comparison).values())
    with pytest.raises(dataclasses.FrozenInstanceError):
        comparison.flip = 0.0  # that this is refused is the point


def test_compare_with_itself_is_perfect() -> None:
    comparison = metrics.compare(radiance(), radiance())
    assert dataclasses.astuple(comparison) == (0, 0, math.inf, pytest.approx(1, abs=SSIM), 0, 1)


TWO_IMAGES = [metrics.relmse, metrics.relmse_standard_error, metrics.psnr, metrics.ssim, metrics.flip]
TWO_IMAGES += [metrics.mean_radiance_ratio, metrics.compare]


@pytest.mark.parametrize("metric", TWO_IMAGES)
@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda x: x[:, :40], "of 48×32 pixels like the image, but got 40×32"),
        (lambda x: x[..., 0], r"of shape (H, W, 3), but got (32, 48)"),
        (lambda x: x[:0], r"of shape (H, W, 3), but got (0, 48, 3)"),
        (lambda x: np.concatenate([x, x], axis=2), r"of shape (H, W, 3), but got (32, 48, 6)"),
        (lambda x: np.where(x == x[5, 7, 1], np.nan, x), "got 1 values that are NaN or infinite"),
        (lambda x: np.where(x == x[5, 7, 1], -np.inf, x), "the first at row 5, column 7: repair"),
    ],
    ids=["size", "gray", "empty", "channels", "nan", "inf"],
)
def test_bad_reference_is_one_clear_line(
    metric: Callable[..., object], spoil: Callable[[np.ndarray], np.ndarray], message: str
) -> None:
    with pytest.raises(FrameError) as caught:
        metric(radiance(0), spoil(radiance(1)))
    assert message in str(caught.value)
    assert "reference" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["image", "reference", "reference_b", "weight"])
@pytest.mark.parametrize("metric", [metrics.relmse, metrics.relmse_standard_error, metrics.compare])
def test_the_message_names_the_image_at_fault(metric: Callable[..., object], name: str) -> None:
    images = {each: radiance() for each in ("image", "reference", "reference_b", "weight")}
    images[name][2, 3, 0] = np.nan
    with pytest.raises(FrameError, match=f"in {name}, but got 1 values .* row 2, column 3"):
        metric(**images)


@pytest.mark.parametrize("name", ["image_a", "image_b"])
def test_the_ratio_names_the_image_at_fault(name: str) -> None:
    images = {each: radiance() for each in ("image_a", "image_b", "reference")}
    images[name][2, 3, 0] = np.nan
    with pytest.raises(FrameError, match=f"in {name}, but got"):
        metrics.relmse_ratio(**images)


@pytest.mark.shared
def test_real_frames(shared: Path) -> None:
    a, b, smooth = (read(shared, f"staircase_ref_{kind}") for kind in ("A", "B", "smooth"))
    halves = [[read(shared, f"staircase_{spp}spp_{half}") for half in "AB"] for spp in ("016", "064", "256")]
    noisy = [(one + other) / 2 for one, other in halves]
    comparisons = [metrics.compare(image, a, b, smooth) for image in noisy]
    for few, many in itertools.pairwise(comparisons):  # four times the samples: a quarter of the variance
        assert few.relmse / many.relmse == pytest.approx(4, rel=0.1)
        assert few.psnr < many.psnr
        assert few.ssim < many.ssim
        assert few.flip > many.flip
    for comparison in comparisons:
        assert 0 < comparison.relmse_standard_error < 0.1 * comparison.relmse
        assert comparison.mean_radiance_ratio == pytest.approx(1, abs=0.005)
    dark = metrics.relmse_ratio(noisy[2] * 0.67, noisy[2], a, b, smooth)
    assert dark.value - 3 * dark.standard_error > 10


def read(shared: Path, name: str) -> np.ndarray:
    with OpenEXR.File(str(shared / "frames" / f"{name}.exr"), separate_channels=True) as file:
        return np.stack([file.channels()[channel].pixels for channel in "RGB"], axis=2).astype(np.float32)
