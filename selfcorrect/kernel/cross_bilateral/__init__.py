"""The cross-bilateral kernel (Back et al. 2022, Eqs. 3, 8, 10 and 11): validated here, computed by one of its forms.

``reference.py`` is the mathematics, ``cpu.py`` the compiled form, ``gpu.py`` the one for CUDA: it needs Triton, and is
imported when it is asked for. One for another device is a file beside them with the functions of :class:`Form`, and a
line in :func:`_form`; until then ROCm and others run the reference, shift by shift.
"""

from importlib import import_module
from typing import Protocol, cast

import torch
from torch import Tensor

from selfcorrect.errors import FrameError, MissingPackageError
from selfcorrect.kernel.backend import choose
from selfcorrect.kernel.cross_bilateral import cpu, reference
from selfcorrect.kernel.cross_bilateral.window import LARGEST_WINDOW, Window
from selfcorrect.kernel.guides import Guides

__all__ = [
    "LARGEST_WINDOW",
    "Form",
    "Window",
    "check_reach",
    "cross_bilateral",
    "cross_bilateral_loss",
    "heads_count",
]


class Form(Protocol):
    """What a module that computes the kernel has; arguments as of the functions below, already checked."""

    def cross_bilateral(self, guides: Guides, raw: Tensor, corners: Tensor, window: Window, *, threads: int) -> Tensor:
        """Eq. 10."""
        ...

    def cross_bilateral_loss(
        self,
        guides: Guides,
        raw: Tensor,
        corners: Tensor,
        target: Tensor,
        weight: Tensor,
        window: Window,
        *,
        threads: int,
    ) -> Tensor:
        """One half of Eq. 8."""
        ...


def _form(guides: Guides, backend: str | None) -> Form:
    name = choose(backend, [guides.planes], gpu=True)
    if name == "gpu":
        return _gpu()
    forms: dict[str, Form] = {"cpu": cpu, "reference": reference}
    return forms[name]


def _gpu() -> Form:
    try:
        return cast(Form, import_module("selfcorrect.kernel.cross_bilateral.gpu"))
    except ModuleNotFoundError as error:
        if error.name != "triton":
            raise
        raise MissingPackageError("the kernel for CUDA", "gpu") from None


def heads_count(guides: Guides, combination: str) -> int:
    """How many raw outputs the kernel takes per pixel: Eq. 10's β, Eq. 11's γ, and τ."""
    return (guides.betas if combination == "eq10" else 0) + guides.gammas + 1


def cross_bilateral(
    guides: Guides,
    raw: Tensor,
    corners: Tensor,
    window: Window,
    *,
    threads: int = 1,
    backend: str | None = None,
) -> Tensor:
    """Corrected radiance of patches (Back et al. 2022, Eqs. 10 and 11), differentiable in ``raw``.

    Args:
        guides: padded buffers of one half, linear radiance.
        raw: network outputs before tanh and softplus, (N, heads, h, w), any strides.
        corners: image row and column of each patch's first pixel, (N, 2), int64, on the CPU; may lie outside the image.
            The form for CUDA takes them on its device, too: then who calls has asked :func:`check_reach` before.
        window: taps and combination.
        threads: of the compiled form.
        backend: as for :func:`selfcorrect.kernel.backend.choose`.

    Returns:
        g, (N, 3, h, w), linear radiance.

    Raises:
        FrameError: shapes or types do not fit, or a patch reaches beyond the guides' margin.
        SettingsError: no such backend for these tensors.
        MissingPackageError: tensors on CUDA, without Triton.
    """
    _validate(guides, raw, corners, window)
    return _form(guides, backend).cross_bilateral(guides, raw, corners, window, threads=threads)


def cross_bilateral_loss(
    guides: Guides,
    raw: Tensor,
    corners: Tensor,
    target: Tensor,
    weight: Tensor,
    window: Window,
    *,
    threads: int = 1,
    backend: str | None = None,
) -> Tensor:
    """One half of Eq. 8: the mean over pixels and channels of ½ weight (g − target)², a scalar.

    ``target`` (3, …) and ``weight`` (…) are padded like the guides' planes; the other arguments and errors are those of
    :func:`cross_bilateral`. The gradient at a pixel is known as soon as its output is, so that the compiled form visits
    each pixel once.
    """
    _validate(guides, raw, corners, window)
    return _form(guides, backend).cross_bilateral_loss(guides, raw, corners, target, weight, window, threads=threads)


def _validate(guides: Guides, raw: Tensor, corners: Tensor, window: Window) -> None:
    heads = heads_count(guides, window.combination)
    if raw.ndim != 4 or raw.shape[1] != heads:
        raise FrameError(f"expected raw heads of shape (N, {heads}, h, w), but got {tuple(raw.shape)}")
    there = corners.device.type
    known = there in ("cpu", guides.planes.device.type)
    if corners.shape != (raw.shape[0], 2) or corners.dtype != torch.int64 or not known:
        raise FrameError(
            f"expected int64 corners of shape ({raw.shape[0]}, 2) on the CPU, "
            f"but got {corners.dtype} of {tuple(corners.shape)} on {there}"
        )
    if raw.dtype != guides.planes.dtype:
        raise FrameError(f"expected raw heads in {guides.planes.dtype}, but got {raw.dtype}")
    if there == "cpu":  # elsewhere to look at them would be to wait
        check_reach(guides, corners, (raw.shape[2], raw.shape[3]), window)


def check_reach(guides: Guides, corners: Tensor, size: tuple[int, int], window: Window) -> None:
    """Raise a FrameError where a window of patches of this size reaches beyond the guides; ``corners`` on the CPU."""
    reach = guides.margin - window.radius
    bottom = (guides.stacked - 1) * guides.pitch + guides.height
    last = corners + torch.tensor([size[0] - bottom, size[1] - guides.width])
    if corners.numel() and (corners.min() < -reach or last.max() > reach):
        raise FrameError(
            f"expected patches at most {reach} pixels outside the image, but got one beyond (margin {guides.margin})"
        )
