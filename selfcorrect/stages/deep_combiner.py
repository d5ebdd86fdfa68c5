"""Deep combiner: kernels predicted for an unbiased and a denoised image (Back et al. 2020).

Every pixel is its denoised radiance plus a weighted mean over 15×15 pixels of what the denoiser has taken away (Eqs. 8
and 15): ``β_c = z_c + Σ w_i (y_i − z_i) / W``. With several buffers the sums run over all of them with one W (Eq. 14),
so that an outlier in one buffer loses its weight to the same pixel in the others.
"""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from selfcorrect.errors import FileError
from selfcorrect.frame import Half, mean
from selfcorrect.image.exposure import LARGEST, scale_
from selfcorrect.image.tiles import Region, tiles
from selfcorrect.image.windows import reflected
from selfcorrect.settings import Settings
from selfcorrect.stages.bilateral_combiner import BilateralCombiner
from selfcorrect.stages.combiner import Combiner
from selfcorrect.stages.images import StageImages
from selfcorrect.stages.layers import convolution, start_flat, tau
from selfcorrect.stages.stage import Outcome, Stage, Work
from selfcorrect.stages.taps import windowed_sum
from selfcorrect.stages.tiled import SIDE, around, autocast, cut, slices
from selfcorrect.stages.weights import of_stage

__all__ = [
    "Combiner",
    "DeepCombiner",
    "DeepCombinerStage",
    "combine_whole",
    "combined",
    "feature_planes",
    "opened_network",
]

_FEATURES = 7  # normal, albedo, depth
_FIRST_ANCHOR = 4  # of the window's weights together: training starts near the denoised image
_FIRST_CENTRE = 0.02  # of them, where the centre's weight is scaled: enough for a gradient, too little for its noise
_LEAST_SUM = 1e-10  # as published
_BEYOND = 1e9  # depth from here on is a renderer's word for nothing hit (Blender's is 1e10)


