"""The project's own denoiser: a small U-Net that predicts the kernels of a multi-scale filter, for ONNX.

Bako et al. 2017 predict one large kernel for each pixel; here a 5×5 softmax kernel works on each of four scales, from
an eighth of the resolution up, so that it reaches over some 60 pixels at a fraction of the cost (Vogels et al. 2018
blend scales; Balint et al. 2023 let the network weigh the pixels of the pyramid, as here). What is filtered is

- demodulated: radiance over a texture that the network sets for each pixel, between 1 and the albedo, so that texture
  survives a wide filter where the albedo explains it and does no harm where it doesn't (mirrors, glass);
- homogeneous: (w · radiance, w) with a weight w in (0, 1) that the network gives each pixel. Kernels, averages and
  blends work on all four channels alike and one division ends it: an outlier is down-weighted once, on all scales, and
  pixels beyond the border, all zeros, do not count.

The result is a weighted mean of the frame's demodulated radiances, and no brighter than the brightest pixel near by:
finite and ≥ 0 whatever the network says.
"""

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

__all__ = ["MULTIPLE", "Denoiser", "filtered", "filtered_reference", "level_of"]

KERNEL = 5
TAPS = KERNEL**2
MULTIPLE = 16
"""Height and width are multiples of this: four halvings."""

_BRIGHTEST = 1e8  # of the frame's level; beyond it, float32 loses the frame's other pixels beside it
_DIMMEST_ALBEDO = 0.1  # of the texture: darker surfaces shine by more than their albedo
_AROUND = 11  # pixels; 5 to 21 differ by less than 1 % on four of five development frames, on dim noise 3 cuts light
_LOGIT = 16.0  # bound of what weights and kernels are the logistic function and the exponential of, e^-16 = 1e-7


class Denoiser(nn.Module):
    """Colour, albedo, normal (N, 3, H, W) → denoised linear radiance (N, 3, H, W) ≥ 0.

    The network is invariant to exposure: it divides by the frame's level (:func:`level_of`) and multiplies back.

    Args:
        widths: filters at full resolution, 1/2, 1/4, 1/8 and 1/16.
    """

    def __init__(self, widths: tuple[int, ...] = (32, 48, 64, 80, 96)):
        super().__init__()
        self.widths = tuple(widths)
        inputs = (9, *widths[:-1])
        self.encoder = nn.ModuleList(_Pair(i, o) for i, o in zip(inputs, widths, strict=True))
        up = list(zip(widths[1:], widths[:-1], strict=True))
        self.decoder = nn.ModuleList(_Pair(below + here, here) for below, here in up)
        # kernel, and how much of the pixel itself is kept beside the coarser scale; w and texture at full resolution
        heads = [TAPS + 3, TAPS + 1, TAPS + 1, TAPS]
        self.heads = nn.ModuleList(nn.Conv2d(i, o, 1) for i, o in zip(widths[:-1], heads, strict=True))
        for head in self.heads:
            assert isinstance(head, nn.Conv2d)
            with torch.no_grad():
                head.weight.mul_(0.1)  # first kernels are nearly even

    @property
    def architecture(self) -> dict[str, Any]:
        """Arguments of the constructor, for JSON."""
        return {"widths": list(self.widths)}

    def forward(self, color: Tensor, albedo: Tensor, normal: Tensor, exposure: Tensor | None = None) -> Tensor:
        """Denoise; ``exposure`` (N, 1, 1, 1) is for training: what the network takes the frame's level times."""
        gain = 1 / level_of(color)
        if exposure is not None:
            gain = gain * exposure
        scaled = (color * gain).clamp(min=0).clamp(max=_BRIGHTEST)
        with torch.autocast("cpu", torch.bfloat16, enabled=torch.is_autocast_enabled("cpu")):
            logits = self._logits(torch.cat([torch.log1p(scaled), albedo, normal], dim=1))
        with torch.autocast("cpu", enabled=False):
            # tap loops run over whole planes, so the channels come apart here
            return self._filtered(scaled, albedo, [each.float().contiguous() for each in logits]) / gain

    def _logits(self, x: Tensor) -> list[Tensor]:
        """What the heads say, from full resolution down."""
        skips = []
        for depth, block in enumerate(self.encoder):
            x = block(F.max_pool2d(x, 2) if depth else x)
            skips.append(x)
        logits = []
        for depth in reversed(range(len(self.decoder))):
            x = F.interpolate(x, scale_factor=2.0, mode="nearest")
            x = self.decoder[depth](torch.cat([x, skips[depth]], dim=1))
            logits.append(self.heads[depth](x))
        return logits[::-1]

    def _filtered(self, radiance: Tensor, albedo: Tensor, logits: list[Tensor]) -> Tensor:
        weight = torch.sigmoid(logits[0][:, TAPS + 1 : TAPS + 2].clamp(-_LOGIT, _LOGIT))
        share = torch.sigmoid(logits[0][:, TAPS + 2 :])
        texture = 1 + share * (albedo.clamp(_DIMMEST_ALBEDO, 1.0) - 1)
        pyramid = [torch.cat([radiance / texture * weight, weight], dim=1)]
        for _ in logits[1:]:
            pyramid.append(F.avg_pool2d(pyramid[-1], 2))
        coarse = _kernel(pyramid[-1], logits[-1])
        for fine, logit in zip(pyramid[-2::-1], logits[-2::-1], strict=True):
            kept = torch.sigmoid(logit[:, TAPS : TAPS + 1])
            above = F.interpolate(coarse, scale_factor=2.0, mode="bilinear", align_corners=False)
            coarse = _kernel(above + kept * (fine - above), logit)
        result = coarse[:, :3] / coarse[:, 3:].clamp(min=1e-20) * texture
        return torch.minimum(result, _brightest(radiance))


