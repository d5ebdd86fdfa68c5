"""The host of a plug-in: it converts, checks, pads and crops, so that no plug-in has to."""

from typing import Any, Protocol, TypeVar, cast

import numpy as np
import torch
from numpy.typing import NDArray

from denoisers import exposure
from denoisers.mirror import mirrored
from selfcorrect.errors import DenoiserError, FrameError

__all__ = ["Denoise", "DualPlugin", "Plugin"]

FEATURES = frozenset({"albedo", "normal"})

Array = NDArray[Any] | torch.Tensor
Pair = tuple[torch.Tensor, torch.Tensor]
Image = TypeVar("Image", NDArray[Any], torch.Tensor)


class Plugin(Protocol):
    """What a denoiser has to be; what it needs is data on it, not code in the host.

    Attributes:
        name: what messages call it.
        multiple: height and width are padded to a multiple of this number of pixels.
        features: those of ``"albedo"`` and ``"normal"`` that it uses; it gets no others.
        prefilter: a method, where the denoiser wants features that were denoised first: it takes albedo and normal as
            :meth:`denoise` does and returns both, finite and of the same shapes. :meth:`denoise` then gets its results.
            The host calls it, so that features are denoised once for all images that go with them.
        reads_only: it leaves its arguments alone, and takes float16 as well as float32: it is spared a copy of them,
            which of a large frame is a gigabyte. By default False.
    """

    name: str
    multiple: int = 1
    features: frozenset[str]

    def denoise(self, color: torch.Tensor, albedo: torch.Tensor | None, normal: torch.Tensor | None) -> torch.Tensor:
        """Return the denoised colour, linear and unclamped.

        Each argument is a contiguous float32 CPU tensor of shape (H, W, 3) that the plug-in may overwrite (see
        ``reads_only``), finite throughout: colour is linear radiance, albedo and normal are as the renderer
        wrote them, or None where the frame has none. The result has the shape of colour and is finite.
        """
        ...


class DualPlugin(Protocol):
    """A denoiser that needs both halves of a frame at once, to know their noise.

    Attributes:
        name, multiple: as for :class:`Plugin`.
        features: those of ``"albedo"``, ``"normal"``, ``"depth"`` and ``"visibility"`` that it uses.
        dual: True.
    """

    name: str
    multiple: int = 1
    features: frozenset[str]
    dual: bool

    def denoise_pair(self, color: Pair, features: dict[str, Pair]) -> Pair:
        """Return the denoised halves, linear and unclamped.

        The arrays are as :meth:`Plugin.denoise` gets them; depth and visibility are (H, W, 1). The first result must be
        made from the first half but for what is pooled over both (variance, a choice of bandwidth): the second is the
        witness that the correction is learned from and judged by.
        """
        ...


