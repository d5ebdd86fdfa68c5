"""The half buffers of one frame: shapes and values are checked and repaired once, here."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, cast

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from selfcorrect.errors import FrameError
from selfcorrect.image.bands import bands

__all__ = ["Frame", "Half", "Repairs", "mean", "repaired"]

Pair = tuple[Any, Any]
_CHANNELS = {"color": 3, "denoised": 3, "albedo": 3, "normal": 3, "visibility": 1, "depth": 1}
_RADIANCE = ("color", "denoised", "denoised_full", "sub_images", "denoised_sub_images")
_SUB_IMAGE_TOLERANCE = 5e-3  # of radiance: half floats round to 1/2048, and a mean of such again
_SUB_IMAGE_PIXELS = 0.01  # share that may differ: what was repaired, or lay beyond half floats
_MOST_REPAIRED = 0.5  # share of a radiance channel's pixels: with more, what is filled in is no render
_FEATURES = ("albedo", "normal", "visibility", "depth")


class Repairs(NamedTuple):
    """How many pixels of a buffer were changed on the way in."""

    non_finite: int
    negative: int


class Half(NamedTuple):
    """The buffers of one half, (H, W, C) like the frame's; None where the frame has no such buffer."""

    color: Tensor
    denoised: Tensor | None
    albedo: Tensor | None
    normal: Tensor | None
    visibility: Tensor | None
    depth: Tensor | None


