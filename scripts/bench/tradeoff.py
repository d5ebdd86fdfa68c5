"""Seconds against true error over the frames that have references: the Pareto front of settings, as CSV and PNG.

    .venv/bin/python scripts/bench/tradeoff.py ../shared/frames [--frames …] [--spp 64] [--points fast window=7 …]
        [--preset balanced] [--csv OUT.csv [--resume]] [--plot OUT.png]

Points are those of `selfcorrect bench`: presets (as they are, the guard as each of them has it), ``base`` (--preset),
``SETTING=VALUE,…`` on top of the base, ``PRESET:SETTING=VALUE,…``; by default its list. Each frame is read and denoised
once. Every line is one frame and point: relMSE over the denoiser's against two references, with its standard error
(bootstrap over 16x16 tiles), and the seconds, with those of the further denoisings that the settings ask for. Where
the folder has the frame with more samples, a curve says what the denoiser alone would make of the same seconds spent on
rendering (`equal_time.py` has how). At the end the geometric mean over frames, the mean seconds, and the
Pareto front. --csv is written after each line; with --resume what it holds (same frame, spp, point and settings) is not
measured again, but then seconds come from several runs. Warm starts need a shot: `scripts/bench/shot.py`.
"""

import argparse
import csv
import json
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import power_laws
import torch
from equal_time import renderer_seconds
from quality import load

import denoisers
from selfcorrect import Frame, Settings, exr, metrics, tradeoff
from selfcorrect.candidates import with_candidates
from selfcorrect.publish import publish
from selfcorrect.tradeoff import Measurement, Point

Row = tuple[str, int, Measurement]


def main() -> None:
    options = parse()
    torch.set_num_threads(options.threads)
    table, picture = (
        None if path is None else exr.check_target(path, suffix)
        for path, suffix in ((options.csv, ".csv"), (options.plot, ".png"))
    )
    if picture is not None:
        tradeoff.figure_class()
    base = Settings.preset(options.preset)
    points = [tradeoff.point(name, base) for name in options.points or []] or tradeoff.points(base)
    names = options.frames or sorted({p.name.split("_")[0] for p in options.folder.glob("*_ref_A.exr")})
    rows: list[Row] = read(table, points) if options.resume and table is not None and table.exists() else []
    known = {(name, spp, m.point.name) for name, spp, m in rows}
    print(f"{len(points)} points on {len(names)} frames, {options.denoiser}, {options.threads} thread(s)", flush=True)
    for name in names:
        for spp in options.spp:
            wanted = [p for p in points if (name, spp, p.name) not in known]
            for one in measured(options, name, spp, wanted):
                rows.append((name, spp, one))
                print(f"{name} {spp} spp, {told(one)}", flush=True)
                if table is not None:
                    publish(table, as_csv(rows))
    several = summary([row for row in rows if row[0] in names and row[1] in options.spp], points)
    if picture is not None:
        title = f"{', '.join(names)}; {', '.join(map(str, options.spp))} spp"
        seconds = [m.seconds for m in several]
        curve = more_samples(options, names, torch.logspace(*(math.log10(f(seconds)) for f in (min, max)), 40).tolist())
        error = f"relMSE over that of {options.denoiser}"
        publish(picture, tradeoff.plot(several, error, title=title, beside={"more samples instead": curve}))


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", nargs="*", help="names; by default all in the folder")
    parser.add_argument("--spp", type=int, nargs="*", default=[64], help="0: the references as halves")
    parser.add_argument("--points", nargs="*")
    parser.add_argument("--preset", default=Settings.default(), help="the base that is varied")
    parser.add_argument("--denoiser", default="oidn")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--csv")
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--plot")
    return parser.parse_args()


def measured(options: argparse.Namespace, name: str, spp: int, points: list[Point]) -> Any:
    """Measurements of one frame, one by one; the frame is not read where there are no points."""
    if not points:
        return
    frame, references = load(options.folder, name, spp)
    frame = frame.denoise(denoisers.create(options.denoiser, threads=options.threads), keep_aids=True)
    for mode in dict.fromkeys(p.settings.candidates for p in points):
        start = time.perf_counter()
        own = with_modes(options, frame, mode)
        more = time.perf_counter() - start
        those = [p for p in points if p.settings.candidates == mode]
        for one in tradeoff.sweep(
            own, those, lambda result: metrics.relmse_ratio(result.image, frame.denoised_full, *references)
        ):
            yield replace(one, infer=one.infer + more)


