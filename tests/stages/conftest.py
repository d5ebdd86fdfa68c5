"""Weights and renders on disk that several tests of stages read."""

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.trained import SMALL, wild, write_render

from selfcorrect import exr
from selfcorrect.stages import weights
from selfcorrect.stages.bilateral_combiner import BilateralCombiner
from selfcorrect.stages.deep_combiner import DeepCombiner
from selfcorrect.stages.neural_james_stein import VarianceNetwork


@pytest.fixture(scope="module", params=["deep", "bilateral"])
def weight_files(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Untrained weights, on disk as float32; a setting for each. The combiner of one pair is of either kind."""
    one = DeepCombiner(**SMALL, seed=2) if request.param == "deep" else BilateralCombiner(8, 5, 3, seed=2)
    folder = tmp_path_factory.mktemp("weights")
    networks = {
        "james_stein_weights": wild(VarianceNetwork(1)),
        "combiner_weights": wild(one),
        "combiner_4_weights": wild(DeepCombiner(4, **SMALL, seed=3)),
    }
    for name, network in networks.items():
        file = folder / f"{name}.safetensors"
        weights.save(file, network, settings={}, data="", attribution="", dtype=torch.float32)
    return {name: str(folder / f"{name}.safetensors") for name in networks}


@pytest.fixture(scope="module")
def renders(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """A corner of the packaged frame as half-float files: halves a and b, then the sub-images of each."""
    folder = tmp_path_factory.mktemp("renders")
    generator, halves, subs = np.random.default_rng(0), [], []
    data = Path(exr.__file__).parents[1] / "data"
    for which in "ab":
        buffers = exr.load_half(str(data / f"demo_064spp_{which.upper()}.exr")).buffers
        color, *others = (buffers[name][100:164, 90:160] for name in ("color", "albedo", "normal", "depth"))
        apart = color * generator.uniform(-0.5, 0.5, color.shape)
        subs += [write_render(folder / f"{which}{i}.exr", [color + sign * apart]) for i, sign in ((1, 1), (2, -1))]
        halves.append(write_render(folder / f"{which}.exr", [color, *others]))
    return [*halves, *subs]
