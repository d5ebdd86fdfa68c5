"""The deep combiner with four buffers: the frame's four independent renders combined by one kernel (Back et al. 2020).

The four are images of their own, beyond the frame's halves: two whose mean is half a, and two whose mean is half b.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import torch
from torch import Tensor

from selfcorrect.buffers import COLOR, FEATURES
from selfcorrect.errors import FrameError
from selfcorrect.frame import DualDenoiser, Frame, checked, mean, prefiltered
from selfcorrect.image.repair import Repairs
from selfcorrect.settings import EXTRA_FLAGS, Settings
from selfcorrect.stages.deep_combiner import DeepCombinerStage, opened_network
from selfcorrect.stages.images import StageImages
from selfcorrect.stages.stage import Extra, Work

__all__ = ["DeepCombiner4", "SubImages"]

_NAMES = [f"sub_images of half {half}, {which}" for half in "ab" for which in ("first", "second")]
_TOLERANCE = 5e-3  # of radiance: half floats round to 1/2048, and a mean of such again
_PIXELS = 0.01  # share that may differ: what was repaired, or lay beyond half floats


@dataclass(frozen=True, eq=False)
class SubImages:
    """Four renders with seeds of their own, the first two of them with half a as their mean, the others with half b.

    Attributes:
        images: (H, W, 3) linear radiance ≥ 0 each.
        repairs: how many pixels were NaN, infinite or negative.
        denoised: the same, each denoised on its own; None before :meth:`denoise`.
    """

    images: tuple[Tensor, ...]
    repairs: dict[str, Repairs]
    denoised: tuple[Tensor, ...] | None = None

    @classmethod
    def of(cls, frame: Frame, arrays: Sequence[Any]) -> "SubImages":
        """The four of this frame, NumPy or torch.

        Raises:
            FrameError: there are not four, a size differs, or a half is not the mean of its two.
        """
        if not isinstance(arrays, (tuple, list)) or len(arrays) != 4:
            got = len(arrays) if isinstance(arrays, (tuple, list)) else type(arrays).__name__
            raise FrameError(f"expected sub_images as four arrays (two of half a, two of half b), but got {got}")
        images, repairs = checked(COLOR, tuple(arrays), _NAMES, frame.size)
        for half, color, pair in zip("ab", frame.color, (images[:2], images[2:]), strict=True):
            _check_mean(half, color, pair)
        return cls(images, {"sub_images": repairs})

    def denoise(self, frame: Frame, denoiser: Callable[..., Any]) -> "SubImages":
        """These, denoised with the G-buffers of their half; by a dual denoiser as the two halves of that."""
        denoised: list[Any] = []
        a, b, c, d = self.images
        for half, pair in zip(frame.halves, ((a, b), (c, d)), strict=True):
            if getattr(denoiser, "dual", False):
                buffers = {buffer.name: getattr(half, buffer.name) for buffer in FEATURES}
                features = {name: None if value is None else (value, value) for name, value in buffers.items()}
                denoised += cast(DualDenoiser, denoiser).pair(pair, **features)
            else:
                guides = prefiltered(denoiser, half.albedo, half.normal)
                denoised += [denoiser(image, **guides) for image in pair]
        names = [f"denoised_{name}" for name in _NAMES]
        images, repairs = checked(COLOR, tuple(denoised), names, frame.size)
        return replace(self, denoised=images, repairs=self.repairs | {"denoised_sub_images": repairs})

    def to(self, device: str | torch.device) -> "SubImages":
        """These with all their tensors on ``device``."""
        images = tuple(image.to(device) for image in self.images)
        denoised = None if self.denoised is None else tuple(image.to(device) for image in self.denoised)
        return replace(self, images=images, denoised=denoised)


def _check_mean(half: str, color: Tensor, pair: tuple[Tensor, ...]) -> None:
    """Raise where the sub-images have another mean than their half."""
    found = mean((pair[0], pair[1]))
    differing = ((found - color).abs() > _TOLERANCE * found.abs() + 1e-6).any(-1)
    share = float(differing.float().mean())
    if share > _PIXELS:
        raise FrameError(
            f"expected two sub-images whose mean is half {half}, but got others at {share:.0%} of its pixels; "
            "give the two renders of half a, then those of half b"
        )


class DeepCombiner4(DeepCombinerStage):
    """The full image from four sub-images with one kernel over all (Eq. 14); each half as deep-combiner's."""

    name = "deep-combiner-4"
    first_only = True
    extra = Extra(*EXTRA_FLAGS["deep-combiner-4"], of=SubImages.of)

    def __init__(self, settings: Settings):
        super().__init__(settings)
        self.network_4 = opened_network(self.name, settings, "combiner_4_weights", "deep-combiner-4", pairs=4)

    def full(self, state: StageImages, work: Work) -> Tensor:
        """Of the four.

        Raises:
            FrameError: there are none, or they are not denoised.
        """
        given = work.extra
        if not isinstance(given, SubImages) or given.denoised is None:
            got = "such as are not denoised; call sub_images.denoise(frame, denoiser)" if given else "none"
            raise FrameError(f"expected four denoised sub-images for the stage {self.name}, but got {got}")
        return self.combined(self.network_4, given.images, given.denoised, state.halves, state.scale)
