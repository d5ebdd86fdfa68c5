"""Windowed first-order regression in plain torch, any dtype, equation by equation (Gu et al. 2022, Eqs. 10–12).

For each centre c: the weighted least squares fit of the targets x_i, over the window's pixels i, by a constant and the
features' differences f_i − f_c. For each pixel i: the mean of what the models of the centres around it say, with the
same weights. The border is mirrored without repeating the edge pixel.
"""

from collections.abc import Callable, Iterable, Iterator

import torch
from torch import Tensor

from selfcorrect.image.windows import reflect
from selfcorrect.kernel.nlm import Strip

__all__ = ["regress", "regress_non_local"]

_HELD = 1 << 20  # pixels of windows at a time
_SMALLEST_REACH = 1e-24  # squared distance below which a feature counts as constant


def regress(
    features: list[Tensor], targets: Tensor, *, window: int, ridge: float, bandwidth: float, stride: int = 1
) -> Tensor:
    """As :func:`selfcorrect.kernel.regression.regress`; the windows of some rows at a time."""
    height, width, _ = targets.shape
    radius, first = window // 2, features[0].shape[2]
    stacked = torch.cat(features, -1)
    around = _Windows(stacked, targets, radius, range(0, width, stride))
    step = max(1, _HELD // (len(around.centre_columns) * window**2))
    centre_rows, models = range(0, height, stride), []
    for at in range(0, len(centre_rows), step):
        difference, values = around.of(centre_rows[at : at + step])
        weight = _weight(difference, first, bandwidth)
        models.append(_models(difference, values, weight, [feature.shape[2] for feature in features], ridge))
    centres = stacked[::stride, ::stride]
    return _reconstruct(stacked, first, torch.cat(models), centres, radius, stride, bandwidth)


def regress_non_local(
    features: list[Tensor],
    targets: Tensor,
    weights: Callable[[], Iterable[Strip]],
    *,
    radius: int,
    ridge: float,
) -> Tensor:
    """As :func:`selfcorrect.kernel.regression.regress_non_local`: the weights of a pixel's own window, both times."""
    width = targets.shape[1]
    stacked, groups = torch.cat(features, -1), [feature.shape[2] for feature in features]

    def of_rows(around: _Windows) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        for strip in weights():
            for row in range(strip.weights.shape[1]):
                yield (
                    *around.of(range(strip.first_row + row, strip.first_row + row + 1)),
                    strip.weights[:, row, :width].T,
                )

    around = _Windows(stacked, targets, radius, range(width))
    models = torch.cat([_models(d, x, w[None], groups, ridge) for d, x, w in of_rows(around)])
    around = _Windows(stacked, models.flatten(2), radius, range(width))
    rows = []
    for difference, near, w in of_rows(around):
        model = near.unflatten(-1, models.shape[2:])
        said = model[..., 0, :] - torch.einsum("yxti,yxtik->yxtk", difference, model[..., 1:, :])
        rows.append(torch.einsum("xt,yxtk->yxk", w / w.sum(-1, keepdim=True), said))
    return torch.cat(rows)


class _Windows:
    """Cuts windows: the features' differences to the centre, and what else there is of the same pixels."""

    def __init__(self, features: Tensor, values: Tensor, radius: int, columns: range):
        height, width, _ = features.shape
        self._features, self._values = features, values
        self._reach = torch.arange(2 * radius + 1)
        self._rows, self._columns = (reflect(-radius, size + radius, size) for size in (height, width))
        self.centre_columns = torch.tensor(columns)

    def of(self, centre_rows: range) -> tuple[Tensor, Tensor]:
        """(rows, columns, taps, C) each."""
        rows = self._rows[torch.tensor(centre_rows)[:, None] + self._reach]
        columns = self._columns[self.centre_columns[:, None] + self._reach]
        at = rows[:, None, :, None], columns[None, :, None, :]
        centre = self._features[torch.tensor(centre_rows)[:, None], self.centre_columns][:, :, None]
        return self._features[at].flatten(2, 3) - centre, self._values[at].flatten(2, 3)


def _models(difference: Tensor, targets: Tensor, weight: Tensor, groups: list[int], ridge: float) -> Tensor:
    """The fit in each window, (rows, columns, F + 1, 3), from the features' differences (rows, columns, taps, F)."""
    scale = _scale(difference, groups)
    phi = torch.cat([torch.ones_like(difference[..., :1]), difference * scale], -1)
    share = weight / weight.sum(-1, keepdim=True)
    moments = torch.einsum("yxt,yxti,yxtj->yxij", share, phi, phi)
    diagonal = torch.full((phi.shape[-1],), ridge, dtype=phi.dtype)
    diagonal[0] = 0
    right = torch.einsum("yxt,yxti,yxtk->yxik", share, phi, targets)
    models: Tensor = torch.linalg.solve(moments + torch.diag(diagonal), right)
    models[:, :, 1:] *= scale.transpose(-1, -2)
    return models


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
