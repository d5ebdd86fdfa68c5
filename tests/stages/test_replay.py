"""The training step that CUDA records and replays, as far as the CPU can tell: bit by bit that of the plain loop.

Recording and replaying are mocks here; whether CUDA records the step was never tried.
"""

from collections.abc import Callable, Sequence

import pytest
import torch
from helpers.kernel import ALWAYS, make_guides, single
from helpers.tape import Tape
from torch import Tensor

from selfcorrect import Settings
from selfcorrect.errors import FrameError
from selfcorrect.kernel import convolution, cross_bilateral
from selfcorrect.kernel.cross_bilateral import gpu
from selfcorrect.kernel.guides import Guides
from selfcorrect.stages.core import train
from selfcorrect.stages.core.network import Network
from selfcorrect.stages.core.replay import Replayed

SMALL = {"patch": 8, "batch": 1, "window": 3, "layers": 2, "visits": 0}
STEPS = [("balanced", {"steps": 6}), ("paper", {"epochs": 2, "stride": 8, "batch": 3})]
"""Of the second, seven batches of an epoch are whole, and one of a single patch is left."""


class Again:
    """A mock of a graph that calls what it should record: the step's arithmetic alone, by the kernels of the CPU."""

    def run(self, function: Callable[[], Tensor]) -> Tensor:
        return function()

    def record(self, function: Callable[[], Tensor]) -> Tensor:
        self.function, self.result = function, torch.full((), float("nan"))
        return self.result

    def replay(self) -> None:
        self.result.copy_(self.function())


def trained(preset: str, changes: dict[str, int], *, crops: bool = False) -> tuple[list[float], list[Tensor]]:
    """Losses and weights after some steps."""
    settings = Settings.preset(preset, **SMALL | changes, cuda_graph=True)
    halves = [[single(make_guides(20, 29, ALWAYS, seed=seed + 2 * i)) for i in range(2)] for seed in (0, 1)]
    a, b = (Guides.stack(half, 2) if crops else half[0] for half in halves)
    generator = torch.Generator().manual_seed(0)
    network = Network.for_guides(a, settings, generator)
    return train.train(network, (a, b), settings, generator), [p.detach() for p in network.parameters()]


def same(one: tuple[list[float], list[Tensor]], other: tuple[list[float], list[Tensor]]) -> bool:
    return one[0] == other[0] and all(torch.equal(*pair) for pair in zip(one[1], other[1], strict=True))


@pytest.mark.parametrize("crops", [False, True])
@pytest.mark.parametrize(("preset", "changes"), STEPS)
def test_inputs_in_place_change_no_bit(
    monkeypatch: pytest.MonkeyPatch, preset: str, changes: dict[str, int], crops: bool
) -> None:
    if crops and preset == "paper":
        changes = {"steps": 5}  # crops are for steps
    plain = trained(preset, changes, crops=crops)
    monkeypatch.setattr(train, "choose", lambda *_, **__: "gpu")
    monkeypatch.setattr(train, "CudaGraph", lambda device: Again())
    assert same(trained(preset, changes, crops=crops), plain)


def test_a_recorded_step_knows_nothing_of_the_host(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replayed operation by operation, with the kernel for CUDA in the interpreter."""
    for module in (cross_bilateral, convolution):
        monkeypatch.setattr(module, "choose", lambda *_, **__: "gpu")
    monkeypatch.setattr(cross_bilateral, "check_reach", lambda *_: None)  # the corners are on the device
    given = ("balanced", {"steps": 5, "window": 1})  # a tap takes the interpreter long
    plain = trained(*given)
    tape = Tape()
    monkeypatch.setattr(train, "choose", lambda *_, **__: "gpu")
    monkeypatch.setattr(train, "CudaGraph", lambda device: tape)
    monkeypatch.setattr(gpu, "_launch", tape.launching(gpu._launch))
    assert same(trained(*given), plain)
    assert tape.replays == 2


def test_the_tape_tells_what_a_graph_would_keep() -> None:
    """The mock can fail: a number of the host stays as it was, and a value may not go to it."""
    guides = single(make_guides(20, 20, ALWAYS))
    settings = Settings.preset("balanced", **SMALL)
    corners = torch.zeros(1, 2, dtype=torch.int64)
    host = iter(range(10))

    def counting(patches: Sequence[Tensor], corners: Tensor, rate: Tensor) -> Tensor:
        return rate + next(host)

    step = Replayed(counting, (guides, guides), settings, Tape())
    assert [float(step(corners, 10.0 * i)) for i in range(6)] == [0.0, 11.0, 22.0, 33.0, 43.0, 53.0]

    def looking(patches: Sequence[Tensor], corners: Tensor, rate: Tensor) -> Tensor:
        return rate + float(rate)

    step = Replayed(looking, (guides, guides), settings, Tape())
    assert [float(step(corners, 1.0)) for _ in range(3)] == [2.0] * 3
    with pytest.raises(AssertionError, match="_local_scalar_dense"):
        step(corners, 1.0)


def test_patches_beyond_the_margin_are_refused_before_they_are_read() -> None:
    guides = single(make_guides(20, 20, ALWAYS, margin=4))
    step = Replayed(lambda *_: torch.zeros(()), (guides, guides), Settings.preset("balanced", **SMALL), Again())
    with pytest.raises(FrameError, match="margin 4"):
        step(torch.tensor([[16, 0]]), 1.0)


def test_the_cpu_records_nothing() -> None:
    """The setting changes nothing where there is no kernel for CUDA."""
    assert trained(*STEPS[0])[0]
