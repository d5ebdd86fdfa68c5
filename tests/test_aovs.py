"""AOVs that sum to the corrected picture: the division of the gap, and the whole on small frames."""

import itertools

import pytest
import torch

from selfcorrect import AovSum, Frame, SelfcorrectError, Settings, correct, correct_aovs, denoiser_of
from selfcorrect.aovs import correct_alone, reconciled


def projected(x, v, target):
    """The minimum by its definition: of all sets of AOVs that are held at 0, the best one that is allowed."""
    best, found = float("inf"), None
    for free in itertools.product((False, True), repeat=len(x)):
        mask = torch.tensor(free)
        if not mask.any():
            continue
        o = torch.where(mask, x + v * (target - x[mask].sum()) / v[mask].sum(), 0.0)
        cost = float(((o - x) ** 2 / v).sum())
        if (o >= 0).all() and cost < best:
            best, found = cost, o
    return found


@pytest.mark.parametrize("count", [1, 2, 3, 6])
def test_the_gap_is_divided_as_the_minimum_says(count):
    generator = torch.Generator().manual_seed(count)
    x, v = (torch.rand(count, 40, generator=generator, dtype=torch.float64) for _ in range(2))
    target = torch.rand(40, generator=generator, dtype=torch.float64) * count
    result = reconciled(x, v, target)
    for pixel in range(40):
        expected = projected(x[:, pixel], v[:, pixel], target[pixel])
        assert torch.allclose(result[:, pixel], expected, rtol=1e-9, atol=1e-12)


def test_the_sum_closes_in_double_precision():
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(11, 64, 65, 3, generator=generator, dtype=torch.float64) ** 8 * 1e4
    v = torch.rand(11, 64, 65, 3, generator=generator, dtype=torch.float64) ** 8 + 1e-20
    x[torch.rand(x.shape, generator=generator) < 0.5] = 0
    target = torch.rand(64, 65, 3, generator=generator, dtype=torch.float64) ** 4 * 1e4
    target[:4] = 0
    result = reconciled(x, v, target)
    assert (result >= 0).all()
    assert torch.allclose(result.sum(0), target, rtol=1e-12, atol=1e-12)


def test_what_has_no_error_is_left():
    x = torch.tensor([[1.0], [2.0], [0.0]], dtype=torch.float64)
    v = torch.tensor([[0.5], [0.0], [0.0]], dtype=torch.float64)
    assert reconciled(x[:1], v[:1], torch.tensor([3.0], dtype=torch.float64)).tolist() == [[3.0]]
    two = reconciled(torch.stack([x[0], x[2]]), torch.stack([v[0], v[2]]), torch.tensor([0.25], dtype=torch.float64))
    assert two.tolist() == [[0.25], [0.0]]


SIZE = (40, 37)


def box(color, albedo=None, normal=None):
    """A denoiser that sees less than is there."""
    image = color.permute(2, 0, 1)[None]
    return torch.nn.functional.avg_pool2d(image, 5, 1, 2, count_include_pad=False)[0].permute(1, 2, 0)


def rendered(count=4, noise=0.3, seed=0):
    """True AOVs, and halves of them whose noise is independent; the first is 0 in a part of the frame."""
    generator = torch.Generator().manual_seed(seed)
    true = [torch.rand(*SIZE, 3, generator=generator) * (1 + i) for i in range(count)]
    true[0][:, :20] = 0

    def half():
        return [t * (1 + noise * torch.randn(*SIZE, 3, generator=generator)).clamp(min=0) for t in true]

    return true, list(zip(half(), half(), strict=True))


def corrected(pairs, factor=1.0, **more):
    picture = tuple(sum(pair[i] for pair in pairs) for i in (0, 1))
    frame = Frame(color=picture).denoise(box)
    image = factor * frame.denoised_full + 0.1
    named = {f"aov{i}": pair for i, pair in enumerate(pairs) if f"aov{i}" not in more.pop("but", ())}
    return image, correct_aovs(image, frame, AovSum("these", named, **more), denoiser_of(frame, box)), frame


def test_aovs_sum_to_the_picture():
    _, pairs = rendered()
    image, found, _ = corrected(pairs, 1.1)
    total = sum(image.double() for image in found.images.values())
    assert float((total - image).abs().max() / image.mean()) < 1e-6
    assert all((one >= 0).all() for one in found.images.values())
    assert 0.05 < found.gap < 1
    assert found.closing < 1e-6


def test_nothing_appears_where_a_pass_is_zero():
    _, pairs = rendered()
    _, found, _ = corrected(pairs)
    assert (found.images["aov0"][:, :19] == 0).all()
    assert (found.images["aov0"][:, 21:] > 0).any()


def test_nothing_appears_where_the_colour_is_zero():
    _, pairs = rendered()
    color = torch.ones(*SIZE, 3)
    color[3, 5] = 0
    image, found, _ = corrected(pairs, colors={"aov1": color})
    assert (found.images["aov1"][3, 5] == 0).all()
    assert torch.allclose(sum(found.images.values()), image, rtol=1e-5)


