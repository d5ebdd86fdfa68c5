"""The network of Back et al. 2022: nine 3×3 convolutions, 20,303 parameters with all thirteen inputs."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from selfcorrect.errors import FrameError
from selfcorrect.kernel import convolution
from selfcorrect.kernel.cross_bilateral import heads_count
from selfcorrect.kernel.guides import Guides
from selfcorrect.settings import Settings

__all__ = ["Network", "Traits", "buffer_names"]

# What the residual initialisation's heads start at: g is close to z_c plus the mean of y_i − z_i over pixels like c,
# with wide bandwidths in the noisy radiance and narrow ones in the buffers that have little noise.
_START_BETA_Z = 0.9
_START_GAMMA = {"y": 3.0, "z": 1.0, "albedo": 0.2, "normal": 0.4, "visibility": 0.2}
_START_TAU = 0.05
_START_SPREAD = 0.1  # of the last layer's weights: heads start near the same value everywhere


def buffer_names(*, albedo: bool, visibility: bool, normal: bool) -> str:
    """What a network sees, in the order of its inputs.

    >>> buffer_names(albedo=True, visibility=False, normal=True)
    'color+albedo+normal+denoised'
    """
    there = {"color": True, "albedo": albedo, "visibility": visibility, "normal": normal, "denoised": True}
    return "+".join(name for name, is_there in there.items() if is_there)


class Traits(NamedTuple):
    """What two networks must share for one to go on from the other: what their inputs and outputs mean.

    Weights of the same shape are not enough: albedo and normal have as many channels, and a bandwidth means another
    thing in another window.

    Attributes:
        buffers: the guides' buffers, in their order.
        combination, window, layers, filters, log_radiance: as in the settings.
        input_scale: as in the settings; 0 is that of each frame.
    """

    buffers: str
    combination: str
    window: int
    layers: int
    filters: int
    log_radiance: bool
    input_scale: float

    @classmethod
    def of(cls, guides: Guides, settings: Settings) -> "Traits":
        """The traits of the network that these guides and settings ask for."""
        buffers = buffer_names(albedo=guides.has_albedo, visibility=guides.has_visibility, normal=guides.has_normal)
        own = [getattr(settings, name) for name in cls._fields[1:]]
        return cls(buffers, *own)

    def check(self, given: "Traits") -> None:
        """Raise a FrameError that names the first trait in which ``given`` differs."""
        for name, expected, got in zip(self._fields, self, given, strict=True):
            if expected != got:
                raise FrameError(
                    f"expected a warm start with {name} {expected}, but got one with {got}: other buffers or settings"
                )

    def check_settings(self, settings: Settings) -> None:
        """Raise a FrameError where other settings than these made the network; the buffers may be any."""
        own = [getattr(settings, name) for name in self._fields[1:]]
        Traits(self.buffers, *own).check(self)


class _Convolution(nn.Module):
    """3×3 with zero padding. torch's own would draw its first weights from the caller's random numbers."""

    def __init__(self, inputs: int, outputs: int, generator: torch.Generator):
        super().__init__()
        self.weight = nn.Parameter(torch.empty(outputs, inputs, 3, 3))
        self.bias = nn.Parameter(torch.zeros(outputs))
        nn.init.xavier_uniform_(self.weight, generator=generator)

    def forward(self, x: Tensor) -> Tensor:
        """(N, inputs, h, w) to (N, outputs, h, w)."""
        return F.conv2d(x, self.weight, self.bias, padding=1)


class Network(nn.Module):
    """Convolutions 3×3 with ReLU between them, zero padding, Glorot-uniform weights and zero biases.

    Args:
        inputs: channels of the guides, radiance first and denoised radiance last.
        heads: raw outputs per pixel, see :func:`selfcorrect.kernel.heads_count`.
        settings: ``filters``, ``layers``, ``log_radiance``, ``precision``.
        generator: source of the first weights.

    Attributes:
        traits: what another network must share to go on from this one; :meth:`for_guides` sets them.
    """

    traits: Traits

    def __init__(self, inputs: int, heads: int, settings: Settings, generator: torch.Generator):
        super().__init__()
        widths = [inputs, *[settings.filters] * (settings.layers - 1), heads]
        self.log_radiance = settings.log_radiance
        self.precision = settings.precision
        self.convolutions = nn.ModuleList()
        for i, o in pairwise(widths):
            self.convolutions.append(_Convolution(i, o, generator))

    @classmethod
    def for_guides(cls, guides: Guides, settings: Settings, generator: torch.Generator) -> "Network":
        """The network that these guides and settings ask for."""
        heads = heads_count(guides, settings.combination)
        network = cls(guides.planes.shape[0], heads, settings, generator)
        if settings.initialisation == "residual":
            network._start_at_residual(guides, settings.combination)
        network.traits = Traits.of(guides, settings)
        network.to(guides.planes.device)
        return network

    def _start_at_residual(self, guides: Guides, combination: str) -> None:
        betas = [math.atanh(_START_BETA_Z)] * 3 + [0.0] * (guides.betas - 3) if combination == "eq10" else []
        present = {"albedo": guides.has_albedo, "normal": guides.has_normal, "visibility": guides.has_visibility}
        gammas = [value for name, value in _START_GAMMA.items() if present.get(name, True)]
        last = self.convolutions[-1]
        assert isinstance(last, _Convolution)
        with torch.no_grad():
            last.weight.mul_(_START_SPREAD)
            last.bias.copy_(torch.tensor([*betas, *(math.log(math.expm1(value)) for value in (*gammas, _START_TAU))]))

    def forward(self, guides: Tensor | Sequence[Tensor], region: tuple[int, int, int, int] | None = None) -> Tensor:
        """Guides, N of (C, h, w), to raw heads (N, heads, h, w), or those of a region (top, left, bottom, right).

        On the CPU by the compiled kernel, see :func:`selfcorrect.kernel.convolution.convolutions`.
        """
        parameters = list(self.parameters())
        if all(t.device.type == "cpu" and t.dtype == torch.float32 for t in (*guides, *parameters)) and (
            max(p.shape[0] for p in (guides[0], *parameters)) <= convolution.LARGEST_WIDTH
        ):
            return convolution.convolutions(
                list(guides),
                parameters,
                log_radiance=self.log_radiance,
                region=region,
                precision=self.precision,
                threads=torch.get_num_threads(),
            )
        raw = self.reference(guides if isinstance(guides, Tensor) else torch.stack(list(guides)))
        top, left, bottom, right = region or (0, 0, *raw.shape[2:])
        return raw[:, :, top:bottom, left:right]

    def reference(self, guides: Tensor) -> Tensor:
        """The same in plain torch: guides (N, C, h, w), any device and dtype."""
        x = guides
        if self.log_radiance:
            x = torch.cat([x[:, :3].log1p(), x[:, 3:-3], x[:, -3:].log1p()], 1)
        x = x.contiguous(memory_format=torch.channels_last)
        *hidden, last = self.convolutions
        for layer in hidden:
            x = torch.relu_(layer(x))
        raw: Tensor = last(x)
        return raw
