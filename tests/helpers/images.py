"""Images for the metrics."""

import numpy as np

SHAPE = (32, 48, 3)


def radiance(seed: int = 0, shape: tuple[int, int, int] = SHAPE) -> np.ndarray:
    return np.random.default_rng(seed).gamma(2.0, 0.25, shape)
