r"""How far an image is from its reference: relMSE with a standard error, PSNR, SSIM, ꟻLIP, mean radiance.

Every image is an array or tensor (H, W, 3) of linear radiance, of any float type, on any device; every result is a
Python float, computed on the first image's device (SSIM, ꟻLIP and resampling on the CPU). Input that is not finite, or
whose size differs, raises `FrameError`.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import flip_evaluator
import kornia.color
import kornia.metrics
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from selfcorrect.errors import FrameError
from selfcorrect.image.channels import channel_mean

__all__ = [
    "Comparison",
    "Estimate",
    "compare",
    "flip",
    "mean_radiance_ratio",
    "psnr",
    "relmse",
    "relmse_ratio",
    "relmse_standard_error",
    "ssim",
    "temporal_error",
    "tone_map",
]

Image: TypeAlias = Tensor | np.ndarray[Any, Any]

TILE = 16
RESAMPLES = 1000
SSIM_WINDOW = 11


class Estimate(NamedTuple):
    """A number and its standard error."""

    value: float
    standard_error: float


@dataclass(frozen=True)
class Comparison:
    """What `compare` measures; every field is a float, described at the function of its name."""

    relmse: float
    relmse_standard_error: float
    psnr: float
    ssim: float
    flip: float
    mean_radiance_ratio: float


def compare(
    image: Image,
    reference: Image,
    reference_b: Image | None = None,
    weight: Image | None = None,
    seed: int | torch.Generator = 0,
) -> Comparison:
    """Measure an image by every metric of this module.

    Two references enter relMSE each on its own; the other metrics know only one and are taken against their
    mean, so its noise is a part of what they report.

    Args:
        image, reference, reference_b, weight: as in `relmse`, at least 11×11 pixels.
        seed: seed or generator of the bootstrap.
    """
    standard_error = relmse_standard_error(image, reference, reference_b, weight, seed)
    mean = _mean_reference(image, reference, reference_b)
    return Comparison(
        relmse=relmse(image, reference, reference_b, weight),
        relmse_standard_error=standard_error,
        psnr=psnr(image, mean),
        ssim=ssim(image, mean),
        flip=flip(image, mean),
        mean_radiance_ratio=mean_radiance_ratio(image, mean),
    )


def relmse(image: Image, reference: Image, reference_b: Image | None = None, weight: Image | None = None) -> float:
    r"""Relative mean squared error, the papers' relL2.

    .. math::
        \frac{1}{3N} \sum_{c,k} \frac{(x_{ck} - r^A_{ck})(x_{ck} - r^B_{ck})}{\bar{s}_c^2 + 0.01}

    over the N pixels c and channels k, with :math:`\bar{s}_c` the mean of the three channels of s. With a
    single reference :math:`r^A = r^B = s = r`, and the noise of r counts as an error of x. With two
    independent references, and s independent of their noise, that noise cancels in expectation: the result is
    unbiased, and may fall below 0 where x is closer to the truth than the references can tell.

    Without `weight`, s is the mean of the references, which is worse: where both missed the rare bright paths
    they are too low and the weight 1/s² is too high, so just those pixels decide, and an image that is too
    dark wins. Give a smooth reference (their mean, denoised) as `weight` wherever there is one, and read the
    result beside `mean_radiance_ratio`.

    Args:
        image: x, (H, W, 3) linear radiance, whose noise is independent of the references'.
        reference: r or r^A, of the same shape.
        reference_b: r^B, rendered independently of r^A, of the same shape.
        weight: s, of the same shape.

    Returns:
        The error, in [0, ∞) with one reference; 0 is best.

    Source:
        Back et al., Self-supervised post-correction for Monte Carlo denoising, 2022, for one reference. The
        form for two is this project's, for references that are noisy themselves.
    """
    return float(_relative_error(image, reference, reference_b, weight).mean())


def relmse_standard_error(
    image: Image,
    reference: Image,
    reference_b: Image | None = None,
    weight: Image | None = None,
    seed: int | torch.Generator = 0,
) -> float:
    """Standard error of `relmse`: how much it would differ on other image content and noise of this kind.

    Bootstrap over 16×16 tiles, 1000 times: as many tiles as the image has are drawn with replacement, and the
    error is averaged over their pixels. Tiles rather than pixels, since denoised pixels err together with
    their neighbours. Tiles at the right and lower edge that are cut short weigh as many pixels as they have.

    Args:
        image, reference, reference_b, weight: as in `relmse`.
        seed: seed, or a CPU generator to draw from.

    Returns:
        The standard deviation of the resampled errors, in [0, ∞); NaN where the image is a single tile, which
        says nothing about spread.

    Source:
        Efron, Bootstrap methods: another look at the jackknife, 1979.
    """
    errors = _relative_error(image, reference, reference_b, weight)
    return float(_resampled_means(errors[None], seed).std())


def relmse_ratio(
    image_a: Image,
    image_b: Image,
    reference: Image,
    reference_b: Image | None = None,
    weight: Image | None = None,
    *,
    seed: int | torch.Generator = 0,
) -> Estimate:
    """Error of `image_a` over that of `image_b`, as in «output/denoised = 0.83 ± 0.02».

    The standard error is paired: each resample of the bootstrap draws the same tiles for both images, so that
    what makes a tile hard for both cancels, and the ratio is known better than either error.

    Args:
        image_a, image_b: the images compared, (H, W, 3) linear radiance.
        reference, reference_b, weight: as in `relmse`.
        seed: as in `relmse_standard_error`.

    Returns:
        Ratio, below 1 where `image_a` is better, and its standard error: NaN where the image is a single
        tile, ∞ where the error of `image_b` cannot be told from 0 (some resample has it at or below 0).

    Raises:
        FrameError: also where `relmse` of `image_b` is not above 0, and a ratio to it means nothing.
    """
    errors = torch.stack(
        [
            _relative_error(image_a, reference, reference_b, weight, name="image_a"),
            _relative_error(image_b, reference, reference_b, weight, name="image_b"),
        ]
    )
    error_a, error_b = errors.mean(dim=(1, 2)).tolist()
    if error_b <= 0:
        raise FrameError(f"expected image_b with a relMSE above 0 to divide by, but got {error_b:.3g}")
    means_a, means_b = _resampled_means(errors, seed).unbind(1)
    uncertain = bool((means_b <= 0).any())
    return Estimate(error_a / error_b, math.inf if uncertain else float((means_a / means_b).std()))


def temporal_error(
    image: Image,
    previous: Image,
    reference: tuple[Image, Image],
    reference_b: tuple[Image, Image],
    weight: tuple[Image, Image] | None = None,
) -> float:
    r"""Flicker: the error of the change from one frame of a shot to the next, in the units of `relmse`.

    .. math::
        \frac{1}{3N} \sum_{c,k} \frac{(\Delta x_{ck} - \Delta r^A_{ck})(\Delta x_{ck} - \Delta r^B_{ck})}
        {\frac{1}{2}(\bar{s}_{t,c}^2 + \bar{s}_{t-1,c}^2) + 0.01}, \qquad \Delta x = x_t - x_{t-1}

    The noise of the references cancels in expectation, as in `relmse`. Two frames whose errors are equal have none;
    where errors are independent it is the sum of both relMSEs, since a static error is no flicker. What moves in the
    picture takes its static error along, and that counts.

    Args:
        image: x of frame t, (H, W, 3) linear radiance.
        previous: x of frame t − 1, of the same shape.
        reference: r^A of frame t and of frame t − 1.
        reference_b: r^B of both, rendered independently of r^A.
        weight: s of both, as in `relmse`; without it, the means of the references.

    Returns:
        The error, unbiased, 0 is best; it may fall below 0 by chance.

    Source:
        This project's.
    """
    x = _radiance("image", image)
    change = x - _radiance("previous", previous, like=x)
    a, b = (
        [_radiance(name, each, like=x) for each in pair]
        for name, pair in (("reference", reference), ("reference_b", reference_b))
    )
    given = [(a[i] + b[i]) / 2 for i in (0, 1)] if weight is None else [_radiance("weight", s, like=x) for s in weight]
    level = sum(channel_mean(s) ** 2 for s in given) / 2 + 0.01
    errors = channel_mean((change - (a[0] - a[1])) * (change - (b[0] - b[1]))) / level
    return float(errors.mean())


def psnr(image: Image, reference: Image) -> float:
    r"""Peak signal-to-noise ratio after `tone_map`, in dB.

    .. math::
        -10 \log_{10} \frac{1}{3N} \sum_{c,k} \left(t(x_{ck}) - t(r_{ck})\right)^2

    Args:
        image: x, (H, W, 3) linear radiance.
        reference: r, of the same shape.

    Returns:
        The ratio, in [0, ∞]; ∞ where the tone-mapped images are equal.
    """
    x, r = _pair(image, reference)
    return float(-10 * torch.log10(functional.mse_loss(tone_map(x), tone_map(r))))


def ssim(image: Image, reference: Image) -> float:
    r"""Structural similarity after `tone_map`, the mean over channels and all whole windows.

    .. math::
        \frac{(2\mu_x\mu_r + 0.01^2)(2\sigma_{xr} + 0.03^2)}
        {(\mu_x^2 + \mu_r^2 + 0.01^2)(\sigma_x^2 + \sigma_r^2 + 0.03^2)}

    with Gaussian windows of 11×11 pixels, σ = 1.5. Windows that reach over the border are left out.

    Args:
        image: x, (H, W, 3) linear radiance, at least 11×11 pixels.
        reference: r, of the same shape.

    Returns:
        The similarity, in [-1, 1]; 1 is best.

    Source:
        Wang et al., Image quality assessment: from error visibility to structural similarity, 2004.
    """
    x, r = _pair(image, reference)
    if min(x.shape[:2]) < SSIM_WINDOW:
        raise FrameError(
            f"expected an image of at least {SSIM_WINDOW}×{SSIM_WINDOW} pixels for SSIM, but got {_size(x)}"
        )
    # Single precision is several times faster here and moves the mean by less than 1e-5.
    x_planes, r_planes = (tone_map(each).cpu().movedim(-1, 0)[None].float().contiguous() for each in (x, r))
    similarity = kornia.metrics.ssim(x_planes, r_planes, SSIM_WINDOW, eps=0.0, padding="valid")
    return float(similarity.double().mean())


def flip(image: Image, reference: Image) -> float:
    """HDR-ꟻLIP: the difference seen when the images alternate, at the worst exposure of each pixel.

    The exposures are taken from the reference, and the viewing distance is ꟻLIP's own (67 pixels per degree).
    Negative radiance is taken as 0.

    Args:
        image: (H, W, 3) linear radiance, sRGB primaries.
        reference: of the same shape; not black.

    Returns:
        The mean over pixels, in [0, 1]; 0 is best.

    Source:
        Andersson et al., Visualizing errors in rendered high dynamic range images, 2021, by `flip-evaluator`.
    """
    x, r = (each.cpu() for each in _pair(image, reference))
    luminance = float((r @ r.new_tensor([0.2126, 0.7152, 0.0722])).max())
    # Below about 1.2e-7 ꟻLIP finds no range of exposures and ends the whole process.
    if luminance < 1e-6:
        raise FrameError(f"expected a reference brighter than 1e-6 for FLIP, but got at most {luminance:.3g}")
    # ꟻLIP computes in single precision: a larger value in the reference would be infinite, and the error 0.
    x, r = (each.clamp(0, 1e38).float() for each in (x, r))
    _, mean, _ = flip_evaluator.evaluate(r.numpy(), x.numpy(), "HDR", applyMagma=False)
    return float(mean)


def mean_radiance_ratio(image: Image, reference: Image) -> float:
    """Mean radiance of the image over that of the reference: below 1 where the image has lost light.

    Args:
        image: (H, W, 3) linear radiance.
        reference: of the same shape; its mean above 0.

    Returns:
        The ratio, in [0, ∞) for radiance that isn't negative; 1 is best.
    """
    x, r = _pair(image, reference)
    mean = float(r.mean())
    if mean <= 0:
        raise FrameError(f"expected a reference with a mean radiance above 0, but got {mean:.3g}")
    return float(x.mean()) / mean


def tone_map(image: Image) -> Tensor:
    """Encode linear radiance for a display: the sRGB transfer function, then clipped to [0, 1].

    Args:
        image: (H, W, 3) linear radiance.

    Returns:
        (H, W, 3) float64, in [0, 1].

    Source:
        IEC 61966-2-1.
    """
    planes = _radiance("image", image).movedim(-1, 0)
    return kornia.color.linear_rgb_to_rgb(planes).movedim(0, -1).clamp(0, 1)


def _relative_error(
    image: Image, reference: Image, reference_b: Image | None, weight: Image | None, name: str = "image"
) -> Tensor:
    """Error of each pixel, (H, W): the terms of `relmse`, averaged over channels."""
    x = _radiance(name, image)
    r_a = _radiance("reference", reference, like=x)
    r_b = r_a if reference_b is None else _radiance("reference_b", reference_b, like=x)
    s = (r_a + r_b) / 2 if weight is None else _radiance("weight", weight, like=x)
    return channel_mean((x - r_a) * (x - r_b)) / (channel_mean(s) ** 2 + 0.01)


def _resampled_means(errors: Tensor, seed: int | torch.Generator) -> Tensor:
    """Means of K error images (K, H, W) over the pixels of drawn tiles: (RESAMPLES, K), NaN with one tile."""
    generator = seed if isinstance(seed, torch.Generator) else torch.Generator().manual_seed(seed)
    planes = torch.cat([errors, torch.ones_like(errors[:1])])
    pooled = functional.avg_pool2d(planes, TILE, ceil_mode=True, divisor_override=1)
    # NumPy starts no threads here: a thousand small barriers would stall where other programs hold the cores.
    tiles = pooled.flatten(1).cpu().numpy()  # (K + 1, T): the sums over each tile, the last its pixels
    count = tiles.shape[1]
    if count == 1:
        return torch.full((RESAMPLES, len(errors)), math.nan)
    sums = np.empty((RESAMPLES, len(tiles)))
    for row in sums:
        drawn = torch.randint(count, (count,), generator=generator).numpy()
        tiles[:, drawn].sum(axis=1, out=row)
    return torch.from_numpy(sums[:, :-1] / sums[:, -1:])


def _mean_reference(image: Image, reference: Image, reference_b: Image | None) -> Tensor:
    x = _radiance("image", image)
    r_a = _radiance("reference", reference, like=x)
    return r_a if reference_b is None else (r_a + _radiance("reference_b", reference_b, like=x)) / 2


def _pair(image: Image, reference: Image) -> tuple[Tensor, Tensor]:
    x = _radiance("image", image)
    return x, _radiance("reference", reference, like=x)


def _radiance(name: str, values: Image, like: Tensor | None = None) -> Tensor:
    """Copy to (H, W, 3) float64, checked; on the device of ``like`` or its own, if that one has float64."""
    if isinstance(values, Tensor):
        own = "cpu" if values.device.type == "mps" else values.device
        radiance = values.detach().to(own, torch.float64)
    else:
        radiance = torch.from_numpy(np.array(values, dtype=np.float64, order="C"))
    if like is not None:
        radiance = radiance.to(like.device)
    if radiance.ndim != 3 or radiance.shape[2] != 3 or radiance.numel() == 0:
        raise FrameError(f"expected {name} of shape (H, W, 3), but got {tuple(radiance.shape)}")
    if like is not None and radiance.shape != like.shape:
        raise FrameError(f"expected {name} of {_size(like)} pixels like the image, but got {_size(radiance)}")
    bad = torch.nonzero(~torch.isfinite(radiance))
    if len(bad):
        row, column, _ = bad[0].tolist()
        raise FrameError(
            f"expected finite radiance in {name}, but got {len(bad)} values that are NaN or infinite, "
            f"the first at row {row}, column {column}: repair or render them again"
        )
    return radiance


def _size(image: Tensor) -> str:
    return f"{image.shape[1]}×{image.shape[0]}"
