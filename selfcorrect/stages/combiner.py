"""What the stage deep-combiner needs of a network, whichever form its weights have."""

from abc import ABC, abstractmethod

from torch import Tensor

from selfcorrect.stages.weights import TrainedNetwork

__all__ = ["Combiner"]


class Combiner(TrainedNetwork, ABC):
    """Combines pairs of a noisy image y and a denoised image z by weights that it predicts.

    Radiance is linear, of a mean near 1, (N, pairs, 3, H, W); features are normal, albedo and depth in 0 … 1,
    (N, 7, H, W), zeros where a frame has none.

    Attributes:
        pairs: how many.
        window: side of the kernels, pixels.
        reach: pixels that a weight sees on each side.
    """

    pairs: int
    window: int
    reach: int

    @abstractmethod
    def weights(self, noisy: Tensor, denoised: Tensor, features: Tensor, precision: str = "fp32") -> Tensor:
        """What :meth:`combined` takes, (N, …, H, W); precision of the convolutions is "fp32" or "bf16"."""

    @abstractmethod
    def combined(self, weights: Tensor, noisy: Tensor, denoised: Tensor, features: Tensor) -> Tensor:
        """The combined radiance (N, 3, H, W); the images have ``window // 2`` pixels more on every side."""
