"""What was gained, in a sentence."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["KEPT", "SHARED", "change", "closing", "luminance", "number", "percent", "summary", "where"]

KEPT = "Kept the denoised image: the two halves do not agree that the correction is better"
SHARED = "Kept the denoised image: the two halves share their noise and cannot judge; use another seed for one"

_REC_709 = (0.2126, 0.7152, 0.0722)
_STOP = 2.0  # how far from the frame's usual radiance shadows and highlights begin
_MOST = 0.5  # of the gain


def summary(estimate: Mapping[str, Any] | None, place: str = "") -> str:
    """ "Error about 31 % lower, mostly in the highlights", from the guard's estimate and :func:`where`."""
    if estimate is None:
        return "No estimate of the error"
    if not estimate.get("independent", True):
        return SHARED
    if not estimate["improved"]:
        return KEPT
    gain = -100 * estimate["change"]
    amount = f"about {gain:.0f} % lower" if gain >= 0.5 else "less than 1 % lower"
    return f"Error {amount}" + (f", {place}" if place else "")


def closing(estimate: Mapping[str, Any], place: str = "") -> str:
    """The same as the last words of a run, with the numbers behind them."""
    words = summary(estimate, place)
    told = f"{words[0].lower()}{words[1:]}"
    if not estimate.get("independent", True):
        return told
    before, after = (f"{estimate[name]:.3g}" for name in ("denoised", "corrected"))
    if not estimate["improved"]:
        return f"{told} (relMSE ≈ {before})"
    share, deviation = 100 * estimate["change"], 100 * estimate["standard_error"]
    return f"{told} (relMSE ≈ {before} → {after}, {share:+.0f} ± {deviation:.0f} %)"


def where(denoised: Any, before: Any, after: Any) -> str:
    """Which tones gained most: "mostly in the highlights", or "all over the frame"; empty where nothing was gained.

    Args:
        denoised: linear radiance, (H, W, 3).
        before: relative squared error of it, (H, W).
        after: the same of the output.

    Shadows and highlights lie more than a stop below and above the frame's geometric mean.
    """
    tone = np.log(np.maximum(luminance(denoised), 1e-4))
    stops = (tone - tone.mean()) / math.log(_STOP)
    gain = np.asarray(before, dtype=np.float64) - np.asarray(after, dtype=np.float64)
    whole = gain.sum()
    if not whole > 0:
        return ""
    tones = {"shadows": stops < -1, "mid-tones": np.abs(stops) <= 1, "highlights": stops > 1}
    name, share = max(((name, gain[those].sum() / whole) for name, those in tones.items()), key=lambda pair: pair[1])
    return f"mostly in the {name}" if share > _MOST else "all over the frame"


def luminance(image: Any) -> NDArray[np.float64]:
    """Of linear radiance (H, W, 3) with Rec. 709 primaries."""
    weighted: NDArray[np.float64] = np.asarray(image, dtype=np.float64) @ np.array(_REC_709)
    return weighted


def change(after: float, before: float) -> str:
    """ "−31 %"."""
    if not (before > 0 and math.isfinite(after)):
        return "–"
    return percent(after / before - 1)


def percent(ratio: float) -> str:
    """A signed share in per cent."""
    text = f"{100 * ratio:+.0f} %"
    return text.replace("-", "−")


def number(value: Any) -> str:
    """A value as a table shows it."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    return str(value)