class Denoise:
    """A denoiser to call: ``denoise(color, albedo=None, normal=None)``; where ``dual``, ``denoise.pair(…)``."""

    def __init__(self, plugin: Plugin | DualPlugin):
        self.plugin = plugin
        self.name = plugin.name
        self.multiple = getattr(plugin, "multiple", 1)
        self.features = plugin.features
        self.dual: bool = getattr(plugin, "dual", False)
        self._shares = getattr(plugin, "reads_only", False)

    def prefilter(self, albedo: Array | None = None, normal: Array | None = None) -> tuple[Array | None, Array | None]:
        """Albedo and normal as the denoiser wants them, for any number of images that go with them.

        They become CPU tensors, float32, or float16 where they were and the plug-in takes those. A denoiser that wants
        them as they are gets them so.

        Raises:
            FrameError, DenoiserError: as for denoising.
        """
        prefilter = getattr(self.plugin, "prefilter", None)
        given = {"albedo": albedo, "normal": normal}
        there = {name: value for name, value in given.items() if value is not None and name in self.features}
        if prefilter is None or not there:
            return albedo, normal
        size = None
        for name, value in there.items():
            size = _checked_size(name, value, size)
        assert size is not None  # tells the type checker: there is at least one
        pad = self._pad(size)
        padded = {name: mirrored(self._checked(name, value, half=True), **pad) for name, value in there.items()}
        with torch.no_grad():
            results = prefilter(padded.get("albedo"), padded.get("normal"))
        for name, result in zip(given, results, strict=True):
            if name in there:
                self._check_result(result, tuple(padded[name].shape))
                given[name] = result[: size[0], : size[1]].contiguous()
        return given["albedo"], given["normal"]

    def __call__(
        self, color: Image, albedo: Array | None = None, normal: Array | None = None, *, prefiltered: bool = False
    ) -> Image:
        """Denoise one image.

        Args:
            color: (H, W, 3) linear HDR radiance, NumPy or torch, of any float dtype.
            albedo: (H, W, 3) albedo in [0, 1], of either kind, or None.
            normal: (H, W, 3) normal in [-1, 1], of either kind, or None.
            prefiltered: albedo and normal are what :meth:`prefilter` made of them; if not, it is called here.

        Returns:
            (H, W, 3) linear radiance, unclamped, of the kind, dtype and device of ``color``. A value that
            the dtype cannot hold (float16 ends at 65504) becomes the largest that it can.

        Raises:
            FrameError: an array is no (H, W, 3) float array, of another size than ``color``, or not finite.
            DenoiserError: the denoiser failed, or returned another shape or values that are not finite.
        """
        if self.dual:
            raise DenoiserError(f"denoiser {self.name}: expected both halves of a frame, but got a single image")
        size = _checked_size("color", color, None)
        for name, feature in (("albedo", albedo), ("normal", normal)):
            if feature is not None:
                _checked_size(name, feature, size)
        if not prefiltered:
            albedo, normal = self.prefilter(albedo, normal)
        pad = self._pad(size)
        padded: torch.Tensor = mirrored(self._checked("color", color), **pad)
        exponent = exposure.exponent((padded,))
        if exponent is None:
            return _like(color, torch.zeros(*size, 3))
        with torch.no_grad():
            result = cast(Plugin, self.plugin).denoise(
                exposure.shifted(padded, exponent),
                self._feature("albedo", albedo, pad),
                self._feature("normal", normal, pad),
            )
        self._check_result(result, tuple(padded.shape))
        return _like(color, exposure.shifted(result[: size[0], : size[1]], -exponent))

    def pair(self, color: tuple[Image, Image], **features: tuple[Array, Array] | None) -> tuple[Image, Image]:
        """Denoise both halves of a frame with a plug-in that is ``dual``.

        Args:
            color: two (H, W, 3) arrays as for a single image.
            features: albedo, normal (H, W, 3), depth, visibility (H, W, 1), each a pair or None.

        Raises:
            FrameError, DenoiserError: as for a single image.
        """
        if not self.dual:
            raise DenoiserError(f"denoiser {self.name}: expected a single image, but got both halves of a frame")
        height, width = _checked_size("color", color[0], None)
        _checked_size("color", color[1], (height, width))
        given: dict[str, Pair] = {}
        for name, pair in features.items():
            if pair is None or name not in self.features:
                continue
            for feature in pair:
                _checked_size(name, feature, (height, width), channels=1 if name in ("depth", "visibility") else 3)
            given[name] = (_finite(name, _float32(pair[0])), _finite(name, _float32(pair[1])))
        halves = _finite("color", _float32(color[0])), _finite("color", _float32(color[1]))
        exponent = exposure.exponent(halves)
        if exponent is None:
            return _like(color[0], torch.zeros(height, width, 3)), _like(color[1], torch.zeros(height, width, 3))
        lit = exposure.shifted(halves[0], exponent), exposure.shifted(halves[1], exponent)
        with torch.no_grad():
            results = cast(DualPlugin, self.plugin).denoise_pair(lit, given)
        for result in results:
            self._check_result(result, (height, width, 3))
        first, second = (exposure.shifted(result, -exponent) for result in results)
        return _like(color[0], first), _like(color[1], second)

    def __repr__(self) -> str:
        return f"<denoiser {self.name}>"

    def _pad(self, size: tuple[int, int]) -> dict[str, int]:
        return {"bottom": -size[0] % self.multiple, "right": -size[1] % self.multiple}

    def _feature(self, name: str, value: Array | None, pad: dict[str, int]) -> torch.Tensor | None:
        if value is None or name not in self.features:
            return None
        return mirrored(self._checked(name, value, half=True), **pad)

    def _checked(self, name: str, value: Array, *, half: bool = False) -> torch.Tensor:
        """An image as the plug-in takes it; the caller's own memory only where the plug-in leaves that alone."""
        if half and self._shares and isinstance(value, np.ndarray) and value.dtype == np.float16:
            return _finite(name, torch.from_numpy(np.array(value, dtype=np.float16, order="C")))
        shared = self._shares and isinstance(value, torch.Tensor) and value.device.type == "cpu"
        kinds = (torch.float32, torch.float16) if half else (torch.float32,)
        if not (shared and isinstance(value, torch.Tensor) and value.dtype in kinds):
            return _finite(name, _float32(value))
        return _finite(name, value.detach().contiguous())

    def _check_result(self, result: object, shape: tuple[int, ...]) -> None:
        """Refuse by name what a plug-in must not return."""
        expected = f"denoiser {self.name}: expected a finite float tensor of shape {shape}, but got"
        if not isinstance(result, torch.Tensor) or not result.is_floating_point():
            got = result.dtype if isinstance(result, torch.Tensor) else type(result).__name__
            raise DenoiserError(f"{expected} {got}")
        if result.shape != shape:
            raise DenoiserError(f"{expected} {tuple(result.shape)}")
        bad = int((~torch.isfinite(result)).sum())
        if bad:
            raise DenoiserError(f"{expected} {bad} of {result.numel()} values that are NaN or infinite")