class _Dual(Protocol):
    """A denoiser that takes both halves at once."""

    def pair(self, color: Pair, **features: Pair | None) -> Pair: ...


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame as two independent halves a and b, each with half of the samples.

    Every buffer is a pair of (H, W, C) float arrays, NumPy or torch; (H, W) will do for one channel. They become
    float32 tensors; G-buffers of half floats stay what they are, and take half the memory. A tensor that needs no
    change is not copied. Values that are NaN or infinite are filled from the finite ones around them in their channel,
    negative radiance is clipped at 0 (as published), and the pixels of both are counted in ``repairs``. A G-buffer that
    is the same at every pixel says nothing and only costs time: it becomes None, and its name is in ``constant``.

    Args:
        color: noisy linear radiance, 3 channels, ≥ 0.
        denoised: the denoised halves, linear radiance, 3 channels; needed by :func:`selfcorrect.correct`.
        albedo: 3 channels, usually 0 … 1.
        normal: 3 channels, usually of unit length.
        visibility: 1 channel.
        depth: 1 channel.
        denoised_full: the denoised mean of both halves, a single array.
        sub_images: four renders with seeds of their own, the first two of them with half a as their mean, the others
            with half b; for the stage deep-combiner-4.
        denoised_sub_images: those denoised, each on its own.

    Raises:
        FrameError: sizes or channel counts do not fit, or a channel of radiance is NaN or infinite at more than half
            of its pixels.
    """

    color: Pair
    denoised: Pair | None = None
    albedo: Pair | None = None
    normal: Pair | None = None
    visibility: Pair | None = None
    depth: Pair | None = None
    denoised_full: Any = None
    sub_images: Any = None
    denoised_sub_images: Any = None
    repairs: dict[str, Repairs] = field(init=False, default_factory=dict)
    constant: list[str] = field(init=False, default_factory=list)
    _like: Any = field(init=False, repr=False, default=None)

    def __post_init__(self) -> None:
        for name in _CHANNELS:
            pair = getattr(self, name)
            if pair is None and name != "color":
                continue
            if not isinstance(pair, (tuple, list)) or len(pair) != 2:
                raise FrameError(f"expected {name} as a pair of arrays (half a, half b), but got {type(pair).__name__}")
            if name == "color":
                object.__setattr__(self, "_like", _empty_like(pair[0]))
            self._set(name, tuple(pair))
        if self.denoised_full is not None:
            self._set("denoised_full", (self.denoised_full,))
        for name in ("sub_images", "denoised_sub_images"):
            if getattr(self, name) is not None:
                self._set_sub_images(name, getattr(self, name))

    def _set_sub_images(self, name: str, arrays: Any) -> None:
        if not isinstance(arrays, (tuple, list)) or len(arrays) != 4:
            got = len(arrays) if isinstance(arrays, (tuple, list)) else type(arrays).__name__
            raise FrameError(f"expected {name} as four arrays (two of half a, two of half b), but got {got}")
        self._set(name, tuple(arrays))
        if name == "sub_images":
            for half, color, pair in zip("ab", self.color, (self.sub_images[:2], self.sub_images[2:]), strict=True):
                _check_sub_images(half, color, pair)

    def _set(self, name: str, arrays: tuple[Any, ...]) -> None:
        """Check, repair and store the arrays of one buffer."""
        size = None if name == "color" else self.size
        tensors, counts = [], Repairs(0, 0)
        for what, array in zip(_names(name), arrays, strict=False):
            tensor = _as_tensor(array, what, _CHANNELS.get(name, 3), half=name in _FEATURES)
            if size is not None and tensor.shape[:2] != size:
                raise FrameError(
                    f"expected {what} of {size[1]}x{size[0]} pixels like the colour of half a, "
                    f"but got {tensor.shape[1]}x{tensor.shape[0]}"
                )
            size = (tensor.shape[0], tensor.shape[1])
            if name in _RADIANCE:
                _check_finite(tensor, what)
            tensor, repairs = _repair(tensor, radiance=name in _RADIANCE)
            tensors.append(tensor)
            counts = Repairs(*(x + y for x, y in zip(counts, repairs, strict=True)))
        self.repairs[name] = counts
        if name in _FEATURES and all(bool((tensor == tensor[0, 0]).all()) for tensor in tensors):
            self.constant.append(name)
            object.__setattr__(self, name, None)
            return
        object.__setattr__(self, name, tensors[0] if name == "denoised_full" else tuple(tensors))

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        height, width, _ = self.color[0].shape
        return height, width

    @property
    def halves(self) -> tuple[Half, Half]:
        """Half a and half b."""

        def one(i: int) -> Half:
            pairs = {name: getattr(self, name) for name in Half._fields}
            own: dict[str, Any] = {name: None if pair is None else pair[i] for name, pair in pairs.items()}
            return Half(**own)

        return one(0), one(1)

    def denoise(self, denoiser: Callable[..., Any], *, full: bool = True) -> "Frame":
        """This frame with each half denoised on its own, with its own G-buffers.

        Args:
            denoiser: called as ``denoiser(color, albedo=…, normal=…)`` with (H, W, 3) tensors, first of the mean;
                albedo and normal may be of half floats. If its ``dual`` is True, it is called once, as
                ``denoiser.pair(color, albedo=…, normal=…, depth=…, visibility=…)`` with pairs.
            full: also denoise the mean of the halves; with a dual denoiser it is the mean of the denoised halves.

        Sub-images are denoised with the G-buffers of their half; by a dual denoiser as the two halves of that.
        """
        if getattr(denoiser, "dual", False):
            features = {name: getattr(self, name) for name in ("albedo", "normal", "depth", "visibility")}
            pair = cast(_Dual, denoiser).pair(self.color, **features)
            return self.with_denoised(pair, mean(pair) if full else None, self._denoised_sub_images(denoiser))
        inputs = [(h.color, h.albedo, h.normal) for h in self.halves]
        denoised_full = None
        if full:  # first: there is no other denoised image in memory yet
            color, albedo, normal = (None if a is None else mean((a, b)) for a, b in zip(*inputs, strict=True))
            denoised_full = denoiser(color, albedo=albedo, normal=normal)
            del color, albedo, normal
        pair = tuple(denoiser(color, albedo=albedo, normal=normal) for color, albedo, normal in inputs)
        return self.with_denoised(pair, denoised_full, self._denoised_sub_images(denoiser))

    def _denoised_sub_images(self, denoiser: Callable[..., Any]) -> tuple[Any, ...] | None:
        if self.sub_images is None:
            return None
        denoised: list[Any] = []
        for half, pair in zip(self.halves, (self.sub_images[:2], self.sub_images[2:]), strict=True):
            if getattr(denoiser, "dual", False):
                buffers = {name: getattr(half, name) for name in ("albedo", "normal", "depth", "visibility")}
                features = {name: None if buffer is None else (buffer, buffer) for name, buffer in buffers.items()}
                denoised += cast(_Dual, denoiser).pair(pair, **features)
            else:
                denoised += [denoiser(image, albedo=half.albedo, normal=half.normal) for image in pair]
        return tuple(denoised)

    def with_denoised(self, denoised: Pair, denoised_full: Any = None, denoised_sub_images: Any = None) -> "Frame":
        """This frame with these denoised images; its other buffers are not checked again."""
        frame = object.__new__(Frame)
        for name, value in vars(self).items():
            object.__setattr__(frame, name, value)
        object.__setattr__(frame, "repairs", dict(self.repairs))
        frame._set("denoised", denoised)
        if denoised_full is not None:
            frame._set("denoised_full", (denoised_full,))
        if denoised_sub_images is not None:
            frame._set_sub_images("denoised_sub_images", denoised_sub_images)
        return frame

    def to(self, device: str | torch.device) -> "Frame":
        """This frame with all its tensors on ``device``."""
        frame = self.with_denoised(self.denoised) if self.denoised is not None else self
        for name in (*_CHANNELS, "denoised_full", "sub_images", "denoised_sub_images"):
            value = getattr(self, name)
            if isinstance(value, tuple):
                object.__setattr__(frame, name, tuple(tensor.to(device) for tensor in value))
            elif value is not None:
                object.__setattr__(frame, name, value.to(device))
        return frame

    def like_input(self, image: Tensor) -> Any:
        """``image`` as the kind of array, and on the device, that the colour of half a was given in."""
        if isinstance(self._like, Tensor):
            limit = torch.finfo(self._like.dtype).max
            return _at_most(image, limit).to(self._like.device, self._like.dtype)
        limit = float(np.finfo(self._like.dtype).max)
        return _at_most(image, limit).cpu().numpy().astype(self._like.dtype, copy=False)


def mean(pair: Pair) -> Tensor:
    """Mean of both halves, float32; by way of float64, as the sum of two large values may exceed float32."""
    average: Tensor = torch.empty_like(pair[0], dtype=torch.float32)
    for rows in bands(len(average)):
        average[rows] = (pair[0][rows].double() + pair[1][rows].double()) / 2
    return average


def repaired(image: Any, what: str) -> Tensor:
    """An (H, W, 3) array as float32, filled where it is not finite; negative values stay.

    Raises:
        FrameError: it has another shape or no floating-point numbers; ``what`` names it.
    """
    return _repair(_as_tensor(image, what, 3, half=False), radiance=False)[0]


def _names(name: str) -> tuple[str, ...]:
    """What the arrays of a buffer are called."""
    if name == "denoised_full":
        return (name,)
    if name.endswith("sub_images"):
        return tuple(f"{name} of half {half}, {which}" for half in "ab" for which in ("first", "second"))
    return tuple(f"{name} of half {half}" for half in "ab")


def _check_sub_images(half: str, color: Tensor, pair: tuple[Tensor, Tensor]) -> None:
    """Raise where the sub-images have another mean than their half."""
    found = mean(pair)
    differing = ((found - color).abs() > _SUB_IMAGE_TOLERANCE * found.abs() + 1e-6).any(-1)
    share = float(differing.float().mean())
    if share > _SUB_IMAGE_PIXELS:
        raise FrameError(
            f"expected two sub-images whose mean is half {half}, but got others at {share:.0%} of its pixels; "
            "give the two renders of half a, then those of half b"
        )


def _empty_like(array: Any) -> Any:
    """An array of the same kind, without its pixels."""
    return array.new_empty(0) if isinstance(array, Tensor) else np.empty(0, np.asarray(array).dtype)


def _at_most(image: Tensor, limit: float) -> Tensor:
    """Clamped; not copied where there is nothing to do."""
    return image if limit >= torch.finfo(image.dtype).max else image.clamp(max=limit)


def _as_tensor(array: Any, what: str, channels: int, *, half: bool) -> Tensor:
    if isinstance(array, Tensor):
        tensor = array.detach()
    else:
        values = np.asarray(array)
        tensor = torch.from_numpy(np.array(values, dtype=values.dtype.newbyteorder("="), order="C"))
    if not tensor.is_floating_point():
        raise FrameError(f"expected {what} as floating-point numbers, but got {tensor.dtype}")
    if tensor.ndim == 2 and channels == 1:
        tensor = tensor[:, :, None]
    if tensor.ndim != 3 or tensor.shape[2] != channels or 0 in tensor.shape:
        raise FrameError(f"expected {what} of shape (H, W, {channels}), but got {tuple(tensor.shape)}")
    if tensor.dtype == torch.float64:
        # what float32 cannot hold must not turn into an infinity that the render does not have
        largest = torch.finfo(torch.float32).max
        tensor = torch.where(tensor.isfinite(), tensor.clamp(-largest, largest), tensor)
    return tensor if half and tensor.dtype == torch.float16 else tensor.float()


def _check_finite(image: Tensor, what: str) -> None:
    """Raise where a channel of radiance holds too few finite values to be filled from."""
    pixels = image.shape[0] * image.shape[1]
    for channel, broken in zip("RGB", (~image.isfinite()).sum((0, 1)).tolist(), strict=True):
        if broken > _MOST_REPAIRED * pixels:
            raise FrameError(
                f"expected finite radiance at {1 - _MOST_REPAIRED:.0%} of the pixels or more in channel {channel} of "
                f"{what}, but got NaN or infinity at {broken} of {pixels}; render it again"
            )


def _repair(image: Tensor, *, radiance: bool) -> tuple[Tensor, Repairs]:
    finite = image.isfinite()
    broken = int((~finite.all(-1)).sum())
    if broken:
        image = _fill(image.float(), finite).to(image.dtype)
    negative = int((image < 0).any(-1).sum()) if radiance else 0
    if negative:
        image = image.clamp(min=0)
    return image, Repairs(broken, negative)


def _fill(image: Tensor, known: Tensor) -> Tensor:
    """Fill unknown values from those of the channel around them, nearer ones first (push-pull); all unknown gives 0."""
    weight = known.to(image.dtype).permute(2, 0, 1)[None]
    value = torch.where(known, image, 0.0).permute(2, 0, 1)[None]
    filled = _push_pull(value, weight)[0].permute(1, 2, 0)
    return torch.where(known, image, filled)


def _push_pull(value: Tensor, weight: Tensor) -> Tensor:
    """``value`` is already zero where ``weight`` is; returns it with the gaps filled from coarser levels."""
    if min(value.shape[-2:]) == max(value.shape[-2:]) == 1 or bool(weight.all()):
        return value
    coarse_weight = F.avg_pool2d(weight, 2, ceil_mode=True, count_include_pad=False)
    coarse_value = F.avg_pool2d(value, 2, ceil_mode=True, count_include_pad=False)
    known = coarse_weight > 0
    coarse = torch.where(known, coarse_value / coarse_weight.clamp(min=1e-12), 0.0)
    filled = F.interpolate(_push_pull(coarse, known.to(weight.dtype)), size=value.shape[-2:], mode="nearest")
    return torch.where(weight > 0, value, filled)
