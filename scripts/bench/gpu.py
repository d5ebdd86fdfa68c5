"""The kernel for CUDA: what it compiles to, what a card should make of it, and on a machine with a card what it does.

Everywhere: the compile table (registers, spilled bytes, shared memory and the inner loop's instructions of every
variant, compiled ahead of time, no device needed) and predicted times from bounds. With a CUDA device: gradients
against the reference first, then kernel, network, step and whole frames timed beside those bounds and the CPU.

    .venv/bin/python scripts/bench/gpu.py [--few] [--json] [--no-measurement] [--no-cpu]

The predictions assume, and nobody has measured:
- the window's loop issues one instruction a clock and scheduler, the counted ones; a warp alone needs LATENCY clocks
  for an iteration; neighbours come from level 1 (GRADIENTS.md has the traffic);
- convolutions reach CONVOLUTION_SHARE of the card's peak and all memory traffic MEMORY_SHARE of its bandwidth;
- the host spends LAUNCH seconds on an operation, which is what a step of small patches waits for;
- guard, exposure and copies take REST seconds for a megapixel.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Any

import torch
import triton
from gpu_variants import EVERYTHING, LARGEST_SHARED, Variant, programs_together, unfit, variants
from kernel import ALL, best, make_guides
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from selfcorrect import Frame, Settings, correct
from selfcorrect.kernel.convolution.reference import convolutions as convolutions_reference
from selfcorrect.kernel.cross_bilateral import Window, cross_bilateral_loss, gpu, heads_count
from selfcorrect.kernel.guides import Guides
from selfcorrect.stages.core.loss import dual_buffer_loss, relative_weight
from selfcorrect.stages.core.network import Network
from selfcorrect.stages.core.patches import batches, steps_count
from selfcorrect.stages.core.train import Adam

LATENCY = 300.0  # clocks: loads from level 1, two logarithms, one exponential, and the sums that wait for them
CONVOLUTION_SHARE = 0.4
MEMORY_SHARE = 0.7
LAUNCH = 8e-6
REST = 0.1
SIZES = ((1024, 1024), (2160, 3840))


@dataclass(frozen=True)
class Card:
    """What a card's data sheet says.

    Attributes:
        name: of the card.
        target: compute capability whose compiled loop is counted.
        processors: streaming multiprocessors, of four schedulers each.
        clock: boost, Hz.
        fp32, bf16: peak of convolutions, FLOP/s: without tensor cores, and with them.
        bandwidth: of memory, bytes/s.
    """

    name: str
    target: int
    processors: int
    clock: float
    fp32: float
    bf16: float
    bandwidth: float


CARDS = (
    Card("RTX 3090", 80, 82, 1.695e9, 35.6e12, 71e12, 936e9),
    Card("H100 SXM", 90, 132, 1.755e9, 67e12, 990e12, 3350e9),
)


class _Counting(TorchDispatchMode):
    """Counts the operations that start something on a device: all but views and allocations."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket._qualified_op_name
        view = func.is_view or name in ("aten::empty", "aten::empty_like", "aten::new_empty", "aten::detach")
        self.count += not view
        return func(*args, **(kwargs or {}))


def operations(settings: Settings) -> int:
    """Of one optimiser step as a device takes it; counted on the CPU, where the kernel's own are a few more."""
    small = replace(settings, batch=1, patch=16, stride=16)  # their number does not depend on size
    step, _ = a_step(small, make_guides(32, ALL), make_guides(32, ALL), plain=True)
    step()
    with _Counting() as counting:
        step()
    return counting.count


def a_step(
    settings: Settings, a: Guides, b: Guides, *, plain: bool = False
) -> tuple[Callable[[], None], tuple[Callable[[], None], Callable[[], None]]]:
    """A training step on given guides; and its two parts, kernel and network. ``plain``: convolutions by torch."""
    generator = torch.Generator().manual_seed(0)
    network = Network.for_guides(a, settings, generator)
    optimiser = Adam(network.parameters(), settings.adam_epsilon, settings.gradient_limit or float("inf"))
    weights = (relative_weight(b.denoised, 0.01), relative_weight(a.denoised, 0.01))
    size = (settings.patch, settings.patch)
    corners = next(iter(batches(a, settings, generator))).clamp(0, a.height - settings.patch)

    def heads() -> Tensor:
        views = [patch for half in (a, b) for patch in half.views(corners, size)]
        if plain:
            return convolutions_reference(views, list(network.parameters()), log_radiance=network.log_radiance)
        return network(views)

    raw = heads().detach().requires_grad_()
    upstream = torch.randn(raw.shape, generator=generator).to(raw.device)

    def step() -> None:
        loss = dual_buffer_loss(heads(), corners, (a, b), weights, settings)
        loss.backward()
        optimiser.step(1e-3, loss.detach())

    def kernel() -> None:
        raw.grad = None
        dual_buffer_loss(raw, corners, (a, b), weights, settings).backward()

    def convolutions() -> None:
        heads().backward(upstream)

    return step, (kernel, convolutions)


