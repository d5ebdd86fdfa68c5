"""The deep combiner that ships: weights of a closed form, of bandwidths that a network trained in advance predicts.

Back et al. 2020 predict every weight of the window, with 1.6 M parameters. Here, as in the core, a small network gives
each pixel the scales β, the bandwidths γ and the center weight τ of Eqs. 10 and 11 of Back et al. 2022, and the share
α that their g has of the result, ``z_c + α (g_c − z_c)``. The core learns on the frame itself, by its halves; this one
has learned on other frames, by their references, and takes no training.
"""

import math
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from selfcorrect.buffers import TERMS
from selfcorrect.image.windows import reflected
from selfcorrect.kernel.convolution import convolutions
from selfcorrect.kernel.cross_bilateral import Window, cross_bilateral
from selfcorrect.kernel.guides import Guides
from selfcorrect.stages.combiner import Combiner
from selfcorrect.stages.layers import convolution, start_flat

__all__ = ["BilateralCombiner", "evidence"]

_TERMS = tuple(term for term in TERMS if term.name != "visibility")
_SIDES = (5, 15)  # of the windows that the evidence is gathered in, pixels
_EVIDENCE = 4 * len(_SIDES)
_INPUTS = 3 + 7 + _EVIDENCE + 3  # y; albedo, normal, depth; evidence; z
_DARKEST = 0.05  # radiance: where z is darker, residuals are not relative to it
_LARGEST = 20.0  # times z: residuals beyond it say no more
_FIRST_BETA_Z, _FIRST_TAU = 0.95, 0.05
_LEAST_SHARE = 0.1  # of g: a share of 0 has no gradient, and where the first steps did harm it stayed there


class BilateralCombiner(Combiner):
    """Convolutions 3×3 with ReLU between them and zero padding, Eqs. 10 and 11, and the share of what they give.

    Args:
        width: filters of each hidden layer, at most 16 for the compiled form.
        window: side of the cross-bilateral window, odd.
        layers: convolutions.
        seed: of the first weights.
    """

    kind = "bilateral-combiner"

    def __init__(self, width: int = 16, window: int = 19, layers: int = 6, *, seed: int = 0):
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.architecture = {"width": width, "window": window, "layers": layers}
        self.pairs, self.window = 1, window
        self.reach = layers + max(_SIDES) // 2
        betas = [math.atanh(_FIRST_BETA_Z) if term.name == "denoised" else 0.0 for term in _TERMS if term.scale]
        gammas = [math.log(math.expm1(term.first_bandwidth)) for term in _TERMS]
        first = [*(beta for beta in betas for _ in range(3)), *gammas, math.log(math.expm1(_FIRST_TAU)), 0.0]
        widths = [_INPUTS, *[width] * (layers - 1), len(first)]
        made = [convolution(i, o, 3, generator) for i, o in pairwise(widths)]
        self.convolutions = nn.ModuleList(made)
        start_flat(made[-1], torch.tensor(first))

    def forward(self, noisy: Tensor, denoised: Tensor, features: Tensor) -> Tensor:
        """The combined radiance (N, 3, H, W) of what :meth:`weights` takes."""
        images = (noisy, denoised, features)
        return self.combined(self.weights(*images), *(reflected(planes, self.window // 2) for planes in images))

    def weights(self, noisy: Tensor, denoised: Tensor, features: Tensor, precision: str = "fp32") -> Tensor:
        """What the weights are made of, before its activations: β, γ, τ, α, (N, 15, H, W)."""
        y, z = noisy[:, 0], denoised[:, 0]
        shown = torch.cat([y.clamp(min=0), features, evidence(y, z), z.clamp(min=0)], 1)
        parameters = list(self.convolutions.parameters())
        threads = torch.get_num_threads()
        heads = convolutions(list(shown), parameters, log_radiance=True, precision=precision, threads=threads)
        return heads.to(noisy.dtype)  # where training casts by itself they are bfloat16

    def combined(self, weights: Tensor, noisy: Tensor, denoised: Tensor, features: Tensor) -> Tensor:
        """Eqs. 10 and 11 and the share of their result; see :class:`Combiner`."""
        margin = self.window // 2
        y, z = noisy[:, 0], denoised[:, 0]
        planes = torch.cat([y, features[:, 3:6], features[:, :3], z], 1)
        crops = [Guides.of_planes(image, margin, _TERMS) for image in planes]
        guides = Guides.stack(crops, len(crops))
        corners = torch.tensor([[guides.pitch * n, 0] for n in range(len(crops))])
        heads, share = weights[:, :-1], _LEAST_SHARE + (1 - _LEAST_SHARE) * weights[:, -1:].sigmoid()
        g = cross_bilateral(guides, heads, corners, Window(self.window), threads=torch.get_num_threads())
        z = z[..., margin : margin + guides.height, margin : margin + guides.width]
        return z + share * (g - z)


def evidence(noisy: Tensor, denoised: Tensor) -> Tensor:
    """Whether the denoiser has erred around a pixel, in windows of 5×5 and 15×15: (N, 8, H, W) of y, z (N, 3, H, W).

    Each window gives a quarter of the mean residual y − z over its standard error, three channels, and a quarter of the
    logarithm of the residuals' mean square, both relative to z. A window ends where the image does.
    """
    residual = ((noisy - denoised) / (denoised.mean(1, keepdim=True).abs() + _DARKEST)).clamp(-_LARGEST, _LARGEST)
    planes = torch.cat([residual, residual.square().mean(1, keepdim=True)], 1)
    found = []
    for side in _SIDES:
        rows = F.avg_pool2d(planes, (side, 1), 1, (side // 2, 0), count_include_pad=False)
        means = F.avg_pool2d(rows, (1, side), 1, (0, side // 2), count_include_pad=False)
        square = means[:, 3:] + 1e-6
        found += [means[:, :3] / (square / side**2).sqrt() / 4, square.log() / 4]
    return torch.cat(found, 1)
