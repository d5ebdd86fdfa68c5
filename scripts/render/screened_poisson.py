"""An image from its values and its neighbours' differences (L2 screened Poisson)."""

from typing import Any

import numpy as np

ALPHA = 0.2  # weight of the values against the gradients, as in gradient-domain path tracing (Kettunen et al. 2015)


def screened_poisson(
    values: np.ndarray[Any, Any], differences: np.ndarray[Any, Any], alpha: float = ALPHA
) -> np.ndarray[Any, Any]:
    """The image I that minimises α² ‖I − values‖² + ‖∇I − ∇differences‖², (H, W, C).

    ``differences`` is an image whose neighbours' differences are to be kept. With mirrored borders the normal equations
    (α² − Δ) I = α² values − Δ differences are diagonal in the cosine transform, here by an FFT of the mirrored image.
    """
    excess = values.astype(np.float64) - differences
    height, width = excess.shape[:2]
    mirrored = np.concatenate([excess, excess[::-1]])
    mirrored = np.concatenate([mirrored, mirrored[:, ::-1]], 1)
    rows, columns = (2 - 2 * np.cos(2 * np.pi * np.fft.fftfreq(2 * n)) for n in (height, width))
    factor = alpha**2 / (alpha**2 + rows[:, None, None] + columns[None, :, None])
    smooth = np.fft.ifft2(np.fft.fft2(mirrored, axes=(0, 1)) * factor, axes=(0, 1)).real
    return np.asarray((differences + smooth[:height, :width]).astype(values.dtype))
