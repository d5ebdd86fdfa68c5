"""A frame's halves with the samples of its neighbours: what helps, what is left alone, what is refused."""

import numpy as np
import pytest
import torch
from torch import Tensor

import denoisers
from selfcorrect import Frame
from selfcorrect.history import with_history
from selfcorrect.history.gather import gathered
from selfcorrect.history.motion import between, fetched, picture

SIZE, STEP = (64, 96), 3  # pixels that the picture moves to the left from frame to frame


def texture() -> Tensor:
    """A wide picture of smooth blobs of all sizes, (64, 160, 3) in 0.2 … 1."""
    generator = torch.Generator().manual_seed(0)
    total = torch.zeros(1, 3, SIZE[0], 160)
    for cells in (4, 8, 16):
        noise = torch.rand(1, 3, cells, 2 * cells, generator=generator)
        total += torch.nn.functional.interpolate(noise, size=(SIZE[0], 160), mode="bicubic")
    image = total[0].permute(1, 2, 0)
    return 0.2 + 0.8 * (image - image.min()) / (image.max() - image.min())


def frame(number: int, *, light: float = 1.0, seed: int | None = None, noise: float = 0.5) -> tuple[Frame, Tensor]:
    """A frame of a camera that pans over the picture, and its true radiance."""
    albedo = texture()[:, 30 + STEP * number :][:, : SIZE[1]].contiguous()
    truth = light * albedo
    generator = torch.Generator().manual_seed(number if seed is None else seed)
    halves = tuple(truth * (1 + noise * torch.randn(*SIZE, 3, generator=generator)) for _ in "ab")
    return Frame(color=halves, albedo=(albedo, albedo.clone())).denoise(denoisers.create("box")), truth


def error(image: Tensor, truth: Tensor) -> float:
    return float(((image - truth) ** 2).mean())


def identity(color: Tensor, albedo: Tensor | None = None, normal: Tensor | None = None) -> Tensor:
    return color


def test_neighbours_bring_their_samples_along_the_motion() -> None:
    here, truth = frame(2)
    neighbours = {distance: frame(2 + distance)[0] for distance in (-2, -1, 1, 2)}
    gathered, history = with_history(here, neighbours, identity)
    (candidate,) = gathered.more
    assert candidate.name == "history"
    assert list(history.found) == [-2, -1, 1, 2]
    assert 3 < history.samples <= 5
    noisy = (here.color[0] + here.color[1]) / 2
    assert error(candidate.full, truth) < 0.45 * error(noisy.clamp(min=0), truth)


def test_half_a_knows_nothing_of_half_b() -> None:
    """Not a bit: only the motion is found in both together, and it is the same here."""
    here, other = frame(2)[0], frame(3)[0]
    changed = Frame(color=(other.color[0], other.color[1] * 1.5), albedo=other.albedo).with_denoised(
        other.denoised, other.denoised_full
    )
    first, second = (with_history(here, {1: f}, identity)[0].more[0].halves for f in (other, changed))
    assert torch.equal(first[0], second[0])
    assert not torch.equal(first[1], second[1])


def test_what_neighbours_have_met_is_known_here() -> None:
    """A bright path of either half, where its surface is in this frame; and of no half of this frame."""
    here, before, after = (frame(n)[0] for n in (2, 1, 4))
    for i, other in enumerate((before, after)):
        other.color[i][30, 40] = 900.0
    here.color[0][20, 20] = 900.0
    found, _ = with_history(here, {-1: before, 2: after}, identity)
    assert found.seen is not None
    places = torch.nonzero(found.seen > 100)
    assert places.tolist() == [[30, 40 - STEP, 0], [30, 40 + 2 * STEP, 3]]
    assert with_history(here, {}, identity)[0].seen is None


def test_what_does_not_fit_is_left_alone() -> None:
    """A light that goes out, and a cut: hardly anything of the neighbour is taken."""
    here, truth = frame(2)
    dark = frame(3, light=0.02)[0]
    turned = {name: tuple(image.flip(0).flip(1) for image in getattr(here, name)) for name in ("color", "albedo")}
    cut = Frame(**turned).denoise(denoisers.create("box"))
    for neighbour in (dark, cut):
        gathered, history = with_history(here, {1: neighbour}, identity)
        assert history.samples < 1.25
        own = (here.color[0] + here.color[1]).clamp(min=0) / 2
        assert error(gathered.more[0].full, truth) < 1.1 * error(own, truth)


