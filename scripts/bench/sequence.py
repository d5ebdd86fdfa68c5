"""`selfcorrect sequence` on a shot of tiny frames: memory over its frames, and seconds against `frame` once per file.

    .venv/bin/python scripts/bench/sequence.py [--frames 100] [--size 96 64] [--single 10] [-- any setting]

The frames are noise around stripes, written as Mitsuba writes them; their content does not matter here. Memory is what
the kernel says the process holds (VmRSS), read after every frame.
"""

import argparse
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import OpenEXR


def write_half(path: Path, seed: int, size: tuple[int, int]) -> None:
    rng = np.random.default_rng(seed)
    stripes = 0.5 + 0.4 * np.sin(np.arange(size[1]))
    names = ["R", "G", "B", "albedo.R", "albedo.G", "albedo.B", "nn.X", "nn.Y", "nn.Z", "dd.T"]
    channels = {name: (stripes + 0.1 * rng.standard_normal(size)).astype(np.float16) for name in names}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, channels).write(str(path))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--size", type=int, nargs=2, default=[96, 64], metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--single", type=int, default=10, help="frames that are also run through `frame`")
    parser.add_argument("settings", nargs="*")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for frame in range(1, options.frames + 1):
            for i, half in enumerate("ab"):
                write_half(folder / f"{half}.{frame:04d}.exr", 2 * frame + i, (options.size[1], options.size[0]))
        memory, seconds = sequence(folder, options.frames, options.settings)
        print(f"sequence, {options.frames} frames: {seconds:.2f} s a frame")
        marks = sorted({min(n, len(memory)) - 1 for n in (3, 10, 25, 50, 100, 200, len(memory))})
        print("memory, MB: " + ", ".join(f"{memory[i]:.1f} after frame {i + 1}" for i in marks))
        start = time.perf_counter()
        for frame in range(1, options.single + 1):
            files = [str(folder / f"{half}.{frame:04d}.exr") for half in "ab"]
            command = [sys.executable, "-m", "selfcorrect", "frame", *files, "-o", str(folder / "single.exr")]
            subprocess.run([*command, *options.settings], check=True, capture_output=True)
        print(f"frame, {options.single} processes: {(time.perf_counter() - start) / options.single:.2f} s a frame")


def sequence(folder: Path, frames: int, settings: list[str]) -> tuple[list[float], float]:
    """Megabytes after every frame, and seconds a frame, start-up included."""
    names = [str(folder / name) for name in ("a.####.exr", "b.####.exr", "out.####.exr")]
    command = [sys.executable, "-m", "selfcorrect", "sequence", *names[:2], "-o", names[2], "--frames", f"1-{frames}"]
    memory = []
    start = time.perf_counter()
    with subprocess.Popen(
        [*command, "--json", *settings], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        assert process.stdout is not None
        for _ in process.stdout:
            status = Path(f"/proc/{process.pid}/status").read_text()
            found = re.search(r"VmRSS:\s+(\d+) kB", status)
            if found:
                memory.append(int(found[1]) / 1024)
    assert process.returncode == 0
    return memory, (time.perf_counter() - start) / frames


if __name__ == "__main__":
    main()