class _Pair(nn.Module):
    """Two 3×3 convolutions with ReLU."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.first = nn.Conv2d(inputs, outputs, 3, padding=1)
        self.second = nn.Conv2d(outputs, outputs, 3, padding=1)
        for convolution in (self.first, self.second):
            nn.init.kaiming_normal_(convolution.weight, nonlinearity="relu")
            nn.init.zeros_(convolution.bias)

    def forward(self, x: Tensor) -> Tensor:
        x = F.relu(self.first(x))
        return F.relu(self.second(x))


def level_of(color: Tensor) -> Tensor:
    """The square of the mean root of each image's radiance, (N, 1, 1, 1): a mean that few bright pixels do not move."""
    roots = color.clamp(min=0).mean(1, keepdim=True).sqrt().mean((2, 3), keepdim=True)
    return (roots * roots).clamp(min=1e-20)


def _brightest(radiance: Tensor) -> Tensor:
    """The largest radiance around each pixel: what divides by a dark texture may come back brighter than any light."""
    rows = F.max_pool2d(radiance, (_AROUND, 1), 1, (_AROUND // 2, 0))
    return F.max_pool2d(rows, (1, _AROUND), 1, (0, _AROUND // 2))


def _kernel(image: Tensor, logits: Tensor) -> Tensor:
    """Filter with a softmax kernel; its largest value is bounded, not subtracted: far faster in onnxruntime."""
    kernel = logits[:, :TAPS].clamp(-_LOGIT, _LOGIT).exp()
    total = filtered(image, kernel) if torch.is_grad_enabled() else filtered_reference(image, kernel)
    return total / kernel.sum(1, keepdim=True)


def filtered_reference(image: Tensor, kernel: Tensor) -> Tensor:
    """Σ_j k_j · image shifted by tap j: (N, C, H, W) with (N, taps, H, W), zeros beyond the border.

    A convolution with a unit for each tap gathers the window of one channel: few operations for the ONNX graph.
    """
    taps = kernel.shape[1]
    side = math.isqrt(taps)
    units = torch.eye(taps, dtype=image.dtype).view(taps, 1, side, side)
    planes = [F.conv2d(image[:, c : c + 1], units, padding=side // 2) for c in range(image.shape[1])]
    return torch.cat([(plane * kernel).sum(1, keepdim=True) for plane in planes], dim=1)


class _Filtered(torch.autograd.Function):
    """The reference with a backward pass that writes in place: autograd's own takes a zero image for each tap."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, kernel: Tensor) -> Tensor:
        side = math.isqrt(kernel.shape[1])
        padded = F.pad(image, (side // 2,) * 4)
        ctx.save_for_backward(padded, kernel)
        height, width = image.shape[-2:]
        total = torch.zeros_like(image)
        for j in range(side**2):
            y, x = divmod(j, side)
            total.addcmul_(kernel[:, j : j + 1], padded[:, :, y : y + height, x : x + width])
        return total

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor]:
        (grad,) = grads
        padded, kernel = ctx.saved_tensors
        side = math.isqrt(kernel.shape[1])
        reach = side // 2
        height, width = grad.shape[-2:]
        of_padded, of_kernel = torch.zeros_like(padded), torch.empty_like(kernel)
        for j in range(side**2):
            y, x = divmod(j, side)
            there = (slice(None), slice(None), slice(y, y + height), slice(x, x + width))
            torch.sum(grad * padded[there], dim=1, out=of_kernel[:, j])
            of_padded[there].addcmul_(kernel[:, j : j + 1], grad)
        return of_padded[:, :, reach : reach + height, reach : reach + width], of_kernel


def filtered(image: Tensor, kernel: Tensor) -> Tensor:
    """:func:`filtered_reference`, faster to differentiate."""
    result: Tensor = _Filtered.apply(image, kernel)
    return result
