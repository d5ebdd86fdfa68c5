"""Trained networks tile by tile, against the whole."""

from typing import Any

import pytest
import torch
from helpers.tolerances import near
from helpers.trained import SIZE, SMALL, make_both, make_frame, planes, wild
from torch import Tensor

from selfcorrect.frame import mean
from selfcorrect.stages.bilateral_combiner import BilateralCombiner
from selfcorrect.stages.deep_combiner import DeepCombiner, combine_whole, feature_planes
from selfcorrect.stages.james_stein import variance_of_mean
from selfcorrect.stages.neural_james_stein import VarianceNetwork, blend_whole, neural_blend

_FLIP = 2 * 2**-8 / SMALL["window"] ** 2  # two of a pixel's weights rounded to their neighbours in bfloat16


@pytest.mark.parametrize("size", [(1, 1), (5, 70), (64, 64), (101, 83)])
@pytest.mark.parametrize(("precision", "tolerance"), [("fp32", 1e-6), ("bf16", 1e-4)])
def test_tiles_are_equal_to_the_whole(size: tuple[int, int], precision: str, tolerance: float) -> None:
    frame = make_frame(size)
    a, b = frame.color
    normal, albedo = torch.rand(2, *size, 3, generator=torch.Generator().manual_seed(1))
    features = feature_planes(size, normal=normal, albedo=albedo, depth=None)
    combiners, variance_network = (
        (wild(DeepCombiner(**SMALL)), wild(BilateralCombiner(8, 5, 3))),
        wild(VarianceNetwork()),
    )

    def each(side: int) -> list[Tensor]:
        options: dict[str, Any] = {"precision": precision, "side": side}
        y = frame.denoised
        found = [combine_whole(network, (a,), (y[0],), features, **options) for network in combiners]
        return [*found, blend_whole(variance_network, mean((a, b)), ((a - b) / 2) ** 2, *y, **options)]

    for whole, pieces, different in zip(each(4096), each(32), (a, a, mean((a, b))), strict=True):
        found = (pieces - whole).abs()
        assert float(found.quantile(0.999)) <= tolerance
        assert float(found.max()) <= max(tolerance, _FLIP if precision == "bf16" else 0)
        assert size == (1, 1) or float((whole - different).abs().max()) > 0.05, "the stage has done something"


def test_tiles_of_single_precision_are_those_of_the_network() -> None:
    frame, subs = make_both()
    network, four = wild(VarianceNetwork()), wild(DeepCombiner(4, **SMALL))
    x, variance = mean(frame.color), variance_of_mean(frame.color).float()
    given = [planes(image) for image in (x, variance, *frame.denoised)]
    with torch.no_grad():
        expected = neural_blend(*network(*given), *given)
        features = torch.rand(7, *SIZE, generator=torch.Generator().manual_seed(2))
        noisy, denoised = (
            torch.stack([image.permute(2, 0, 1) for image in images])[None] for images in (subs.images, subs.denoised)
        )
        combined = four(noisy, denoised, features[None])
    got = blend_whole(network, x, variance, *frame.denoised, side=16)
    torch.testing.assert_close(planes(got), expected, **near("neural blend in tiles"))
    got = combine_whole(four, subs.images, subs.denoised, features, side=16)
    torch.testing.assert_close(planes(got), combined, **near("combiner in tiles"))
