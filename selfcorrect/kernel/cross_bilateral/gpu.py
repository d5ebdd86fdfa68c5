"""The kernel for CUDA as differentiable torch functions; program.py is what runs on the device.

Under ``TRITON_INTERPRET=1`` it runs on the CPU, for tests: some milliseconds for each tap of the window.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from selfcorrect.kernel.cross_bilateral.program import BACKWARD, FORWARD, LOSS, program
from selfcorrect.kernel.cross_bilateral.window import Window
from selfcorrect.kernel.device import on_device
from selfcorrect.kernel.guides import Guides

__all__ = [
    "TILE",
    "WARPS",
    "Terms",
    "cross_bilateral",
    "cross_bilateral_loss",
    "specialisation",
    "terms_of",
]

TILE = (4, 32)  # rows and columns of a program's pixels: a row is a warp, whose loads are then one line of the cache
WARPS = 4

Terms = tuple[tuple[int, int, int, bool], ...]


class _Options(NamedTuple):
    window: Window
    tile: tuple[int, int]


def terms_of(guides: Guides) -> Terms:
    """What TERMS is for these guides."""
    places = [guides.scaled.index(term) if term.scale else -1 for term in guides.terms]
    return tuple(
        (guides.channels(term).start, term.channels, place, term.distance == "logarithmic")
        for term, place in zip(guides.terms, places, strict=True)
    )


def specialisation(terms: Terms, window: Window, tile: tuple[int, int]) -> dict[str, Any]:
    """The device function's compile-time arguments but MODE."""
    return {
        "TERMS": terms,
        "BETAS": sum(term[1] for term in terms if term[2] >= 0),
        "WINDOW": window.side,
        "EVERY": window.every,
        "EQ3": window.combination == "eq3",
        "ROWS": tile[0],
        "COLUMNS": tile[1],
    }


def _launch(
    mode: Any,
    guides: Guides,
    raw: Tensor,
    corners: Tensor,
    options: _Options,
    *,
    image: Tensor | None = None,
    gradient: Tensor | None = None,
    target: Tensor | None = None,
    weight: Tensor | None = None,
) -> Tensor:
    """Run the program on every tile; returns what each of them leaves of the loss, (programs,)."""
    patches, _, height, width = raw.shape
    rows, columns = options.tile
    tiles = -(-height // rows) * -(-width // columns)
    losses = raw.new_empty(patches * tiles if mode is LOSS else 0)
    with torch.cuda.device_of(raw):  # Triton asks for the current device, not for that of the tensors
        program[(tiles, patches)](
            guides.planes,
            raw,
            corners,
            image,
            gradient,
            target,
            weight,
            losses,
            *guides.planes.stride()[:2],
            *raw.stride(),
            *((0, 0, 0, 0) if gradient is None else gradient.stride()),
            0 if target is None else target.stride(0),
            height,
            width,
            MODE=mode,
            **specialisation(terms_of(guides), options.window, options.tile),
            num_warps=WARPS,
            enable_fp_fusion=True,
        )
    return losses


def _placed(guides: Guides, corners: Tensor) -> Tensor:
    """Corners in the guides' planes, on their device, without waiting for it."""
    return on_device(corners + guides.margin, guides.planes.device)


class _CrossBilateral(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, raw: Tensor, guides: Guides, corners: Tensor, options: _Options) -> Tensor:
        ctx.save_for_backward(raw)
        ctx.call = (guides, _placed(guides, corners), options)
        image = raw.new_empty((raw.shape[0], 3, raw.shape[2], raw.shape[3]))
        _launch(FORWARD, guides, raw, ctx.call[1], options, image=image)
        return image

    @staticmethod
    def backward(ctx: Any, *output_gradients: Tensor) -> Any:
        (raw,) = ctx.saved_tensors
        guides, corners, options = ctx.call
        gradient = torch.empty_like(raw)
        _launch(BACKWARD, guides, raw, corners, options, image=output_gradients[0].contiguous(), gradient=gradient)
        return gradient, None, None, None


class _CrossBilateralLoss(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, raw: Tensor, guides: Guides, corners: Tensor, target: Tensor, weight: Tensor, options: _Options
    ) -> Tensor:
        gradient = torch.empty_like(raw)
        losses = _launch(
            LOSS, guides, raw, _placed(guides, corners), options, gradient=gradient, target=target, weight=weight
        )
        ctx.save_for_backward(gradient)
        ctx.count = raw.shape[0] * raw.shape[2] * raw.shape[3] * 3
        total: Tensor = losses.sum(dtype=torch.float64) / ctx.count
        return total.to(raw.dtype)

    @staticmethod
    def backward(ctx: Any, *output_gradients: Tensor) -> Any:
        (gradient,) = ctx.saved_tensors
        return gradient * (output_gradients[0] / ctx.count), None, None, None, None, None


def cross_bilateral(
    guides: Guides, raw: Tensor, corners: Tensor, window: Window, *, threads: int = 1, tile: tuple[int, int] = TILE
) -> Tensor:
    """Eq. 10, like :func:`selfcorrect.kernel.cross_bilateral.reference.cross_bilateral`, for float32.

    ``tile`` are rows and columns of a program's pixels, powers of two; the result does not depend on it, nor on
    ``threads``.
    """
    apply: Callable[..., Tensor] = _CrossBilateral.apply  # torch leaves it untyped
    return apply(raw, guides, corners, _Options(window, tile))


def cross_bilateral_loss(
    guides: Guides,
    raw: Tensor,
    corners: Tensor,
    target: Tensor,
    weight: Tensor,
    window: Window,
    *,
    threads: int = 1,
    tile: tuple[int, int] = TILE,
) -> Tensor:
    """One half of Eq. 8, value and gradient in one visit of each pixel; ``tile`` orders the sum of the loss."""
    apply: Callable[..., Tensor] = _CrossBilateralLoss.apply  # torch leaves it untyped
    return apply(raw, guides, corners, target, weight, _Options(window, tile))
