"""What one frame costs from 512² to 8K: seconds of each stage, peak memory, and how both grow with the frame.

    .venv/bin/python scripts/bench/frame.py [--sizes 512 1024 2048 4096 7680x4320] [--preset fast balanced paper]
        [--sample 200] [--threads 2] [--folder DIR]

Frames are the packaged one, mirrored until it fills the size: both halves alike, so that they stay independent. Every
run is a process of its own, whose peak memory is what the system says at its end. For each size: OIDN alone (the full
buffer with albedo and normal), then for each preset the real command `selfcorrect frame` from files to file; what it
takes on top of denoising (further candidates' too) and correction is its overhead: imports, EXR in and out. Presets
that count epochs, like `paper`, would take hours: they are marked ~ and end after --sample of their steps; the seconds
of training are those of a step, the first left out, times the number of all steps, plus what the start took. They are
denoised by `box`, since who denoised makes no difference to the seconds; their memory is that of the correction,
without OIDN's.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import OpenEXR
import power_laws
import torch

import denoisers
from selfcorrect import Settings, correct, files
from selfcorrect.errors import SelfcorrectError
from selfcorrect.stages.core.patches import steps_count

Size = tuple[int, int]  # width, height

COLUMNS = (
    *("size", "run", "denoise", "candidates", "train", "infer", "correction"),
    *("of OIDN's time", "of paper's", "overhead", "peak GiB"),
)


class Cost(NamedTuple):
    """Seconds and memory of one run; NaN where a stage is not part of it."""

    denoise: float
    candidates: float
    train: float
    infer: float
    overhead: float
    gibibytes: float

    @property
    def correction(self) -> float:
        """Seconds of training, inference and guard."""
        return self.train + self.infer


def main() -> None:
    options = parse()
    if options.job:
        print(json.dumps(JOBS[options.job](options)))
        return
    sampled = ", ".join(name for name in options.preset if not Settings.preset(name).steps) or "none"
    print(f"{options.threads} thread(s); sampled ({options.sample} steps, scaled to all): {sampled}")
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}", flush=True)
    costs: dict[str, dict[Size, Cost]] = {}
    for size in options.sizes:
        with tempfile.TemporaryDirectory(dir=options.folder) as folder:
            of_size(options, size, folder, costs)
    for name, by_size in costs.items():
        if len(by_size) < 2:
            continue
        pixels = [width * height for width, height in by_size]
        seconds = [c.denoise if name == "OIDN" else c.correction for c in by_size.values()]
        memory = [c.gibibytes for c in by_size.values()]
        print(
            f"{name}: seconds grow as pixels^{power_laws.exponent(pixels, seconds):.2f}, "
            f"peak memory as pixels^{power_laws.exponent(pixels, memory):.2f}",
            flush=True,
        )


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--sizes", nargs="*", type=size_of, default=[size_of(s) for s in ("512", "1024", "2048", "4096", "7680x4320")]
    )
    parser.add_argument("--preset", nargs="*", default=list(Settings.presets()))
    parser.add_argument("--sample", type=int, default=200, help="steps of a preset that counts epochs")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--folder", help="for the frames, some gigabytes at 8K; by default that of temporary files")
    parser.add_argument("--job", choices=list(JOBS), help=argparse.SUPPRESS)
    return parser.parse_args()


def size_of(text: str) -> Size:
    width, _, height = text.partition("x")
    return int(width), int(height or width)


def of_size(options: argparse.Namespace, size: Size, folder: str, costs: dict[str, dict[Size, Cost]]) -> None:
    """Run all runs on frames of one size, print their rows and keep what they cost."""
    script = [sys.executable, str(Path(__file__).resolve()), "--sizes", f"{size[0]}x{size[1]}", "--folder", folder]
    script += ["--threads", str(options.threads), "--sample", str(options.sample), "--job"]
    run([*script, "frame"])
    oidn = run([*script, "oidn"])
    rows: dict[str, Cost | None] = {"OIDN": None}
    if oidn is not None:
        rows["OIDN"] = Cost(oidn["seconds"], *[math.nan] * 4, oidn["gibibytes"])
    # the sampled ones first, so that the others' ratio to paper can be told at once
    for preset in sorted(options.preset, key=lambda name: Settings.preset(name).steps):
        if Settings.preset(preset).steps:
            rows[preset] = command(options, folder, preset)
        else:
            found = run([*script, "sample", "--preset", preset])
            rows[preset] = found and Cost(*[math.nan] * 2, found["train"], found["infer"], math.nan, found["gibibytes"])
    for name, cost in rows.items():
        told = f"| {size[0]}x{size[1]} | {'' if name == 'OIDN' or Settings.preset(name).steps else '~'}{name} |"
        if cost is None:
            print(f"{told} failed |", flush=True)
            continue
        costs.setdefault(name, {})[size] = cost
        yardsticks = (rows["OIDN"] and rows["OIDN"].denoise, rows.get("paper") and rows["paper"].correction)
        ratios = [cost.correction / y if y else math.nan for y in yardsticks]
        numbers = [cost.denoise, cost.candidates, cost.train, cost.infer, cost.correction]
        cells = [*map(seconds, numbers), *(plain(r) for r in ratios), seconds(cost.overhead), plain(cost.gibibytes)]
        print(f"{told} {' | '.join(cells)} |", flush=True)


def seconds(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.2f}" if value < 100 else f"{value:.0f}"


def plain(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.3g}"


def run(arguments: list[str]) -> dict[str, Any] | None:
    """The JSON that a process prints, with its wall-clock seconds and peak memory; None where it failed.

    A process's peak begins at that of the one which starts it: so this one makes no frames itself.
    """
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        start = time.perf_counter()
        process = subprocess.Popen(arguments, stdout=out, stderr=err, cwd=Path(__file__).parent)
        _, status, usage = os.wait4(process.pid, 0)
        wall = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            err.seek(0)
            last = (err.read().strip().splitlines() or ["no message"])[-1]
            print(f"exit code {process.returncode}: {last}", file=sys.stderr, flush=True)
            return None
        out.seek(0)
        found: dict[str, Any] = json.loads(out.read())
    unit = 2**30 if sys.platform == "darwin" else 2**20  # bytes there, KiB elsewhere
    return {"wall": wall, "gibibytes": usage.ru_maxrss / unit, **found}


def command(options: argparse.Namespace, folder: str, preset: str) -> Cost | None:
    """The real command, from its start to its end."""
    halves = [f"{folder}/{half}.exr" for half in "AB"]
    arguments = ["frame", *halves, "-o", f"{folder}/{preset}.exr", "--preset", preset, "--denoiser", "oidn", "--json"]
    found = run([sys.executable, "-m", "selfcorrect", *arguments, "--threads", str(options.threads)])
    if found is None:
        return None
    Path(f"{folder}/{preset}.exr").unlink()
    names = ("denoise", "candidates", "train", "infer", "guard")
    denoise, candidates, train, infer, guard = (found["seconds"].get(name, 0.0) for name in names)
    overhead = found["wall"] - denoise - candidates - train - infer - guard
    return Cost(denoise, candidates, train, infer + guard, overhead, found["gibibytes"])


def make_frame(options: argparse.Namespace) -> dict[str, Any]:
    """Job: write the halves of a frame of the size."""
    (width, height), *_ = options.sizes
    for half in "AB":
        with resources.as_file(resources.files("selfcorrect") / "data" / f"demo_064spp_{half}.exr") as path:
            file = OpenEXR.File(str(path), separate_channels=True)
        channels = {}
        for name, channel in file.channels().items():
            pixels = channel.pixels
            both = np.block([[pixels, pixels[:, ::-1]], [pixels[::-1], pixels[::-1, ::-1]]])
            tiles = (-(-height // both.shape[0]), -(-width // both.shape[1]))
            channels[name] = np.ascontiguousarray(np.tile(both, tiles)[:height, :width])
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, channels).write(f"{options.folder}/{half}.exr")
    return {}


def time_oidn(options: argparse.Namespace) -> dict[str, Any]:
    """Job: seconds of one denoising of the full buffer."""
    torch.set_num_threads(options.threads)
    denoise = denoisers.create("oidn", threads=options.threads)
    halves = files.load(files.Sources(f"{options.folder}/A.exr", f"{options.folder}/B.exr")).frame
    color, albedo, normal = ((a + b) / 2 for a, b in (halves.color, halves.albedo, halves.normal))
    denoise(color[:64, :64], albedo=albedo[:64, :64], normal=normal[:64, :64])  # the first call is slower
    start = time.perf_counter()
    denoise(color, albedo=albedo, normal=normal)
    return {"seconds": time.perf_counter() - start}


def sample(options: argparse.Namespace) -> dict[str, Any]:
    """Job: seconds of a preset that counts epochs, from a number of its steps."""
    torch.set_num_threads(options.threads)
    frame = files.load(files.Sources(f"{options.folder}/A.exr", f"{options.folder}/B.exr")).frame
    frame = frame.denoise(denoisers.create("box"))
    settings = Settings.preset(options.preset[0])
    steps = steps_count(frame.size, settings)
    times: list[float] = []
    result = correct(
        frame,
        settings,
        progress=lambda *_: times.append(time.perf_counter()),
        stop=lambda: len(times) >= options.sample,
    )
    if len(times) < 2:
        raise SelfcorrectError(f"expected --sample of at least 2, but got {options.sample}")
    each = (times[-1] - times[0]) / (len(times) - 1)
    train = result.seconds["train"] + each * (steps - len(times))
    return {"train": train, "infer": result.seconds["infer"] + result.seconds.get("guard", 0.0)}


JOBS = {"frame": make_frame, "oidn": time_oidn, "sample": sample}


if __name__ == "__main__":
    main()
