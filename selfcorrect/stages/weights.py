"""Trained weights on disk: safetensors, so that loading them runs nothing; those of the package, or the user's own."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import safetensors
import safetensors.torch
import torch
from torch import Tensor, nn

from selfcorrect.errors import FileError
from selfcorrect.publish import publish
from selfcorrect.settings import Settings

__all__ = ["PACKAGED", "TrainedNetwork", "load", "of_stage", "save"]

PACKAGED = Path(__file__).resolve().parent.parent / "weights"
"""Where the package keeps its own."""

_FORMAT = "selfcorrect weights 1"


class TrainedNetwork(nn.Module):
    """A network whose weights are in a file.

    Attributes:
        kind: what files call it.
        architecture: the arguments that rebuild it.
    """

    kind: ClassVar[str]
    architecture: dict[str, Any]


Kind = TypeVar("Kind", bound=TrainedNetwork)


def save(
    path: str | Path,
    network: TrainedNetwork,
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
        "network": network.kind,
        "architecture": json.dumps(network.architecture),
        "settings": json.dumps(dict(settings)),
        "data": data,
        "attribution": attribution,
    }
    publish(Path(path), safetensors.torch.save(tensors, metadata))


def load(path: str | Path, *kinds: type[Kind]) -> Kind:
    """Read a network of one of these kinds, in float32, for evaluation.

    Raises:
        FileError: the file is missing, holds no weights of selfcorrect or those of another network, or they do not fit
            their architecture.
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
    return _built(path, kinds, metadata, tensors)


def _built(
    path: str | Path, kinds: tuple[type[Kind], ...], metadata: Mapping[str, str], tensors: dict[str, Tensor]
) -> Kind:
    name, architecture = metadata.get("network", ""), metadata.get("architecture", "")
    known = {kind.kind: kind for kind in kinds}
    if name not in known:
        raise FileError(f"{path}: expected weights of {' or '.join(known)}, but got those of {name or 'no network'}")
    try:
        network = known[name](**json.loads(architecture))
        network.load_state_dict(tensors)
    except (TypeError, ValueError, RuntimeError, LookupError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise FileError(
            f"{path}: expected weights that fit their architecture {architecture}, but got: {reason}"
        ) from None
    return network.eval().requires_grad_(requires_grad=False)


def of_stage(stage: str, settings: Settings, setting: str, packaged: str, *kinds: type[Kind]) -> tuple[Kind, Path]:
    """The user's own weights of a stage, else the package's; and their file.

    Args:
        stage: its name, for messages.
        settings: of the frame.
        setting: the one that names the user's file.
        packaged: name of the package's file, without ending.
        kinds: that the network may be of.

    Raises:
        FileError: see :func:`load`.
    """
    path = Path(getattr(settings, setting) or PACKAGED / f"{packaged}.safetensors")
    if not path.is_file():
        flag = setting.replace("_", "-")
        raise FileError(f"{path}: expected the weights of the stage {stage}, but got no file; name one with --{flag}")
    return load(path, *kinds), path
