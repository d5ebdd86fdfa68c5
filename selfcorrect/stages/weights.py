"""Trained weights on disk: safetensors, so that loading them runs nothing; those of the package, or the user's own."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor, nn

from selfcorrect.errors import FileError
from selfcorrect.publish import publish
from selfcorrect.settings import Settings
from selfcorrect.stages.deep_combiner import DeepCombiner
from selfcorrect.stages.neural_james_stein import VarianceNetwork

__all__ = ["PACKAGED", "check", "combiner", "load", "save", "variance_network"]

PACKAGED = Path(__file__).resolve().parent.parent / "weights"
"""Where the package keeps its own."""

_FORMAT = "selfcorrect weights 1"
_STAGES = {
    "neural-james-stein": ("james_stein_weights", "james-stein"),
    "deep-combiner": ("combiner_weights", "deep-combiner"),
    "deep-combiner-4": ("combiner_4_weights", "deep-combiner-4"),
}
"""By stage: the setting that names a file, and the packaged one."""
_NETWORKS: dict[str, type[nn.Module]] = {"james-stein": VarianceNetwork, "deep-combiner": DeepCombiner}


def save(
    path: str | Path,
    network: VarianceNetwork | DeepCombiner,
    *,
    settings: Mapping[str, Any],
    data: str,
    attribution: str,
    dtype: torch.dtype = torch.float16,
) -> None:
    """Write a network's weights; the file appears under its name only when it is whole.

    Args:
        path: a name that ends in .safetensors.
        network: trained.
        settings: of the training, for JSON.
        data: checksum of what it was trained on.
        attribution: whose scenes those were, and their licences.
        dtype: of the weights on disk.

    Raises:
        FileError: it cannot be written, or a weight is not finite in ``dtype``.
    """
    tensors = {name: value.detach().cpu().to(dtype).contiguous() for name, value in network.state_dict().items()}
    for name, tensor in tensors.items():
        if not tensor.isfinite().all():
            raise FileError(f"{path}: expected finite weights in {dtype}, but got others in {name}")
    metadata = {
        "format": _FORMAT,
        "network": next(name for name, kind in _NETWORKS.items() if isinstance(network, kind)),
        "architecture": json.dumps(network.architecture),
        "settings": json.dumps(dict(settings)),
        "data": data,
        "attribution": attribution,
    }
    publish(Path(path), safetensors.torch.save(tensors, metadata))


def load(path: str | Path) -> nn.Module:
    """Read a network, in float32, for evaluation.

    Raises:
        FileError: the file is missing, holds no weights of selfcorrect, or they do not fit its architecture.
    """
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            metadata: dict[str, str] = file.metadata() or {}
            names: list[str] = file.keys()
            tensors = {name: file.get_tensor(name).float() for name in names}
    except OSError as error:
        raise FileError(f"{path}: expected trained weights, but got: {error.strerror or error}") from None
    except safetensors.SafetensorError as error:
        raise FileError(f"{path}: expected intact trained weights, but got: {error}") from None
    if metadata.get("format") != _FORMAT:
        got = metadata.get("format", "another safetensors file")
        raise FileError(f"{path}: expected '{_FORMAT}', but got {got!r}; export the weights again")
    return _built(path, metadata, tensors)


def _built(path: str | Path, metadata: Mapping[str, str], tensors: dict[str, Tensor]) -> nn.Module:
    name, architecture = metadata.get("network", ""), metadata.get("architecture", "")
    if name not in _NETWORKS:
        raise FileError(f"{path}: expected a network out of {', '.join(_NETWORKS)}, but got {name!r}")
    try:
        network = _NETWORKS[name](**json.loads(architecture))
        network.load_state_dict(tensors)
    except (TypeError, ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise FileError(
            f"{path}: expected weights that fit their architecture {architecture}, but got: {reason}"
        ) from None
    return network.eval().requires_grad_(requires_grad=False)


def variance_network(settings: Settings) -> VarianceNetwork:
    """The network of the stage neural-james-stein.

    Raises:
        FileError: see :func:`load`; or the file holds another network.
    """
    path = _path(settings, "neural-james-stein")
    network = load(path)
    if not isinstance(network, VarianceNetwork):
        raise FileError(f"{path}: expected weights of james-stein, but got those of a deep combiner")
    return network


def combiner(settings: Settings, *, pairs: int = 1) -> DeepCombiner:
    """The network of the stage deep-combiner, of one pair of a noisy and a denoised image, or of deep-combiner-4.

    Raises:
        FileError: see :func:`load`; or the file holds another network, or one for another number of pairs.
    """
    stage = "deep-combiner" if pairs == 1 else f"deep-combiner-{pairs}"
    path = _path(settings, stage)
    network = load(path)
    if not isinstance(network, DeepCombiner):
        raise FileError(f"{path}: expected weights of {stage}, but got those of james-stein")
    if network.pairs != pairs:
        raise FileError(f"{path}: expected weights of {stage}, but got those for {network.pairs} denoised images")
    return network


def _path(settings: Settings, stage: str) -> Path:
    """The user's own weights of a stage, else the package's."""
    setting, name = _STAGES[stage]
    path = Path(getattr(settings, setting) or PACKAGED / f"{name}.safetensors")
    if not path.is_file():
        flag = setting.replace("_", "-")
        raise FileError(f"{path}: expected the weights of the stage {stage}, but got no file; name one with --{flag}")
    return path


def check(settings: Settings) -> None:
    """Raise what a stage would raise that lacks its weights, before any long work."""
    if "neural-james-stein" in settings.stage_names:
        variance_network(settings)
    if {"deep-combiner", "deep-combiner-4"} & set(settings.stage_names):
        combiner(settings)
    if "deep-combiner-4" in settings.stage_names:
        combiner(settings, pairs=4)
