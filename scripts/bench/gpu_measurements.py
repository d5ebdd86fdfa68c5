"""What `gpu.py` does where there is a card: differences to the reference first, then times and memory.

Nobody has run this on a GPU. It runs on any device, so that a test can show on the CPU that it works at all.
"""

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import torch
from gpu_variants import BUFFERS
from kernel import ALL, best, make_guides
from torch import Tensor

from selfcorrect import Frame, Settings, correct
from selfcorrect.kernel.convolution import convolutions
from selfcorrect.kernel.cross_bilateral import Window, cross_bilateral_loss, heads_count
from selfcorrect.kernel.guides import Guides
from selfcorrect.stages.core.loss import dual_buffer_loss, witnesses
from selfcorrect.stages.core.network import Network
from selfcorrect.stages.core.patches import batches
from selfcorrect.stages.core.replay import CudaGraph, Replayed
from selfcorrect.stages.core.train import Adam

LARGEST_DIFFERENCE = 1e-4
"""Of single precision to the float64 reference, over the largest value: twice what the tests allow the kernels."""


class Parts(NamedTuple):
    """A training step, and what it consists of; ``replayed`` is the step as CUDA repeats it, on CUDA alone."""

    step: Callable[[], object]
    kernel: Callable[[], object]
    network: Callable[[], object]
    replayed: Callable[[], object] | None


def as_in_correct() -> AbstractContextManager[Any]:
    """The convolutions as :func:`selfcorrect.correct` has them: torch's defaults round single precision to ten bits."""
    return torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=False)


def parts(settings: Settings, a: Guides, b: Guides, *, backend: str | None = None) -> Parts:
    """A training step on given guides, on the device that they are on; ``backend``: of the convolutions."""
    generator = torch.Generator().manual_seed(0)
    network = Network.for_guides(a, settings, generator)
    weights, device = list(network.parameters()), a.planes.device
    optimiser = Adam(weights, settings.adam_epsilon, settings.gradient_limit or float("inf"))
    judges = witnesses((a, b), settings)
    corners = next(iter(batches(a, settings, generator))).clamp(0, a.height - settings.patch)

    def heads(patches: Any) -> Tensor:
        return convolutions(
            list(patches),
            weights,
            log_radiance=settings.log_radiance,
            precision=settings.precision,
            threads=torch.get_num_threads(),
            backend=backend,
        )

    def views() -> list[Tensor]:
        return [patch for half in (a, b) for patch in half.views(corners, (settings.patch, settings.patch))]

    def taken(patches: Any, corners: Tensor, rate: Any) -> Tensor:
        loss = dual_buffer_loss(heads(patches), corners, (a, b), judges, settings)
        loss.backward()
        optimiser.step(rate, loss.detach())
        return loss.detach()

    raw = heads(views()).detach().requires_grad_()
    upstream = torch.randn(raw.shape, generator=generator).to(device)

    def kernel() -> None:
        raw.grad = None
        dual_buffer_loss(raw, corners, (a, b), judges, settings).backward()

    def of_network() -> None:
        heads(views()).backward(upstream)

    replayed = Replayed(taken, (a, b), settings, CudaGraph(device)) if device.type == "cuda" else None
    return Parts(
        step=lambda: taken(views(), corners, 1e-3),
        kernel=kernel,
        network=of_network,
        replayed=None if replayed is None else lambda: replayed(corners, 1e-3),
    )


def halves(settings: Settings, side: int, device: torch.device) -> list[Guides]:
    """Two images of noise to take patches from, on the device."""
    pair = [make_guides(max(side, settings.patch), ALL) for _ in "ab"]
    return [replace(half, planes=half.planes.to(device)) for half in pair]


