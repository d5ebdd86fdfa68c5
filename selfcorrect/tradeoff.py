"""What each second buys: settings tried on a frame, the Pareto front, and the preset to take. Nothing is printed here.

Error is a ratio to that of the denoised image. On a user's own frame the guard estimates it without a reference; where
there are references, another ``judge`` measures it.
"""

import csv
import importlib
import io
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from selfcorrect.correct import Result, correct
from selfcorrect.errors import FrameError, MissingPackageError, SettingsError
from selfcorrect.frame import Frame, Half
from selfcorrect.settings import Settings

__all__ = [
    "Measurement",
    "Point",
    "estimated",
    "figure_class",
    "over_frames",
    "pareto_front",
    "plot",
    "point",
    "points",
    "recommended",
    "sweep",
    "table",
    "warm_up",
]

Judge = Callable[[Result], tuple[float, float]]

BASE, WARM = "base", "warm"
_WARM_UP_SIDE = 64  # of the corner that is corrected, untimed, before the first point
_NEAR_ENOUGH = 0.1  # of the best gain: what a quicker preset may give away

# One thing at a time around the base; what equals the base is left out. More than 16 filters run without the compiled
# convolutions, so that their seconds would say nothing about the width.
_WINDOWS, _TAPS, _FILTERS, _LAYERS = (7, 13, 19, 25, 31), (1, 2, 4, 8), (8, 12, 16), (5, 7, 9)
_PATCHES = ((32, 4), (32, 16), (64, 1), (64, 4), (64, 8), (128, 1), (128, 4))  # side, and how many in a step
_STEPS, _RATES = (0.25, 0.5, 2.0), (0.5, 2.0)  # of the base's


@dataclass(frozen=True)
class Point:
    """Settings under a name.

    Attributes:
        name: a preset, ``base``, ``warm``, or what differs from the base, like ``window=7`` or ``patch=32,batch=16``.
        settings: all of them.
        preset: whether it is a preset as it is offered.
        warm: starts from the network of the frame before.
    """

    name: str
    settings: Settings
    preset: bool = False
    warm: bool = False


@dataclass(frozen=True)
class Measurement:
    """What a point gave.

    Attributes:
        point: the settings.
        ratio: error over that of the denoised image; below 1 is better.
        standard_error: of ``ratio``.
        train: seconds of training, everything before inference included.
        infer: seconds of inference, guard and other stages.
        started_warm: whether training went on from the frame before.
    """

    point: Point
    ratio: float
    standard_error: float
    train: float
    infer: float
    started_warm: bool = False

    @property
    def seconds(self) -> float:
        """Of the correction as a whole."""
        return self.train + self.infer


def point(name: str, base: Settings, *, guarded: bool = False) -> Point:
    """The point of this name around ``base``.

    Args:
        name: a preset; ``base``; ``warm``; or ``FIELD=VALUE,…``, which changes the base; ``PRESET:FIELD=VALUE,…``
            changes that preset.
        base: the settings to vary. Presets take its seed, and nothing else of it.
        guarded: turn the guard on, also in a preset that is published without: its estimate makes points comparable.

    Raises:
        SettingsError: the name is none of these, or a value is out of range.
    """
    forced: dict[str, Any] = {"guard": True} if guarded else {}
    if name in Settings.presets():
        return Point(name, Settings.preset(name, seed=base.seed, **forced), preset=True)
    if name in (BASE, WARM):
        return Point(name, replace(base, **forced), warm=name == WARM)
    head, _, tail = name.rpartition(":")
    start = Settings.preset(head, seed=base.seed) if head else base
    return Point(name, Settings.from_dict(start.to_dict() | _changes(name, tail) | forced))


def _changes(name: str, text: str) -> dict[str, Any]:
    """The settings that ``FIELD=VALUE,…`` names."""
    known = {f.name for f in fields(Settings)}
    changes: dict[str, Any] = {}
    for part in text.split(","):
        key, equals, value = part.partition("=")
        if not equals or key not in known:
            presets = ", ".join(Settings.presets())
            raise SettingsError(
                f"expected a point out of {presets}, {BASE}, {WARM} or SETTING=VALUE,…, but got {name!r}"
            )
        try:
            changes[key] = Settings.parsed(key, value)
        except SettingsError as error:
            raise SettingsError(f"the point {name!r}: {error}") from None
    return changes


