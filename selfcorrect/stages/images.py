"""The state of a frame between two stages."""

from typing import NamedTuple

from torch import Tensor

from selfcorrect.frame import Candidate, Half
from selfcorrect.image.exposure import Scaled

__all__ = ["StageImages"]


class StageImages(NamedTuple):
    """What a stage takes and gives.

    Attributes:
        halves: buffers of both halves; ``denoised`` is what the stages so far have made of them.
        full: the image so far, of both halves, (H, W, 3).
        scale: what brings radiance to a mean near 1, where the methods' constants mean what they meant.
    """

    halves: tuple[Half, Half]
    full: Tensor
    scale: float = 1.0

    @classmethod
    def of(cls, halves: tuple[Half, Half], candidate: Candidate, scale: float) -> "StageImages":
        """The state that a candidate image is."""
        return cls(halves, candidate.full, scale).then(candidate.halves, candidate.full)

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
        """The state after a stage that gave these images."""
        a, b = (half._replace(denoised=image) for half, image in zip(self.halves, images, strict=True))
        return self._replace(halves=(a, b), full=full)

    def scaled(self) -> "StageImages":
        """The state with radiance times ``scale``, and bounded so that squares stay finite."""

        def one(half: Half, color: Scaled, image: Scaled) -> Half:
            features = {name: feature.float() for name, feature in half.features.items()}  # may be half floats
            return Half(color[:], image[:], **features)

        a, b = (one(*each) for each in zip(self.halves, self.scaled_color, self.scaled_images, strict=True))
        return StageImages((a, b), Scaled(self.full, self.scale)[:])
