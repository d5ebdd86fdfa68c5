"""A long shot of tiny frames: memory, descriptors, threads and temporary files have to stay flat.

    python scripts/bench/soak.py            # 300 frames; a row of the table for every fiftieth

Exit code 1 where anything grows after the first fifty frames: descriptors, threads or temporary files at all, memory
by more than 32 MiB.
"""

import argparse
import os
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import OpenEXR

from selfcorrect import cli
from selfcorrect.cli import sequence

EVERY = 50
GROWTH = 32.0  # MiB: the allocator's own ups and downs
FAST = "--steps 2 --warm-steps 2 --patch 16 --batch 1 --window 5 --denoiser box --threads 1 --preset fast"


class Taken(NamedTuple):
    """What the process holds after so many frames."""

    frames: int
    memory: float  # MiB, resident
    descriptors: int
    threads: int
    files: int  # temporary ones, in the system's folder and in that of the outputs


def write_halves(folder: Path, frames: int) -> None:
    names = [*"RGB", *(f"albedo.{c}" for c in "RGB"), *(f"nn.{c}" for c in "XYZ"), "dd.T"]
    for frame in range(1, frames + 1):
        for number, half in enumerate("ab"):
            generator = np.random.default_rng([frame, number])
            channels = {name: generator.random((24, 30), dtype=np.float32).astype(np.float16) for name in names}
            OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(str(folder / f"{half}.{frame:04d}.exr"))


def taken(frames: int, folder: Path) -> Taken:
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines())
    files = [path for place in (folder / "out", folder / "tmp") for path in place.iterdir()]
    return Taken(
        frames,
        int(status["VmRSS"].split()[0]) / 1024,
        len(os.listdir("/proc/self/fd")),
        int(status["Threads"]),
        sum(not path.name.startswith("x.") for path in files),
    )


def soak(frames: int, folder: Path) -> list[Taken]:
    """Correct a shot in this process; what it held on the way, a row of which is printed as it is taken."""
    for name in ("out", "tmp"):
        (folder / name).mkdir()
    tempfile.tempdir = str(folder / "tmp")
    write_halves(folder, frames)
    rows: list[Taken] = []
    done = 0

    def count(told: Any) -> None:
        nonlocal done
        done += told["outcome"] == "written"
        if done % EVERY == 0:
            rows.append(row := taken(done, folder))
            print(f"| {row.frames} | {row.memory:.1f} | {row.descriptors} | {row.threads} | {row.files} |", flush=True)

    sequence.answer = count  # in place of lines on stdout
    given = ["sequence", *(str(folder / f"{half}.####.exr") for half in "ab"), "-o", str(folder / "out" / "x.####.exr")]
    state = str(folder / "out" / "x.safetensors")
    code = cli.main([*given, "--frames", f"1-{frames}", "--save-state", state, "--json", *FAST.split()])
    if code or done < frames:
        raise SystemExit(f"expected {frames} frames, but got {done} and exit code {code}")
    return rows


def grown(rows: list[Taken]) -> list[str]:
    """What grew after the first row."""
    first, last = rows[0], rows[-1]
    found = [name for name in ("descriptors", "threads", "files") if getattr(last, name) > getattr(first, name)]
    return found + ["memory"] * (last.memory > first.memory + GROWTH)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=300)
    options = parser.parse_args()
    print("| frames | MiB | descriptors | threads | temporary files |\n|---|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        rows = soak(options.frames, Path(folder))
    print(f"grown: {', '.join(grown(rows)) or 'nothing'}")
    return bool(grown(rows))


if __name__ == "__main__":
    sys.exit(main())