def points(base: Settings, *, guarded: bool = False, warm: bool = False) -> list[Point]:
    """The presets, then the base, then one thing changed at a time: steps, pixels of a step, window, taps, network.

    Settings that came up before under another name are left out, and so is ``warm`` unless it is asked for.
    ``guarded`` is as in :func:`point`.
    """
    variations = (",".join(f"{key}={value}" for key, value in changes.items()) for changes in _variations(base))
    found: list[Point] = []
    for name in (*Settings.presets(), BASE, *variations):
        one = point(name, base, guarded=guarded)
        if all(one.settings != other.settings for other in found):
            found.append(one)
    return [*found, point(WARM, base, guarded=guarded)] if warm else found


def _variations(base: Settings) -> Iterator[dict[str, Any]]:
    length = "steps" if base.steps else "epochs"
    for share in _STEPS:
        yield {length: max(1, round(share * getattr(base, length)))}
    for patch, batch in _PATCHES:
        stride = {} if base.steps or base.stride <= patch else {"stride": patch}
        yield {"patch": patch, "batch": batch, **stride}
    ranges: dict[str, Iterable[Any]] = {
        "window": _WINDOWS,
        "taps_every": _TAPS,
        "filters": _FILTERS,
        "layers": _LAYERS,
        "precision": ("fp32", "bf16"),
        "learning_rate": [float(f"{factor * base.learning_rate:.4g}") for factor in _RATES],
        "schedule": ("constant", "cosine"),
    }
    for name, values in ranges.items():
        yield from ({name: value} for value in values)


def estimated(result: Result) -> tuple[float, float]:
    """A judge that needs no reference: the guard's estimate, with its standard error."""
    if result.estimate is None:
        raise SettingsError("expected points with guard=True to estimate their error, but got one without")
    return 1 + result.estimate.change, result.estimate.standard_error


def sweep(
    frame: Frame, tried: Iterable[Point], judge: Judge = estimated, *, previous: Frame | None = None
) -> Iterator[Measurement]:
    """Correct a frame with each point in turn, and yield what it gave.

    Args:
        frame: with its denoised halves.
        tried: the points; the default judge needs settings with the guard.
        judge: ratio and standard error of a result.
        previous: the frame before, denoised, that ``warm`` points start from; training on it is not counted.

    Raises:
        FrameError: a point starts warm, but there is no frame before.
    """
    warm_up(frame)
    for one in tried:
        if one.warm and previous is None:
            raise FrameError(f"expected the frame before for the point {one.name!r}, but got none")
        network = correct(previous, one.settings).network if one.warm and previous is not None else None
        result = correct(frame, one.settings, warm_start=network)
        ratio, error = judge(result)
        train = result.seconds.get("train", 0.0)
        yield Measurement(one, ratio, error, train, sum(result.seconds.values()) - train, result.start.warm)


def warm_up(frame: Frame) -> None:
    """Correct a corner of a frame, for nothing: the first call of a process is slower than those to be timed."""
    buffers = {name: getattr(frame, name) for name in Half._fields}
    side = _WARM_UP_SIDE
    cut: dict[str, Any] = {n: (p[0][:side, :side], p[1][:side, :side]) for n, p in buffers.items() if p is not None}
    corner = Frame(**cut)
    for name, settings in Settings.presets().items():
        short = {"steps": 1} if settings.steps else {"epochs": 1}
        correct(corner, Settings.preset(name, **short))


def over_frames(measurements: Sequence[Measurement]) -> Measurement:
    """One point on several frames: the geometric mean of the ratios, the arithmetic mean of the seconds."""
    count = len(measurements)
    if not count or min(m.ratio for m in measurements) <= 0:
        raise FrameError(f"expected measurements with ratios above 0, but got {[m.ratio for m in measurements]}")
    ratio = math.exp(sum(math.log(m.ratio) for m in measurements) / count)
    error = ratio * math.sqrt(sum((m.standard_error / m.ratio) ** 2 for m in measurements)) / count
    train, infer = (sum(getattr(m, name) for m in measurements) / count for name in ("train", "infer"))
    return Measurement(measurements[0].point, ratio, error, train, infer, all(m.started_warm for m in measurements))


