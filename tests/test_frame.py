"""Frame: shapes are checked, values repaired and counted."""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from selfcorrect import Frame
from selfcorrect.errors import FrameError
from selfcorrect.frame import Repairs, mean


def pair(shape: tuple[int, ...], seed: int = 0) -> tuple[Any, Any]:
    generator = np.random.default_rng(seed)
    return generator.random(shape, dtype=np.float32), generator.random(shape, dtype=np.float32)


def test_buffers_become_float32_tensors() -> None:
    color = tuple(torch.from_numpy(x).double() for x in pair((4, 5, 3)))
    frame = Frame(color=color, denoised=pair((4, 5, 3)), depth=pair((4, 5)))
    assert frame.size == (4, 5)
    assert frame.halves[0].color.dtype == torch.float32
    assert frame.halves[1].depth.shape == (4, 5, 1)
    assert frame.halves[0].albedo is None
    assert frame.repairs == {"color": (0, 0), "denoised": (0, 0), "depth": (0, 0)}


def test_input_is_not_changed() -> None:
    color = pair((4, 4, 3))
    color[0][1, 1] = np.nan
    color[1][2, 2] = -1
    before = [x.copy() for x in color]
    Frame(color=color)
    for x, y in zip(color, before, strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"color": pair((4, 4, 4))}, r"color of half a of shape \(H, W, 3\)"),
        ({"color": pair((4, 4, 3))[:1]}, "pair"),
        ({"color": pair((0, 4, 3))}, r"\(H, W, 3\)"),
        ({"albedo": pair((4, 6, 3))}, "albedo of half a of 5x4 pixels"),
        ({"normal": (pair((4, 5, 3))[0], pair((5, 5, 3))[0])}, "normal of half b"),
        ({"depth": pair((4, 5, 3))}, "depth"),
        ({"color": tuple(np.ones((4, 5, 3), np.uint8) for _ in "ab")}, "floating-point"),
        ({"denoised_full": np.zeros((1, 1, 3), np.float32)}, "denoised_full"),
    ],
)
def test_what_does_not_fit_is_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(FrameError, match=message):
        Frame(**({"color": pair((4, 5, 3))} | changes))


def test_broken_pixels_are_filled_from_their_neighbours() -> None:
    color = [np.full((8, 9, 3), 2.0, np.float32) for _ in "ab"]
    color[0][:, 5:] = 6.0
    color[0][2, 1, 1] = np.nan
    color[0][3, 8] = np.inf
    color[1][:3] = -np.inf
    color[1][5, 5] = -0.5
    frame = Frame(color=tuple(color))
    assert frame.repairs["color"] == Repairs(non_finite=2 + 27, negative=1)
    assert frame.color[0][2, 1].tolist() == [2, 2, 2]
    assert frame.color[0][3, 8].tolist() == [6, 6, 6]
    assert frame.color[1][:3].eq(2).all()
    assert frame.color[1][5, 5].eq(0).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("channel", range(3))
def test_a_channel_that_is_hardly_finite_is_refused(value: float, channel: int) -> None:
    good, bad = pair((6, 8, 3))
    bad[..., channel] = value
    letter = "RGB"[channel]
    with pytest.raises(FrameError, match=f"channel {letter} of color of half b, but got NaN or infinity at 48 of 48"):
        Frame(color=(good, bad))
    bad[:3, :, channel] = 1
    assert Frame(color=(good, bad)).repairs["color"].non_finite == 24
    bad[0, 0, channel] = value
    with pytest.raises(FrameError, match="at 25 of 48"):
        Frame(color=(good, bad))


def test_a_channel_is_repaired_without_the_others() -> None:
    a, b = pair((6, 8, 3))
    a[2:4, :, 0] = np.nan
    repaired = Frame(color=(a, b)).color[0].numpy()
    assert np.array_equal(repaired[..., 1:], a[..., 1:])
    assert np.isfinite(repaired).all()
    assert repaired[..., 0].max() <= np.nanmax(a[..., 0])


def test_depth_may_be_infinite_where_nothing_was_hit() -> None:
    depth = pair((6, 8, 1))
    depth[0][:5], depth[1][:5] = np.inf, np.inf
    assert Frame(color=pair((6, 8, 3)), depth=depth).depth is not None


