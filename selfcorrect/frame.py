"""The half buffers of one frame: shapes and values are checked and repaired once, here."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, cast

import numpy as np
import torch
from torch import Tensor

from selfcorrect.buffers import BUFFERS, COLOR, DENOISED, FEATURES, Buffer
from selfcorrect.errors import FrameError
from selfcorrect.image.bands import in_bands
from selfcorrect.image.repair import Repairs, as_tensor, check_finite, repair

__all__ = ["Candidate", "DualDenoiser", "Frame", "Half", "checked", "mean", "prefiltered"]

Pair = tuple[Any, Any]
Aids = tuple[Mapping[str, Any], Mapping[str, Any], Mapping[str, Any]]
_DENOISED_FULL = "denoised_full"


class Half(NamedTuple):
    """The buffers of one half, (H, W, C) like the frame's; None where the frame has no such buffer."""

    color: Tensor
    denoised: Tensor | None = None
    albedo: Tensor | None = None
    normal: Tensor | None = None
    visibility: Tensor | None = None
    depth: Tensor | None = None
    motion: Tensor | None = None

    @property
    def features(self) -> dict[str, Tensor]:
        """The G-buffers that there are, by name."""
        values = {buffer.name: getattr(self, buffer.name) for buffer in FEATURES}
        return {name: value for name, value in values.items() if value is not None}


class Candidate(NamedTuple):
    """What the output may be made of: an image of the frame, and the same made of each half alone.

    Attributes:
        name: what the log calls it.
        halves: (H, W, 3) linear radiance ≥ 0 each. Half a's may not know half b, which is its witness.
        full: the same of both halves together.
    """

    name: str
    halves: tuple[Tensor, Tensor]
    full: Tensor