def test_light_that_no_pass_has_comes_into_one_that_may():
    """Where all passes are 0 and the picture is not, the sum comes first; a pass of colour 0 cannot have it."""
    pairs = [tuple(torch.zeros(*SIZE, 3) for _ in "ab") for _ in range(2)]
    lit = torch.rand(*SIZE, 3, generator=torch.Generator().manual_seed(1))
    pairs[0][0][:, :5] = pairs[0][1][:, :5] = lit[:, :5]
    image, found, _ = corrected(pairs, colors={"aov1": torch.zeros(*SIZE, 3)})
    assert torch.allclose(found.images["aov0"], image, rtol=1e-5)
    assert not found.images["aov1"].any()


def test_a_pass_without_noise_is_kept_where_the_denoiser_would_blur_it():
    true, pairs = rendered(noise=0.0)
    _, found, frame = corrected(pairs)
    blurred = box(true[3])
    image = correct_alone(frame, "aov3", pairs[3], denoiser_of(frame, box))
    assert ((image - true[3]) ** 2).mean() < 0.5 * ((blurred - true[3]) ** 2).mean()
    assert found.closing < 1e-6


def test_the_gap_goes_where_halves_differ():
    """An AOV without noise, that the denoiser leaves as it is, keeps its light; the noisy one beside it gives way."""
    generator = torch.Generator().manual_seed(3)
    calm = torch.full((*SIZE, 3), 0.7)
    noisy = tuple(0.7 + 0.3 * torch.rand(*SIZE, 3, generator=generator) for _ in "ab")
    pairs = [(calm, calm.clone()), noisy]
    image, found, _ = corrected(pairs, 1.2)
    assert found.gap > 0.1
    moved = [
        float((found.images[f"aov{i}"] - box((pair[0] + pair[1]) / 2)).abs().mean()) for i, pair in enumerate(pairs)
    ]
    assert moved[0] < 1e-4 * moved[1]
    assert torch.allclose(sum(found.images.values()), image, rtol=1e-5)


def test_the_division_is_that_of_any_exposure():
    """What is dark is so beside the picture's mean."""
    _, pairs = rendered()
    found = []
    for factor in (1.0, 2.0**-12):
        exposed = {f"aov{i}": tuple(factor * half for half in pair) for i, pair in enumerate(pairs)}
        frame = Frame(color=tuple(sum(pair[i] for pair in exposed.values()) for i in (0, 1))).denoise(box)
        images = correct_aovs(1.1 * frame.denoised_full, frame, AovSum("x", exposed), denoiser_of(frame, box)).images
        found.append({name: image / factor for name, image in images.items()})
    for name, image in found[0].items():
        assert torch.allclose(found[1][name], image, rtol=1e-3, atol=1e-4)


def test_a_remainder_takes_part():
    _, pairs = rendered()
    picture = tuple(sum(pair[i] for pair in pairs) for i in (0, 1))
    frame = Frame(color=picture).denoise(box)
    sums = AovSum("some", {"aov1": pairs[1]}, remainder=True)
    found = correct_aovs(frame.denoised_full, frame, sums, denoiser_of(frame, box))
    assert list(found.images) == ["aov1"]
    assert found.closing < 1e-6
    assert (found.images["aov1"] <= frame.denoised_full * (1 + 1e-5) + 1e-6).all()


def test_aovs_are_named_outputs_of_a_result():
    _, pairs = rendered()
    picture = tuple(sum(pair[i] for pair in pairs) for i in (0, 1))
    frame = Frame(color=picture).denoise(box)
    result = correct(frame, Settings.preset("fast", steps=1, patch=16, window=3, batch=1))
    sums = AovSum("these", {f"aov{i}": pair for i, pair in enumerate(pairs)})
    found = result.with_outputs(correct_aovs(result.image, frame, sums, denoiser_of(frame, box)).images)
    assert set(found.outputs) == set(result.outputs) | set(sums.halves)
    assert found.image is result.image
    total = sum(found.outputs[name].double() for name in sums.halves)
    assert torch.allclose(total, result.image.double(), rtol=1e-5)


def test_the_same_input_gives_the_same_bits():
    _, pairs = rendered()
    (_, first, _), (_, second, _) = corrected(pairs), corrected(pairs)
    assert all(torch.equal(first.images[name], second.images[name]) for name in first.images)


def test_broken_pixels_are_repaired_and_counted():
    _, pairs = rendered()
    pairs[2][0][3, 4] = float("nan")
    pairs[2][1][5, 6, 1] = -1
    picture = tuple(sum(pair[i] for pair in pairs).nan_to_num().clamp(min=0) for i in (0, 1))
    frame = Frame(color=picture).denoise(box)
    sums = AovSum("these", {f"aov{i}": pair for i, pair in enumerate(pairs)})
    found = correct_aovs(frame.denoised_full, frame, sums, denoiser_of(frame, box))
    assert tuple(found.repairs["aov2"]) == (1, 1)
    assert all(image.isfinite().all() for image in found.images.values())


def test_an_aov_of_another_size_is_refused_by_its_name():
    _, pairs = rendered()
    pairs[1] = (pairs[1][0][1:], pairs[1][1][1:])
    frame = Frame(color=pairs[0]).denoise(box)
    with pytest.raises(SelfcorrectError, match="aov1 of half a"):
        correct_aovs(frame.denoised_full, frame, AovSum("x", {"aov1": pairs[1]}), denoiser_of(frame, box))
