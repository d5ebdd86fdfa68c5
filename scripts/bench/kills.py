"""Kills and interrupts at random moments of a shot: an output is whole or not there, and the next run goes on.

    python scripts/bench/kills.py           # 100 SIGKILLs and 100 SIGINTs in turn; --seconds ends it sooner

Each child is forked from a process that has imported everything, so that the moments fall into the work: reading,
training, writing, publishing. One shot is corrected over and over: after each kill the outputs that are there must be
whole and finite, and the folder may hold temporary files only of the last kill, which the next run removes. SIGINT
has to end with exit code 130 (or 0, where the work was done before) and leaves no temporary file at all.
"""

import argparse
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
import torch
from soak import FAST, write_halves

from selfcorrect import cli, exr
from selfcorrect.errors import FileError

FRAMES = 3
HANG = 900.0  # seconds: on a busy machine a run of one second takes minutes


def child(folder: Path) -> int:
    """Correct the shot in a forked process; its id."""
    process = os.fork()
    if process:
        return process
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    code = 99
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        halves = [str(folder / f"{half}.####.exr") for half in "ab"]
        out = ["-o", str(folder / "out" / "x.####.exr"), "--save-state", str(folder / "out" / "x.safetensors")]
        code = cli.main(["sequence", *halves, *out, "--frames", f"1-{FRAMES}", "--skip-existing", *FAST.split()])
    finally:
        os._exit(code)


def state(folder: Path) -> str:
    """Whether all outputs that are there are whole."""
    for path in sorted((folder / "out").glob("x.*.exr")):
        try:
            color = exr.load_half(path).buffers["color"]
        except FileError as error:
            return f"half-written: {error}"
        if not np.isfinite(color).all():
            return f"not finite: {path.name}"
    return "whole"


def left_behind(folder: Path) -> int:
    return sum(path.name.endswith("selfcorrect-tmp") for path in (folder / "out").iterdir())


def ended(process: int, seconds: float) -> int | None:
    """The status of a child, or None where it goes on for longer."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        done, status = os.waitpid(process, os.WNOHANG)
        if done:
            return status
        time.sleep(0.005)
    return None


def trial(folder: Path, sent: signal.Signals, moment: float) -> str:
    """One run that gets a signal; what became of it."""
    for path in (folder / "out").glob("x.*"):
        path.unlink()
    process = child(folder)
    time.sleep(moment)
    os.kill(process, sent)
    status = ended(process, HANG)
    if status is None:
        os.kill(process, signal.SIGKILL)
        os.waitpid(process, 0)
        return "hang"
    found = state(folder)
    if found != "whole":
        return found
    return interrupted(folder, status) if sent == signal.SIGINT else resumed(folder)


def interrupted(folder: Path, status: int) -> str:
    """Whether an interrupted run told of it and left nothing behind."""
    code = os.waitstatus_to_exitcode(status)
    if code not in (0, 130):
        return f"exit code {code}"
    return "a temporary file left behind" if left_behind(folder) else "whole"


def resumed(folder: Path) -> str:
    """Whether the next run makes whole what a killed one left."""
    status = ended(child(folder), HANG)
    if status is None or os.waitstatus_to_exitcode(status):
        return "the next run failed"
    if left_behind(folder) or len(list((folder / "out").glob("x.*.exr"))) < FRAMES:
        return "the next run left something undone"
    return state(folder)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=float("inf"))
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    draw = random.Random(options.seed)
    torch.set_num_threads(1)
    bad = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "out").mkdir()
        write_halves(folder, FRAMES)
        start = time.monotonic()
        ended(child(folder), HANG)
        whole = time.monotonic() - start
        print(f"a run takes {whole:.2f} s; signals come after 0 to {whole:.2f} s", flush=True)
        counts: Counter[tuple[str, str]] = Counter()
        for _ in range(options.times):
            for sent in (signal.SIGKILL, signal.SIGINT):
                counts[sent.name, trial(folder, sent, draw.uniform(0.0, whole))] += 1
            if time.monotonic() - start > options.seconds:
                break
    for (sent_name, outcome), count in sorted(counts.items()):
        print(f"{sent_name}: {count} {outcome}")
        bad += count * (outcome != "whole")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
