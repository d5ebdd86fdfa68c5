"""Windowed first-order regression in plain torch, any dtype, equation by equation (Gu et al. 2022, Eqs. 10–12).

For each centre c: the weighted least squares fit of the targets x_i, over the window's pixels i, by a constant and the
features' differences f_i − f_c. For each pixel i: the mean of what the models of the centres around it say, with the
same weights. The border is mirrored without repeating the edge pixel.
"""

import torch
from torch import Tensor

from selfcorrect.image.windows import reflect

__all__ = ["regress"]

_SMALLEST_REACH = 1e-24  # squared distance below which a feature counts as constant


def regress(
    features: list[Tensor], targets: Tensor, *, window: int, ridge: float, bandwidth: float, stride: int = 1
) -> Tensor:
    """As :func:`selfcorrect.kernel.regression.regress`, for images small enough to hold every window at once."""
    height, width, _ = targets.shape
    radius = window // 2
    centre_rows, centre_columns = torch.arange(0, height, stride), torch.arange(0, width, stride)
    stacked = torch.cat(features, -1)
    rows = centre_rows[:, None] + torch.arange(-radius, radius + 1)
    columns = centre_columns[:, None] + torch.arange(-radius, radius + 1)
    rows, columns = (
        reflect(-radius, size + radius, size)[index + radius] for size, index in ((height, rows), (width, columns))
    )
    centre = stacked[centre_rows[:, None], centre_columns][:, :, None]  # (Gh, Gw, 1, F)

    def windows(image: Tensor) -> Tensor:
        return image[rows[:, None, :, None], columns[None, :, None, :]].flatten(2, 3)  # (Gh, Gw, taps, C)

    difference = windows(stacked) - centre
    scale = _scale(difference, [feature.shape[2] for feature in features])
    weight = _weight(difference, features[0].shape[2], bandwidth)
    phi = torch.cat([torch.ones_like(difference[..., :1]), difference * scale], -1)
    share = weight / weight.sum(-1, keepdim=True)
    moments = torch.einsum("yxt,yxti,yxtj->yxij", share, phi, phi)
    diagonal = torch.full((phi.shape[-1],), ridge, dtype=phi.dtype)
    diagonal[0] = 0
    right = torch.einsum("yxt,yxti,yxtk->yxik", share, phi, windows(targets))
    models = torch.linalg.solve(moments + torch.diag(diagonal), right)  # (Gh, Gw, F + 1, 3)
    models[:, :, 1:] *= scale.transpose(-1, -2)
    return _reconstruct(stacked, features[0].shape[2], models, centre[:, :, 0], radius, stride, bandwidth)


def _scale(difference: Tensor, groups: list[int]) -> Tensor:
    """One over each feature group's largest distance to the centre in the window, 0 for a constant group."""
    scales = []
    for group in difference.split(groups, -1):
        reach = (group**2).sum(-1).amax(-1)[..., None, None]
        inverse = torch.where(reach > _SMALLEST_REACH, reach.clamp(min=_SMALLEST_REACH).rsqrt(), 0.0)
        scales.append(inverse.expand(*inverse.shape[:-1], group.shape[-1]))
    return torch.cat(scales, -1)


def _weight(difference: Tensor, first: int, bandwidth: float) -> Tensor:
    """exp(−‖z_i − z_c‖² / bandwidth), with z the first feature group."""
    return torch.exp(-(difference[..., :first] ** 2).sum(-1) / bandwidth)


def _reconstruct(
    features: Tensor, first: int, models: Tensor, centres: Tensor, radius: int, stride: int, bandwidth: float
) -> Tensor:
    """The weighted mean of the models around each pixel, (H, W, 3); the grid of centres is mirrored like the image."""
    height, width, _ = features.shape
    grid_height, grid_width = models.shape[:2]
    reach = -(-radius // stride)
    mirrored = [reflect(-reach, size + reach, size) for size in (grid_height, grid_width)]
    output = torch.empty(height, width, models.shape[-1], dtype=features.dtype)
    for row in range(height):
        for column in range(width):
            near = [
                torch.arange(-(-(at - radius) // stride), (at + radius) // stride + 1) + reach for at in (row, column)
            ]
            y, x = (index[span] for index, span in zip(mirrored, near, strict=True))
            difference = features[row, column] - centres[y[:, None], x]
            distance = (difference[..., :first] ** 2).sum(-1)
            weight = torch.exp((distance.min() - distance) / bandwidth)  # the factor cancels; it keeps one weight at 1
            model = models[y[:, None], x]
            said = model[..., 0, :] + torch.einsum("yxi,yxik->yxk", difference, model[..., 1:, :])
            output[row, column] = (weight[..., None] * said).sum((0, 1)) / weight.sum()
    return output