class DualDenoiser(Protocol):
    """A denoiser that takes both halves at once."""

    def pair(self, color: Pair, **features: Pair | None) -> Pair:
        """The denoised halves."""
        ...


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
        more: further images of the frame that the guard may blend in, finite and ≥ 0.
        motion: 4 channels (:data:`selfcorrect.buffers.MOTION`), for the history of a shot's frames; what is NaN or
            infinite is unknown and stays so.
        neighbours: the frames around it in a shot, by distance in frames (−1 is the one before), whose samples
            :func:`selfcorrect.correct` lets the guard take; :func:`selfcorrect.correct_sequence` finds them itself.

    Attributes:
        aids: what the denoiser was given beside the colours of both halves together, of half a and of half b, where
            :meth:`denoise` was asked to keep it.
        seen: (H, W, halves), how far the noisy halves of neighbouring frames lie above what is usual where they show a
            pixel's surface, by the mean of the channels; None without neighbours.

    Raises:
        FrameError: sizes or channel counts do not fit, a channel of radiance is NaN or infinite at more than half of
            its pixels, or a neighbour is no other frame.
    """

    color: Pair
    denoised: Pair | None = None
    albedo: Pair | None = None
    normal: Pair | None = None
    visibility: Pair | None = None
    depth: Pair | None = None
    denoised_full: Any = None
    more: tuple[Candidate, ...] = ()
    motion: Pair | None = None
    neighbours: "Mapping[int, Frame]" = field(default_factory=dict)
    repairs: dict[str, Repairs] = field(init=False, default_factory=dict)
    constant: list[str] = field(init=False, default_factory=list)
    aids: "Aids | None" = field(init=False, default=None)
    seen: Tensor | None = field(init=False, default=None)
    _like: Any = field(init=False, repr=False, default=None)

    def __post_init__(self) -> None:
        for buffer in BUFFERS:
            pair = getattr(self, buffer.name)
            if pair is None and buffer is not COLOR:
                continue
            if not isinstance(pair, (tuple, list)) or len(pair) != 2:
                got = type(pair).__name__
                raise FrameError(f"expected {buffer.name} as a pair of arrays (half a, half b), but got {got}")
            if buffer is COLOR:
                object.__setattr__(self, "_like", _empty_like(pair[0]))
            self._set(buffer, tuple(pair))
        if self.denoised_full is not None:
            self._set_full(self.denoised_full)
        for candidate in self.more:
            for image in (*candidate.halves, candidate.full):
                if tuple(image.shape) != (*self.size, 3):
                    raise FrameError(
                        f"expected the candidate {candidate.name} of shape {(*self.size, 3)}, "
                        f"but got {tuple(image.shape)}"
                    )
        for distance, neighbour in self.neighbours.items():
            _check_neighbour(distance, neighbour)

    def _set(self, buffer: Buffer, arrays: tuple[Any, ...]) -> None:
        """Check, repair and store the pair of one buffer."""
        names = [f"{buffer.name} of half {half}" for half in "ab"]
        size = None if buffer is COLOR else self.size
        tensors, self.repairs[buffer.name] = checked(buffer, arrays, names, size)
        if buffer in FEATURES and all(bool((tensor == tensor[0, 0]).all()) for tensor in tensors):
            self.constant.append(buffer.name)
            object.__setattr__(self, buffer.name, None)
        else:
            object.__setattr__(self, buffer.name, tensors)

    def _set_full(self, array: Any) -> None:
        (tensor,), self.repairs[_DENOISED_FULL] = checked(COLOR, (array,), [_DENOISED_FULL], self.size)
        object.__setattr__(self, _DENOISED_FULL, tensor)

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        height, width, _ = self.color[0].shape
        return height, width

    @property
    def halves(self) -> tuple[Half, Half]:
        """Half a and half b."""

        def one(i: int) -> Half:
            pairs = {buffer.name: getattr(self, buffer.name) for buffer in BUFFERS}
            own: dict[str, Any] = {name: None if pair is None else pair[i] for name, pair in pairs.items()}
            return Half(**own)

        return one(0), one(1)

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """The images to correct: first the denoised one, which the output must not be worse than.

        Raises:
            FrameError: the frame has no denoised halves.
        """
        if self.denoised is None:
            raise FrameError("expected a frame with denoised halves, but got none; call frame.denoise(denoiser) first")
        full = mean(self.denoised) if self.denoised_full is None else self.denoised_full
        return Candidate("denoised", self.denoised, full), *self.more

    def denoise(self, denoiser: Callable[..., Any], *, full: bool = True, keep_aids: bool = False) -> "Frame":
        """This frame with each half denoised on its own, with its own G-buffers; and its neighbours alike.

        Args:
            denoiser: called as ``denoiser(color, albedo=…, normal=…)`` with (H, W, 3) tensors, first of the mean;
                albedo and normal may be of half floats. If its ``dual`` is True, it is called once, as
                ``denoiser.pair(color, albedo=…, normal=…, depth=…, visibility=…)`` with pairs. If it has a method
                ``prefilter``, that is called as in :func:`prefiltered`.
            full: also denoise the mean of the halves; with a dual denoiser it is the mean of the denoised halves.
            keep_aids: keep what the denoiser was given beside the colours, for more to be denoised alike; a dual
                denoiser leaves nothing to keep.
        """
        around = {
            n: frame if frame.denoised is not None else frame.denoise(denoiser, full=full, keep_aids=keep_aids)
            for n, frame in self.neighbours.items()
        }
        if getattr(denoiser, "dual", False):
            features = {buffer.name: getattr(self, buffer.name) for buffer in FEATURES}
            pair = cast(DualDenoiser, denoiser).pair(self.color, **features)
            return self.with_denoised(pair, mean(pair) if full else None)._with_neighbours(around)
        source = (self.with_aids(denoiser) if keep_aids else self)._with_neighbours(around)

        def one(part: int, color: Tensor) -> Any:
            return denoiser(color, **(source.aids[part] if source.aids else source._aids(denoiser, part)))

        # first of both halves together: there is no other denoised image in memory yet
        denoised_full = one(0, mean(self.color)) if full else None
        return source.with_denoised((one(1, self.color[0]), one(2, self.color[1])), denoised_full)

    def with_aids(self, denoiser: Callable[..., Any]) -> "Frame":
        """This frame with what the denoiser is given beside the colours, for images that are to be denoised later."""
        frame = self._copy()
        object.__setattr__(frame, "aids", tuple(self.aids_for(denoiser)))
        return frame

    def aids_for(self, denoiser: Callable[..., Any]) -> Iterator[dict[str, Any]]:
        """What a denoiser is given beside the colour of both halves together, of half a and of half b, one by one."""
        return (self._aids(denoiser, part) for part in (0, 1, 2))

    def _aids(self, denoiser: Callable[..., Any], part: int) -> dict[str, Any]:
        """What goes with the colour of both halves together, 0, or of half a or b, 1 or 2."""
        pairs = (self.albedo, self.normal)
        albedo, normal = (None if p is None else p[part - 1] if part else mean(p) for p in pairs)
        return prefiltered(denoiser, albedo, normal)

    def with_denoised(self, denoised: Pair, denoised_full: Any = None) -> "Frame":
        """This frame with these denoised images; its other buffers are not checked again."""
        frame = self._copy()
        frame._set(DENOISED, denoised)
        if denoised_full is not None:
            frame._set_full(denoised_full)
        return frame

    def with_candidate(self, candidate: Candidate) -> "Frame":
        """This frame with one candidate more."""
        frame = self._copy()
        object.__setattr__(frame, "more", (*self.more, candidate))
        return frame

    def with_seen(self, seen: Tensor) -> "Frame":
        """This frame with what neighbouring frames have met of it."""
        frame = self._copy()
        object.__setattr__(frame, "seen", seen)
        return frame

    def _with_neighbours(self, neighbours: "Mapping[int, Frame]") -> "Frame":
        frame = self._copy()
        object.__setattr__(frame, "neighbours", neighbours)
        return frame

    def to(self, device: str | torch.device) -> "Frame":
        """This frame with all its tensors on ``device``; its neighbours stay where they are."""
        frame = self._copy()
        if self.seen is not None:
            object.__setattr__(frame, "seen", self.seen.to(device))
        for buffer in BUFFERS:
            if (pair := getattr(self, buffer.name)) is not None:
                object.__setattr__(frame, buffer.name, tuple(tensor.to(device) for tensor in pair))
        if self.denoised_full is not None:
            object.__setattr__(frame, _DENOISED_FULL, self.denoised_full.to(device))
        moved = [
            Candidate(c.name, (c.halves[0].to(device), c.halves[1].to(device)), c.full.to(device)) for c in self.more
        ]
        object.__setattr__(frame, "more", tuple(moved))
        object.__setattr__(frame, "aids", None)  # denoisers have had them
        return frame

    def _copy(self) -> "Frame":
        frame = object.__new__(Frame)
        for name, value in vars(self).items():
            object.__setattr__(frame, name, value)
        object.__setattr__(frame, "repairs", dict(self.repairs))
        return frame

    def like_input(self, image: Tensor) -> Any:
        """``image`` as the kind of array, and on the device, that the colour of half a was given in."""
        if isinstance(self._like, Tensor):
            limit = torch.finfo(self._like.dtype).max
            return _at_most(image, limit).to(self._like.device, self._like.dtype)
        limit = float(np.finfo(self._like.dtype).max)
        return _at_most(image, limit).cpu().numpy().astype(self._like.dtype, copy=False)


def _check_neighbour(distance: int, neighbour: object) -> None:
    if not distance or not isinstance(neighbour, Frame):
        got = f"{type(neighbour).__name__} at {distance}"
        raise FrameError(f"expected neighbours as frames by their distance, such as -1 and 1, but got {got}")


def mean(pair: Pair) -> Tensor:
    """Mean of both halves, float32; by way of float64, as the sum of two large values may exceed float32."""
    average: Tensor = torch.empty_like(pair[0], dtype=torch.float32)

    def halve(rows: slice) -> None:
        average[rows] = (pair[0][rows].double() + pair[1][rows].double()) / 2

    in_bands(len(average), halve)
    return average


def prefiltered(denoiser: Callable[..., Any], albedo: Any, normal: Any) -> dict[str, Any]:
    """What a denoiser is called with beside a colour, for any number of images that these G-buffers go with.

    A denoiser that wants its G-buffers denoised first has a method ``prefilter`` that takes albedo and normal, either
    or both None, and returns both; it is then called with ``prefiltered=True``.
    """
    prefilter = getattr(denoiser, "prefilter", None)
    if prefilter is None:
        return {"albedo": albedo, "normal": normal}
    albedo, normal = prefilter(albedo, normal)
    return {"albedo": albedo, "normal": normal, "prefiltered": True}


def checked(
    buffer: Buffer, arrays: tuple[Any, ...], names: list[str], size: tuple[int, int] | None
) -> tuple[tuple[Tensor, ...], Repairs]:
    """Arrays that hold a buffer, as finite tensors of one size, and how many pixels were repaired.

    Args:
        buffer: which.
        arrays: NumPy or torch, (H, W, C).
        names: what messages call each.
        size: height and width to have; None takes those of the first.

    Raises:
        FrameError: a size or channel count does not fit, or a channel of radiance is hardly finite.
    """
    tensors, counts = [], Repairs(0, 0)
    for what, array in zip(names, arrays, strict=True):
        tensor = as_tensor(array, what, buffer.channels, half=buffer.kind != "radiance")
        if size is not None and tensor.shape[:2] != size:
            raise FrameError(
                f"expected {what} of {size[1]}x{size[0]} pixels like the colour of half a, "
                f"but got {tensor.shape[1]}x{tensor.shape[0]}"
            )
        size = (tensor.shape[0], tensor.shape[1])
        if buffer.kind == "radiance":
            check_finite(tensor, what)
        if buffer.kind == "motion":  # what would be filled in is no motion of that surface
            infinite = tensor.isinf()
            tensors.append(torch.where(infinite, torch.nan, tensor) if bool(infinite.any()) else tensor)
            continue
        tensor, repairs = repair(tensor, radiance=buffer.kind == "radiance")
        tensors.append(tensor)
        counts = Repairs(*(x + y for x, y in zip(counts, repairs, strict=True)))
    return tuple(tensors), counts


def _empty_like(array: Any) -> Any:
    """An array of the same kind, without its pixels."""
    return array.new_empty(0) if isinstance(array, Tensor) else np.empty(0, np.asarray(array).dtype)


def _at_most(image: Tensor, limit: float) -> Tensor:
    """Clamped; not copied where there is nothing to do."""
    return image if limit >= torch.finfo(image.dtype).max else image.clamp(max=limit)
