"""The stages as steps from one state of a frame to the next, so that they compose in any order.

A step gives halves and a full image, as it was given. Its half a is made from half a alone, so that half b stays its
witness, for the core's loss and for the guard behind the last step. The full image may use both halves. Where the two
need different formulas, the halves' is the poorer one and the guard errs on the safe side.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from selfcorrect.frame import Half, mean
from selfcorrect.image.exposure import Scaled, scaled
from selfcorrect.settings import Settings
from selfcorrect.stages import james_stein as js
from selfcorrect.stages import regression, tiled, weights
from selfcorrect.stages.deep_combiner import DeepCombiner, feature_planes

__all__ = [
    "StageImages",
    "SubImage",
    "deep_combiner",
    "deep_combiner_4",
    "james_stein",
    "neural_james_stein",
    "regress",
]

_BUFFERS = ("albedo", "normal", "visibility", "depth")


class SubImage(NamedTuple):
    """One of the frame's four independent renders, (H, W, 3), as it was rendered and denoised."""

    color: Tensor
    denoised: Tensor


class StageImages(NamedTuple):
    """What a step takes and gives.

    Attributes:
        halves: buffers of both halves; ``denoised`` is what the steps so far have made of them.
        full: the image so far, of both halves, (H, W, 3).
        scale: what brings radiance to a mean near 1, where the methods' constants mean what they meant.
        sub_images: the four that the halves are means of, two of half a and two of half b; none where none are given.
    """

    halves: tuple[Half, Half]
    full: Tensor
    scale: float = 1.0
    sub_images: tuple[SubImage, ...] = ()

    @property
    def images(self) -> tuple[Tensor, Tensor]:
        """The halves' images so far."""
        a, b = (half.denoised for half in self.halves)
        if a is None or b is None:
            raise ValueError("expected halves with denoised images, but got none")
        return a, b

    @property
    def color(self) -> tuple[Tensor, Tensor]:
        """The halves' noisy radiance."""
        return self.halves[0].color, self.halves[1].color

    @property
    def scaled_color(self) -> tuple[Scaled, Scaled]:
        """The noisy radiance times ``scale``, made where it is read."""
        return Scaled(self.halves[0].color, self.scale), Scaled(self.halves[1].color, self.scale)

    @property
    def scaled_images(self) -> tuple[Scaled, Scaled]:
        """The halves' images so far, times ``scale``, made where they are read."""
        return Scaled(self.images[0], self.scale), Scaled(self.images[1], self.scale)

    def then(self, images: tuple[Tensor, Tensor], full: Tensor) -> "StageImages":
        """The state after a step that gave these images."""
        a, b = (half._replace(denoised=image) for half, image in zip(self.halves, images, strict=True))
        return self._replace(halves=(a, b), full=full)

    def scaled(self) -> "StageImages":
        """The state with radiance times ``scale``, and bounded so that squares stay finite."""

        def one(half: Half, color: Scaled, image: Scaled) -> Half:
            # the G-buffers may be half floats
            features = {name: None if (b := getattr(half, name)) is None else b.float() for name in _BUFFERS}
            return half._replace(color=color[:], denoised=image[:], **features)

        a, b = (one(*each) for each in zip(self.halves, self.scaled_color, self.scaled_images, strict=True))
        return StageImages((a, b), Scaled(self.full, self.scale)[:])


def regress(state: StageImages, settings: Settings) -> StageImages:
    """Each half fitted by features of its own; the full image is the mean of the cross-buffer fits (Eqs. 10–12).

    A cross-buffer fit knows its witness through the other half's denoised image. The covariance with the witness's
    noise, over its variance, was 0.006 with OIDN and 0.03 with joint-bilateral, as much as the fit's whole error.
    """
    options = {"stride": settings.regression_stride, "threads": torch.get_num_threads()}
    halves = state.scaled().halves
    a, b = (scaled(image, 1 / state.scale) for image in regression.own_buffer_regression(halves, **options))
    crossed = regression.cross_buffer_regression(halves, **options)
    return state.then((a, b), scaled(mean(crossed), 1 / state.scale))


