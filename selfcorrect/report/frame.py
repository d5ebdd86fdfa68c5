"""The page of one frame."""

from collections.abc import Mapping
from html import escape
from typing import Any

import numpy as np

from selfcorrect import words
from selfcorrect.report.html import assembled, facts_sections, section
from selfcorrect.report.pack import LARGEST_PAGE, Packed, fitted, reduced

__all__ = ["LABELS", "errors", "frame_page", "layers", "note", "viewer"]

LABELS = {
    "noisy": "Noisy",
    "denoised": "Denoised",
    "corrected": "Corrected",
    "reference": "Reference",
    "error.before": "Error before",
    "error.after": "Error after",
    "blend": "Blend weight",
}
_ROOM = 300_000  # bytes for all that is no image
_DETAIL, _DETAIL_SIDE = 0.2, 320  # share of the bytes, and side in pixels, of a region that is kept as it is


def frame_page(
    images: Mapping[str, Any], maps: Mapping[str, Any], facts: Mapping[str, Any], *, limit: int = LARGEST_PAGE
) -> str:
    """A page to look at one frame.

    Args:
        images: linear radiance, (H, W, 3): ``noisy``, ``denoised``, ``corrected`` and perhaps ``reference``, in the
            order in which the keys 1 to 4 show them.
        maps: (H, W): ``error.before`` and ``error.after`` (relative squared error), ``blend`` (0 … 1), or none.
        facts: what the command prints with --json, as far as it is known; ``title`` names the page, ``relmse`` holds
            errors against the reference by image.
        limit: largest page, in bytes. Frames that do not fit are rounded, then reduced, and the region that was changed
            most is kept as it was given; the page says so, and how many of the frame's pixels one of those is.

    Returns:
        HTML that needs no other file.
    """
    budget, shown_all = limit - _ROOM, {**images, **maps}
    height, width = next(iter(images.values())).shape[:2]
    full = facts.get("size") or {"width": width, "height": height}
    packed, detail = fitted(shown_all, budget), None
    if next(iter(packed.values())).width < width:
        packed = fitted(shown_all, int((1 - _DETAIL) * budget))
        detail = _detail(shown_all, full["width"] / width, int(_DETAIL * budget))
    shown = next(iter(packed.values()))
    place = ""
    if {"error.before", "error.after"} <= set(maps) and "denoised" in images:
        place = words.where(images["denoised"], maps["error.before"], maps["error.after"])
    return assembled(
        title=str(facts.get("title", "frame")),
        lead=_lead(facts, full),
        summary=f"<p class='headline'>{escape(words.summary(facts.get('estimate'), place))}.</p>{errors(facts)}",
        body=viewer(note(full, shown)) + section("What was done", facts_sections(facts)),
        data={"scale": full["width"] / shown.width, "layers": layers(packed), "detail": detail},
        scripts=("viewer.js", "controls.js", "frame.js"),
    )


def _lead(facts: Mapping[str, Any], size: Mapping[str, int]) -> str:
    parts = [f"{size['width']} × {size['height']} pixels"]
    if denoiser := facts.get("denoiser"):
        parts.append("denoised halves given" if denoiser == "given" else f"denoised by {denoiser}")
    if preset := facts.get("preset"):
        parts.append(f"preset {preset}")
    if total := (facts.get("seconds") or {}).get("total"):
        parts.append(f"{total:.1f} s")
    return " · ".join(parts)


def _detail(images: Mapping[str, Any], scale: float, budget: int) -> dict[str, Any] | None:
    """The square that the correction has changed most, for JSON; None where it takes more than there is room for."""
    if not {"denoised", "corrected"} <= set(images):
        return None
    before, after = (words.luminance(images[name]) for name in ("denoised", "corrected"))
    changed = reduced(np.abs(after - before) / (before + 0.1), _DETAIL_SIDE)
    row, column = np.unravel_index(int(changed.argmax()), changed.shape)
    top, left = int(row) * _DETAIL_SIDE, int(column) * _DETAIL_SIDE
    square = slice(top, top + _DETAIL_SIDE), slice(left, left + _DETAIL_SIDE)
    packed = fitted({name: image[square] for name, image in images.items()}, budget)
    if next(iter(packed.values())).width < next(iter(images.values()))[square].shape[1]:
        return None
    label = "Most changed, every pixel" if scale == 1 else f"Most changed, {_by(scale)} pixels in one"
    return {"label": label, "scale": scale, "left": left * scale, "top": top * scale, "layers": layers(packed)}


def _by(scale: float) -> str:
    return f"{scale:.2g} × {scale:.2g}"


def layers(packed: Mapping[str, Packed]) -> list[dict[str, Any]]:
    """What the viewer shows, for JSON."""
    return [{"name": name, "label": LABELS.get(name, name), **one._asdict()} for name, one in packed.items()]


def note(full: Mapping[str, int], shown: Packed) -> str:
    """What the page does not show as it is in the file; empty where it shows all."""
    parts = []
    if full["width"] != shown.width:
        parts.append(
            f"This page shows {shown.width} × {shown.height} pixels, each the mean of about "
            f"{_by(full['width'] / shown.width)} of the frame's, to stay small."
        )
    if shown.bits < 10:
        parts.append("Values are rounded by up to 0.4 %.")
    return " ".join(parts)


def errors(facts: Mapping[str, Any]) -> str:
    """Bars of the error before and after: estimated, and against the reference where there is one."""
    parts = []
    if estimate := facts.get("estimate"):
        deviation = f" (± {100 * estimate['standard_error']:.0f} %)" if estimate["improved"] else ""
        parts.append(_bars("Estimated error, relMSE, from the two halves alone", estimate, deviation))
    if relmse := facts.get("relmse"):
        parts.append(_bars("Error against the reference, relMSE", relmse, ""))
    return f'<div class="errors">{"".join(parts)}</div>' if parts else ""


def _bars(caption: str, values: Mapping[str, Any], deviation: str) -> str:
    names = [name for name in ("noisy", "denoised", "corrected") if name in values]
    largest = max(values["denoised"], values["corrected"])
    lines = []
    for name in names:
        share = min(values[name] / largest, 1.0) if largest > 0 else 0.0
        told = words.number(float(values[name]))
        if name == "corrected":
            told += f"  {words.change(values['corrected'], values['denoised'])}{deviation}"
        over = " over" if largest > 0 and values[name] > largest else ""
        lines.append(
            f"<dt>{LABELS[name]}</dt><dd><meter class='{name}{over}' min='0' max='1' value='{share:.4f}' "
            f"aria-label='{LABELS[name]}'>{told}</meter><span>{escape(told)}</span></dd>"
        )
    return f"<figure><figcaption>{escape(caption)}</figcaption><dl>{''.join(lines)}</dl></figure>"


def viewer(remark: str) -> str:
    """The place for the viewer; controls.js fills it."""
    told = f'<p class="note">{escape(remark)}</p>' if remark else ""
    return f'<section id="viewer" class="viewer" aria-label="Images">{told}</section>'
