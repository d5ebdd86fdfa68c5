"""Motion that the files tell: used where it fits what the frames show, and only there."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

import denoisers
from selfcorrect import Frame
from selfcorrect.history import History, with_history
from selfcorrect.history.motion import between, chained, optical_flow

SIZE, STEP = (64, 96), 6  # pixels that the picture moves to the left from frame to frame
TRUE = torch.tensor([STEP, 0.0, -STEP, 0.0]).expand(*SIZE, 4)


def stripes(number: int, step: int = STEP) -> Tensor:
    """(H, W) in 0 … 1, of period 8: moved by six pixels it looks as if moved by two the other way."""
    x = torch.arange(SIZE[1]) + step * number
    y = torch.arange(SIZE[0])
    return (0.5 + 0.3 * torch.sin(x * torch.pi / 4) + 0.15 * torch.sin(y * torch.pi / 16)[:, None]).float()


def blobs(number: int) -> Tensor:
    """(H, W, 3) in 0.2 … 1 of a picture that the camera pans over."""
    generator = torch.Generator().manual_seed(0)
    total = torch.zeros(1, 3, SIZE[0], 190)
    for cells in (4, 8, 16):
        noise = torch.rand(1, 3, cells, 2 * cells, generator=generator)
        total += torch.nn.functional.interpolate(noise, size=(SIZE[0], 190), mode="bicubic")
    image = total[0].permute(1, 2, 0)
    return (0.2 + 0.8 * (image - image.min()) / (image.max() - image.min()))[:, 40 + STEP * number :][:, : SIZE[1]]


def frame(number: int, motion: Tensor | None) -> Frame:
    albedo = blobs(number).contiguous()
    generator = torch.Generator().manual_seed(number)
    halves = tuple(albedo * (1 + 0.3 * torch.randn(*SIZE, 3, generator=generator)) for _ in "ab")
    pair = None if motion is None else (motion, motion)
    return Frame(color=halves, albedo=(albedo, albedo), motion=pair).denoise(denoisers.create("box"))


def identity(color: Tensor, albedo: Tensor | None = None, normal: Tensor | None = None) -> Tensor:
    return color


def history(motion: Tensor | None) -> tuple[Tensor, History]:
    """The candidate and the history of the middle one of five frames, all with this motion."""
    frames = {distance: frame(2 + distance, motion) for distance in (-2, -1, 0, 1, 2)}
    found, known = with_history(frames.pop(0), frames, identity)
    return found.more[0].full, known


def test_where_both_fit_it_is_the_files_own() -> None:
    here, after = stripes(2), stripes(3)
    assert float(optical_flow(here, after)[..., 0].median()) == pytest.approx(2, abs=0.5)  # the other way
    there, back = between(here, after, (TRUE[..., 2:], TRUE[..., :2]))
    inside = slice(STEP + 3, -STEP - 3)
    assert there.offset[:, inside].eq(TRUE[:, inside, 2:]).all()
    assert back.offset[:, inside].eq(TRUE[:, inside, :2]).all()
    assert there.known[:, inside].all()
    assert not there.known[:, :STEP].any()
    assert 0.85 < there.told <= 1


def test_of_two_frames_it_is_one_after_the_other() -> None:
    """Where the first leads, the second is read."""
    first, second = TRUE.clone(), TRUE.clone()
    second[:, 50:, 2] = -20
    frames = [frame(n, motion) for n, motion in enumerate((first, second, None))]
    offset = chained(frames, 1)
    assert offset is not None
    assert offset[:, STEP : 50 + STEP, 0].eq(-2 * STEP).all()
    assert offset[:, 50 + STEP :, 0].eq(-STEP - 20).all()
    assert chained(frames[::-1], -1) is None  # the first of these tells nothing


def test_what_is_true_is_used_over_two_frames_and_told() -> None:
    _, known = history(TRUE)
    assert known.told is not None
    assert known.told > 0.8
    assert any(line.startswith("motion: the files' own at ") for line in known.lines())
    assert known.to_dict()["motion_of_files"] == known.told


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda motion: -motion, id="wrong sign"),
        pytest.param(torch.zeros_like, id="zero"),
        pytest.param(lambda motion: motion / 2, id="half"),
        pytest.param(lambda motion: motion * 1e6, id="another unit"),
        pytest.param(lambda motion: motion[..., [2, 3, 0, 1]], id="past for future"),
        pytest.param(lambda motion: motion + 0 * torch.nan, id="NaN"),
        pytest.param(lambda motion: motion * torch.inf, id="infinite"),
    ],
)
def test_what_is_wrong_is_not_used(change: Callable[[Tensor], Tensor]) -> None:
    """To the bit what it is without."""
    image, known = history(change(TRUE))
    assert known.told == 0
    assert "motion: by optical flow; the files' own does not fit what the frames show" in known.lines()
    alone, without = history(None)
    assert "motion: by optical flow" in without.lines()
    assert torch.equal(image, alone)
    assert known.found == without.found


def test_what_is_unknown_in_places_is_flow_there() -> None:
    """As where a surface comes into being, or a pass tells of the future alone."""
    partly = TRUE.clone()
    partly[20:40] = torch.nan
    there, _ = between(blobs(2).mean(-1), blobs(3).mean(-1), (partly[..., 2:], None))
    assert there.offset.isfinite().all()
    assert there.told == pytest.approx(1 - 20 / 64, abs=0.1)
    assert float(there.offset[20:40, 20:-20, 0].median()) == pytest.approx(-STEP, abs=0.5)


def test_it_is_kept_as_it_was_given() -> None:
    """No pixel of it is filled in from others, and a frame whose motion is the same everywhere has motion."""
    motion = TRUE.clone().half()
    motion[3, 4, 0] = torch.inf
    given = frame(0, motion)
    assert given.motion is not None
    assert given.motion[0].dtype == torch.float16
    assert given.motion[0].isnan().sum() == 1
    assert "motion" not in given.constant
    assert not any(given.repairs["motion"])
