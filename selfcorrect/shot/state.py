"""A network on disk, for the next frame of a shot to start from: safetensors, so that loading it runs nothing."""

import hashlib
import json
import os
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import get_type_hints

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from selfcorrect.errors import FileError, SelfcorrectError
from selfcorrect.publish import publish
from selfcorrect.settings import Settings
from selfcorrect.stages.core.network import Network, Traits

__all__ = ["State", "check_state_target", "load_state", "save_state", "state_after"]

_FORMAT = "selfcorrect state 1"


@dataclass(frozen=True, eq=False)
class State:
    """What a state file holds.

    Attributes:
        network: the network after its frame.
        frame: the frame's number, or None.
        recipe: the recipe of the frame's output (:func:`selfcorrect.shot.recipe.recipe`), empty where there is none: it
            ties the state to the output it was saved with.
    """

    network: Network
    frame: int | None = None
    recipe: str = ""


def check_state_target(path: str | Path) -> Path:
    """The file to write; to be called before long work.

    Raises:
        FileError: it cannot be written.
    """
    target = Path(path)
    if target.suffix != ".safetensors":
        raise FileError(f"{path}: expected a state whose name ends in .safetensors, but got '{target.name}'")
    if target.is_dir() or not target.parent.is_dir():
        raise FileError(f"{path}: expected a file in a folder that exists, but got none; create the folder first")
    if not os.access(target if target.exists() else target.parent, os.W_OK):
        raise FileError(f"{path}: expected a state that can be written, but it is read-only; choose another folder")
    return target


def save_state(path: str | Path, state: State, settings: Settings) -> None:
    """Write the state; the file appears under its name only when it is whole.

    Raises:
        FileError: it cannot be written.
    """
    tensors = {name: value.cpu().contiguous() for name, value in state.network.state_dict().items()}
    metadata = {
        "format": _FORMAT,
        "version": version("selfcorrect"),
        "traits": json.dumps(state.network.traits._asdict()),
        "settings": json.dumps(settings.to_dict()),
        "frame": json.dumps(state.frame),
        "recipe": state.recipe,
    }
    metadata["checksum"] = _checksum(tensors, metadata)
    publish(check_state_target(path), safetensors.torch.save(tensors, metadata))


def load_state(path: str | Path) -> State:
    """Read a state.

    Whether it fits a frame is checked where the frame is known (:func:`selfcorrect.correct`).

    Raises:
        FileError: the file is missing, no state of selfcorrect, or damaged.
    """
    if os.path.exists(path) and not os.path.isfile(path):
        raise FileError(f"{path}: expected a state of selfcorrect, but got a folder, a pipe or a device; name a file")
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            metadata: dict[str, str] = file.metadata() or {}
            names: list[str] = file.keys()
            tensors = {name: file.get_tensor(name) for name in names}
    except OSError as error:
        raise FileError(f"{path}: expected a state of selfcorrect, but got: {error.strerror or error}") from None
    except safetensors.SafetensorError as error:
        raise FileError(f"{path}: expected an intact state of selfcorrect, but got: {error}; save it again") from None
    if metadata.get("format") != _FORMAT:
        got = metadata.get("format", "another safetensors file")
        raise FileError(f"{path}: expected '{_FORMAT}', but got {got!r}; save it again with --save-state")
    checksum = metadata.pop("checksum", "")
    try:
        if checksum != _checksum(tensors, metadata):
            raise ValueError("the checksum of another state: it is damaged")
        network = _network(_traits(metadata["traits"]), tensors)
        frame = json.loads(metadata["frame"])
        return State(network, None if frame is None else int(frame), metadata["recipe"])
    except (SelfcorrectError, LookupError, TypeError, ValueError, RuntimeError, RecursionError, OverflowError) as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise FileError(f"{path}: expected a state that fits together, but got: {reason}; save it again") from None


def state_after(path: str | Path, frame: int, recipe: str) -> State | None:
    """The state that was saved after this frame with this recipe; None where the file has another one, or none."""
    try:
        state = load_state(path)
    except SelfcorrectError:  # missing, or of a run that was killed and lost it: there is nothing to go on from
        return None
    return state if (state.frame, state.recipe) == (frame, recipe) else None


def _traits(text: str) -> Traits:
    """Traits from JSON; of each the type that it is annotated with."""
    found = json.loads(text)
    kinds = get_type_hints(Traits)
    return Traits(**{name: kinds[name](value) for name, value in dict(found).items()})


def _network(traits: Traits, tensors: dict[str, Tensor]) -> Network:
    inputs = tensors["convolutions.0.weight"].shape[1]
    heads = tensors[f"convolutions.{traits.layers - 1}.weight"].shape[0]
    settings = Settings(filters=traits.filters, layers=traits.layers, log_radiance=traits.log_radiance)
    network = Network(inputs, heads, settings, torch.Generator())
    network.load_state_dict(tensors)
    network.traits = traits
    return network


def _checksum(tensors: dict[str, Tensor], metadata: dict[str, str]) -> str:
    digest = hashlib.blake2b(json.dumps(metadata, sort_keys=True).encode(), digest_size=16)
    for name in sorted(tensors):
        digest.update(name.encode())
        digest.update(tensors[name].numpy().tobytes())
    return digest.hexdigest()
