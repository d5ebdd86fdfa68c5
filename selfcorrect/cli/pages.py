"""Pages to look at (:mod:`selfcorrect.report`), gathered while frames are in memory."""

import contextlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any
from urllib.parse import quote

from selfcorrect import exr, report
from selfcorrect.correct import Result
from selfcorrect.errors import SelfcorrectError
from selfcorrect.frame import Frame
from selfcorrect.guard import Estimate
from selfcorrect.publish import publish
from selfcorrect.report.shot import looked_at
from selfcorrect.settings import Settings
from selfcorrect.shot.run import Outcome

__all__ = ["MAPS", "FramePage", "Gather", "ShotPage", "facts_of", "images_of", "page_of", "target", "write"]

MAPS = ("error.before", "error.after", "blend")
"""Of a result's maps, in the order of the page."""

Gather = Callable[[Frame, Result], None]
"""Called with a denoised frame and what was made of it."""


def target(path: str | None) -> Path | None:
    """The page to write, or None of none; to be called before long work.

    Raises:
        FileError: it cannot be written.
    """
    return None if path is None else exr.check_target(path, ".html")


def page_of(page: Path, layer: str) -> Path:
    """Where the page of a further view layer stands: beside the first, with its name in the file's, no two alike.

    >>> page_of(Path("page.html"), "Far Hills").name, page_of(Path("page.html"), "Far/Hills").name
    ('page.Far Hills.html', 'page.Far%2FHills.html')
    """
    return page.with_name(f"{page.stem}.{quote(layer, safe=' ')}{page.suffix}")


def write(page: Path, text: str) -> None:
    """Write a page; an older one survives any failure."""
    publish(page, text.encode())


def facts_of(file: exr.ExrFile) -> dict[str, Any]:
    """What an output of selfcorrect tells of how it was made; of another file nothing. Values of a wrong kind are left
    out: anyone may have written the attributes.
    """
    header = file.parts[0].header
    run, settings = (_object(header.get(f"selfcorrect/{name}")) for name in ("run", "settings"))
    facts: dict[str, Any] = {
        name: run[name] for name in ("preset", "denoiser", "version") if isinstance(run.get(name), str)
    }
    facts["estimate"] = _estimate(run.get("estimate"))
    with contextlib.suppress(SelfcorrectError):
        facts["settings"] = Settings.from_dict(settings).to_dict() if settings else None
    return facts


def _object(text: Any) -> dict[str, Any]:
    try:
        found = json.loads(text or "{}")
    except (TypeError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _estimate(found: Any) -> dict[str, Any] | None:
    names = [f.name for f in fields(Estimate)]
    if not isinstance(found, dict) or not all(isinstance(found.get(name), (int, float)) for name in names):
        return None
    return {name: found[name] for name in names}


def images_of(frame: Frame, corrected: Any) -> dict[str, tuple[Any, ...]]:
    """What is to be looked at: name → images whose mean it is."""
    denoised = frame.denoised if frame.denoised_full is None else (frame.denoised_full,)
    return {"noisy": frame.color, "denoised": denoised or (), "corrected": (corrected,)}


class FramePage:
    """The pages of one frame, one of each view layer; what is kept for them is small enough to stand beside any frame
    in memory.
    """

    def __init__(self, page: Path):
        self._page = page
        self._layers: list[tuple[dict[str, Any], dict[str, Any]]] = []

    @classmethod
    def at(cls, path: str | None) -> "FramePage | None":
        """A page to be written here, or None where there is to be none."""
        page = target(path)
        return None if page is None else cls(page)

    def gather(self, frame: Frame, result: Result) -> None:
        """Keep what is to be looked at; called once for each view layer, in their order."""
        images = {name: report.shrunk(*parts) for name, parts in images_of(frame, result.image).items()}
        self._layers.append((images, {name: report.shrunk(result.maps[name]) for name in MAPS if name in result.maps}))

    def write(self, facts: Mapping[str, Any]) -> None:
        """Write the pages; ``facts`` are what --json prints."""
        title = Path(facts["output"]).name
        others: dict[str, Mapping[str, Any]] = facts.get("layers") or {}
        if others:
            title = f"{title}::{facts['layer']}"
        (images, maps), *further = self._layers
        write(self._page, report.frame_page(images, maps, {**facts, "title": title}))
        for (images, maps), (layer, own) in zip(further, others.items(), strict=True):
            about = {**facts, **own, "title": f"{Path(facts['output']).name}::{layer}"}
            write(page_of(self._page, layer), report.frame_page(images, maps, about))


def _summed(given: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Numbers by name, or by name and name, summed over frames."""
    total: dict[str, Any] = {}
    for one in given:
        for name, value in one.items():
            if isinstance(value, Mapping):
                total[name] = _summed([total.get(name, {}), value])
            else:
                total[name] = total.get(name, 0) + value
    return total


class ShotPage:
    """The page of a shot, gathered frame by frame."""

    def __init__(self, page: Path, numbers: Sequence[int]):
        self._page = page
        self._kept = looked_at(numbers)
        self._pictures: dict[int, dict[str, Any]] = {}
        self._frames: list[report.ShotFrame] = []

    @classmethod
    def at(cls, path: str | None, numbers: Sequence[int]) -> "ShotPage | None":
        """A page to be written here, or None where there is to be none."""
        page = target(path)
        return None if page is None else cls(page, numbers)

    def gather(self, number: int) -> Gather:
        """What keeps a frame of this number."""

        def keep(frame: Frame, result: Result) -> None:
            images = images_of(frame, result.image)
            kept: dict[str, Any] = {
                "thumbnail": report.thumbnail(*images["corrected"]),
                "rows": {name: report.slice_of(*parts) for name, parts in images.items()},
            }
            if number in self._kept:
                kept["images"] = {name: report.still(*parts) for name, parts in images.items()}
                kept["maps"] = {name: report.still(result.maps[name]) for name in MAPS if name in result.maps}
            self._pictures[number] = kept

        return keep

    def told(self, outcome: Outcome) -> None:
        """Keep what became of a frame."""
        pictures = self._pictures.pop(outcome.frame, {}) if outcome.kind == "written" else {}
        facts = {"reason": outcome.reason} if outcome.report is None else outcome.report.to_dict()
        if outcome.kind == "skipped":
            with contextlib.suppress(SelfcorrectError):  # the page is no reason to fail
                half = exr.load_half(outcome.output)
                color = half.buffers["color"]
                facts |= facts_of(half.file)
                pictures = {"thumbnail": report.thumbnail(color), "rows": {"corrected": report.slice_of(color)}}
        self._frames.append(report.ShotFrame(outcome.frame, outcome.kind, facts, **pictures))

    def write(self, title: str, settings: Settings, more: Mapping[str, Any]) -> None:
        """Write the page, of the frames there are; ``more`` is what all of them share."""
        written = [frame.facts for frame in self._frames if frame.outcome == "written"]
        totals = {name: _summed(facts[name] for facts in written) for name in ("seconds", "repairs")} if written else {}
        shared = {name: written[0][name] for name in ("channels", "threads", "version") if written}
        facts = {"title": Path(title).name, "settings": settings.to_dict(), **shared, **totals, **more}
        write(self._page, report.shot_page(self._frames, facts))
