"""A frame on another device than the CPU, told without one.

Torch's ``meta`` device stands in for it where nothing need be computed: its tensors have no values, so that whatever
would make the host wait (``float``, ``bool``, ``tolist``, a copy to the CPU) raises, and so does most of what mixes
tensors of two devices. Where values are needed, tensors of the CPU in disguise stand in (helpers/elsewhere.py).
Both are mocks: they show what the host asks for and what lies where, not that a device computes the right thing. The
kernel itself runs in Triton's interpreter (see tests/kernel/test_cross_bilateral.py).
"""

import argparse
import json
import os
import subprocess
import sys
from dataclasses import astuple
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.elsewhere import ELSEWHERE, Elsewhere, elsewhere
from helpers.tolerances import INTERPRETED_LOSS, near
from torch import Tensor

from selfcorrect import Frame, Settings, cli, correct, metrics
from selfcorrect.cli import runner
from selfcorrect.cli.flags import add_run_flags, add_written
from selfcorrect.errors import DeviceError, MissingPackageError
from selfcorrect.frame import Half
from selfcorrect.kernel import cross_bilateral as kernel
from selfcorrect.kernel.guides import Guides
from selfcorrect.stages.core import train
from selfcorrect.stages.core.infer import infer
from selfcorrect.stages.core.network import Network
from selfcorrect.stages.deep_combiner import DeepCombiner, combine_whole, feature_planes

META = torch.device("meta")
TESTS = Path(__file__).parent
BENCH = TESTS.parent / "scripts" / "bench"


def make_frame(size: tuple[int, int] = (32, 32), *, features: bool = True) -> Frame:
    generator = torch.Generator().manual_seed(0)

    def pair() -> tuple[Tensor, Tensor]:
        a, b = (torch.rand(*size, 3, generator=generator) for _ in "ab")
        return a, b

    aids = {"albedo": pair(), "normal": pair()} if features else {}
    return Frame(color=pair(), denoised=pair(), **aids)


def guides_of(half: Half, margin: int) -> Guides:
    return Guides.of_half(half._asdict(), margin=margin, scale=2.0)


@pytest.mark.parametrize(("preset", "changes"), [("balanced", {"steps": 2}), ("paper", {"epochs": 1})])
def test_the_training_loop_never_waits(monkeypatch: pytest.MonkeyPatch, preset: str, changes: dict[str, int]) -> None:
    """Every step of a round, until its losses are fetched."""
    small = {"patch": 16, "stride": 16, "batch": 2, "window": 3, "rate_from_variance": False}
    settings = Settings.preset(preset, **small, **changes)
    a, b = (guides_of(half, 24) for half in make_frame().to(META).halves)
    generator = torch.Generator().manual_seed(0)
    network = Network.for_guides(a, settings, generator)
    assert all(p.device == META for p in network.parameters())
    waiting: list[int] = []
    monkeypatch.setattr(train, "_FETCHED_EVERY", 1000)
    monkeypatch.setattr(train._Losses, "fetched", lambda self, steps: waiting.append(self.count) or [])
    train.train(network, (a, b), settings, generator)
    assert waiting == [2]


def test_fetching_is_what_waits() -> None:
    """The mock can fail: a value of the device is not to be had."""
    losses = train._Losses(None, META)
    losses.add(torch.zeros((), device=META), 1)
    with pytest.raises(RuntimeError, match="meta"):
        losses.fetched(1)


def test_losses_are_fetched_every_so_many_steps_and_told_in_turn() -> None:
    told: list[tuple[int, int, float]] = []
    losses = train._Losses(lambda *step: told.append(step), META)
    for step in range(20):
        losses.add(torch.tensor(float(step)), 20)
        assert len(told) == (0 if step < 15 else 16)
        assert losses.count == step + 1
    assert losses.fetched(20) == [float(step) for step in range(20)]
    assert told == [(step + 1, 20, float(step)) for step in range(20)]


def test_inference_never_waits() -> None:
    settings = Settings.preset("balanced", window=3)
    half, _ = make_frame().to(META).halves
    network = Network.for_guides(guides_of(half, 2), settings, torch.Generator().manual_seed(0))
    image = infer(network, half, settings, side=20, scale=2.0)
    assert image.device == META
    assert image.shape == (32, 32, 3)


def test_the_combiner_never_waits() -> None:
    half, _ = make_frame().to(META).halves
    features = feature_planes((32, 32), normal=half.normal, albedo=half.albedo, depth=None)
    network = DeepCombiner(window=3, width=4, layers=2).to(META)
    image = combine_whole(network, (half.color,), (half.denoised,), features, scale=2.0, precision="bf16", side=20)
    assert image.device == META


def test_a_whole_frame_through_the_interpreter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Training, inference and guard with the kernel for CUDA in the CPU's place: the same frame."""
    changes = {"patch": 8, "batch": 1, "steps": 1, "window": 3, "layers": 3, "inference": "halves"}
    settings = Settings.preset("balanced", **changes)
    frame = make_frame(features=False)  # the fewer channels, the faster
    compiled = correct(frame, settings)
    monkeypatch.setattr(kernel, "choose", lambda *_, **__: "gpu")
    interpreted = correct(frame, settings)
    torch.testing.assert_close(interpreted.image, compiled.image, **near("whole frame interpreted"))
    assert interpreted.losses == pytest.approx(compiled.losses, rel=INTERPRETED_LOSS)


