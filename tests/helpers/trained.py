"""Frames, sub-images, files and untrained networks for the tests of the trained stages."""

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import torch
from torch import Tensor

import denoisers
from selfcorrect import Frame, Settings
from selfcorrect.frame import mean
from selfcorrect.stages.deep_combiner_4 import SubImages
from selfcorrect.stages.images import StageImages
from selfcorrect.stages.neural_james_stein import VarianceNetwork

SMALL = {"width": 8, "window": 5, "layers": 3, "kernel": 3}
SIZE = (44, 39)
_NAMES = ["R", "G", "B", "albedo.R", "albedo.G", "albedo.B", "nn.X", "nn.Y", "nn.Z", "dd.T"]


def wild(network: Any) -> Any:
    """With outputs that differ a lot from pixel to pixel, as those of a trained network."""
    last = network.last if isinstance(network, VarianceNetwork) else network.convolutions[-1]
    with torch.no_grad():
        last.weight.mul_(10)
        last.bias.mul_(0.3)
    return network.eval()


def settings(weight_files: dict[str, str], **changes: object) -> Settings:
    return Settings.preset("balanced", **{"precision": "fp32", "guard": False} | weight_files | changes)


def make_frame(size: tuple[int, int] = SIZE, *, features: bool = True, scale: float = 1.0) -> Frame:
    """The frame of :func:`make_both`."""
    return make_both(size, features=features, scale=scale)[0]


def make_both(size: tuple[int, int] = SIZE, *, features: bool = True, scale: float = 1.0) -> tuple[Frame, SubImages]:
    """A frame and its four sub-images, denoised by a box."""
    generator = torch.Generator().manual_seed(0)
    y, x = torch.meshgrid(*(torch.arange(n) for n in size), indexing="ij")
    albedo = (0.5 + 0.3 * torch.sin(x / 2))[..., None].expand(*size, 3).contiguous()
    truth = scale * albedo * (1 + 0.5 * torch.sin(y / 9))[..., None]
    four = [truth * (0.2 + 0.8 * torch.rand(*size, 3, generator=generator)) for _ in range(4)]
    buffers = {}
    if features:
        normal = torch.nn.functional.normalize(torch.randn(*size, 3, generator=generator), dim=-1)
        depth = 3 + torch.rand(*size, 1, generator=generator)
        buffers = {"albedo": (albedo, albedo), "normal": (normal, -normal), "depth": (depth, depth + 1)}
    color = (mean((four[0], four[1])), mean((four[2], four[3])))
    box = denoisers.create("box")
    frame = Frame(color=color, **buffers).denoise(box)
    return frame, SubImages.of(frame, four).denoise(frame, box)


def planes(image: Tensor) -> Tensor:
    return image.permute(2, 0, 1)[None]


def state_of(frame: Frame, scale: float = 1.0) -> StageImages:
    return StageImages(frame.halves, frame.denoised_full, scale)


def write_render(path: Path, images: list[np.ndarray]) -> str:
    channels = dict(zip(_NAMES, np.moveaxis(np.concatenate(images, -1), -1, 0).astype(np.float16), strict=False))
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {name: np.ascontiguousarray(plane) for name, plane in channels.items()}).write(str(path))
    return str(path)
