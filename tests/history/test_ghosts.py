"""What tempts a temporal denoiser to ghost: behind the guard, no frame gets worse than its denoised image."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from selfcorrect import Frame, Settings, correct
from selfcorrect.history import Histories

SIZE = (64, 96)
HERE = 2  # of frames 0 … 4
SETTINGS = Settings.preset("balanced", steps=2, window=5, patch=32, batch=2, candidates="none", precision="fp32")
Truth = tuple[Tensor, Tensor]  # radiance and albedo, (H, W, 3) each
Scene = Callable[[int], Truth]


def texture(seed: int = 0, width: int = 160) -> Tensor:
    """Smooth blobs of all sizes, (H, width, 3) in 0.1 … 1."""
    generator = torch.Generator().manual_seed(seed)
    total = torch.zeros(1, 3, SIZE[0], width)
    for cells in (4, 8, 16):
        noise = torch.rand(1, 3, cells, 2 * cells, generator=generator)
        total += torch.nn.functional.interpolate(noise, size=(SIZE[0], width), mode="bicubic")
    image = total[0].permute(1, 2, 0)
    return 0.1 + 0.9 * (image - image.min()) / (image.max() - image.min())


def window(image: Tensor, left: int) -> Tensor:
    return image[:, left : left + SIZE[1]].clone()


def light_switches(number: int) -> Truth:
    """A lamp goes on between the frame before and this one."""
    albedo = window(texture(), 30)
    return albedo * (1.0 if number >= HERE else 0.3), albedo


def shadow_moves(number: int) -> Truth:
    albedo = window(texture(), 30)
    light = torch.ones(*SIZE, 1)
    light[20:44, 10 + 14 * number : 26 + 14 * number] = 0.35
    return albedo * light, albedo


def mirror(number: int) -> Truth:
    """The surface stands still; what it shows moves by five pixels a frame."""
    albedo = torch.full((*SIZE, 3), 0.9)
    albedo[:8] = window(texture(), 30)[:8]  # the frame of the mirror
    radiance = albedo.clone()
    radiance[8:] = window(texture(1), 5 + 5 * number)[8:]
    return radiance, albedo


def glass_ball(number: int) -> Truth:
    """The camera pans by three pixels a frame; the ball shows what is behind it mirrored, and twice as fast."""
    albedo = window(texture(), 30 + 3 * number)
    y, x = torch.meshgrid(torch.arange(SIZE[0]) - 32, torch.arange(SIZE[1]) - 60 + 3 * number, indexing="ij")
    ball = (y**2 + x**2 < 20**2)[..., None]
    behind = window(texture(1), 50 - 6 * number).flip(1)
    return torch.where(ball, behind, albedo), torch.where(ball, torch.ones(()), albedo)


def texture_moves(number: int) -> Truth:
    """On still geometry, in emitted light that no G-buffer knows."""
    albedo = window(texture(), 30)
    return albedo * (0.3 + window(texture(2), 5 + 9 * number)), albedo


def disocclusion(number: int) -> Truth:
    """A dark pillar moves fast in front of a wall."""
    albedo = window(texture(), 30)
    albedo[:, 5 + 17 * number : 23 + 17 * number] = 0.08
    return albedo, albedo


def cut(number: int) -> Truth:
    albedo = window(texture(0 if number >= HERE else 3), 30)
    return albedo, albedo


def sky_changes(number: int) -> Truth:
    """A still camera; clouds drift over the upper half, which has no albedo."""
    albedo, radiance = window(texture(), 30), window(texture(), 30)
    albedo[:32] = 0
    radiance[:32] = 2 * window(texture(4), 3 + 11 * number)[:32]
    return radiance, albedo


def still(number: int) -> Truth:
    albedo = window(texture(), 30)
    return albedo, albedo


def pan(number: int) -> Truth:
    albedo = window(texture(), 30 + 3 * number)
    return albedo, albedo


SCENES = (light_switches, shadow_moves, mirror, glass_ball, texture_moves, disocclusion, cut, sky_changes)


def demodulated(color: Tensor, albedo: Tensor, normal: Tensor | None = None) -> Tensor:
    """A denoiser that leaves noise rather than take detail: the light on a surface is averaged over 5×5 pixels."""
    light = (color / (albedo + 0.05)).permute(2, 0, 1)[None]
    padded = torch.nn.functional.pad(light, (2, 2, 2, 2), "replicate")
    return torch.nn.functional.avg_pool2d(padded, 5, 1)[0].permute(1, 2, 0) * (albedo + 0.05)


def frame(scene: Scene, number: int, noise: float = 0.6, motion: Tensor | None = None) -> Frame:
    """Of a scene; ``motion`` is what its files tell: in x to the frames before and after, the same everywhere."""
    radiance, albedo = scene(number)
    generator = torch.Generator().manual_seed(100 + number)
    halves = tuple(radiance * (1 + noise * torch.randn(*SIZE, 3, generator=generator)) for _ in "ab")
    noisy = tuple((albedo + 0.02 * torch.randn(*SIZE, 3, generator=generator)).clamp(0, 1) for _ in "ab")
    told = None if motion is None else motion.expand(*SIZE, 4)
    return Frame(color=halves, albedo=noisy, motion=None if told is None else (told, told)).denoise(demodulated)


def errors(scene: Scene, frames: Mapping[int, Frame]) -> tuple[float, float, float]:
    """Relative squared error of the denoised image, of the candidate, and of the output."""
    truth, _ = scene(HERE)
    remembered, _ = Histories(2, demodulated).of(HERE, frames)
    output = correct(remembered, SETTINGS).image

    def of(image: Any) -> float:
        return float(((image - truth) ** 2 / (truth.mean(-1, keepdim=True) ** 2 + 0.01)).mean())

    return of(frames[HERE].denoised_full), of(remembered.candidates[-1].full), of(output)


@pytest.mark.parametrize("scene", SCENES)
def test_no_frame_gets_worse(scene: Scene) -> None:
    denoised, _, output = errors(scene, {n: frame(scene, n) for n in range(5)})
    assert output <= 1.01 * denoised


@pytest.mark.parametrize("scene", SCENES)
def test_nor_where_the_files_tell_that_nothing_moves(scene: Scene) -> None:
    """True of the surfaces of most, and not of what they show; zero is also what a pass holds that was not written."""
    denoised, _, output = errors(scene, {n: frame(scene, n, motion=torch.zeros(4)) for n in range(5)})
    assert output <= 1.01 * denoised


@pytest.mark.parametrize("told", [(3.0, 0, -3.0, 0), (-3.0, 0, 3.0, 0), (0.0, 0, 0, 0), (0, 3.0, 0, -3.0)])
def test_what_motion_the_files_tell_decides_no_gain(told: tuple[float, ...]) -> None:
    """The true one of a camera that pans, with wrong signs, none, and of another axis."""
    denoised, _, output = errors(pan, {n: frame(pan, n, motion=torch.tensor(told)) for n in range(5)})
    assert output < 0.7 * denoised


@pytest.mark.parametrize("scene", [still, pan])
def test_and_what_can_be_gained_is(scene: Scene) -> None:
    """Else the guard could pass the others by taking nothing."""
    denoised, candidate, output = errors(scene, {n: frame(scene, n) for n in range(5)})
    assert candidate < 0.6 * denoised
    assert output < 0.7 * denoised


def test_it_is_told_whose_the_gain_is() -> None:
    """A core of two steps has hardly learned anything."""
    remembered, _ = Histories(2, demodulated).of(HERE, {n: frame(still, n) for n in range(5)})
    shares = correct(remembered, SETTINGS).shares
    assert list(shares) == ["history", "stages"]
    assert sum(shares.values()) == pytest.approx(1)
    assert shares["history"] > 0.8
    assert list(correct(frame(still, HERE), SETTINGS).shares) == ["stages"]


def test_one_frame_with_its_neighbours_is_what_a_shot_makes_of_it() -> None:
    """The history of `Frame.neighbours`, denoised with the frame; what the settings turn off is not looked for."""
    around = {n - HERE: replace(frame(still, n), denoised=None, denoised_full=None) for n in range(5)}
    alone = around.pop(0)
    given = replace(alone, neighbours=around).denoise(demodulated)
    remembered, _ = Histories(2, demodulated).of(HERE, {n: frame(still, n) for n in range(5)})
    result = correct(given, replace(SETTINGS, frame_radius=2), denoiser=demodulated)
    assert torch.equal(result.image, correct(remembered, SETTINGS).image)
    assert list(result.shares) == ["history", "stages"]
    known = replace(remembered, neighbours=around)  # as in a shot, whose frames may have theirs: not found twice
    assert list(correct(known, replace(SETTINGS, frame_radius=2)).shares) == ["history", "stages"]
    for off in (replace(SETTINGS, frame_radius=0), replace(SETTINGS, frame_radius=2, guard=False)):
        assert torch.equal(correct(given, off, denoiser=demodulated).image, correct(frame(still, HERE), off).image)


def test_frames_in_the_wrong_order_do_no_harm() -> None:
    frames = {n: frame(pan, n) for n in range(5)}
    denoised, _, output = errors(pan, {0: frames[3], 1: frames[4], HERE: frames[HERE], 3: frames[0], 4: frames[1]})
    assert output <= 1.01 * denoised
