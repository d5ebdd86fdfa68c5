"""The page of `bench`: what each second buys on a frame."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from selfcorrect.report.html import assembled, section, table

__all__ = ["bench_page"]


def bench_page(
    points: Sequence[Mapping[str, Any]], front: Sequence[str], recommended: str | None, facts: Mapping[str, Any]
) -> str:
    """A page of the trade of seconds for error.

    Args:
        points: each with ``point`` (its name), ``ratio`` (error over that of the denoised image), ``standard_error``,
            ``train`` and ``infer`` (seconds), ``settings`` and ``preset`` (whether it is one).
        front: names of those that no other one beats.
        recommended: name of the preset to take.
        facts: ``title``, ``size``, ``denoiser``.

    Returns:
        HTML that needs no other file.
    """
    told = [
        {
            "name": one["point"],
            "ratio": one["ratio"],
            "error": one["standard_error"],
            "seconds": one["train"] + one["infer"],
            "preset": bool(one["preset"]),
            "front": one["point"] in front,
            "recommended": one["point"] == recommended,
        }
        for one in points
    ]
    size = facts.get("size")
    parts = [f"{size['width']} × {size['height']} pixels"] if size else []
    parts += [f"{len(points)} points", *([f"denoised by {facts['denoiser']}"] if facts.get("denoiser") else [])]
    return assembled(
        title=str(facts.get("title", "bench")),
        lead=" · ".join(parts),
        summary=f"<p class='headline'>{escape(_summary(told))}.</p>",
        body='<section id="pareto" aria-label="Seconds against error"></section>'
        + section("Points", _table(points, told)),
        data={"points": told},
        scripts=("pareto.js",),
    )


def _summary(told: Sequence[Mapping[str, Any]]) -> str:
    for one in told:
        if one["recommended"]:
            if one["ratio"] >= 1:
                return f"No preset gains on this frame; {one['name']} takes the least time"
            gain = 100 * (1 - one["ratio"])
            return f"Take {one['name']}: error about {gain:.0f} % lower in {one['seconds']:.1f} s"
    return "No preset among the points"


def _table(points: Sequence[Mapping[str, Any]], told: Sequence[Mapping[str, Any]]) -> str:
    rows = []
    for one, plain in sorted(zip(points, told, strict=True), key=lambda pair: pair[1]["seconds"]):
        marks = [word for word in ("front", "preset", "recommended") if plain[word]]
        deviation = f"{one['ratio']:.3f} ± {one['standard_error']:.3f}"
        seconds, *parts = (f"{value:.2f}" for value in (plain["seconds"], one["train"], one["infer"]))
        rows.append((one["point"], deviation, seconds, ", ".join(marks), *parts))
    head = ("point", "error over denoised", "seconds", "", "train", "infer")
    return table("Estimated without a reference; the quickest first", head, rows, "numbers points")
