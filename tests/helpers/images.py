"""Random images, and channels of files."""

from pathlib import Path

import numpy as np
import OpenEXR
import torch

SHAPE = (32, 48, 3)


def radiance(seed: int = 0, shape: tuple[int, int, int] = SHAPE) -> np.ndarray:
    return np.random.default_rng(seed).gamma(2.0, 0.25, shape)


def image(height: int, width: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed))


def read(path: Path) -> dict[str, np.ndarray]:
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: channel.pixels.astype(np.float32) for name, channel in file.channels().items()}


def stacked(channels: dict[str, np.ndarray], *names: str) -> np.ndarray:
    return np.stack([channels[name] for name in names], axis=2)
