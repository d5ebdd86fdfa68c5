"""James–Stein combination with a network that smooths the variance and mixes two biased images (Gu et al. 2022).

It is the combination of :mod:`selfcorrect.stages.james_stein` with two things left to a U-Net of 539,426 parameters:
the weights that smooth the variance over 15×15 pixels (Eq. 6), and the share α of each biased image in
``y* = α y^A + (1 − α) y^B``. Whatever it predicts, weights of sum 1 over a window and an image between two images
remain, so that Stein's promise is left to the formula. It holds for noise that is even in a block: hence the relative
weight of the classical variant here, too. With equal weights and α = ½ the two variants are one.
"""

import torch
from torch import Tensor, nn

from selfcorrect.frame import mean
from selfcorrect.image.exposure import scale_
from selfcorrect.image.tiles import tiles
from selfcorrect.image.windows import box_mean, reflected
from selfcorrect.settings import Settings
from selfcorrect.stages.images import StageImages
from selfcorrect.stages.james_stein import WINDOW, relative_weight, variance_of_mean
from selfcorrect.stages.layers import convolution, start_flat, tau, to_multiple
from selfcorrect.stages.stage import Outcome, Stage, Work
from selfcorrect.stages.taps import windowed_sum
from selfcorrect.stages.tiled import ALIGNMENT, SIDE, around, autocast, cut, slices
from selfcorrect.stages.weights import TrainedNetwork, of_stage

__all__ = [
    "REACH",
    "NeuralJamesStein",
    "VarianceNetwork",
    "blend_whole",
    "neural_blend",
    "relative_weights",
    "shrunk",
    "smoothed_variance",
    "tau_loss",
]

REACH = 24  # pixels that an output sees on each side, 21 and what poolings add, up to a multiple of ALIGNMENT
_LEAST_WEIGHT = 1e-4  # as published, so that no sum of weights is 0
_LEAST_VARIANCE = 1e-8  # under the root, whose slope at 0 is infinite
_EPSILON = 0.01  # of the loss, as published


class VarianceNetwork(TrainedNetwork):
    """U-Net of 32-32 | 64-64 | 128-128 | 64-64 | 32-32 filters of 3×3, ReLU, and 226 outputs.

    It sees τ(x) = sign(x) ln(1 + |x|) of the radiance and of the standard deviation: fireflies do not leave the range
    that it was trained in. Its first outputs, before any training, are nearly those of the classical variant.

    Args:
        seed: of the first weights.
    """

    kind = "james-stein"

    def __init__(self, seed: int = 0):
        super().__init__()
        self.architecture = {}  # its size is as published
        generator = torch.Generator().manual_seed(seed)

        def pair(inputs: int, outputs: int) -> nn.ModuleList:
            return nn.ModuleList(convolution(i, outputs, 3, generator) for i in (inputs, outputs))

        self.down = nn.ModuleList([pair(12, 32), pair(32, 64)])
        self.bottom = pair(64, 128)
        self.up = nn.ModuleList([pair(128 + 64, 64), pair(64 + 32, 32)])
        self.last = convolution(32, WINDOW**2 + 1, 3, generator)
        start_flat(self.last, torch.tensor([1.0] * WINDOW**2 + [0.0]))

    def forward(self, x: Tensor, variance: Tensor, y_a: Tensor, y_b: Tensor) -> tuple[Tensor, Tensor]:
        """Weights of the taps and the share of ``y_a`` at every pixel.

        Args:
            x: noisy linear radiance of a mean near 1, (N, 3, H, W), any size.
            variance: of each pixel of x, ≥ 0.
            y_a: one biased image.
            y_b: another.

        Returns:
            weights (N, 225, H, W) of at least 1e-4, by rows of the window, and alpha (N, 1, H, W) in 0 … 1; the
            weights in bfloat16 where autocast says so.
        """
        height, width = x.shape[-2:]
        shown = [tau(x), (variance + _LEAST_VARIANCE).sqrt().log1p(), tau(y_a), tau(y_b)]
        planes = to_multiple(torch.cat(shown, 1), ALIGNMENT).contiguous(memory_format=torch.channels_last)
        skips = []
        for layers in self.down:
            skips.append(_through(layers, planes))
            planes = nn.functional.max_pool2d(skips[-1], 2)
        planes = _through(self.bottom, planes)
        for layers in self.up:
            planes = nn.functional.interpolate(planes, scale_factor=2.0, mode="nearest")
            planes = _through(layers, torch.cat([planes, skips.pop()], 1))
        raw = self.last(planes)[..., :height, :width]
        return raw[:, :-1].relu() + _LEAST_WEIGHT, raw[:, -1:].float().sigmoid()


