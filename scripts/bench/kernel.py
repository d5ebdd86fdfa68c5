"""Nanoseconds per pixel, tap and half buffer of the cross-bilateral kernel, forward and backward.

Reference (the whole window gathered at once, and as a loop over shifts) and the compiled kernel, side by side in
one run, with 1 and 2 threads; then the seconds of one `paper` run of 512x512, split into kernel, CNN and the rest.

    .venv/bin/python scripts/bench/kernel.py [--repeat 5] [--no-run]
"""

import argparse
import platform
import time
from collections.abc import Callable
from pathlib import Path

import torch

from selfcorrect import Frame, Settings, correct
from selfcorrect.buffers import TERMS
from selfcorrect.kernel.backend import instruction_sets
from selfcorrect.kernel.cross_bilateral import Window, cpu, heads_count, reference
from selfcorrect.kernel.guides import Guides
from selfcorrect.stages.core.loss import dual_buffer_loss, witnesses
from selfcorrect.stages.core.network import Network

WINDOW = Window(19)
PATCH = 128  # the paper's
ALL = tuple(term.name for term in TERMS)


def processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{models[0]}, {len(models)} cores" if models else platform.processor()


def best(function: Callable[[], None], repeat: int) -> float:
    function()
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


SETS = {
    "color": ("color", "denoised"),
    "color, albedo, normal": ("color", "denoised", "albedo", "normal"),
    "color, albedo, normal, visibility": ALL,
}


def make_guides(size: int, buffers: tuple[str, ...]) -> Guides:
    generator = torch.Generator().manual_seed(0)
    there = [term for term in TERMS if term.name in buffers]
    half = {term.name: torch.rand(size, size, term.channels, generator=generator) for term in there}
    return Guides.of_half(half, margin=WINDOW.radius)


def nanoseconds(form: str, size: int, threads: int, repeat: int, buffers: tuple[str, ...] = ALL) -> float:
    """Forward and backward of Eq. 10 and Eq. 8's half on one image of size² pixels."""
    torch.set_num_threads(threads)
    guides = make_guides(size, buffers)
    raw = 0.3 * torch.randn(1, heads_count(guides, "eq10"), size, size, generator=torch.Generator().manual_seed(1))
    raw = raw.to(memory_format=torch.channels_last).requires_grad_()
    corners = torch.zeros(1, 2, dtype=torch.int64)
    target, weight = guides.denoised, torch.ones_like(guides.planes[0])
    cut = guides.patches(corners, (size, size))[:, -3:]

    def run() -> None:
        if form in ("unfold", "shift"):
            taps = None if form == "unfold" else 1
            g = reference.cross_bilateral(guides, raw, corners, WINDOW, taps_per_step=taps)
            loss = 0.5 * (g - cut).square().mean()
        else:
            loss = cpu.cross_bilateral_loss(guides, raw, corners, target, weight, WINDOW, threads=threads, isa=form)
        raw.grad = None
        loss.backward()

    return best(run, repeat) / (size * size * WINDOW.side**2) * 1e9


def split_run(size: int) -> None:
    """One paper run, and what a step of it spends in the kernel and in the CNN."""
    generator = torch.Generator().manual_seed(0)
    images = [torch.rand(size, size, 3, generator=generator) for _ in range(8)]
    visibility = tuple(image[:, :, :1] for image in images[:2])
    color, denoised, albedo, normal = (tuple(images[i : i + 2]) for i in (0, 2, 4, 6))
    frame = Frame(color=color, denoised=denoised, albedo=albedo, normal=normal, visibility=visibility)
    settings = Settings.preset("paper")
    start = time.perf_counter()
    result = correct(frame, settings)
    total = time.perf_counter() - start

    guides = tuple(Guides.of_half(half._asdict(), margin=73) for half in frame.halves)
    judges = witnesses(guides, settings)
    corners = torch.randint(0, size - 128, (settings.batch, 2), generator=generator)
    batch = torch.cat([half.patches(corners, (128, 128)) for half in guides])
    network = Network.for_guides(guides[0], settings, generator)
    raw = network(batch).detach().requires_grad_()

    def kernel() -> None:
        dual_buffer_loss(raw, corners, guides, judges, settings).backward()

    upstream = torch.randn_like(raw)

    def cnn() -> None:
        network(batch).backward(upstream)

    steps = len(result.losses)
    in_kernel, in_cnn = (best(f, 3) * steps for f in (kernel, cnn))
    print(f"\npaper, {size}x{size}, {torch.get_num_threads()} threads, {steps} steps: {total:.1f} s")
    print(f"  kernel {in_kernel:.1f} s, CNN {in_cnn:.1f} s, other {max(0.0, total - in_kernel - in_cnn):.1f} s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--no-run", action="store_true", help="leave out the 512x512 run")
    options = parser.parse_args()
    print(f"{processor()}; torch {torch.__version__}; window {WINDOW.side}, all 13 channels")
    print("ns per pixel, tap and buffer, forward + backward (best of runs)")
    for threads in (1, 2):
        unfold = nanoseconds("unfold", PATCH, threads, 2)
        shift = nanoseconds("shift", PATCH, threads, 2)
        print(f"{threads} thread(s)  reference: unfold {unfold:.1f}, shift loop {shift:.1f}")
        for isa in instruction_sets():
            value = nanoseconds(isa, PATCH, threads, options.repeat)
            print(f"  {isa:9} {value:6.2f}   {unfold / value:6.0f}x unfold  {shift / value:5.0f}x shift loop")
    for name, buffers in SETS.items():
        value = nanoseconds(instruction_sets()[-1], PATCH, 1, options.repeat, buffers)
        print(f"{instruction_sets()[-1]}, 1 thread, {name}: {value:.2f}")
    if not options.no_run:
        torch.set_num_threads(2)
        split_run(512)


if __name__ == "__main__":
    main()
