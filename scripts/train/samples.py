"""What a network learns from: random inputs and targets out of a view, as planes (…, H, W).

A noisy target is as good as a clean one under a squared error (Lehtinen et al. 2018) where its noise is independent of
all else in the loss. So of a view's sub-images some are the input, alone or as means, the target is a render of its
own, and the weight of the loss comes from the denoised image of the *inputs*: one of the target would weigh a pixel
that came out bright by chance less, and teach the network to darken.

Path-traced noise has tails that a few thousand steps cannot average, and of a target of 256 samples, too, nearly all
noise may lie in a few pixels. Leaving those to a bound of the gradient's norm teaches to darken: by 12 % in the median
of the validation views after 400 steps. So what such pixels have beyond the denoised *target* is spread over their
surroundings (:func:`spread`): light is neither lost nor gained, only where in those 31×31 pixels it lies remains
unknown.
"""

from typing import NamedTuple

import torch
from dataset import View
from torch import Tensor
from torch.nn import functional as F

__all__ = ["HALVES", "MEMBERS", "SINGLES", "WHOLE", "Memory", "Sample", "collate", "draw", "level_of", "spread"]

MEMBERS = ((0,), (1,), (2,), (3,), (0, 1), (2, 3), (0, 1, 2, 3))
"""Renders that each of a view's seven denoised images was made of: sub-images, halves, the frame."""
SINGLES, HALVES, WHOLE = (0, 1, 2, 3), (4, 5), 6

_TARGET = 4  # its number among a view's renders
_TAIL = 2.0  # times the level: residuals beyond it are spread
_SPREAD = 31  # pixels, odd
_BARE = 0.1  # share of the samples that lack a feature, of each feature
_EXPOSURES = 8.0  # up to this factor either way: a crop of a frame is darker or brighter than the frame
_PERMUTATIONS = ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0))


class Sample(NamedTuple):
    """Planes of one view, or with a leading N of a batch; radiance of a mean near 1.

    Attributes:
        noisy: (B, 3, H, W), inputs of independent noise.
        denoised: (B, 3, H, W), each of them, by some denoiser.
        biased: (2, 3, H, W), images for James–Stein, or none, (0, 3, H, W).
        albedo: (3, H, W).
        normal: (3, H, W).
        depth: (1, H, W), 0 … 1.
        target: (3, H, W), noise independent of all inputs.
        level: (3, H, W), the inputs denoised, for the weight of the loss.
        importance: (), weight of the sample.
    """

    noisy: Tensor
    denoised: Tensor
    biased: Tensor
    albedo: Tensor
    normal: Tensor
    depth: Tensor
    target: Tensor
    level: Tensor
    importance: Tensor

    @property
    def features(self) -> Tensor:
        """Normal, albedo and depth as the combiners take them."""
        return torch.cat([self.normal, self.albedo, self.depth], dim=-3)


class Memory(NamedTuple):
    """A view in planes, with half floats where its file has them: a thousand of 128×128 take 3.3 GB."""

    color: Tensor  # (4, 3, H, W) float32, sub-images
    target: Tensor  # (3, H, W) float32, without outliers
    denoised: dict[str, Tensor]  # (7, 3, H, W) float16
    albedo: Tensor
    normal: Tensor
    depth: Tensor

    @classmethod
    def of(cls, view: View) -> "Memory":
        """Take what training needs of a view."""
        color = view.color.movedim(-1, -3)
        return cls(
            color[:_TARGET].contiguous(),
            spread(color[_TARGET], view.smooth.movedim(-1, -3)),
            {name: image.movedim(-1, -3).half().contiguous() for name, image in view.denoised.items()},
            view.albedo.movedim(-1, -3).half().contiguous(),
            view.normal.movedim(-1, -3).half().contiguous(),
            view.depth[None].half(),
        )

    def noisy(self, keys: tuple[int, ...]) -> Tensor:
        """The noisy images (B, 3, H, W) whose denoised ones have these numbers."""
        return torch.stack([self.color[list(MEMBERS[key])].mean(0) for key in keys])