def _checked_size(name: str, value: object, expected: tuple[int, int] | None, channels: int = 3) -> tuple[int, int]:
    """Return (H, W) of an image that is a float array of so many channels and of the expected size."""
    size = "H, W" if expected is None else f"{expected[0]}, {expected[1]}"
    wanted = f"{name}: expected a NumPy or torch float array of shape ({size}, {channels}), but got"
    if isinstance(value, torch.Tensor):
        floating = value.is_floating_point()
    elif isinstance(value, np.ndarray):
        floating = np.issubdtype(value.dtype, np.floating)
    else:
        raise FrameError(f"{wanted} {type(value).__name__}")
    if not floating:
        raise FrameError(f"{wanted} {value.dtype}")
    shape = tuple(value.shape)
    if len(shape) != 3 or shape[2] != channels or 0 in shape or (expected and shape[:2] != expected):
        raise FrameError(f"{wanted} {shape}")
    return shape[0], shape[1]


def _float32(value: Array) -> torch.Tensor:
    """Copy an image to a contiguous float32 CPU tensor."""
    if isinstance(value, torch.Tensor):
        return value.detach().to("cpu", torch.float32, copy=True, memory_format=torch.contiguous_format)
    with np.errstate(over="ignore"):  # what float32 cannot hold is reported by who calls
        return torch.from_numpy(np.array(value, dtype=np.float32, order="C"))


def _finite(name: str, tensor: torch.Tensor) -> torch.Tensor:
    bad = int((~torch.isfinite(tensor)).sum())
    if bad:
        raise FrameError(f"{name}: expected finite values, but got {bad} that are not in float32; repair them first")
    return tensor


def _like(color: Image, result: torch.Tensor) -> Image:
    """Copy a result to the kind, dtype and device of the colour it was made from."""
    numbers = torch.finfo(color.dtype) if isinstance(color, torch.Tensor) else np.finfo(color.dtype)
    limit = min(float(numbers.max), torch.finfo(torch.float32).max)
    held = result.detach().to("cpu", torch.float32).clamp(-limit, limit).contiguous()
    if isinstance(color, torch.Tensor):
        return held.to(color.device, color.dtype)
    return held.numpy().astype(color.dtype, copy=False)
