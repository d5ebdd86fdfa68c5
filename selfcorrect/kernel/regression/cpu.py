"""The compiled windowed regression."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from selfcorrect.image.exposure import LARGEST
from selfcorrect.image.windows import reflect
from selfcorrect.kernel.backend import instruction_set
from selfcorrect.kernel.compiled import functions as _cpu
from selfcorrect.kernel.nlm import Strip

__all__ = ["regress", "regress_non_local"]

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
    """As :func:`selfcorrect.kernel.regression.regress`; ``isa`` is an instruction set, by default the fastest."""
    layout = Layout.of(features, targets, window // 2, stride)
    inverse = 1 / (bandwidth * math.log(2))
    options = (ridge, inverse, None, 0, layout.height, instruction_set(isa), threads)
    models = torch.empty(3 * (layout.features + 1), layout.height, layout.width)
    _cpu.solve(*layout.arguments, *options, models)
    output = torch.empty(stride * stride, 3, layout.height, layout.width)
    _cpu.reconstruct(*layout.arguments, *options, layout.centres(models), output)
    return layout.image(output)


def regress_non_local(
    features: list[Tensor],
    targets: Tensor,
    weights: Callable[[], Iterable[Strip]],
    *,
    radius: int,
    ridge: float,
    threads: int = 1,
    isa: str = "",
) -> Tensor:
    """As :func:`selfcorrect.kernel.regression.regress_non_local`; ``isa`` is an instruction set."""
    layout = Layout.of(features, targets, radius, 1)
    models = torch.empty(3 * (layout.features + 1), layout.height, layout.width)
    output = torch.empty(1, 3, layout.height, layout.width)

    def each(function: Callable[..., None], *arrays: Tensor) -> None:
        for strip in weights():
            options = (ridge, 0.0, strip.weights, strip.first_row, strip.weights.shape[1])
            function(*layout.arguments, *options, instruction_set(isa), threads, *arrays)

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
        """Bound the buffers by ±1e15 and lay them out."""
        height, width = targets.shape[:2]
        channels = [feature.shape[2] for feature in features]
        vectors, scalars = channels.count(3), channels.count(1)
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