@pytest.mark.parametrize("stages", ["regression,james-stein,core,neural-james-stein", "deep-combiner"])
def test_a_whole_frame_elsewhere(stages: str) -> None:
    """On a device that is neither the CPU nor CUDA: kernels by the reference, shift by shift, nothing left behind."""
    changes = {"patch": 8, "batch": 1, "steps": 1, "window": 3, "layers": 2, "inference": "full"}
    settings = Settings.preset("balanced", stages=stages, precision="fp32", **changes)  # all that both devices have
    here = correct(make_frame(), settings)
    with elsewhere() as waited:
        frame = make_frame().to(ELSEWHERE)
        assert waited() == 0
        result = correct(frame, settings)
        assert all(isinstance(image, Elsewhere) for image in result.maps.values())
        blend = result.maps["blend"].cpu()
    torch.testing.assert_close(result.image, here.image, **near("whole frame elsewhere"))
    torch.testing.assert_close(blend, here.maps["blend"], **near("whole frame elsewhere"))


def test_metrics_elsewhere() -> None:
    generator = torch.Generator().manual_seed(0)
    images = [torch.rand(16, 20, 3, generator=generator) + 0.1 for _ in range(4)]
    here = metrics.compare(*images)
    with elsewhere():
        there = metrics.compare(*(image.to(ELSEWHERE) for image in images))
    assert astuple(there) == pytest.approx(astuple(here), rel=1e-12)  # 0 here


def test_the_disguise_refuses_what_a_device_would() -> None:
    """The mock can fail: tensors here and elsewhere do not mix, and who looks at a value waits."""
    with elsewhere() as waited:
        there = torch.ones(3).to(ELSEWHERE)
        with pytest.raises(AssertionError, match="on the CPU"):
            there + torch.ones(3)
        with pytest.raises(AssertionError, match="on the CPU"):
            there.index_select(0, torch.tensor([0]))
        assert waited() == 0
        assert (float(there[0]), there.tolist(), there.cpu().sum()) == (1.0, [1.0] * 3, 3.0)
        assert waited() == 3


def test_where_no_value_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    """A device that runs out of memory in the middle of a frame."""

    def full(*_: Any, **__: Any) -> None:
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB.\nMore lines.")

    monkeypatch.setattr(train, "dual_buffer_loss", full)
    with pytest.raises(DeviceError, match=r"tiles of 512 pixels.*--maxmem") as error:
        correct(make_frame(), Settings.preset("fast"))
    assert "\n" not in str(error.value)


def test_the_command_where_no_value_fits(
    monkeypatch: pytest.MonkeyPatch, halves: tuple[Path, Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise torch.cuda.OutOfMemoryError("CUDA out of memory.")

    monkeypatch.setattr(train, "dual_buffer_loss", full)
    flags = ["frame", *map(str, halves), "-o", str(tmp_path / "out.exr"), "--preset", "fast", "--denoiser", "box"]
    assert cli.main(flags) == 2
    assert "--maxmem" in capfd.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "out.exr").exists()


def test_without_triton(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError("No module named 'triton'", name="triton")

    monkeypatch.setattr(kernel, "import_module", missing)
    guides = guides_of(make_frame().halves[0], 2)
    raw = torch.zeros(1, kernel.heads_count(guides, "eq10"), 4, 4)
    with pytest.raises(MissingPackageError, match=r"pip install 'triton>="):
        kernel.cross_bilateral(guides, raw, torch.zeros(1, 2, dtype=torch.int64), kernel.Window(3), backend="gpu")


def test_what_stays_on_the_cpu_is_told(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    parser = argparse.ArgumentParser()
    add_written(parser)
    add_run_flags(parser)
    monkeypatch.setattr(runner, "_use_machine", lambda options: None)
    flags = ["--device", "cuda", "--stages", "regression,core", "--denoiser", "nlm"]
    runner.Runner(parser.parse_args(flags), given=False)
    assert capfd.readouterr().err == "regression and the denoiser nlm: on the CPU; all else on cuda\n"
    runner.Runner(parser.parse_args([]), given=True)
    assert capfd.readouterr().err == ""


def test_frames_move_without_touching_the_one_given() -> None:
    frame = make_frame()
    moved = frame.to(META)
    assert moved.color[0].device == META
    assert frame.color[0].device.type == "cpu"


def compiling(*command: str | Path, **more: str) -> Any:
    """What a command prints as JSON, in a process where Triton compiles and does not interpret."""
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"} | more
    ran = subprocess.run([sys.executable, *command], env=environment, capture_output=True, text=True, check=True)
    return json.loads(ran.stdout)


def test_every_target_is_compiled_without_spilling() -> None:
    """Ahead of time, as scripts/bench/gpu.py prints it for many more variants."""
    table = compiling(BENCH / "gpu.py", "--few", "--json")
    assert {v["target"] for v in table} == {80, 90, 120}
    assert {v["mode"] for v in table} == {"FORWARD", "LOSS"}
    for variant in table:
        assert variant["spilled"] == 0, variant
        assert variant["shared"] <= 48 << 10, variant
        assert variant["registers"] <= 128, variant  # four programs of 128 threads on a multiprocessor
        assert variant["loads"] == 13, variant  # one for each channel: nothing is read twice in a tap


def test_what_is_launched_is_what_the_table_compiled() -> None:
    """The host's side of a launch, types and constants of its own choice, up to a driver that launches nothing."""
    paths = os.pathsep.join(map(str, (TESTS, BENCH)))
    launched = compiling("-m", "helpers.launches", PYTHONPATH=paths)
    assert launched["same"] == [True] * 3
    assert launched["grids"] == [[9 * 2, 2, 1]] * 3  # tiles of 4 × 32 in 33 × 37 pixels, patches