def with_modes(options: argparse.Namespace, frame: Frame, mode: str) -> Frame:
    """The frame with further modes of its denoiser as candidates, as the command would take them."""
    if mode == "none":
        return frame
    further = {spec: denoisers.create(spec, threads=options.threads) for spec in denoisers.variants(options.denoiser)}
    own, _ = with_candidates(frame, further, every=mode == "all")
    return own


def more_samples(
    options: argparse.Namespace, names: Sequence[str], seconds: Sequence[float]
) -> list[tuple[float, float]]:
    """Seconds and what they would bring as samples: the denoiser's error over what it is now, geometric mean."""
    costs, denoise = renderer_seconds(options.folder), denoisers.create(options.denoiser, threads=options.threads)
    ratios = torch.zeros(len(seconds), dtype=torch.float64)
    for name in names:
        known = sorted(int(p.name.split("_")[1].removesuffix("spp")) for p in options.folder.glob(f"{name}_*spp_A.exr"))
        errors = []
        for spp in known:
            frame, references = load(options.folder, name, spp)
            errors.append(metrics.relmse(frame.denoise(denoise).denoised_full, *references))
        for spp in options.spp:
            now = power_laws.interpolated(known, errors, spp)
            later = [power_laws.interpolated(known, errors, spp + s * options.threads / costs[name]) for s in seconds]
            ratios += (torch.tensor(later, dtype=torch.float64) / now).log()
    means = (ratios / (len(names) * len(options.spp))).exp()
    return list(zip(seconds, means.tolist(), strict=True))


def told(m: Measurement) -> str:
    return (
        f"{m.point.name}: {m.ratio:.3f} ± {m.standard_error:.3f} in {m.seconds:.2f} s "
        f"(train {m.train:.2f}, infer {m.infer:.2f})"
    )


def as_csv(rows: list[Row]) -> bytes:
    """Every row; the column ``front`` would mix frames, so it is taken within each frame and spp."""
    groups = list(dict.fromkeys((name, spp) for name, spp, _ in rows))
    lines: list[bytes] = []
    for name, spp in groups:
        own = [m for n, s, m in rows if (n, s) == (name, spp)]
        header, *body = tradeoff.table(own, frame=[name] * len(own), spp=[spp] * len(own)).splitlines(keepends=True)
        lines += body if lines else [header, *body]
    return b"".join(lines)


def read(table: Path, points: list[Point]) -> list[Row]:
    """What an earlier run has measured of these points, with the same settings."""
    wanted = {p.name: p for p in points}
    rows = []
    with table.open(newline="", encoding="utf-8") as stream:
        for line in csv.DictReader(stream):
            point = wanted.get(line["point"])
            if point is None or json.loads(line["settings"]) != point.settings.to_dict():
                continue
            numbers = [float(line[key]) for key in ("ratio", "standard_error", "train", "infer")]
            rows.append((line["frame"], int(line["spp"]), Measurement(point, *numbers)))
    return rows


def summary(rows: list[Row], points: list[Point]) -> list[Measurement]:
    """Print each point over all frames; returns those measurements."""
    several = [tradeoff.over_frames(own) for p in points if (own := [m for _, _, m in rows if m.point.name == p.name])]
    front = tradeoff.pareto_front(several)
    print("\n| point | relMSE ratio, geometric mean | worst | seconds a frame | train | infer | Pareto front |")
    print("|---|---|---|---|---|---|---|")
    for one in several:
        worst = max(m.ratio for _, _, m in rows if m.point.name == one.point.name)
        print(
            f"| {one.point.name} | {one.ratio:.3f} ± {one.standard_error:.3f} | {worst:.3f} | {one.seconds:.2f} "
            f"| {one.train:.2f} | {one.infer:.2f} | {'yes' if one in front else ''} |"
        )
    print(f"front, the quickest first: {', '.join(m.point.name for m in front)}", flush=True)
    chosen = tradeoff.recommended(several)
    if chosen is not None:
        print(f"recommended: {chosen.point.name}", flush=True)
    return several


if __name__ == "__main__":
    main()