def draw(
    memory: Memory,
    keys: tuple[int, ...],
    denoiser: str,
    generator: torch.Generator,
    *,
    crop: int,
    biased: Tensor | None = None,
    taught: bool = False,
) -> Sample:
    """One training sample of a view: turned, mirrored, its colours permuted, at a random exposure.

    Args:
        memory: the view.
        keys: numbers of the denoised images whose noisy ones are the inputs.
        denoiser: whose denoised images.
        generator: of what is random here.
        crop: side in pixels; the whole view where it is not larger.
        biased: images (K, 3, H, W) to go along.
        taught: the target is OIDN's image of the frame instead of the render.
    """
    noisy = memory.noisy(keys)
    level = memory.denoised["oidn"][list(keys)].float().mean(0)
    exposure = _exposure(level, generator)
    radiance = [
        noisy,
        memory.denoised[denoiser][list(keys)].float(),
        noisy[:0] if biased is None else biased,
        memory.denoised["oidn"][WHOLE].float() if taught else memory.target,
        level,
    ]
    noisy, denoised, biased, target, level = (image * exposure for image in radiance)
    depth = memory.depth.float()
    depth = depth / depth.max().clamp(min=1e-6) * (0.25 + 0.75 * _uniform(generator))  # crops of deeper frames
    sample = Sample(
        noisy, denoised, biased, memory.albedo.float(), memory.normal.float(), depth, target, level, torch.ones(())
    )
    sample = _turned(_permuted(_cropped(sample, crop, generator), generator), generator)
    sample = _bared(sample, generator)
    return sample._replace(importance=_importance(sample))


def collate(samples: list[Sample]) -> Sample:
    """Samples as one batch."""
    return Sample(*(torch.stack(planes) for planes in zip(*samples, strict=True)))


def level_of(image: Tensor) -> Tensor:
    """The square of the mean root of radiance (…, 3, H, W): what the tool brings a frame to 1 by."""
    return image.clamp(min=0).mean(-3).sqrt().mean().square().clamp(min=1e-20)


def spread(target: Tensor, level: Tensor) -> Tensor:
    """The target with what its outliers differ from the level, itself denoised, by beyond a bound spread around them.

    Means over windows of 31×31 pixels stay what they are, but for windows across the border, which is mirrored.
    """
    residual = target - level
    bound = _TAIL * (level.mean(0, keepdim=True) + 0.1 * level.mean())
    kept = residual.clamp(-bound, bound)
    reach = min(_SPREAD // 2, min(target.shape[-2:]) - 1)
    padded = F.pad((residual - kept)[None], (reach,) * 4, mode="reflect")
    return level + kept + F.avg_pool2d(padded, 2 * reach + 1, 1)[0]


def _uniform(generator: torch.Generator) -> float:
    return float(torch.rand((), generator=generator))


def _integer(below: int, generator: torch.Generator) -> int:
    return int(torch.randint(below, (), generator=generator))


def _exposure(level: Tensor, generator: torch.Generator) -> float:
    """To a mean near 1, times a factor that is even in its logarithm."""
    return float(_EXPOSURES ** (2 * _uniform(generator) - 1) / level_of(level))


def _importance(sample: Sample) -> Tensor:
    """About 1 / the relative squared noise of the inputs.

    Unweighted, the few noisiest views would decide everything. It is made of inputs alone, so that what is learned at a
    pixel is still the mean of all targets. Outliers are bounded here: a single one should not remove a view.
    """
    squared = ((sample.noisy.mean(0) - sample.level) ** 2).mean(0) / (sample.level.mean(0) ** 2 + 0.01)
    return 1 / (squared.clamp(max=10).mean() + 0.01)


def _cropped(sample: Sample, side: int, generator: torch.Generator) -> Sample:
    height, width = sample.target.shape[-2:]
    top, left = (_integer(max(size - side, 0) + 1, generator) for size in (height, width))
    planes = (image[..., top : top + side, left : left + side] for image in sample[:-1])
    return Sample(*planes, sample.importance)


def _permuted(sample: Sample, generator: torch.Generator) -> Sample:
    """Colours in another order, of radiance and albedo alike; the world turned by another choice of its axes."""
    colors = list(_PERMUTATIONS[_integer(len(_PERMUTATIONS), generator)])
    axes = list(_PERMUTATIONS[_integer(len(_PERMUTATIONS), generator)])
    signs = (torch.randint(2, (3, 1, 1), generator=generator) * 2 - 1).to(sample.normal.dtype)
    shown = {
        name: getattr(sample, name)[..., colors, :, :]
        for name in ("noisy", "denoised", "biased", "albedo", "target", "level")
    }
    return sample._replace(normal=sample.normal[axes] * signs, **shown)


def _bared(sample: Sample, generator: torch.Generator) -> Sample:
    """Without some features, which are then 0: not every frame has all."""
    names = ("albedo", "normal", "depth")
    kept = (torch.rand(len(names), generator=generator) >= _BARE).to(sample.albedo.dtype).tolist()
    return sample._replace(**{name: getattr(sample, name) * keep for name, keep in zip(names, kept, strict=True)})


def _turned(sample: Sample, generator: torch.Generator) -> Sample:
    """One of the eight symmetries of the square; shading normals are of the world, and stay."""
    kind = _integer(8, generator)

    def one(image: Tensor) -> Tensor:
        image = image.transpose(-1, -2) if kind & 1 else image
        axes = [axis for bit, axis in ((2, -1), (4, -2)) if kind & bit]
        return image.flip(axes) if axes else image

    return Sample(*(one(image).contiguous() for image in sample[:-1]), sample.importance)
