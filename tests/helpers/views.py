"""A training set of synthetic views: a known image under gamma noise, denoised by real denoisers."""

from pathlib import Path

import dataset
import torch
from torch import Tensor

import denoisers

DENOISERS = ("oidn", "joint-bilateral")


def make_view(seed: int, side: int, *, clean: bool) -> dataset.View:
    """Stripes of albedo under a light that varies slowly."""
    generator = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    phase, period = torch.rand(2, generator=generator).tolist()
    albedo = (0.5 + 0.3 * torch.sin(x / (1 + 2 * period)))[..., None] * torch.tensor([1.0, 0.8, 0.6])
    truth = albedo * (1 + 0.5 * torch.sin(y / 9 + 6 * phase))[..., None]
    noise = torch.empty(5, side, side, 3).exponential_(generator=generator)  # seeded, unlike torch's gamma
    normal = torch.nn.functional.normalize(
        torch.stack([x / side - 0.5, y / side - 0.5, torch.ones_like(x)], -1), dim=-1
    )
    noise[4] = 1 + (noise[4] - 1) / 8  # of the target, which has more samples
    color = truth * (0.5 + 0.5 * noise)
    images = dataset.inputs_of(color)
    denoised = {name: _denoised(name, images, albedo, normal) for name in DENOISERS}
    smooth, reference = (truth, torch.stack([truth, truth])) if clean else (color[4].clone(), None)
    return dataset.View("", "stripes", 16, color, albedo, normal, 1.0 + y / side, denoised, smooth, reference)


def write_dataset(folder: Path, *, views: int = 6, side: int = 48) -> Path:
    """A folder with train/ and validation/."""
    for part, count in (("train", views), ("validation", 2)):
        (folder / part).mkdir(parents=True)
        for number in range(count):
            view = make_view(number + 100 * (part == "train"), side, clean=part == "validation")
            dataset.save(folder / part / f"{number:03}.safetensors", view, {"seed": str(number)})
    return folder


def _denoised(name: str, images: Tensor, albedo: Tensor, normal: Tensor) -> Tensor:
    denoise = denoisers.create(name, threads=1)
    return torch.stack([denoise(image, albedo=albedo, normal=normal) for image in images])
