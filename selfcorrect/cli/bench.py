"""The command `bench`: what each second buys on the user's own frame, judged without a reference."""

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from selfcorrect import exr, files, report, tradeoff
from selfcorrect.cli import flags, halves, pages
from selfcorrect.cli.runner import Runner
from selfcorrect.cli.terminal import answer, log, show
from selfcorrect.errors import SettingsError
from selfcorrect.frame import Frame
from selfcorrect.publish import publish
from selfcorrect.settings import Settings
from selfcorrect.tradeoff import Measurement, Point

__all__ = ["run"]

_ERROR = "estimated relMSE over that of the denoised image"


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    halves.check(options)
    if options.guard is False:
        raise SettingsError("expected the guard, whose estimate bench compares, but got --no-guard")
    runner = Runner(options, given=options.denoised_a is not None and options.previous is None)
    table, picture = (
        None if path is None else exr.check_target(path, suffix)
        for path, suffix in ((options.csv, ".csv"), (options.plot, ".png"))
    )
    page = pages.target(options.report)
    if picture is not None:
        tradeoff.figure_class()  # what is missing is to be known before the work
    points = _points(options, replace(runner.settings, guard=True))
    frame = _frame(options, runner, (options.a, options.b), given=True)
    previous = None if options.previous is None else _frame(options, runner, options.previous, given=False)
    measured: list[Measurement] = []
    try:
        for one in tradeoff.sweep(frame, points, previous=previous):
            measured.append(one)
            log(f"{len(measured)} of {len(points)}: {_told(one)}")
            if table is not None:
                publish(table, tradeoff.table(measured))
    finally:  # also after Ctrl-C: what was measured is worth its minutes
        if measured:
            found = _found(frame, measured)
            _answer(options, found, measured)
            if page is not None:
                facts = {"title": Path(options.a).name, "size": found["size"], "denoiser": runner.denoiser}
                pages.write(page, report.bench_page(found["points"], found["front"], found["recommended"], facts))
    if picture is not None:
        publish(picture, tradeoff.plot(measured, _ERROR, title=f"{frame.size[1]}x{frame.size[0]} pixels"))


def _points(options: argparse.Namespace, base: Settings) -> list[Point]:
    if options.points is None:
        return tradeoff.points(base, guarded=True, warm=options.previous is not None)
    chosen = [tradeoff.point(name, base, guarded=True) for name in options.points]
    if options.previous is None and any(p.warm for p in chosen):
        raise SettingsError("expected --previous A.exr B.exr with the point warm, but got none")
    return chosen


def _frame(options: argparse.Namespace, runner: Runner, halves: Sequence[str], *, given: bool) -> Frame:
    """A frame with its denoised halves; ``given``: those of the flags, where there are any."""
    denoised = flags.denoised(options) if given else {}
    start = time.perf_counter()
    loaded = files.load(files.Sources(halves[0], halves[1], **denoised, mapping=flags.mapping(options)))
    prepared = runner.prepare(runner.denoise(loaded, start))
    log(f"read and denoised ({prepared.facts.denoiser}) in {time.perf_counter() - start:.1f} s")
    return prepared.frame.to(options.device)


def _told(m: Measurement) -> str:
    cold = ", started cold: it does not look like the frame before" if m.point.warm and not m.started_warm else ""
    return f"{m.point.name}: {m.ratio:.3f} ± {m.standard_error:.3f} in {m.seconds:.2f} s{cold}"


def _found(frame: Frame, measured: list[Measurement]) -> dict[str, Any]:
    """What --json prints."""
    height, width = frame.size
    chosen = tradeoff.recommended(measured)
    return {
        "size": {"width": width, "height": height},
        "points": [_plain(m) for m in measured],
        "front": [m.point.name for m in tradeoff.pareto_front(measured)],
        "recommended": None if chosen is None else chosen.point.name,
    }


def _answer(options: argparse.Namespace, found: dict[str, Any], measured: list[Measurement]) -> None:
    """The table and the recommendation, on stdout."""
    if options.json:
        answer(found)
        return
    front, chosen = tradeoff.pareto_front(measured), tradeoff.recommended(measured)
    show(f"{'point':24} {'train':>8} {'infer':>8} {'seconds':>8}  {_ERROR}; * on the Pareto front")
    for m in measured:
        mark = " *" if m in front else ""
        show(
            f"{m.point.name:24} {m.train:8.2f} {m.infer:8.2f} {m.seconds:8.2f}  "
            f"{m.ratio:.3f} ± {m.standard_error:.3f}{mark}"
        )
    show(_recommendation(measured, chosen))


def _recommendation(measured: list[Measurement], chosen: Measurement | None) -> str:
    if chosen is None:
        return "no preset was among the points: none is recommended"
    best = min((m for m in measured if m.point.preset), key=lambda m: m.ratio)
    if best.ratio >= 1:
        return "the evidence shows no gain by any preset on this frame: keep the denoised image"
    line = f"recommended: --preset {chosen.point.name} ({100 * (chosen.ratio - 1):+.0f} % in {chosen.seconds:.1f} s"
    if best is chosen:
        return f"{line}: the best preset here)"
    return f"{line}; {best.point.name}: {100 * (best.ratio - 1):+.0f} % in {best.seconds:.1f} s)"


def _plain(m: Measurement) -> dict[str, Any]:
    return {
        "point": m.point.name,
        "settings": m.point.settings.to_dict(),
        "preset": m.point.preset,
        "warm": m.started_warm,
        "ratio": m.ratio,
        "standard_error": m.standard_error,
        "train": round(m.train, 3),
        "infer": round(m.infer, 3),
    }
