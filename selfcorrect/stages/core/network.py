"""The network of Back et al. 2022: 3×3 convolutions.

Nine as published, 20,303 parameters with all thirteen inputs; with the other presets' five 11,023.
"""

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn

from selfcorrect.buffers import DENOISED, INPUTS, Buffer
from selfcorrect.errors import FrameError
from selfcorrect.kernel import convolution
from selfcorrect.kernel.cross_bilateral import heads_count
from selfcorrect.kernel.guides import Guides
from selfcorrect.settings import Settings

__all__ = ["Network", "Traits", "buffer_names"]

# What the residual initialisation's heads start at: g is close to z_c plus the mean of y_i − z_i over pixels like c,
# with the bandwidths of the table of buffers: wide in the noisy radiance, narrow where there is little noise.
_START_BETA_Z = 0.9
_START_TAU = 0.05
_START_SPREAD = 0.1  # of the last layer's weights: heads start near the same value everywhere


def buffer_names(terms: Iterable[Buffer]) -> str:
    """What a network sees of these, in the order of its inputs.

    >>> from selfcorrect.buffers import TERMS
    >>> buffer_names(term for term in TERMS if term.name != "visibility")
    'color+albedo+normal+denoised'
    """
    there = set(terms)
    return "+".join(term.name for term in INPUTS if term in there)


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
        own = [getattr(settings, name) for name in cls._fields[1:]]
        return cls(buffer_names(guides.terms), *own)

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
    """Weights of a 3×3 convolution. torch's own would draw the first ones from the caller's random numbers."""

    def __init__(self, inputs: int, outputs: int, generator: torch.Generator):
        super().__init__()
        self.weight = nn.Parameter(torch.empty(outputs, inputs, 3, 3))
        self.bias = nn.Parameter(torch.zeros(outputs))
        nn.init.xavier_uniform_(self.weight, generator=generator)


class Network(nn.Module):
    """Convolutions 3×3 with ReLU between them, zero padding, Glorot-uniform weights and zero biases.

    Args:
        inputs: channels of the guides, radiance first and denoised radiance last.
        heads: raw outputs per pixel, see :func:`selfcorrect.kernel.cross_bilateral.heads_count`.
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
        scaled = guides.scaled if combination == "eq10" else ()
        betas = [math.atanh(_START_BETA_Z) if term == DENOISED else 0.0 for term in scaled for _ in range(3)]
        gammas = [term.first_bandwidth for term in guides.terms]
        last = self.convolutions[-1]
        assert isinstance(last, _Convolution)
        with torch.no_grad():
            last.weight.mul_(_START_SPREAD)
            last.bias.copy_(torch.tensor([*betas, *(math.log(math.expm1(value)) for value in (*gammas, _START_TAU))]))

    def forward(self, guides: Tensor | Sequence[Tensor], region: tuple[int, int, int, int] | None = None) -> Tensor:
        """Guides, N of (C, h, w), to raw heads (N, heads, h, w), or those of a region (top, left, bottom, right)."""
        return convolution.convolutions(
            list(guides),
            list(self.parameters()),
            log_radiance=self.log_radiance,
            region=region,
            precision=self.precision,
            threads=torch.get_num_threads(),
        )
