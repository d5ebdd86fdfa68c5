"""Guides, heads and differences for the tests of the kernels."""

from dataclasses import replace
from itertools import chain, combinations

import torch
from torch import Tensor

from selfcorrect.buffers import TERMS, Buffer
from selfcorrect.kernel.cross_bilateral import heads_count
from selfcorrect.kernel.guides import Guides

Terms = tuple[Buffer, ...]

ALWAYS: Terms = tuple(term for term in TERMS if term.kind == "radiance")
OPTIONAL: Terms = tuple(term for term in TERMS if term not in ALWAYS)

EVERY_SET: list[Terms] = [
    (*ALWAYS, *some)
    for some in chain.from_iterable(combinations(OPTIONAL, count) for count in range(len(OPTIONAL) + 1))
]
"""Each of the table's buffers present and absent, in all combinations."""


TOLERANCE = {
    # Largest difference to the float64 reference, over its largest value; behind it the worst measured.
    torch.float32: {
        "cross-bilateral": 1e-5,  # 1.9e-6
        "cross-bilateral gradients": 5e-5,  # 1.7e-5: 16 pixels in a column, a window of 31
        "cross-bilateral extreme": 1e-7,  # 1.3e-8
        "cross-bilateral saturated gradients": 1e-4,  # 2.9e-5
        "cross-bilateral saturated scales": 2e-6,  # 3.3e-7
        "convolution": 3e-6,  # 7.7e-7
        "convolution gradients": 1e-5,  # 1.4e-6
        "nlm": 5e-6,  # 7.9e-7
        "regression models": 1e-3,  # 5.0e-4: slopes that the ridge alone determines, at 1e-4 of the largest
        "regression what models say": 2e-6,  # 1.0e-6: the same models' values in their windows
        "regression": 1e-4,  # 4.7e-5: a line of 17 pixels, models at every third
    },
    # The same by norm, to float64 with the same roundings.
    torch.bfloat16: {
        # Single-precision sums may round to the neighbouring bfloat16 (2⁻⁸) where they lie on the edge, which few do.
        "convolution": 2**-10,  # 1.6e-4
        "convolution gradients": 2**-9,  # 4.6e-4
        # by norm, to float64 without roundings: what nine layers of them are worth
        "convolution for CUDA": 5e-3,  # 2.2e-3
        "convolution for CUDA gradients": 5e-2,  # 2.4e-2
    },
}


def names(terms: Terms) -> str:
    """Of the optional ones, for a test's name."""
    return "+".join(term.name for term in terms if term not in ALWAYS) or "radiance"


def make_guides(
    height: int,
    width: int,
    terms: Terms = TERMS,
    *,
    margin: int = 20,
    dtype: torch.dtype = torch.float64,
    seed: int = 0,
) -> Guides:
    """Random buffers: noise of a few times the mean in the radiance, features of either sign."""
    generator = torch.Generator().manual_seed(seed)

    def buffer(term: Buffer) -> Tensor:
        values = torch.rand(height, width, term.channels, generator=generator, dtype=dtype)
        return 4 * values**3 if term.kind == "radiance" else 2 * values - 1

    return Guides.of_half({term.name: buffer(term) for term in terms}, margin=margin)


def make_raw(guides: Guides, combination: str, shape: tuple[int, int, int], scale: float = 1.0) -> Tensor:
    """Raw heads (N, heads, h, w) for a shape (N, h, w), float64."""
    generator = torch.Generator().manual_seed(1)
    n, h, w = shape
    return scale * torch.randn(n, heads_count(guides, combination), h, w, generator=generator, dtype=torch.float64)


def single(guides: Guides, device: str = "cpu") -> Guides:
    """The same in float32."""
    return replace(guides, planes=guides.planes.float().to(device))


def worst(got: Tensor, expected: Tensor) -> float:
    """Largest difference, over the largest expected value."""
    assert got.shape == expected.shape
    assert got.isfinite().all()
    expected = expected.detach().double()
    return float((got.detach().cpu().double() - expected).abs().max() / expected.abs().max().clamp(min=1e-9))


def by_norm(got: Tensor, expected: Tensor) -> float:
    """Norm of the difference, over that of the expected values."""
    assert got.shape == expected.shape
    assert got.isfinite().all()
    expected = expected.detach().double()
    return float((got.detach().cpu().double() - expected).norm() / expected.norm().clamp(min=1e-9))
