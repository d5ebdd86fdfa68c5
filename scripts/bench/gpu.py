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
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Any

import torch
import triton
from gpu_measurements import LARGEST_DIFFERENCE, differences, frame_seconds, parts, same_frame, step_seconds
from gpu_variants import EVERYTHING, LARGEST_SHARED, Variant, programs_together, unfit, variants
from kernel import ALL, make_guides
from torch.utils._python_dispatch import TorchDispatchMode

from selfcorrect import Settings
from selfcorrect.kernel.cross_bilateral import gpu
from selfcorrect.stages.core.patches import steps_count

LATENCY = 300.0  # clocks: loads from level 1, two logarithms, one exponential, and the sums that wait for them
CONVOLUTION_SHARE = 0.4
MEMORY_SHARE = 0.7
LAUNCH = 8e-6
REST = 0.1
SIZES = ((1024, 1024), (2160, 3840))
PRESETS = ("fast", "balanced", "paper")


@dataclass(frozen=True)
class Card:
    """What a card's data sheet says.

    Attributes:
        name: of the card.
        sign: what the driver's name of it contains.
        target: compute capability whose compiled loop is counted.
        processors: streaming multiprocessors, of four schedulers each.
        clock: boost, Hz.
        fp32, bf16: peak of convolutions, FLOP/s: without tensor cores, and with them.
        bandwidth: of memory, bytes/s.
    """

    name: str
    sign: str
    target: int
    processors: int
    clock: float
    fp32: float
    bf16: float
    bandwidth: float


CARDS = (
    Card("RTX 3090", "RTX 3090", 80, 82, 1.695e9, 35.6e12, 71e12, 936e9),
    Card("H100 SXM", "H100 80GB HBM3", 90, 132, 1.755e9, 67e12, 990e12, 3350e9),
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
    step = parts(small, make_guides(32, ALL), make_guides(32, ALL), backend="reference").step
    step()
    with _Counting() as counting:
        step()
    return counting.count


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
    launches = {preset: operations(Settings.preset(preset)) for preset in PRESETS}
    for card, size, preset in product(CARDS, SIZES, launches):
        p = predicted(card, preset, size, table, launches[preset])
        print(
            f"| {card.name} | {preset} | {size[1]}×{size[0]} | {1e3 * p.kernel:.2f} | {1e3 * p.convolutions:.2f} "
            f"| {1e3 * p.host:.2f} | {1e3 * p.step:.2f} | {p.steps} | {p.inference:.3f} | {p.total:.2f} |"
        )
    print(f"\noperations of a step, counted: {launches}")


def print_measurements(
    device: torch.device,
    table: list[Variant],
    *,
    cpu_too: bool,
    sizes: Sequence[tuple[int, int]] = SIZES,
    presets: Mapping[str, Settings] | None = None,
    repeat: int = 5,
) -> None:
    """Differences first; then a row of times for the device, one for what it should reach, and one for the CPU."""
    presets = presets or {name: Settings.preset(name) for name in PRESETS}
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else str(device)
    found = differences(device)
    print(f"\n{name}; largest differences to the reference: {rounded(found)}")
    if max(found.values()) > LARGEST_DIFFERENCE:
        sys.exit(f"expected differences of at most {LARGEST_DIFFERENCE}: what follows would be worth nothing")
    print(f"differences of a frame by `fast`: {rounded(same_frame(device, presets['fast'], (96, 128)))}\n")
    print("| preset | size | | kernel, ms | network, ms | step, ms | replayed, ms | frame, s | peak, GiB |")
    print("|---|---|---|---:|---:|---:|---:|---:|---:|")
    card = next((card for card in CARDS if card.sign in name), None)
    for size, (preset, settings) in product(sizes, presets.items()):
        label = f"| {preset} | {size[1]}×{size[0]} |"
        side = size[0] // 4
        timed = step_seconds(device, settings, side, repeat) | frame_seconds(device, settings, size)
        print(label, f"{name} |", row(timed), flush=True)
        if card is not None:
            p = predicted(card, preset, size, table, operations(settings))
            bound = {"kernel": p.kernel, "network": p.convolutions, "step": p.step, "frame": p.total}
            print(label, "predicted |", row(bound), flush=True)
        if cpu_too:
            cpu = torch.device("cpu")
            timed = step_seconds(cpu, settings, side, 1)
            if preset == "fast" and size == sizes[0]:
                timed |= frame_seconds(cpu, settings, size)
            print(label, f"CPU, {torch.get_num_threads()} threads |", row(timed), flush=True)


def row(values: Mapping[str, float]) -> str:
    """Cells of a table: milliseconds of what belongs to a step, seconds of a frame, GiB."""
    units = {"kernel": 1e3, "network": 1e3, "step": 1e3, "replayed": 1e3, "frame": 1.0, "peak": 1.0}
    return " | ".join(f"{unit * values[key]:.3g}" if key in values else "" for key, unit in units.items()) + " |"


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
        print_measurements(torch.device("cuda"), table, cpu_too=not options.no_cpu)
    else:
        print("no CUDA device: nothing was measured")


if __name__ == "__main__":
    main()