def james_stein(state: StageImages, settings: Settings) -> StageImages:
    """Each half and the full image shrunk from the noisy radiance towards what the steps so far have made (Eq. 13).

    Where a half's noise is large is told by both halves, (y^a − y^b)² / 2, but only as a mean over a block: see
    ``tests/test_stages.py`` for how little the half thereby knows of its witness.
    """
    work = state.scaled()
    variance = js.variance_of_mean(work.color)

    def shrunk(noisy: Tensor, image: Tensor, variance: Tensor) -> Tensor:
        return scaled(js.james_stein(noisy, image, variance, js.relative_weight(noisy)), 1 / state.scale)

    a, b = (shrunk(noisy, image, 2 * variance) for noisy, image in zip(work.color, work.images, strict=True))
    return state.then((a, b), shrunk(mean(work.color), work.full, variance))


def neural_james_stein(state: StageImages, settings: Settings) -> StageImages:
    """The James–Stein step with a trained network for the variance's smoothing and the mix of two images.

    The mix ``α y^A + (1 − α) y^B`` is of the halves' images so far, for the full image. What that image so far has
    beyond their mean, such as that it was denoised whole, is added to both. A half must not lean on the image of the
    other: there, both are its own image.
    """
    work, network = state.scaled(), weights.variance_network(settings)
    variance = js.variance_of_mean(work.color)

    def shrunk(noisy: Tensor, variance: Tensor, y_a: Tensor, y_b: Tensor) -> Tensor:
        theta = tiled.neural_james_stein(network, noisy, variance, y_a, y_b, precision=settings.precision)
        return scaled(theta, 1 / state.scale)

    a, b = (shrunk(noisy, 2 * variance, y, y) for noisy, y in zip(work.color, work.images, strict=True))
    beyond = work.full - mean(work.images)
    full = shrunk(mean(work.color), variance, *(image + beyond for image in work.images))
    return state.then((a, b), full)


def deep_combiner(state: StageImages, settings: Settings) -> StageImages:
    """Each half combined with its image so far, and the mean of both with the full image so far (Eq. 8)."""
    network = weights.combiner(settings)
    full = _combined(network, (mean(state.color),), (state.full,), state.halves, state.scale, settings)
    return state.then(_combined_halves(network, state, settings), full)


def deep_combiner_4(state: StageImages, settings: Settings) -> StageImages:
    """The full image from four sub-images with one kernel over all (Eq. 14); each half as :func:`deep_combiner`'s."""
    noisy, denoised = zip(*state.sub_images, strict=True)
    network = weights.combiner(settings, pairs=len(noisy))
    full = _combined(network, noisy, denoised, state.halves, state.scale, settings)
    return state.then(_combined_halves(weights.combiner(settings), state, settings), full)


def _combined_halves(network: DeepCombiner, state: StageImages, settings: Settings) -> tuple[Tensor, Tensor]:
    """Each half by what belongs to it alone."""
    a, b = (
        _combined(network, (half.color,), (image,), (half,), state.scale, settings)
        for half, image in zip(state.halves, state.images, strict=True)
    )
    return a, b


def _combined(
    network: DeepCombiner,
    noisy: Sequence[Tensor],
    denoised: Sequence[Tensor],
    halves: Sequence[Half],
    scale: float,
    settings: Settings,
) -> Tensor:
    """The combiner's image, with the G-buffers of one half, or the mean of those of both."""

    def buffer(name: str) -> Tensor | None:
        buffers = [getattr(half, name) for half in halves]
        return None if buffers[0] is None else mean((buffers[0], buffers[-1]))

    size = (noisy[0].shape[0], noisy[0].shape[1])
    features = feature_planes(size, normal=buffer("normal"), albedo=buffer("albedo"), depth=buffer("depth"))
    return tiled.combine(network, noisy, denoised, features, scale=scale, precision=settings.precision)