def wait(device: torch.device) -> None:
    """Until the device has done what it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def differences(device: torch.device, backend: str | None = None, window: int = 9) -> dict[str, float]:
    """The largest, to float64 by the reference and over the largest value of each: loss, heads' and weights' gradients.

    Over every set of buffers, combination, and all taps as well as a lattice of them. ``backend``: of the kernel.
    """
    worst = {"loss": 0.0, "gradient": 0.0}
    for buffers, combination, every in product(BUFFERS.values(), ("eq10", "eq3"), (1, 4)):
        guides = make_guides(48, buffers)
        of_window = Window(window, every, combination)
        raw = torch.randn(2, heads_count(guides, combination), 31, 37, generator=torch.Generator().manual_seed(1))
        results = []
        for where, kind in ((torch.device("cpu"), torch.float64), (device, torch.float32)):
            half = replace(guides, planes=guides.planes.to(where, kind))
            leaf = raw.to(where, kind).requires_grad_()
            chosen = "reference" if kind == torch.float64 else backend
            corners, weight = torch.tensor([[0, 0], [5, 11]]), half.planes[0].clone()
            loss = cross_bilateral_loss(half, leaf, corners, half.denoised, weight, of_window, backend=chosen)
            loss.backward()
            assert leaf.grad is not None
            results.append((loss.detach().cpu().double(), leaf.grad.cpu().double()))
        (expected, by_heads), (got, found) = results
        heads = (found - by_heads).abs().amax((0, 2, 3)) / by_heads.abs().amax((0, 2, 3))
        worst["loss"] = max(worst["loss"], float((got - expected).abs() / expected.abs()))
        worst["gradient"] = max(worst["gradient"], float(heads.max()))
    return worst | {"network": _of_the_network(device)}


def _of_the_network(device: torch.device) -> float:
    """The largest difference of the weights' gradients, in single precision."""
    settings = Settings.preset("balanced", precision="fp32")
    guides = make_guides(64, ALL)
    network = Network.for_guides(guides, settings, torch.Generator().manual_seed(0))
    upstream = torch.randn(2, heads_count(guides, "eq10"), 31, 37, generator=torch.Generator().manual_seed(1))
    gradients = []
    for where, kind in ((torch.device("cpu"), torch.float64), (device, torch.float32)):
        weights = [p.detach().to(where, kind).requires_grad_() for p in network.parameters()]
        half = replace(guides, planes=guides.planes.to(where, kind))
        with as_in_correct():
            heads = convolutions(half.views(torch.tensor([[0, 0], [5, 11]]), (31, 37)), weights, log_radiance=True)
            heads.backward(upstream.to(where, kind))
        gradients.append([weight.grad.cpu().double() for weight in weights if weight.grad is not None])
    return max(
        float((got - expected).abs().max() / expected.abs().max()) for expected, got in zip(*gradients, strict=True)
    )


def step_seconds(device: torch.device, settings: Settings, side: int, repeat: int) -> dict[str, float]:
    """Of a step as it is and as CUDA replays it, and of its parts; several in turn, as training does not wait."""
    times = 20 if device.type == "cuda" else 1

    def seconds(function: Callable[[], object]) -> float:
        def several() -> None:
            for _ in range(times):
                function()
            wait(device)

        return best(several, repeat) / times

    a, b = halves(settings, side, device)
    with as_in_correct():
        of = parts(settings, a, b)
        found = {"kernel": seconds(of.kernel), "network": seconds(of.network), "step": seconds(of.step)}
        return found if of.replayed is None else found | {"replayed": seconds(of.replayed)}


def frame_seconds(device: torch.device, settings: Settings, size: tuple[int, int]) -> dict[str, float]:
    """Of a whole frame, denoised halves given, to the device and back; and the peak of the device's memory in GiB."""
    frame = a_frame(size)
    correct(frame.to(device), settings)  # compiles
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    start = time.perf_counter()
    correct(frame.to(device), settings)  # the image comes back to the CPU, so that all is done
    found = {"frame": time.perf_counter() - start}
    if device.type == "cuda":
        found["peak"] = torch.cuda.max_memory_allocated(device) / 2**30
    return found


def a_frame(size: tuple[int, int]) -> Frame:
    """Noise: what is timed does not depend on the picture."""
    generator = torch.Generator().manual_seed(0)

    def pair(channels: int = 3) -> tuple[Tensor, Tensor]:
        a, b = (torch.rand(*size, channels, generator=generator) for _ in "ab")
        return a, b

    return Frame(color=pair(), denoised=pair(), albedo=pair(), normal=pair(), visibility=pair(1))


def same_frame(device: torch.device, settings: Settings, size: tuple[int, int]) -> dict[str, float]:
    """Relative difference, by norm, of a frame corrected on the device to the CPU's, and to the replayed steps'.

    Training enlarges what rounding begins: these are to be looked at, not held to a bound.
    """
    on_device, here, replayed = (
        correct(a_frame(size).to(where), replace(settings, precision="fp32", cuda_graph=graph)).image
        for where, graph in ((device, False), (torch.device("cpu"), False), (device, True))
    )
    return {
        "CPU": float((on_device - here).norm() / here.norm()),
        "replayed": float((on_device - replayed).norm() / here.norm()),
    }
