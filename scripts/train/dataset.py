"""The training set's files: one view of a scene each, a safetensors file with its facts as metadata.

A view has five independent renders. Four are the sub-images of a frame, half a of the first two and half b of the
others; the fifth is the target, of more samples. A noisy target is as good as a clean one under a squared error
(Lehtinen et al. 2018) as long as no input shares its samples, but where its noise is tens of times what a network could
gain, thousands of views are needed to see the gain at all.
"""

import hashlib
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

__all__ = ["SUB_IMAGES", "View", "checksum", "inputs_of", "load", "metadata_of", "save", "views"]

SUB_IMAGES = 4
_PREFIX = "denoised."
_LARGEST = torch.finfo(torch.float16).max


class View(NamedTuple):
    """One view; linear radiance, world-space shading normals, float32 (H, W, 3) unless another shape is named.

    Attributes:
        name: of the file.
        scene: that it shows.
        spp: samples per pixel of the frame, of both halves together; a sub-image has a quarter of them.
        color: (5, H, W, 3): four sub-images and the target.
        albedo: 0…1.
        normal: of the surface, length 0 where nothing was hit.
        depth: (H, W), distance; 0 where nothing was hit.
        denoised: by denoiser, (7, H, W, 3): of sub-images 0…3, of halves a and b, and of the frame.
        smooth: the target denoised; in the validation part the mean of the references, for the weight of the metric.
        reference: (2, H, W, 3), two independent ones; None in the training part.
    """

    name: str
    scene: str
    spp: int
    color: Tensor
    albedo: Tensor
    normal: Tensor
    depth: Tensor
    denoised: dict[str, Tensor]
    smooth: Tensor
    reference: Tensor | None = None


def inputs_of(color: Tensor) -> Tensor:
    """What is denoised of a view's sub-images (4 or more, H, W, 3): they, halves a and b, the frame: (7, H, W, 3)."""
    halves = torch.stack([color[:2].mean(0), color[2:SUB_IMAGES].mean(0)])
    return torch.cat([color[:SUB_IMAGES], halves, halves.mean(0, keepdim=True)])


def save(path: Path, view: View, facts: Mapping[str, str]) -> None:
    """Write a view, under a temporary name first; what is denoised and the G-buffers as half floats."""
    half = {"albedo": view.albedo, "normal": view.normal, "depth": view.depth}
    half |= {_PREFIX + name: image for name, image in view.denoised.items()}
    tensors = {"color": view.color, "smooth": view.smooth}
    tensors |= {name: t.clamp(-_LARGEST, _LARGEST).half() for name, t in half.items()}
    if view.reference is not None:
        tensors["reference"] = view.reference
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    save_file(
        {name: tensor.contiguous() for name, tensor in tensors.items()},
        temporary,
        {**facts, "scene": view.scene, "spp": str(view.spp)},
    )
    os.replace(temporary, path)


def load(path: Path) -> View:
    """Read a view."""
    with safe_open(path, "pt") as file:
        facts = file.metadata()
        names: list[str] = file.keys()
        tensors = {name: file.get_tensor(name).float() for name in names}
    denoised = {name.removeprefix(_PREFIX): tensors[name] for name in sorted(tensors) if name.startswith(_PREFIX)}
    return View(
        path.stem,
        facts["scene"],
        int(facts["spp"]),
        *(tensors[name] for name in ("color", "albedo", "normal", "depth")),
        denoised,
        tensors["smooth"],
        tensors.get("reference"),
    )


def metadata_of(path: Path) -> dict[str, str]:
    """The facts of a view, without its images."""
    with safe_open(path, "pt") as file:
        return dict(file.metadata())


def views(folder: Path) -> list[Path]:
    """The files of a part of the set, sorted by name."""
    return sorted(folder.glob("[!.]*.safetensors"))


def checksum(paths: Iterable[Path]) -> str:
    """SHA-256 over the names and the contents of files."""
    total = hashlib.sha256()
    for path in paths:
        total.update(path.name.encode())
        with path.open("rb") as file:
            total.update(hashlib.file_digest(file, "sha256").digest())
    return total.hexdigest()
