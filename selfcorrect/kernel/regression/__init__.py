"""Windowed first-order regression: one door to the compiled kernel (see ``regression_reference.py`` for the maths).

The compiled kernel's cost is that of its centres: a model for every pixel is 114 sums over 2,601 pixels at the paper's
window. Every pixel takes the mean of all models around it, so that models at every second or fourth pixel of every
second or fourth row (``stride``) say nearly the same for a fourth or a sixteenth of the time.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from selfcorrect.errors import FrameError, SettingsError
from selfcorrect.image.exposure import LARGEST
from selfcorrect.image.windows import reflect
from selfcorrect.kernel import _cpu, nlm
from selfcorrect.kernel.cross_bilateral.cpu import instruction_sets

__all__ = ["regress", "regress_non_local"]

LARGEST_WINDOW = 63
_LANES = 16  # the widest vector reads up to this many cells beyond the last one


def regress(
    features: list[Tensor],
    targets: Tensor,
    *,
    window: int,
    ridge: float,
    bandwidth: float,
    stride: int = 1,
    threads: int = 1,
    isa: str = "",
) -> Tensor:
    """Targets as a first-order function of features, fitted by weighted least squares in every window.

    Each feature group is divided by its largest distance to the centre in the window; the weight of a pixel in the
    window is exp(−‖z_i − z_c‖² / bandwidth) with z the first group; every pixel takes the mean of the models around it
    with the same weights. The border is mirrored without repeating the edge pixel.

    Args:
        features: groups (H, W, 1) or (H, W, 3), those of three first, at most three of them and two of one.
        targets: (H, W, 3).
        window: side of the window in pixels, odd, at most 63.
        ridge: added to the diagonal of the scaled system, whose weights sum to 1; > 0.
        bandwidth: > 0.
        stride: models are solved at every stride-th pixel of every stride-th row, 1 … 16 and at most the window.
        threads: of the compiled kernel.
        isa: one of :func:`selfcorrect.kernel.cross_bilateral.cpu.instruction_sets`; by default the widest.

    Returns:
        (H, W, 3) float32.

    Raises:
        FrameError: shapes do not fit.
        SettingsError: a number is out of range.
    """
    if window % 2 == 0 or not 1 <= window <= LARGEST_WINDOW:
        raise SettingsError(f"expected an odd window from 1 to {LARGEST_WINDOW}, but got {window}")
    if not 1 <= stride <= min(16, window) or not (ridge > 0 and bandwidth > 0 and math.isfinite(ridge + bandwidth)):
        raise SettingsError(
            f"expected a stride from 1 to 16 and to the window, a ridge > 0 and a bandwidth > 0, "
            f"but got {stride}, {ridge}, {bandwidth}"
        )
    layout = Layout.of(features, targets, window // 2, stride)
    inverse = 1 / (bandwidth * math.log(2))
    options = (ridge, inverse, None, 0, layout.height, isa or instruction_sets()[-1], threads)
    models = torch.empty(3 * (layout.features + 1), layout.height, layout.width)
    _cpu.solve(*layout.arguments, *options, models)
    output = torch.empty(stride * stride, 3, layout.height, layout.width)
    _cpu.reconstruct(*layout.arguments, *options, layout.centres(models), output)
    return layout.image(output)


def regress_non_local(
    features: list[Tensor],
    targets: Tensor,
    weights: Callable[[], Iterable[nlm.Strip]],
    *,
    radius: int,
    ridge: float,
    threads: int = 1,
    isa: str = "",
) -> Tensor:
    """As :func:`regress` with a model at every pixel, but with given weights, those of non-local means.

    Args:
        features: as for :func:`regress`.
        targets: (H, W, 3).
        weights: gives :func:`selfcorrect.kernel.nlm.strips` of this radius; called twice.
        radius: of the window.
        ridge, threads, isa: as for :func:`regress`.
    """
    layout = Layout.of(features, targets, radius, 1)
    models = torch.empty(3 * (layout.features + 1), layout.height, layout.width)
    output = torch.empty(1, 3, layout.height, layout.width)

    def each(function: Callable[..., None], *arrays: Tensor) -> None:
        for strip in weights():
            options = (ridge, 0.0, strip.weights, strip.first_row, strip.weights.shape[1])
            function(*layout.arguments, *options, isa or instruction_sets()[-1], threads, *arrays)

    each(_cpu.solve, models)
    each(_cpu.reconstruct, layout.centres(models), output)
    return layout.image(output)


@dataclass(frozen=True)
class Layout:
    """Features and targets in planes padded by mirroring, cut into cells of stride × stride pixels.

    ``planes`` is (stride², channels, rows, columns): place in the cell, then cells. The first place is the centres'.
    """

    planes: Tensor
    size: tuple[int, int]
    vectors: int
    scalars: int
    radius: int
    stride: int
    margin: int  # cells
    height: int  # cells
    width: int  # cells

    @classmethod
    def of(cls, features: list[Tensor], targets: Tensor, radius: int, stride: int) -> "Layout":
        """Check the buffers, bound them by ±1e15, and lay them out."""
        height, width = targets.shape[:2]
        channels = [feature.shape[2] for feature in features]
        vectors, scalars = channels.count(3), channels.count(1)
        known = channels == [3] * vectors + [1] * scalars and vectors <= 3 and scalars <= 2
        fitting = all(feature.shape[:2] == (height, width) for feature in features)
        if not features or not known or not fitting or targets.shape[2] != 3:
            shapes = ", ".join(str(tuple(image.shape)) for image in (*features, targets))
            raise FrameError(f"expected features (H, W, 3), then (H, W, 1), and targets (H, W, 3), but got {shapes}")
        stacked = torch.cat([*features, targets], 2).float().clamp(-LARGEST, LARGEST).permute(2, 0, 1)
        margin = -(-radius // stride)
        cells = (-(-height // stride), -(-width // stride))
        rows = reflect(-margin * stride, (cells[0] + margin) * stride, height)
        columns = reflect(-margin * stride, (cells[1] + margin + _LANES) * stride, width)
        padded = stacked.index_select(1, rows).index_select(2, columns)
        cut = padded.unflatten(2, (-1, stride)).unflatten(1, (-1, stride))  # (C, rows, stride, columns, stride)
        planes = cut.permute(2, 4, 0, 1, 3).flatten(0, 1).contiguous()
        return cls(planes, (height, width), vectors, scalars, radius, stride, margin, *cells)

    @property
    def features(self) -> int:
        """Number of features, without the constant."""
        return 3 * self.vectors + self.scalars

    @property
    def arguments(self) -> tuple[object, ...]:
        """What the compiled functions take first."""
        return (
            *(self.planes, self.vectors, self.scalars),
            *(self.radius, self.stride, self.margin, self.height, self.width),
        )

    def centres(self, models: Tensor) -> Tensor:
        """Models (planes, height, width) and their centres' features, the grid mirrored by the margin."""
        m = self.margin
        own = self.planes[0, : self.features, m : m + self.height, m : m + self.width]
        rows, columns = reflect(-m, self.height + m, self.height), reflect(-m, self.width + m + _LANES, self.width)
        return torch.cat([models, own]).index_select(1, rows).index_select(2, columns).contiguous()

    def image(self, output: Tensor) -> Tensor:
        """The kernel's output as an image (H, W, 3)."""
        s = self.stride
        whole = output.reshape(s, s, 3, self.height, self.width).permute(3, 0, 4, 1, 2)
        return whole.reshape(self.height * s, self.width * s, 3)[: self.size[0], : self.size[1]].contiguous()
