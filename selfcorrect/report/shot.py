"""The page of a shot: a strip of its frames, the gain of each, a slice through time, and some frames to look at."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any

import numpy as np

from selfcorrect import words
from selfcorrect.report.frame import LABELS, layers, note, viewer
from selfcorrect.report.html import assembled, facts_sections, section, table
from selfcorrect.report.pack import LARGEST_PAGE, Array, fitted, pack, shrunk

__all__ = ["ShotFrame", "looked_at", "shot_page", "slice_of", "still", "thumbnail"]

_ROOM = 400_000  # bytes for all that is no image
_STRIP, _SLICE = 0.2, 0.2  # shares of the images' bytes
_THUMBNAIL, _STILL, _ROW = 20_000, 350_000, 640  # pixels at most; the last, of a slice's width
_LOOKED_AT = 6  # frames


@dataclass(frozen=True, eq=False)
class ShotFrame:
    """What the page tells of a frame.

    Attributes:
        number: of the frame.
        outcome: ``written``, ``skipped`` (it was there) or ``failed``.
        facts: as of a frame's page.
        images: to be looked at, as of a frame's page; empty for most frames of a long shot.
        maps: the same.
        thumbnail: of the corrected image (:func:`thumbnail`), or None.
        rows: image name → one row of it (:func:`slice_of`).
    """

    number: int
    outcome: str
    facts: Mapping[str, Any]
    images: Mapping[str, Any] = field(default_factory=dict)
    maps: Mapping[str, Any] = field(default_factory=dict)
    thumbnail: Array | None = None
    rows: Mapping[str, Array] = field(default_factory=dict)


def looked_at(numbers: Sequence[int]) -> set[int]:
    """Which frames of a shot the page shows in full: some, evenly spread, with the first and the last."""
    if len(numbers) <= _LOOKED_AT:
        return set(numbers)
    return {numbers[round(i * (len(numbers) - 1) / (_LOOKED_AT - 1))] for i in range(_LOOKED_AT)}


def still(*images: Any) -> Array:
    """An image or a map, or the mean of several, of a frame to be looked at, not larger than the page has room for."""
    return shrunk(*images, pixels=_STILL)


def thumbnail(*images: Any) -> Array:
    """An image, or the mean of several, small enough for the strip."""
    return shrunk(*images, pixels=_THUMBNAIL)


def slice_of(*images: Any) -> Array:
    """The middle row of an image, or of the mean of several, (W, 3) float16, of at most 640 pixels."""
    row: Array = shrunk(*(image[image.shape[0] // 2][None] for image in images), pixels=_ROW)[0]
    return row


def shot_page(frames: Sequence[ShotFrame], facts: Mapping[str, Any], *, limit: int = LARGEST_PAGE) -> str:
    """A page to look at a shot.

    Args:
        frames: in their order.
        facts: what all frames share: ``title``, ``settings``, ``preset``, ``denoiser``, …
        limit: largest page, in bytes.

    Returns:
        HTML that needs no other file.
    """
    budget = limit - _ROOM
    strip = _strip(frames, int(_STRIP * budget))
    slices = _slices(frames, int(_SLICE * budget))
    budget -= sum(len(one["data"]) for one in strip.values()) + sum(len(one["data"]) for one in slices.values())
    shown = [frame for frame in frames if frame.images]
    told, remark = [], ""
    images = {frame.number: fitted({**frame.images, **frame.maps}, budget // len(shown)) for frame in shown}
    if shown:
        first = next(iter(images[shown[0].number].values()))
        remark = note(shown[0].facts["size"], first)
    for frame in frames:
        packed = images.get(frame.number)
        told.append(
            {
                "number": frame.number,
                "outcome": frame.outcome,
                "change": (frame.facts.get("estimate") or {}).get("change"),
                "error": (frame.facts.get("estimate") or {}).get("standard_error"),
                "warm": (frame.facts.get("start") or {}).get("warm"),
                "thumbnail": strip.get(frame.number),
                "layers": layers(packed) if packed else [],
                "scale": frame.facts["size"]["width"] / next(iter(packed.values())).width if packed else 1,
            }
        )
    rest = section("Frames", _table(frames)) + section("What was done", facts_sections(facts))
    return assembled(
        title=str(facts.get("title", "shot")),
        lead=_lead(frames, facts),
        summary=f"<p class='headline'>{escape(_summary(frames))}.</p>",
        body='<section id="strip" aria-label="Frames of the shot"></section>'
        f'{viewer(remark)}<section id="slice" aria-label="A row through time"></section>{rest}',
        data={"frames": told, "slices": slices, "labels": LABELS},
        scripts=("viewer.js", "controls.js", "strip.js"),
    )


def _lead(frames: Sequence[ShotFrame], facts: Mapping[str, Any]) -> str:
    parts = [f"{len(frames)} frames"]
    for outcome, name in (("skipped", "were there"), ("failed", "failed")):
        if count := sum(frame.outcome == outcome for frame in frames):
            parts.append(f"{count} {name}")
    parts += [str(facts[name]) for name in ("denoiser", "preset") if facts.get(name)]
    return " · ".join(parts)


def _summary(frames: Sequence[ShotFrame]) -> str:
    changes = [(e["change"], f.number) for f in frames if (e := f.facts.get("estimate"))]
    if not changes:
        return "No estimate of the error"
    if not any(change < 0 for change, _ in changes):
        return f"{words.KEPT}, in every frame"
    ratio = float(np.exp(np.mean([np.log(max(1 + change, 1e-6)) for change, _ in changes])))
    lower = f"Error about {100 * (1 - ratio):.0f} % lower over the shot"
    (best, at_best), (worst, at_worst) = min(changes), max(changes)
    if words.percent(best) == words.percent(worst):
        return lower
    return f"{lower}, from {words.percent(worst)} in frame {at_worst} to {words.percent(best)} in frame {at_best}"


def _table(frames: Sequence[ShotFrame]) -> str:
    rows = []
    for frame in frames:
        estimate = frame.facts.get("estimate")
        start = frame.facts.get("start")
        rows.append(
            (
                frame.number,
                words.percent(estimate["change"]) if estimate and estimate["improved"] else None,
                estimate and float(estimate["denoised"]),
                estimate and float(estimate["corrected"]),
                None if start is None else "warm" if start["warm"] else "cold",
                (frame.facts.get("seconds") or {}).get("total"),
                frame.facts.get("reason") or frame.outcome,
            )
        )
    head = ("frame", "gain", "relMSE before", "after", "start", "s", "outcome")
    return f"<details><summary>Each frame in numbers</summary>{table('Frames', head, rows, 'numbers')}</details>"


def _strip(frames: Sequence[ShotFrame], budget: int) -> dict[int, dict[str, Any]]:
    """Thumbnails by frame: of all, or of every so many-th where all would be too much."""
    having = [frame for frame in frames if frame.thumbnail is not None]
    packed = {frame.number: pack(frame.thumbnail, 7)._asdict() for frame in having}
    every = 1
    while sum(len(packed[frame.number]["data"]) for frame in having[::every]) > budget:
        every += 1
    return {frame.number: packed[frame.number] for frame in having[::every]}


def _slices(frames: Sequence[ShotFrame], budget: int) -> dict[str, dict[str, Any]]:
    """Image name → its middle row in every frame, one below the other."""
    names = next((list(frame.rows) for frame in frames if frame.rows), [])
    stacked = {}
    for name in names:
        width = next(len(frame.rows[name]) for frame in frames if frame.rows)
        gap = np.zeros((width, 3), np.float16)
        rows = [frame.rows.get(name, gap) for frame in frames]
        stacked[name] = np.stack([row if len(row) == width else gap for row in rows])
    if not stacked:
        return {}
    return {name: one._asdict() for name, one in fitted(stacked, budget).items()}