def _through(layers: nn.Module, planes: Tensor) -> Tensor:
    for layer in layers.children():
        planes = layer(planes).relu()
    return planes


def neural_blend(
    weights: Tensor, alpha: Tensor, x: Tensor, variance: Tensor, y_a: Tensor, y_b: Tensor, *, relative: bool = True
) -> Tensor:
    """θ of Eqs. 6 and 13 from what the network predicts, (N, 3, H, W), differentiable in weights and alpha.

    Args:
        weights: of the taps of 15×15 pixels, (N, 225, H, W) > 0.
        alpha: share of ``y_a``, (N, 1, H, W).
        x: noisy linear radiance, (N, 3, H, W); each image of the batch whole, or a crop of its own.
        variance: of each pixel of x, ≥ 0.
        y_a: one biased image.
        y_b: another.
        relative: weigh squared error by :func:`relative_weights`; False is the published formula, whose promise
            noise breaks that is larger where the image is brighter.
    """
    q = relative_weights(x) if relative else torch.ones_like(x[:, :1])
    smoothed = smoothed_variance(weights, reflected(q * variance, WINDOW // 2))
    return shrunk(x, alpha * y_a + (1 - alpha) * y_b, smoothed, q)


def relative_weights(x: Tensor) -> Tensor:
    """The classical variant's weight of every pixel's squared error, of each image on its own, (N, 1, H, W), to 1.

    A factor common to an image changes nothing: here the largest is 1, so that black images stay finite in float32.
    """
    weights = torch.stack([relative_weight(image.permute(1, 2, 0))[..., 0] for image in x.detach()])[:, None]
    return (weights / weights.amax((2, 3), keepdim=True)).to(x.dtype)


def smoothed_variance(weights: Tensor, padded: Tensor) -> Tensor:
    """Σ w_i s²_i / Σ w_i over 15×15 pixels (Eq. 6); ``padded`` has seven pixels more on every side."""
    sums, total = windowed_sum(weights, padded, WINDOW)
    return sums / total


def shrunk(x: Tensor, y: Tensor, smoothed: Tensor, q: Tensor) -> Tensor:
    """Eq. 13 on (N, C, H, W): ``y_i + mean_{c ∈ Ω_i} (1 − (p−2) σ²_c / ‖X_c − Y_c‖²)⁺ (x_i − y_i)``.

    Args:
        x: unbiased.
        y: biased.
        smoothed: σ² q, the smoothed variance.
        q: of each pixel's squared error, (N, 1, H, W).
    """
    p = WINDOW**2
    noise, distance = (p - 2) * smoothed, p * _box_mean(q * (x - y) ** 2)
    nearer = noise < distance
    # not 1 − noise / distance alone: the gradient of the side that where() drops must be finite, too
    kept = torch.where(nearer, 1 - noise / torch.where(nearer, distance, 1.0), 0.0)
    return y + _box_mean(kept) * (x - y)


def _box_mean(planes: Tensor) -> Tensor:
    return box_mean(planes.flatten(0, 1), WINDOW).view_as(planes)


def tau_loss(theta: Tensor, target: Tensor, level: Tensor | None = None) -> Tensor:
    """Eq. 14: mean over pixels and channels of ``(τ(θ) − τ(t))² / (τ(t)² + 0.01)``.

    The mean of a curve of noise is not the curve of its mean: trained on noisy targets by this formula a network
    darkens. With ``level``, τ is taken as straight around it and the weight from it: then a noisy target is as good
    as a clean one, where its noise is independent of θ and of the level (Lehtinen et al. 2018).

    Args:
        theta: linear radiance, (N, 3, H, W).
        target: the reference; or, with a level, an unbiased noisy image.
        level: about the reference, for example a denoised image.
    """
    if level is None:
        target = tau(target)
        return ((tau(theta) - target) ** 2 / (target**2 + _EPSILON)).mean()
    return (((theta - target) / (1 + level.abs())) ** 2 / (tau(level) ** 2 + _EPSILON)).mean()


@torch.no_grad()
def blend_whole(
    network: VarianceNetwork,
    x: Tensor,
    variance: Tensor,
    y_a: Tensor,
    y_b: Tensor,
    *,
    precision: str = "fp32",
    side: int = SIDE,
) -> Tensor:
    """θ of the neural James–Stein combiner, (H, W, 3); arguments as for its network, and ``side`` of the tiles.

    The tiles' share is σ² and α; what is shrunk is the whole image, by its own relative weight.
    """
    planes = [image.permute(2, 0, 1).float() for image in (x, variance, y_a, y_b)]
    size = (x.shape[0], x.shape[1])
    q = relative_weights(planes[0][None])
    weighted = q[0] * planes[1]
    smoothed, alpha = torch.empty_like(planes[0]), torch.empty_like(planes[0][:1])
    aligned = (-(-size[0] // ALIGNMENT) * ALIGNMENT, -(-size[1] // ALIGNMENT) * ALIGNMENT)
    for region in tiles(size, -(-side // ALIGNMENT) * ALIGNMENT):
        wide, inside = around(region, REACH, aligned)
        with autocast(x, precision):
            weights, share = network(*(cut(each, wide)[None] for each in planes))
        at = (slice(None), *slices(region))
        smoothed[at] = smoothed_variance(weights[(..., *inside)], cut(weighted, region, WINDOW // 2)[None])[0]
        alpha[at] = share[(0, slice(None), *inside)]
    y = alpha * planes[2] + (1 - alpha) * planes[3]
    return shrunk(planes[0][None], y[None], smoothed[None], q)[0].permute(1, 2, 0).contiguous()


class NeuralJamesStein(Stage):
    """The James–Stein stage with a trained network for the variance's smoothing and the mix of two images.

    The mix ``α y^A + (1 − α) y^B`` is of the halves' images so far, for the full image. What that image so far has
    beyond their mean, such as that it was denoised whole, is added to both. A half must not lean on the image of the
    other: there, both are its own image.
    """

    name = "neural-james-stein"

    def __init__(self, settings: Settings):
        super().__init__(settings)
        self.network, _ = of_stage(self.name, settings, "james_stein_weights", "james-stein", VarianceNetwork)

    def run(self, state: StageImages, work: Work) -> Outcome:
        """Shrink with what the network predicts."""
        scaled = state.scaled()
        variance = variance_of_mean(scaled.color)
        network = self.network.to(state.full.device)

        def blended(noisy: Tensor, variance: Tensor, y_a: Tensor, y_b: Tensor) -> Tensor:
            theta = blend_whole(network, noisy, variance, y_a, y_b, precision=self.settings.precision)
            return scale_(theta, 1 / state.scale)

        a, b = (blended(noisy, 2 * variance, y, y) for noisy, y in zip(scaled.color, scaled.images, strict=True))
        beyond = scaled.full - mean(scaled.images)
        full = blended(mean(scaled.color), variance, *(image + beyond for image in scaled.images))
        return Outcome(state.then((a, b), full))