def pareto_front(measurements: Iterable[Measurement]) -> list[Measurement]:
    """Those that no other one beats in seconds or error without losing in the other; the quickest first."""
    front: list[Measurement] = []
    for one in sorted(measurements, key=lambda m: (m.seconds, m.ratio)):
        if not front or one.ratio < front[-1].ratio or _same(one, front[-1]):
            front.append(one)
    return front


def _same(a: Measurement, b: Measurement) -> bool:
    return a.seconds == b.seconds and a.ratio == b.ratio


def recommended(measurements: Iterable[Measurement]) -> Measurement | None:
    """The quickest preset whose gain is within a standard error, or a tenth, of the best preset's; None of none.

    Where no preset gains anything it is the quickest of all, with a ratio of 1.
    """
    presets = [m for m in measurements if m.point.preset]
    if not presets:
        return None
    best = min(presets, key=lambda m: m.ratio)
    slack = max(best.standard_error, _NEAR_ENOUGH * max(1 - best.ratio, 0.0))
    return min((m for m in presets if m.ratio <= best.ratio + slack), key=lambda m: m.seconds)


def table(measurements: Sequence[Measurement], **more: Sequence[object]) -> bytes:
    """The measurements as CSV, UTF-8: a header, a row for each, further columns first."""
    front = pareto_front(measurements)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = ["point", "preset", "warm", "front", "ratio", "standard_error", "train", "infer", "seconds", "settings"]
    writer.writerow([*more, *names])
    for i, m in enumerate(measurements):
        marks = [int(mark) for mark in (m.point.preset, m.started_warm, m in front)]
        numbers = [f"{x:.6g}" for x in (m.ratio, m.standard_error, m.train, m.infer, m.seconds)]
        own = [m.point.name, *marks, *numbers, json.dumps(m.point.settings.to_dict())]
        writer.writerow([*(column[i] for column in more.values()), *own])
    return text.getvalue().encode()


def plot(
    measurements: Sequence[Measurement],
    error: str,
    *,
    title: str = "",
    beside: Mapping[str, Sequence[tuple[float, float]]] | None = None,
) -> bytes:
    """Seconds against error, the Pareto front as a line, presets and front by name: a PNG.

    Args:
        measurements: one or more.
        error: what the ratio is, on the axis.
        title: above.
        beside: curves of seconds and ratio, by name.

    Raises:
        MissingPackageError: matplotlib is not installed.
    """
    figure = figure_class()(figsize=(9, 5.5), layout="constrained")
    axes = figure.subplots()
    front = pareto_front(measurements)
    for chosen, style in ((False, {"color": "0.6", "markersize": 4}), (True, {"color": "C3", "markersize": 8})):
        those = [m for m in measurements if m.point.preset is chosen]
        if not those:
            continue
        errors = [m.standard_error if math.isfinite(m.standard_error) else 0.0 for m in those]
        axes.errorbar(
            [m.seconds for m in those],
            [m.ratio for m in those],
            errors,
            fmt="o",
            elinewidth=0.7,
            label="presets" if chosen else "variations",
            **style,
        )
    axes.plot([m.seconds for m in front], [m.ratio for m in front], drawstyle="steps-post", lw=1, label="Pareto front")
    for label, curve in (beside or {}).items():
        axes.plot(*zip(*curve, strict=True), color="0.4", lw=1, ls="--", label=label)
    axes.axhline(1, color="0.3", lw=0.8, ls=":")
    for m in measurements:
        if m.point.preset or m in front:
            # neighbours on the front lie close: their names go up at an angle, past each other
            look: Any = {"fontsize": 9} if m.point.preset else {"fontsize": 7, "rotation": 40}
            axes.annotate(m.point.name, (m.seconds, m.ratio), xytext=(4, 4), textcoords="offset points", **look)
    axes.set(xscale="log", xlabel="seconds of the correction", ylabel=error, title=title)
    for ticks in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
        ticks("{x:g}")
    axes.tick_params(which="minor", labelsize=7)
    axes.legend()
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=120)
    return data.getvalue()


def figure_class() -> Any:
    """Matplotlib's figure, which draws without a display; to be asked for before long work.

    Raises:
        MissingPackageError: matplotlib is not installed.
    """
    try:
        return importlib.import_module("matplotlib.figure").Figure
    except ImportError as error:
        raise MissingPackageError("the plot", "bench") from error
