"""Tiles: the same bits as the whole image; crops: large frames are trained on a bounded number of pixels."""

import time

import pytest
import torch
from torch import Tensor

from selfcorrect import Frame, Settings, correct
from selfcorrect.kernel.guides import Guides
from selfcorrect.stages.core.infer import infer, tiles
from selfcorrect.stages.core.network import Network
from selfcorrect.stages.core.patches import batches, crops

QUICK = Settings.preset("balanced", steps=4, window=7)


def make_frame(height: int, width: int, seed: int = 0) -> Frame:
    generator = torch.Generator().manual_seed(seed)

    def noise(channels: int = 3) -> Tensor:
        return torch.rand(height, width, channels, generator=generator)

    rows = torch.linspace(0, 6, height).sin()[:, None, None].expand(height, width, 3) + 1.5
    albedo = noise()
    return Frame(
        (rows + noise(), rows + noise()),
        denoised=(rows + 0.1 * noise(), rows + 0.1 * noise()),
        albedo=(albedo, albedo),
        denoised_full=rows + 0.05 * noise(),
    )


def make_network(frame: Frame, settings: Settings) -> Network:
    half = frame.halves[0]
    guides = Guides.of_half(half._asdict(), margin=9)
    return Network.for_guides(guides, settings, torch.Generator().manual_seed(1))


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
@pytest.mark.parametrize("side", [16, 37])
def test_tiles_give_the_bits_of_the_whole_image(side: int, precision: str) -> None:
    frame = make_frame(61, 83)
    settings = Settings.preset("balanced", precision=precision)
    network = make_network(frame, settings)
    whole, tiled = (infer(network, frame.halves[0], settings, scale=0.7, side=s) for s in (100, side))
    assert torch.equal(whole, tiled)
    assert whole.std() > 0.1


def test_tiles_cover_every_pixel_once() -> None:
    count = torch.zeros(70, 33)
    for top, left, bottom, right in tiles((70, 33), 32):
        count[top:bottom, left:right] += 1
    assert count.eq(1).all()


def test_a_region_of_the_guides_is_the_part_of_the_whole() -> None:
    frame = make_frame(40, 50)
    half = frame.halves[0]
    whole = Guides.of_half(half._asdict(), margin=12, scale=2.0)
    part = Guides.of_half(half._asdict(), margin=5, scale=2.0, region=(0, 30, 20, 50))
    assert torch.equal(part.planes[:, :30, :30], whole.planes[:, 7:37, 37:67])


def test_large_frames_are_trained_on_crops_spread_over_them() -> None:
    generator = torch.Generator().manual_seed(0)
    found = crops((2160, 3840), QUICK, generator)
    assert 2**20 < len(found) * 128 * 128 <= 2**21
    centres = torch.tensor([[(t + b) / 2 / 2160, (left + r) / 2 / 3840] for t, left, b, r in found])
    assert centres.min() > 0
    assert centres.max() < 1
    counts = torch.histogramdd(centres.double(), bins=[2, 2], range=[0, 1, 0, 1]).hist
    assert counts.min() > 0.2 * len(found)
    assert not crops((1000, 1000), QUICK, generator), "whole: it has fewer pixels"
    assert not crops((2160, 3840), Settings.preset("paper"), generator), "the paper takes all patches"


def test_patches_of_crops_lie_inside_them() -> None:
    frame = make_frame(60, 90)
    half = frame.halves[0]
    regions = [(0, 0, 40, 40), (20, 50, 60, 90), (10, 10, 50, 50)]
    settings = Settings.preset("balanced", patch=16, steps=1)
    crops = (Guides.of_half(half._asdict(), margin=9, region=region) for region in regions)
    guides = Guides.stack(crops, len(regions))
    seen = set()
    for corners, _ in zip(batches(guides, settings, torch.Generator().manual_seed(0)), range(50), strict=False):
        for row, column in corners.tolist():
            crop, inside = divmod(row, guides.pitch)
            seen.add(crop)
            assert 0 <= inside <= 24
            assert 0 <= column <= 24
            top, left, _, _ = regions[crop]
            patch = guides.patches(torch.tensor([[row, column]]), (16, 16))[0, :3]
            expected = half.color[top + inside : top + inside + 16, left + column : left + column + 16]
            assert torch.equal(patch, expected.permute(2, 0, 1))
    assert seen == {0, 1, 2}


def test_a_frame_on_crops_is_corrected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("selfcorrect.stages.core.patches._MOST_PIXELS", 128 * 128 * 2)
    frame = make_frame(150, 300)
    cold = correct(frame, QUICK)
    assert torch.isfinite(cold.image).all()
    warm = correct(frame, QUICK, warm_start=cold.network)
    assert warm.start.warm_loss is not None


def test_stop_ends_training_and_still_gives_a_result() -> None:
    steps = []
    frame = make_frame(40, 50)
    result = correct(
        frame,
        Settings.preset("balanced", steps=50, window=7),
        progress=lambda step, *_: steps.append(step),
        stop=lambda: len(steps) >= 3,
    )
    assert len(result.losses) == 3
    assert torch.isfinite(result.image).all()


class Clock:
    """Stands for the machine's clock, which another process's load would move: every look at it takes 10 ms."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        self.now += 0.01
        return self.now


def test_a_time_budget_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr(time, "perf_counter", clock)
    monkeypatch.setattr("selfcorrect.stages.core.stage._GUARD_SECONDS", 0.5 / (40 * 50))
    frame = make_frame(40, 50)
    result = correct(frame, Settings.preset("balanced", steps=100_000, visits=0, time_budget=3.0, window=5, patch=16))
    assert 1 < result.seconds["train"] < 2.6, "half a second is kept for the guard"
    assert clock.now < 3.3
    assert 0 < len(result.losses) < 100_000


def test_time_left_is_used_as_long_as_it_gains(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr(time, "perf_counter", clock)
    frame = make_frame(64, 64)
    settings = Settings.preset("balanced", steps=3, window=7, patch=32)
    once = correct(frame, settings)
    longer = correct(frame, Settings.from_dict(settings.to_dict() | {"time_budget": 60.0}))
    assert len(once.losses) == 3
    assert len(longer.losses) % 3 == 0
    assert len(longer.losses) > 3
    assert longer.seconds["train"] < 60


def test_no_time_for_training_gives_the_denoised_image() -> None:
    frame = make_frame(40, 50)
    result = correct(frame, Settings.preset("balanced", time_budget=1e-6))
    assert result.losses == []
    assert torch.isfinite(result.image).all()


def test_g_buffers_of_half_floats_give_the_bits_of_floats() -> None:
    frame = make_frame(60, 70)
    settings = Settings.preset("balanced", steps=3, window=7, patch=32)
    albedo = tuple(half.half() for half in frame.albedo)
    images = []
    for kind in (torch.float16, torch.float32):
        given = tuple(half.to(kind) for half in albedo)
        frame = Frame(frame.color, denoised=frame.denoised, albedo=given, denoised_full=frame.denoised_full)
        assert frame.albedo[0].dtype == kind
        images.append(correct(frame, settings).image)
    assert torch.equal(*images)


def test_strips_of_rows_give_the_bits_of_the_whole_image() -> None:
    frame = make_frame(90, 40)
    settings = Settings.preset("balanced")
    network = make_network(frame, settings)
    whole = infer(network, frame.halves[0], settings)
    strips = [infer(network, frame.halves[0], settings, rows=slice(top, min(top + 32, 90))) for top in (0, 32, 64)]
    assert torch.equal(torch.cat(strips), whole)
