"""Pixels that nothing around them speaks for, though both halves agree on them: no evidence, whatever they are.

Where both halves show one pixel a hundred times as bright as all around it, a path of great energy has been met twice,
or there is a star, a glint, a lamp of a pixel's size. The halves cannot tell which: each confirms the other. And the
errors are not alike: a star that is lost costs its own pixel, a firefly that is put back costs its whole energy. So
what the denoiser of the full buffer says stands there. Such a pixel is set aside before anything is learned or judged:
each noisy half takes the value that its own denoised image has there, so that nothing is learned from it, no change of
it is confirmed, and no gain is claimed for it. What the denoised image may have left of a firefly there counts in the
estimate as an error that stays. The halves remain independent of each other.

A lamp is taken for one, and believed, where a pixel beside it shares its light, or where its albedo is brighter than
all around it: it is then a thing that the renderer's first hit has seen. Emission is no buffer of a frame.

With m the mean of a half's channels, of a frame whose mean is near 1, and the maximum over the eight neighbours q of p:

    min(m^a, m^b)(p) > 100 · ( max_q min(m^a, m^b)(q) + 0.1 )

The factor is a tenth of what was asked to be safe from, and far above what noise or texture does in both halves at
once; `tests/test_lone_pixels.py` has fireflies, stars, glints and lamps on either side of it.
"""

import torch
from torch import Tensor

from selfcorrect.frame import Half
from selfcorrect.image.bands import bands

__all__ = ["lone_pixels", "set_aside", "unjudged"]

Halves = tuple[Half, Half]

_BRIGHTER = 100.0  # times its neighbours
_DARKEST = 0.1  # radiance of a mean near 1: black surroundings make nothing a firefly
_OWN_ALBEDO = 0.1  # more than all around it: a thing of its own
_AROUND = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0)]


def lone_pixels(halves: Halves, scale: float) -> Tensor:
    """Where both halves show a pixel that nothing around it speaks for, (N, 2): rows and columns.

    Args:
        halves: noisy linear radiance ≥ 0 and, where there is one, albedo.
        scale: what brings radiance to a mean near 1.
    """
    color = [half.color for half in halves]
    albedo = [half.albedo for half in halves if half.albedo is not None]
    found = [torch.empty(0, 2, dtype=torch.long, device=color[0].device)]
    for rows in bands(color[0].shape[0]):
        both = torch.minimum(_sum(color[0][rows]), _sum(color[1][rows])) * (scale / 3)
        pixels = (both > _BRIGHTER * _DARKEST).nonzero()  # few, of a mean near 1
        if not len(pixels):
            continue
        agreed = both[pixels[:, 0], pixels[:, 1]]
        pixels[:, 0] += rows.start
        beside = torch.stack([_beside(image, pixels) for image in color]).amin(0) * scale
        alone = agreed > _BRIGHTER * (beside.amax(0) + _DARKEST)
        if albedo:
            alone &= ~torch.stack([_of_its_own(image, pixels) for image in albedo]).all(0)
        found.append(pixels[alone])
    return torch.cat(found)


def set_aside(halves: Halves, pixels: Tensor) -> Halves:
    """The halves, whose noisy radiance at these pixels is that of their own denoised images; a copy where it changes.

    Args:
        halves: with their denoised images.
        pixels: (N, 2), rows and columns.
    """
    if not len(pixels):
        return halves
    rows, columns = pixels.unbind(1)

    def one(half: Half) -> Half:
        if half.denoised is None:
            raise ValueError("expected halves with denoised images, but got none")
        color = half.color.clone()
        color[rows, columns] = half.denoised[rows, columns].clamp(min=0)
        return half._replace(color=color)

    return one(halves[0]), one(halves[1])


def unjudged(image: Tensor, halves: Halves, pixels: Tensor) -> float:
    """The relMSE that an image has at these pixels if they are fireflies, that is, if the truth is what lies around.

    Args:
        image: (H, W, 3) linear radiance.
        halves: noisy; what both show of the eight neighbours is what lies around.
        pixels: (N, 2), rows and columns.
    """
    if not len(pixels):
        return 0.0
    around = torch.stack([_beside(half.color, pixels) for half in halves]).amin(0).mean(0)
    shown = image[pixels[:, 0], pixels[:, 1]].double().mean(-1)
    errors = (shown - around) ** 2 / (around**2 + 0.01)
    return float(errors.sum()) / (image.shape[0] * image.shape[1])


def _sum(image: Tensor) -> Tensor:
    """Over channels, (rows, W); one by one: a reduction over three is slow."""
    first, second, third = image.unbind(-1)
    return first.double() + second + third


def _beside(image: Tensor, pixels: Tensor) -> Tensor:
    """An image's mean over channels at the eight neighbours of pixels, (8, N); 0 beyond the border."""
    size = torch.tensor(image.shape[:2], device=image.device)
    places = pixels + torch.tensor(_AROUND, device=image.device)[:, None]
    inside = ((places >= 0) & (places < size)).all(-1)
    rows, columns = places.clamp(min=0).minimum(size - 1).unbind(-1)
    values: Tensor = image[rows, columns].double().mean(-1) * inside
    return values


def _of_its_own(albedo: Tensor, pixels: Tensor) -> Tensor:
    """Whether a half's albedo is brighter there than all around it, (N,)."""
    own = albedo[pixels[:, 0], pixels[:, 1]].double().mean(-1)
    return own > _beside(albedo, pixels).amax(0) + _OWN_ALBEDO
