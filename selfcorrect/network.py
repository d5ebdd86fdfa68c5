"""The network of Back et al. 2022: nine 3×3 convolutions, 20,303 parameters with all thirteen inputs."""

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
        self.convolutions = nn.ModuleList(
            nn.Conv2d(i, o, 3, padding=1) for i, o in zip(widths[:-1], widths[1:], strict=True)
        )
        for convolution in self.convolutions:
            nn.init.xavier_uniform_(convolution.weight, generator=generator)
            nn.init.zeros_(convolution.bias)

    @classmethod
    def for_guides(cls, guides: Guides, settings: Settings, generator: torch.Generator) -> "Network":
        """The network that these guides and settings ask for."""
        heads = heads_count(guides, settings.combination)
        network = cls(
            guides.planes.shape[0], heads, filters=settings.filters, layers=settings.layers, generator=generator
        )
        return network.to(guides.planes.device, memory_format=torch.channels_last)

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
