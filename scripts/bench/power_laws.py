"""Power laws between measurements: cost over pixels, error over samples. Between them, straight lines in logarithms."""

import math
from collections.abc import Sequence

import numpy as np

from selfcorrect.errors import FrameError

__all__ = ["exponent", "interpolated", "wins_from"]


def exponent(x: Sequence[float], y: Sequence[float]) -> float:
    """The k of y ≈ c·xᵏ, by least squares in logarithms; 1 is growth in proportion. Needs two different x, all > 0."""
    logs_x, logs_y = _logs(x, y)
    if len(set(x)) < 2:
        raise FrameError(f"expected measurements at two different places or more, but got {len(set(x))}")
    centred = logs_x - logs_x.mean()
    return float(centred @ (logs_y - logs_y.mean()) / (centred @ centred))


def interpolated(x: Sequence[float], y: Sequence[float], at: float) -> float:
    """y at a place between two measurements, by the power law through both; beyond them, by that of the nearest two.

    Args:
        x: increasing, > 0, two or more.
        y: > 0, one for each x.
        at: the place, > 0.
    """
    logs_x, logs_y = _logs(x, y)
    if len(x) < 2 or bool((np.diff(logs_x) <= 0).any()) or at <= 0:
        raise FrameError(f"expected two or more increasing places and one above 0 to look at, but got {list(x)}, {at}")
    i = min(max(int(np.searchsorted(logs_x, math.log(at))) - 1, 0), len(x) - 2)
    share = (math.log(at) - logs_x[i]) / (logs_x[i + 1] - logs_x[i])
    return math.exp(logs_y[i] + share * (logs_y[i + 1] - logs_y[i]))


def wins_from(x: Sequence[float], ratio: Sequence[float]) -> float | None:
    """The x from which a ratio stays below 1.

    Returns:
        The crossing between the last measurement that is not below 1 and the next one; the first x where all are below
        1, which says no more than «there or earlier»; None where the last one is not below 1.
    """
    losing = [i for i, value in enumerate(ratio) if value >= 1]
    if not losing:
        return x[0]
    last = losing[-1]
    if last + 1 == len(x):
        return None
    (x0, x1), (r0, r1) = _logs(x[last : last + 2], ratio[last : last + 2])
    return math.exp(x0 + (x1 - x0) * r0 / (r0 - r1))


def _logs(x: Sequence[float], y: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    if len(x) != len(y) or min((*x, *y), default=0.0) <= 0:
        raise FrameError(f"expected as many numbers above 0 on both sides, but got {list(x)} and {list(y)}")
    return np.log(np.asarray(x, np.float64)), np.log(np.asarray(y, np.float64))