@settings(max_examples=60, deadline=None)
@given(
    height=st.integers(1, 17),
    width=st.integers(1, 17),
    share=st.floats(0, 1),
    seed=st.integers(0, 2**31),
    value=st.sampled_from([np.nan, np.inf, -np.inf, 3e38, 1e-42, -3e38]),
)
def test_filling_stays_within_the_range_of_what_is_known(
    height: int, width: int, share: float, seed: int, value: float
) -> None:
    generator = np.random.default_rng(seed)
    color = generator.random((height, width, 3), dtype=np.float32)
    color[generator.random((height, width)) < share] = value
    assume(np.isfinite(color[..., 0]).mean() >= 0.5)
    repaired = Frame(color=(color, color)).color[0]
    assert repaired.isfinite().all()
    assert repaired.min() >= 0
    if not np.isfinite(value):
        assert repaired.max() <= 1


def test_denoise_hands_each_half_its_own_buffers() -> None:
    calls: list[tuple[Any, ...]] = []

    def denoiser(color: torch.Tensor, albedo: Any = None, normal: Any = None) -> torch.Tensor:
        calls.append((color, albedo, normal))
        return color * 0.5

    frame = Frame(color=pair((4, 5, 3)), albedo=pair((4, 5, 3), 1))
    denoised = frame.denoise(denoiser)
    assert frame.denoised is None
    torch.testing.assert_close(denoised.denoised[1], frame.color[1] / 2)
    torch.testing.assert_close(denoised.denoised_full, (frame.color[0] + frame.color[1]) / 4)
    assert torch.equal(calls[0][1], (frame.albedo[0] + frame.albedo[1]) / 2)
    assert torch.equal(calls[2][1], frame.albedo[1])
    assert calls[0][2] is None


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_result_is_like_the_input(dtype: type) -> None:
    image = torch.rand(4, 5, 3)
    array = Frame(color=tuple(x.astype(dtype) for x in pair((4, 5, 3)))).like_input(image)
    assert isinstance(array, np.ndarray)
    assert array.dtype == dtype
    tensor = Frame(color=tuple(torch.from_numpy(x.astype(dtype)) for x in pair((4, 5, 3)))).like_input(image)
    assert isinstance(tensor, torch.Tensor)
    assert tensor.numpy().dtype == dtype


def test_g_buffers_of_half_floats_are_kept_and_their_mean_is_not_rounded() -> None:
    albedo = tuple(torch.from_numpy(x).half() for x in pair((4, 5, 3)))
    albedo[0][1, 2] = torch.inf
    frame = Frame(color=tuple(x.astype(np.float16) for x in pair((4, 5, 3))), albedo=albedo)
    assert (frame.color[0].dtype, frame.albedo[0].dtype) == (torch.float32, torch.float16)
    assert frame.albedo[1].data_ptr() == albedo[1].data_ptr()
    assert frame.albedo[0].isfinite().all()
    assert frame.repairs["albedo"].non_finite == 1
    expected = (frame.albedo[0].double() + frame.albedo[1].double()) / 2
    assert torch.equal(mean(frame.albedo), expected.float())
    assert not torch.equal(expected.half().double(), expected)


@pytest.mark.parametrize("neighbours", [{0: Frame(color=pair((4, 4, 3)))}, {-1: pair((4, 4, 3))}])
def test_neighbours_are_frames_at_a_distance(neighbours: Any) -> None:
    with pytest.raises(
        FrameError,
        match=r"^expected neighbours as frames by their distance, such as -1 and 1, but got (Frame at 0|tuple at -1)$",
    ):
        Frame(color=pair((4, 4, 3)), neighbours=neighbours)


def test_a_buffer_that_says_nothing_is_left_out() -> None:
    """The network has no input for it, the kernel no term."""
    generator = torch.Generator().manual_seed(0)
    color, other = (torch.rand(20, 30, 3, generator=generator) for _ in range(2))
    normal = torch.rand(20, 30, 3, generator=generator)
    flat = torch.full((20, 30, 3), 0.5)
    frame = Frame((color, other), albedo=(flat, 2 * flat), normal=(normal, flat), depth=(flat[..., :1],) * 2)
    assert frame.constant == ["albedo", "depth"]
    assert frame.albedo is None
    assert frame.depth is None
    assert frame.normal is not None, "one half of it says something"
    assert Frame((flat, flat)).color[0].shape == (20, 30, 3), "colour stays in any case"