class DeepCombiner(Combiner):
    """Six convolutions 5×5 of 100 filters and kernels of 15×15, ReLU after every layer including the last.

    It has one output for each pixel of the window and buffer, the centre among them, as the public code does: 1,595,725
    parameters with one buffer, 3,328,900 with four. The paper counts |Ω| + 1 outputs (1,598,226 parameters), but the
    centre's own weight in its Eq. 8 adds to that which the centre has as a pixel of the window.

    It sees τ(x) = sign(x) ln(1 + |x|) of the radiance: fireflies do not leave the range that it was trained in. The
    combination itself is linear. Before any training all weights are nearly equal. Where all are 0, the denoised image
    (of several buffers, their mean) comes back.

    Args:
        buffers: B, pairs of a noisy and a denoised image.
        width: filters of each hidden layer.
        window: side of the predicted kernels, odd.
        layers: convolutions.
        kernel: side of the convolutions' kernels, odd.
        anchored: one more output for each buffer, the weight of the denoised image as it is, a residual of 0. Weights
            that are normalised without one must take in the residuals' noise everywhere. The number says what it is
            multiplied by, and the centre's weight, too, 0 (False) that there is none: the window has hundreds of
            weights, and an optimiser that moves every weight by the same step would need thousands of steps to move a
            single one to where it counts for as much as they do. Not in the paper.
        seed: of the first weights.
    """

    kind = "deep-combiner"

    def __init__(
        self,
        buffers: int = 1,
        width: int = 100,
        window: int = 15,
        layers: int = 6,
        kernel: int = 5,
        *,
        anchored: int = 0,
        seed: int = 0,
    ):
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.architecture = {
            "buffers": buffers,
            "width": width,
            "window": window,
            "layers": layers,
            "kernel": kernel,
            "anchored": anchored,
        }
        self.pairs, self.window = buffers, window
        self.reach = layers * (kernel // 2)
        """Pixels that a weight sees on each side."""
        taps = window**2 + bool(anchored)
        self.scaled = {window**2 // 2: anchored, window**2: anchored} if anchored > 1 else {}
        """What the outputs of these numbers are multiplied by."""
        widths = [6 * buffers + _FEATURES, *[width] * (layers - 1), buffers * taps]
        made = [convolution(i, o, kernel, generator) for i, o in pairwise(widths)]
        self.convolutions = nn.ModuleList(made)
        first = torch.ones(buffers, taps)
        first[:, window**2 :] = _FIRST_ANCHOR * window**2 / max(anchored, 1)
        if self.scaled:
            first[:, window**2 // 2] = _FIRST_CENTRE * window**2 / anchored
        start_flat(made[-1], first.flatten())

    def forward(self, noisy: Tensor, denoised: Tensor, features: Tensor) -> Tensor:
        """The combined radiance (N, 3, H, W).

        Args:
            noisy: y, linear radiance of a mean near 1, (N, B, 3, H, W).
            denoised: z, the same shape.
            features: normal, albedo, depth in 0 … 1, (N, 7, H, W); zeros where a frame has none.
        """
        images = (noisy, denoised, features)
        return self.combined(self.weights(*images), *(reflected(planes, self.window // 2) for planes in images))

    def weights(self, noisy: Tensor, denoised: Tensor, features: Tensor, precision: str = "fp32") -> Tensor:
        """Weights (N, B, window², H, W) ≥ 0, by rows of the window, and the anchor.

        They are bfloat16 where autocast or the precision says so.
        """
        shown = [tau(denoised).flatten(1, 2), tau(noisy).flatten(1, 2), features]
        planes = torch.cat(shown, 1).contiguous(memory_format=torch.channels_last)
        with autocast(planes, precision):
            for layer in self.convolutions:
                planes = layer(planes).relu()
        weights: Tensor = planes.unflatten(1, (self.pairs, -1))
        if self.scaled:
            scale = weights.new_ones(weights.shape[2], 1, 1)
            for tap, factor in self.scaled.items():
                scale[tap] = factor
            weights = weights * scale
        return weights

    def combined(self, weights: Tensor, noisy: Tensor, denoised: Tensor, features: Tensor) -> Tensor:
        """The combined radiance (N, 3, H, W) by given weights; the images have ``window // 2`` pixels around them."""
        del features  # the weights know them
        pad = self.window // 2
        inner = (..., slice(pad, denoised.shape[-2] - pad), slice(pad, denoised.shape[-1] - pad))
        return combined(weights, noisy - denoised, denoised[inner], self.window)


def combined(weights: Tensor, residual: Tensor, denoised: Tensor, window: int) -> Tensor:
    """Eqs. 14 and 15: ``Σ_b [W^b z^b_c + Σ_i w^b_i (y^b_i − z^b_i)] / Σ_b W^b``, (N, 3, H, W).

    Args:
        weights: (N, B, window², H, W) ≥ 0; with one plane more where the denoised image has a weight of its own.
        residual: y − z, (N, B, 3, H + window − 1, W + window − 1): with its border.
        denoised: z, (N, B, 3, H, W).
        window: side of the kernels.
    """
    base = denoised.mean(1)
    moved, total = torch.zeros_like(base), torch.zeros_like(base[:, :1])
    for b in range(weights.shape[1]):
        taken, weight = windowed_sum(weights[:, b, : window**2], residual[:, b], window)
        weight = weight + weights[:, b, window**2 :].to(weight.dtype).sum(1, keepdim=True)
        moved = moved + taken + weight * (denoised[:, b] - base)
        total = total + weight
    return base + moved / total.clamp(min=_LEAST_SUM)


def feature_planes(
    size: tuple[int, int], *, normal: Tensor | None, albedo: Tensor | None, depth: Tensor | None
) -> Tensor:
    """What the combiner is shown of the G-buffers, (7, H, W) float32; zeros for those that are None.

    Args:
        size: (H, W).
        normal: (H, W, 3), of unit length, in world space.
        albedo: (H, W, 3), 0 … 1.
        depth: (H, W, 1), ≥ 0, any unit: it is divided by its largest value in the image. Where nothing was hit, it
            is 0, or 1e9 and more.
    """
    if depth is not None:
        depth = torch.where(depth.float() < _BEYOND, depth.float(), 0.0).clamp(min=0)
        depth = depth / depth.amax().clamp(min=torch.finfo(torch.float32).tiny)
    planes = torch.zeros(_FEATURES, *size)
    for first, buffer in ((0, normal), (3, albedo), (6, depth)):
        if buffer is not None:
            planes = planes.to(buffer.device)
            planes[first : first + buffer.shape[2]] = buffer.permute(2, 0, 1)
    return planes


@torch.no_grad()
def combine_whole(
    network: Combiner,
    noisy: Sequence[Tensor],
    denoised: Sequence[Tensor],
    features: Tensor,
    *,
    scale: float = 1.0,
    precision: str = "fp32",
    side: int = SIDE,
) -> Tensor:
    """The deep combiner's image, (H, W, 3).

    Args:
        network: trained, of as many pairs as there are images.
        noisy: y of each pair, linear radiance, (H, W, 3).
        denoised: z of each pair.
        features: (7, H, W), see :func:`feature_planes`.
        scale: what brings the radiance to a mean near 1.
        precision: "fp32", or "bf16" for convolutions in bfloat16 where the processor has matrix tiles.
        side: of the tiles, pixels.
    """

    def shown(region: Region, reach: int = 0) -> tuple[Tensor, Tensor, Tensor]:
        return radiance(noisy, region, reach), radiance(denoised, region, reach), cut(features, region, reach)[None]

    def radiance(images: Sequence[Tensor], region: Region, reach: int) -> Tensor:
        parts = [cut(image.permute(2, 0, 1), region, reach).double() * scale for image in images]
        return torch.stack(parts).clamp_(-LARGEST, LARGEST).float()[None]

    size = (features.shape[1], features.shape[2])
    result = torch.empty_like(noisy[0])
    for region in tiles(size, side):
        wide, inside = around(region, network.reach, size)
        weights = network.weights(*shown(wide), precision)[(..., *inside)]
        tile = network.combined(weights, *shown(region, network.window // 2))
        result[slices(region)] = tile[0].permute(1, 2, 0)
    return scale_(result, 1 / scale)


def opened_network(stage: str, settings: Settings, setting: str, packaged: str, *, pairs: int) -> Combiner:
    """The network of a stage, of so many pairs of a noisy and a denoised image.

    Raises:
        FileError: weights are missing, do not fit, or are for another number of pairs.
    """
    network, path = of_stage(stage, settings, setting, packaged, DeepCombiner, BilateralCombiner)
    if network.pairs != pairs:
        raise FileError(f"{path}: expected weights of {stage}, but got those for {network.pairs} denoised images")
    return network


class DeepCombinerStage(Stage):
    """Each half combined with its image so far, and the mean of both with the full image so far (Eq. 8)."""

    name = "deep-combiner"

    def __init__(self, settings: Settings):
        super().__init__(settings)
        self.network = opened_network(DeepCombinerStage.name, settings, "combiner_weights", "deep-combiner", pairs=1)

    def run(self, state: StageImages, work: Work) -> Outcome:
        """Combine thrice."""
        a, b = (
            self.combined(self.network, (half.color,), (image,), (half,), state.scale)
            for half, image in zip(state.halves, state.images, strict=True)
        )
        return Outcome(state.then((a, b), self.full(state, work)))

    def full(self, state: StageImages, work: Work) -> Tensor:
        """The combined image of both halves."""
        return self.combined(self.network, (mean(state.color),), (state.full,), state.halves, state.scale)

    def combined(
        self,
        network: Combiner,
        noisy: Sequence[Tensor],
        denoised: Sequence[Tensor],
        halves: Sequence[Half],
        scale: float,
    ) -> Tensor:
        """The network's image, with the G-buffers of one half, or the mean of those of both."""

        def feature(name: str) -> Tensor | None:
            values = [getattr(half, name) for half in halves]
            return None if values[0] is None else mean((values[0], values[-1]))

        size = (noisy[0].shape[0], noisy[0].shape[1])
        features = feature_planes(size, normal=feature("normal"), albedo=feature("albedo"), depth=feature("depth"))
        there = noisy[0].device
        return combine_whole(
            network.to(there), noisy, denoised, features.to(there), scale=scale, precision=self.settings.precision
        )
