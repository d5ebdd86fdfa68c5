"""How training, inference and guard grow from 1080p to 8K: seconds, how busy the cores are, page faults, memory.

    .venv/bin/python scripts/bench/growth.py [--sizes 1920x1080 3840x2160 7680x4320] [--preset fast] [--steps 20]
        [--threads 2] [--rounds 1] [--bare] [--json]

Frames are the packaged one, mirrored until it fills the size: both halves and their denoised images alike, so that all
sizes have the same mix of pixels. No files: images are in memory, as after reading and denoising. Each size is a
process of its own. `busy` is CPU time over wall-clock time and threads; `system` the part of it that the kernel took
(page faults); `peak` the process's, with the frame itself. --bare takes a window of one pixel and two layers, so that
the kernels have next to nothing to do: what is left is what the stages do around them.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from importlib import resources
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import denoisers
from selfcorrect import Frame, Settings, files
from selfcorrect.cli.memory import keep_freed
from selfcorrect.guard import Evidence, guard, keep_light_
from selfcorrect.image.exposure import Scaled, scale_, scale_to_one
from selfcorrect.kernel.guides import mirror
from selfcorrect.stages.core.stage import inferred, trained
from selfcorrect.stages.images import StageImages

Size = tuple[int, int]  # width, height
STAGES = ("train", "infer", "guard")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="*", type=size_of, default=[(1920, 1080), (3840, 2160), (7680, 4320)])
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--rounds", type=int, default=1, help="runs of each size, the quickest of every stage is told")
    parser.add_argument("--bare", action="store_true", help="a window of one pixel and two layers")
    parser.add_argument("--json", action="store_true", help="measure the one size and print it as JSON")
    options = parser.parse_args()
    if options.json:
        print(json.dumps(measured(options.sizes[0], options)))
        return
    print("| size | stage | seconds | ns a pixel | of the first size's | busy | system | faults | peak GiB |")
    print("|---|---|---|---|---|---|---|---|---|")
    first: dict[str, float] = {}
    for size in options.sizes:
        runs = [in_a_process(size, options) for _ in range(options.rounds)]
        pixels, peak = size[0] * size[1], min(run["peak"] for run in runs)
        for stage in STAGES:
            found = min((run[stage] for run in runs), key=lambda run: run["wall"])
            each = found["wall"] / pixels * 1e9
            first.setdefault(stage, each)
            busy, system = (found[name] / found["wall"] / options.threads for name in ("cpu", "system"))
            print(
                f"| {size[0]}x{size[1]} | {stage} | {found['wall']:.2f} | {each:.0f} | {each / first[stage]:.2f} | "
                f"{busy:.0%} | {system:.0%} | {found['faults']:.0f} | {peak:.2f} |",
                flush=True,
            )


def size_of(text: str) -> Size:
    width, _, height = text.partition("x")
    return int(width), int(height)


def in_a_process(size: Size, options: argparse.Namespace) -> dict[str, Any]:
    arguments = ["--sizes", f"{size[0]}x{size[1]}", "--preset", options.preset, "--steps", str(options.steps)]
    script = [
        sys.executable,
        str(Path(__file__).resolve()),
        *arguments,
        "--threads",
        str(options.threads),
        "--json",
        *(["--bare"] if options.bare else []),
    ]
    ran = subprocess.run(script, stdout=subprocess.PIPE, text=True, check=True, cwd=Path(__file__).parent)
    found: dict[str, Any] = json.loads(ran.stdout)
    return found


class Meter:
    """Wall-clock and CPU seconds and page faults of one stage after the other."""

    def __init__(self) -> None:
        self.stages: dict[str, dict[str, float]] = {}
        self._last = self._now()

    @staticmethod
    def _now() -> tuple[float, ...]:
        used = resource.getrusage(resource.RUSAGE_SELF)
        return time.perf_counter(), used.ru_utime + used.ru_stime, used.ru_stime, used.ru_minflt

    def begin(self) -> None:
        """From now on."""
        self._last = self._now()

    def end(self, stage: str) -> None:
        """Until now; the next stage begins."""
        spent = (now - before for now, before in zip(self._now(), self._last, strict=True))
        self.stages[stage] = dict(zip(("wall", "cpu", "system", "faults"), spent, strict=True))
        self.begin()


def measured(size: Size, options: argparse.Namespace) -> dict[str, Any]:
    """What each stage of one correction costs, as :func:`selfcorrect.correct` calls them."""
    torch.set_num_threads(options.threads)
    keep_freed()  # as the command does
    bare = {"window": 1, "layers": 2} if options.bare else {}
    settings = Settings.preset(options.preset, steps=options.steps, **bare)
    corrected(mirrored((256, 256)), settings)  # what is done once in a process
    stages = corrected(mirrored(size), settings)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**30 if sys.platform == "darwin" else 2**20)
    return {"peak": peak, **stages}


def corrected(frame: Frame, settings: Settings) -> dict[str, dict[str, float]]:
    (given,) = frame.candidates
    state = StageImages.of(frame.halves, given, scale_to_one(given.halves))
    meter = Meter()
    network = trained(state, settings).network
    meter.end("train")
    evidence = Evidence(state.scaled_color, state.scaled_images)
    image = inferred(state, network, settings, evidence.add)
    meter.end("infer")
    full = Scaled(state.full, state.scale)
    scale_(image, state.scale)
    guard(evidence, full, [image], scale=state.scale, out=image)
    keep_light_(image, full, state.scaled_color)
    meter.end("guard")
    return meter.stages


def mirrored(size: Size) -> Frame:
    """The packaged frame and what a filter makes of it, mirrored until they fill the size."""
    with resources.as_file(resources.files("selfcorrect") / "data") as folder:
        loaded = files.load(files.Sources(*(str(folder / f"demo_064spp_{half}.exr") for half in "AB")))
    small = loaded.frame.denoise(denoisers.create("box"))
    rows, columns = (mirror(0, length, there) for length, there in zip(size[::-1], small.size, strict=True))

    def large(image: Tensor | None) -> Tensor | None:
        return None if image is None else image[rows][:, columns].contiguous()

    def both(name: str) -> Any:
        pair = getattr(small, name)
        return None if pair is None else tuple(map(large, pair))

    (given,) = small.candidates
    buffers = {name: both(name) for name in ("color", "albedo", "normal", "visibility", "denoised")}
    return Frame(**buffers, denoised_full=large(given.full))


if __name__ == "__main__":
    main()