def test_what_is_no_neighbour_is_left_out_and_told() -> None:
    here = frame(2)[0]
    small = Frame(color=tuple(torch.rand(5, 6, 3) for _ in "ab")).denoise(denoisers.create("box"))
    same, history = with_history(here, {1: here, -1: small, -2: frame(0)[0]}, identity)
    assert same is here
    assert history.left_out == {
        -1: "is of 6x5 pixels",  # and what lies beyond it is not looked at
        1: "has this frame's noise: render each frame with seeds of its own",
    }
    assert history.samples == 1
    assert "history: the frame at -1 is of 6x5 pixels; left out" in history.lines()
    same, history = with_history(here, {}, identity)
    assert same is here


def test_the_same_noise_in_a_neighbours_neighbour_is_seen() -> None:
    """Frame +3 has half b's noise in its half a; the next frame has gathered it, so it lends nothing."""
    frames = {distance: frame(2 + distance)[0] for distance in (0, 1, 2, 3)}
    here, far = frames[0], frames[3]
    noise = here.color[1] / texture()[:, 36:132] - 1
    color = (texture()[:, 45:141] * (1 + noise), far.color[1])
    crossed = Frame(color=color, albedo=far.albedo).denoise(denoisers.create("box"))
    found, _ = with_history(here, {1: frames[1], 2: frames[2], 3: crossed}, identity)
    around = {n: (frames[n], between(picture(here), picture(frames[n]))[0]) for n in (1, 2)}
    assert torch.equal(found.more[0].halves[0], gathered(here, around, 0)[0])
    usual, _ = with_history(here, {1: frames[1], 2: frames[2], 3: far}, identity)
    assert not torch.equal(usual.more[0].halves[0], found.more[0].halves[0])


def test_a_frame_that_is_missing_does_not_hide_the_one_beyond_it() -> None:
    here, truth = frame(2)
    found, history = with_history(here, {-2: frame(0)[0], 2: frame(4)[0]}, identity)
    assert list(history.found) == [-2, 2]
    assert error(found.more[0].full, truth) < 0.6 * error((here.color[0] + here.color[1]) / 2, truth)


def test_a_cut_ends_the_history_on_its_side() -> None:
    """Beyond it nothing is looked for, though it may show this frame again."""
    here, after = frame(2)[0], frame(3)[0]
    night = {name: tuple(0.05 * image for image in getattr(after, name)) for name in ("color", "albedo")}
    other = Frame(**night).denoise(denoisers.create("box"))
    _, history = with_history(here, {-1: frame(1)[0], 1: other, 2: frame(4)[0]}, identity)
    assert list(history.found) == [-1]
    assert history.left_out == dict.fromkeys((1, 2), "shows something else, or lies beyond what does")


def test_the_same_noise_in_the_other_half_is_seen() -> None:
    """Seeds 1 and 2, then 2 and 3: half b is the next frame's half a, and would be no witness of it."""
    here, other = frame(2)[0], frame(2, seed=7)[0]
    noise = (other.color[0] / texture()[:, 36:132] - 1).clamp(-1, 3)
    crossed = Frame(color=(here.color[1], texture()[:, 36:132] * (1 + noise)), albedo=here.albedo)
    crossed = crossed.denoise(denoisers.create("box"))
    assert "has this frame's noise" in with_history(here, {1: crossed}, identity)[1].left_out[1]


def test_without_a_denoiser_the_denoised_images_are_averaged() -> None:
    here, truth = frame(2, noise=0.1)
    neighbours = {distance: frame(2 + distance, noise=0.1)[0] for distance in (-2, -1, 1, 2)}
    as_they_are = {
        distance: f.with_denoised(f.color, (f.color[0] + f.color[1]) / 2)
        for distance, f in {0: here, **neighbours}.items()
    }
    found, history = with_history(as_they_are.pop(0), as_they_are)
    assert list(history.found) == [-2, -1, 1, 2]
    assert error(found.more[0].full, truth) < 0.6 * error((here.color[0] + here.color[1]) / 2, truth)


def test_pixels_are_fetched_and_not_mixed() -> None:
    image = torch.arange(12.0).reshape(3, 4, 1)
    offset = torch.tensor([1.4, -0.6]).expand(3, 4, 2)
    assert np.array_equal(fetched(image, offset)[1, :, 0], [1, 2, 3, 3])


def test_motion_out_of_the_picture_is_not_believed() -> None:
    """A pan to the left: what enters on one side has no place in the other frame."""
    wide = texture().mean(-1)
    motion, back = between(wide[:, 30:126].contiguous(), wide[:, 42:138].contiguous())
    assert float(motion.offset[..., 0].median()) == pytest.approx(-12, abs=0.5)
    assert not motion.known[:, :11].any()
    assert motion.known[:, 20:].float().mean() > 0.7
    assert not back.known[:, -11:].any()
