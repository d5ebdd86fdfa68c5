"""Trained weights on disk: what comes back, what is refused, and by which line."""

import json
from pathlib import Path
from typing import Any

import pytest
import safetensors
import safetensors.torch
import torch

from selfcorrect import Settings
from selfcorrect.errors import FileError
from selfcorrect.stages import opened, weights
from selfcorrect.stages.deep_combiner import DeepCombiner
from selfcorrect.stages.neural_james_stein import VarianceNetwork

SMALL = {"width": 8, "window": 5, "layers": 3, "kernel": 3}
ORIGIN: dict[str, Any] = {"settings": {"steps": 3}, "data": "0123abcd", "attribution": "a scene by someone, CC-BY"}


def saved(path: Path, network: VarianceNetwork | DeepCombiner, **options: Any) -> Path:
    weights.save(path, network, **ORIGIN, **options)
    return path


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
@pytest.mark.parametrize("network", [VarianceNetwork(1), DeepCombiner(**SMALL), DeepCombiner(4, **SMALL)])
def test_what_was_saved_comes_back(network: VarianceNetwork | DeepCombiner, dtype: torch.dtype, tmp_path: Path) -> None:
    path = saved(tmp_path / "w.safetensors", network, dtype=dtype)
    loaded = weights.load(path, type(network))
    assert type(loaded) is type(network)
    assert loaded.architecture == network.architecture
    assert not loaded.training
    for name, value in network.state_dict().items():
        got = loaded.state_dict()[name]
        assert got.dtype == torch.float32
        assert not got.requires_grad
        assert torch.equal(got, value.to(dtype).float())


def test_metadata_tells_the_origin(tmp_path: Path) -> None:
    path = saved(tmp_path / "w.safetensors", DeepCombiner(**SMALL))
    with safetensors.safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    assert json.loads(metadata["architecture"]) == {"buffers": 1, **SMALL, "anchored": False}
    assert json.loads(metadata["settings"]) == {"steps": 3}
    assert (metadata["data"], metadata["attribution"]) == ("0123abcd", "a scene by someone, CC-BY")


def test_weights_that_half_floats_cannot_hold_are_not_saved(tmp_path: Path) -> None:
    network = DeepCombiner(**SMALL)
    with torch.no_grad():
        network.convolutions[1].weight[0, 0, 0, 0] = 1e6
    with pytest.raises(FileError, match=r"convolutions\.1\.weight"):
        saved(tmp_path / "w.safetensors", network)
    assert not list(tmp_path.iterdir())
    assert weights.load(saved(tmp_path / "w.safetensors", network, dtype=torch.bfloat16), DeepCombiner) is not None


def test_files_that_are_no_weights_are_refused(tmp_path: Path) -> None:
    whole = saved(tmp_path / "w.safetensors", DeepCombiner(**SMALL))
    cut = tmp_path / "cut.safetensors"
    cut.write_bytes(whole.read_bytes()[:-100])
    other = tmp_path / "other.safetensors"
    other.write_bytes(safetensors.torch.save({"x": torch.zeros(3)}))
    for path, line in (
        (tmp_path / "none.safetensors", "expected trained weights"),
        (cut, "expected intact trained weights"),
        (other, "another safetensors file"),
        (tmp_path, "expected"),
    ):
        with pytest.raises(FileError, match=line) as error:
            weights.load(path, DeepCombiner)
        assert str(path) in str(error.value)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "change",
    [
        {"network": "another"},
        {"architecture": "{"},
        {"architecture": '{"depth": 3}'},
        {"architecture": json.dumps({**SMALL, "width": 9})},
        {"architecture": json.dumps({**SMALL, "layers": 4})},
        {"format": "selfcorrect weights 0"},
    ],
)
def test_weights_that_do_not_fit_are_refused_in_one_line(change: dict[str, str], tmp_path: Path) -> None:
    path = saved(tmp_path / "w.safetensors", DeepCombiner(**SMALL))
    with safetensors.safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    path.write_bytes(safetensors.torch.save(safetensors.torch.load_file(path), metadata | change))
    with pytest.raises(FileError, match="expected") as error:
        weights.load(path, DeepCombiner)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_stage_gets_its_own_network_only(tmp_path: Path) -> None:
    variance = str(saved(tmp_path / "v.safetensors", VarianceNetwork()))
    one = str(saved(tmp_path / "1.safetensors", DeepCombiner(**SMALL)))
    four = str(saved(tmp_path / "4.safetensors", DeepCombiner(4, **SMALL)))
    fits = Settings(
        stages="deep-combiner-4,neural-james-stein",
        james_stein_weights=variance,
        combiner_weights=one,
        combiner_4_weights=four,
    )
    opened(fits)
    assert fits.files == (variance, one, four)
    for changes, line in (
        ({"james_stein_weights": one}, "those of deep-combiner"),
        ({"combiner_weights": variance}, "those of james-stein"),
        ({"combiner_weights": four}, "those for 4 denoised images"),
        ({"combiner_4_weights": one}, "those for 1 denoised images"),
        ({"combiner_4_weights": str(tmp_path / "none")}, "--combiner-4-weights"),
        ({"james_stein_weights": str(tmp_path / "none")}, "--james-stein-weights"),
    ):
        with pytest.raises(FileError, match=line):
            opened(Settings.from_dict(fits.to_dict() | changes))
    opened(Settings(combiner_weights=str(tmp_path / "none")))  # no stage asks for it


def test_the_package_is_where_weights_are_looked_for(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert Path(weights.__file__).parent.parent / "weights" == weights.PACKAGED
    monkeypatch.setattr(weights, "PACKAGED", tmp_path)
    with pytest.raises(FileError, match=r"james-stein\.safetensors: .* --james-stein-weights"):
        opened(Settings(stages="neural-james-stein"))
    saved(tmp_path / "james-stein.safetensors", VarianceNetwork(5))
    (stage,) = opened(Settings(stages="neural-james-stein"))
    got = stage.network.last.weight
    assert torch.equal(got, VarianceNetwork(5).last.weight.half().float())