@dataclass(frozen=True)
class Prediction:
    """Seconds of a preset on a card, by parts; those of a step, and those of the whole frame."""

    kernel: float
    convolutions: float
    host: float
    step: float
    steps: int
    training: float
    inference: float
    total: float


def predicted(card: Card, preset: str, size: tuple[int, int], table: list[Variant], launches: int) -> Prediction:
    """From bounds and the assumptions that stand above."""
    settings = Settings.preset(preset)
    taps = settings.window**2 / settings.taps_every
    loss, forward = (
        next(v for v in table if (v.target, v.mode, v.buffers, v.window) == (card.target, mode, EVERYTHING, 19))
        for mode in ("LOSS", "FORWARD")
    )

    def kernel(pixels: int, variant: Variant) -> float:
        """A launch on so many pixels: warps that share a scheduler take turns, one alone waits for itself."""
        warps = max(pixels / 32 / (4 * card.processors), 1.0)
        return taps * max(warps * variant.instructions, LATENCY) / card.clock

    def convolutions(pixels: int, passes: int) -> float:
        """``passes``: 1 forward, 3 with backward."""
        numbers = 13 * 16 + 7 * 16 * 16 + 16 * 15
        bf16 = settings.precision == "bf16"
        work = 2 * 9 * numbers * pixels * passes / (CONVOLUTION_SHARE * (card.bf16 if bf16 else card.fp32))
        # a layer reads and writes its activations, and with backward their gradients, four times for each pass
        moved = 4 * passes * settings.layers * settings.filters * pixels * (2 if bf16 else 4)
        return max(work, moved / (MEMORY_SHARE * card.bandwidth))

    pixels = settings.batch * settings.patch**2
    steps = steps_count(size, settings)
    a_kernel, a_network, host = 2 * kernel(pixels, loss), convolutions(2 * pixels, 3), launches * LAUNCH
    step = max(a_kernel + a_network, host)
    whole = 2 * size[0] * size[1]
    inference = kernel(whole, forward) + convolutions(whole, 1)
    rest = REST * size[0] * size[1] / 2**20
    total = steps * step + inference + rest
    return Prediction(a_kernel, a_network, host, step, steps, steps * step, inference, total)


