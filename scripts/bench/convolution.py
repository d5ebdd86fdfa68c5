"""Nanoseconds per pixel and half of the network's convolutions, forward, and forward and backward.

torch in float32 and with bfloat16 autocast, and the compiled variants, side by side in one run on eight patches of
64x64 (a step of `balanced`), with 1 and 2 threads; on one thread also the share of the multiply-adds per second that
the same instructions reach in registers, and torch's seconds over the variant's. CPU seconds of the process are
counted on one thread, so that a busy machine disturbs less, and wall seconds on two.

    .venv/bin/python scripts/bench/convolution.py [--repeat 30] [--patch 64]
"""

import argparse
import time
from collections.abc import Callable, Sequence

import torch
from kernel import processor
from torch import Tensor

from selfcorrect import Settings
from selfcorrect.kernel.convolution import cpu, reference
from selfcorrect.stages.core.network import Network

INPUTS, HEADS, PATCHES = 13, 15, 8


def best(function: Callable[[], object], repeat: int, clock: Callable[[], float]) -> float:
    function()
    seconds = []
    for _ in range(repeat):
        start = clock()
        function()
        seconds.append(clock() - start)
    return min(seconds)


def peak(isa: str) -> float:
    """Multiply-adds per second."""
    count = cpu.peak(isa, 100_000)
    return count / best(lambda: cpu.peak(isa, 100_000), 20, time.process_time)


def multiply_adds(network: Network, *, backward: bool) -> int:
    """Per pixel; the backward pass takes as many for the weights, and for the inputs except the first layer's."""
    layers = [parameter.numel() for parameter in network.parameters() if parameter.ndim == 4]
    return 3 * sum(layers) - layers[0] if backward else sum(layers)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=30)
    parser.add_argument("--patch", type=int, default=64)
    options = parser.parse_args()
    generator = torch.Generator().manual_seed(0)
    network = Network(INPUTS, HEADS, Settings.preset("paper"), generator)
    parameters = list(network.parameters())
    images = torch.rand(PATCHES, INPUTS, options.patch, options.patch, generator=generator)
    upstream = torch.rand(PATCHES, HEADS, options.patch, options.patch, generator=generator)

    def in_torch(images: Sequence[Tensor]) -> Tensor:
        return reference.convolutions(images, parameters)

    def in_torch_bf16(images: Sequence[Tensor]) -> Tensor:
        with torch.autocast("cpu", torch.bfloat16):
            return in_torch(images).float()

    def compiled(isa: str, threads: int) -> Callable[[Sequence[Tensor]], Tensor]:
        return lambda images: cpu.convolutions(images, parameters, isa=isa, threads=threads)

    print(f"{processor()}; torch {torch.__version__}; {PATCHES} patches of {options.patch}x{options.patch}")
    print("ns per pixel and half (best of runs)          forward   with backward   over torch   share of peak")
    for threads in (1, 2):
        torch.set_num_threads(threads)
        clock = time.process_time if threads == 1 else time.perf_counter
        forms = {"torch fp32": in_torch, "torch bf16": in_torch_bf16}
        forms |= {isa: compiled(isa, threads) for isa in cpu.instruction_sets()}
        baseline = 0.0
        for name, form in forms.items():

            def forward(form: Callable[[Sequence[Tensor]], Tensor] = form) -> Tensor:
                with torch.no_grad():
                    return form(images.unbind())

            def both(form: Callable[[Sequence[Tensor]], Tensor] = form) -> object:
                return torch.autograd.grad(form(images.unbind()), parameters, upstream)

            pixels = PATCHES * options.patch**2
            one, two = (best(f, options.repeat, clock) / pixels * 1e9 for f in (forward, both))
            baseline = baseline or two
            share = ""
            if threads == 1 and name in cpu.instruction_sets():
                speeds = (multiply_adds(network, backward=b) / ns * 1e9 for b, ns in ((False, one), (True, two)))
                most = peak(name)
                share = " / ".join(f"{speed / most:.0%}" for speed in speeds) + f" of {most / 1e9:.0f} G/s"
            print(f"{threads} thread(s)  {name:12} {one:27.0f} {two:15.0f} {baseline / two:11.1f}x   {share}")


if __name__ == "__main__":
    main()
