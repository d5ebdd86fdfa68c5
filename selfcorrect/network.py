"""The network of Back et al. 2022: nine 3×3 convolutions, 20,303 parameters with all thirteen inputs."""

from itertools import pairwise

import torch
from torch import Tensor, nn

from selfcorrect.kernel import Guides, heads_count
from selfcorrect.settings import Settings

__all__ = ["Network"]


class Network(nn.Module):
    """Convolutions 3×3 with ReLU between them, zero padding, Glorot-uniform weights and zero biases.

    Args:
        inputs: channels of the guides.
        heads: raw outputs per pixel, see :func:`selfcorrect.kernel.heads_count`.
        filters: filters of each hidden layer.
        layers: number of convolutions.
        generator: source of the first weights.
    """

    def __init__(self, inputs: int, heads: int, *, filters: int, layers: int, generator: torch.Generator):
        super().__init__()
        widths = [inputs, *[filters] * (layers - 1), heads]
        self.convolutions = nn.ModuleList()
        for i, o in pairwise(widths):
            # skip_init: torch's own first weights would draw from the caller's random numbers
            convolution = nn.utils.skip_init(nn.Conv2d, i, o, 3, padding=1)
            nn.init.xavier_uniform_(convolution.weight, generator=generator)
            nn.init.zeros_(convolution.bias)
            self.convolutions.append(convolution)

    @classmethod
    def for_guides(cls, guides: Guides, settings: Settings, generator: torch.Generator) -> "Network":
        """The network that these guides and settings ask for."""
        heads = heads_count(guides, settings.combination)
        network = cls(
            guides.planes.shape[0], heads, filters=settings.filters, layers=settings.layers, generator=generator
        )
        network.to(guides.planes.device)
        network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # lacking in torch's stubs
        return network

    @property
    def shape(self) -> list[tuple[int, ...]]:
        """Shapes of all weights: two networks with the same shape can be exchanged."""
        return [tuple(p.shape) for p in self.parameters()]

    def forward(self, guides: Tensor) -> Tensor:
        """Guides (N, C, h, w) to raw heads (N, heads, h, w)."""
        x = guides.contiguous(memory_format=torch.channels_last)
        *hidden, last = self.convolutions
        for convolution in hidden:
            x = torch.relu_(convolution(x))
        raw: Tensor = last(x)
        return raw