def wait(device: torch.device) -> None:
    """Until the device has done what it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def worst_difference(device: torch.device, backend: str | None = None) -> dict[str, float]:
    """To the float64 reference, over the largest value: the loss, and the gradient of the worst head."""
    guides = make_guides(48, ALL)
    corners = torch.tensor([[0, 0], [5, 11]])
    raw = torch.randn(2, heads_count(guides, "eq10"), 32, 37, generator=torch.Generator().manual_seed(1))
    results = []
    for where, kind in ((torch.device("cpu"), torch.float64), (device, torch.float32)):
        planes = guides.planes.to(where, kind)
        half = replace(guides, planes=planes)
        leaf = raw.to(where, kind).requires_grad_()
        chosen = "reference" if kind == torch.float64 else backend
        loss = cross_bilateral_loss(half, leaf, corners, half.denoised, planes[3], Window(9), backend=chosen)
        loss.backward()
        assert leaf.grad is not None
        results.append((loss.detach().cpu().double(), leaf.grad.cpu().double()))
    (expected, by_heads), (got, found) = results
    scale = by_heads.abs().amax((0, 2, 3))
    heads = (found - by_heads).abs().amax((0, 2, 3)) / scale
    return {"loss": float((got - expected).abs() / expected.abs()), "gradient": float(heads.max())}


def measured(device: torch.device, preset: str, size: tuple[int, int], repeat: int) -> dict[str, float]:
    """Seconds of kernel, network, step and frame, and the peak of the device's memory in GiB."""
    settings = Settings.preset(preset)
    halves = [make_guides(max(size[0] // 4, settings.patch), ALL) for _ in "ab"]
    a, b = (replace(half, planes=half.planes.to(device)) for half in halves)
    step, (kernel, convolutions) = a_step(settings, a, b)

    def timed(function: Callable[[], None]) -> float:
        def whole() -> None:
            function()
            wait(device)

        return best(whole, repeat)

    found = {"kernel": timed(kernel), "convolutions": timed(convolutions), "step": timed(step)}
    frame = a_frame(size).to(device)
    correct(frame, settings)  # compiles
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    start = time.perf_counter()
    result = correct(frame, settings)
    wait(device)
    found |= {"total": time.perf_counter() - start} | result.seconds
    if device.type == "cuda":
        found["peak memory"] = torch.cuda.max_memory_allocated(device) / 2**30
    return found


def a_frame(size: tuple[int, int]) -> Frame:
    """Noise: what is timed does not depend on the picture."""
    generator = torch.Generator().manual_seed(0)

    def pair(channels: int = 3) -> tuple[Tensor, Tensor]:
        a, b = (torch.rand(*size, channels, generator=generator) for _ in "ab")
        return a, b

    return Frame(color=pair(), denoised=pair(), albedo=pair(), normal=pair(), visibility=pair(1))


def print_table(table: Iterable[Variant]) -> list[Variant]:
    """Each row as soon as it is compiled."""
    print("| sm | mode | buffers | window | taps | Eq. | registers | spilled | shared | warps | loop | FMA | loads |")
    print("|---:|---|---|---:|---|---|---:|---:|---:|---:|---:|---:|---:|")
    rows = []
    for v in table:
        rows.append(v)
        taps = "all" if v.every == 1 else f"1 in {v.every}"
        print(
            f"| {v.target} | {v.mode.lower()} | {v.buffers} | {v.window} | {taps} | {v.combination[2:]} "
            f"| {v.registers} | {v.spilled} | {v.shared} | {gpu.WARPS * programs_together(v)} "
            f"| {v.instructions} | {v.multiply_adds} | {v.loads} |",
            flush=True,
        )
    return rows


def print_summary(table: list[Variant]) -> None:
    """The worst of each target and mode."""
    print("\n| sm | mode | variants | registers | spilled | shared | warps |\n|---:|---|---:|---:|---:|---:|---:|")
    for target, mode in sorted({(v.target, v.mode) for v in table}):
        of = [v for v in table if (v.target, v.mode) == (target, mode)]
        registers = sorted(v.registers for v in of)
        spilled, shared = max(v.spilled for v in of), max(v.shared for v in of)
        warps = gpu.WARPS * min(map(programs_together, of))
        print(
            f"| {target} | {mode.lower()} | {len(of)} | {registers[0]} to {registers[-1]} | {spilled} | {shared} "
            f"| {warps} or more |"
        )


def print_predictions(table: list[Variant]) -> None:
    print(
        "\n| card | preset | size | kernel, ms | network, ms | host, ms | step, ms | steps | inference, s | frame, s |"
    )
    print("|---|---|---|---:|---:|---:|---:|---:|---:|---:|")
    launches = {preset: operations(Settings.preset(preset)) for preset in ("fast", "balanced", "paper")}
    for card, size, preset in product(CARDS, SIZES, launches):
        p = predicted(card, preset, size, table, launches[preset])
        print(
            f"| {card.name} | {preset} | {size[1]}×{size[0]} | {1e3 * p.kernel:.2f} | {1e3 * p.convolutions:.2f} "
            f"| {1e3 * p.host:.2f} | {1e3 * p.step:.2f} | {p.steps} | {p.inference:.3f} | {p.total:.2f} |"
        )
    print(f"\noperations of a step, counted: {launches}")


def print_measurements(device: torch.device, cpu_too: bool) -> None:
    print(f"\n{torch.cuda.get_device_name(device)}; difference to the reference: {worst_difference(device)}")
    for size, preset in product(SIZES, ("fast", "balanced", "paper")):
        print(f"{preset}, {size[1]}×{size[0]}: {rounded(measured(device, preset, size, 5))}")
    if cpu_too:
        print(f"fast, 1024×1024, on the CPU: {rounded(measured(torch.device('cpu'), 'fast', SIZES[0], 1))}")


def rounded(values: dict[str, float]) -> dict[str, float]:
    return {name: float(f"{value:.3g}") for name, value in values.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--few", action="store_true", help="one variant of each mode and target")
    parser.add_argument("--json", action="store_true", help="the compile table alone, as JSON")
    parser.add_argument("--no-measurement", action="store_true", help="also where there is a device")
    parser.add_argument("--no-cpu", action="store_true", help="do not time the CPU beside the device")
    options = parser.parse_args()
    if options.json:
        print(json.dumps([asdict(variant) for variant in variants(few=options.few)]))
        return
    print(f"Triton {triton.__version__}, torch {torch.__version__}\n")
    table = print_table(variants(few=options.few))
    print_summary(table)
    if bad := unfit(table):
        sys.exit(f"expected variants without spills and of at most {LARGEST_SHARED} shared bytes, but got {bad}")
    print_predictions(table)
    if torch.cuda.is_available() and not options.no_measurement:
        print_measurements(torch.device("cuda"), cpu_too=not options.no_cpu)
    else:
        print("no CUDA device: nothing was measured")


if __name__ == "__main__":
    main()
