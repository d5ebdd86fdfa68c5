"""scripts/bench/gpu.py measures what no machine of ours has: here its measurements run on the CPU, and in disguise."""

import gpu_measurements
import pytest
import torch
from gpu import operations, print_measurements
from gpu_variants import BUFFERS, EVERYTHING
from helpers.elsewhere import ELSEWHERE, elsewhere

from selfcorrect import Settings

TINY = {"patch": 8, "stride": 8, "batch": 1, "steps": 1, "window": 3, "layers": 2}


@pytest.fixture(autouse=True)
def one_set_of_buffers(monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernels' own tests have them all."""
    monkeypatch.setattr(gpu_measurements, "BUFFERS", {EVERYTHING: BUFFERS[EVERYTHING]})


def test_on_the_cpu(capsys: pytest.CaptureFixture[str]) -> None:
    """Everything but CUDA's own calls, with small frames."""
    presets = {"fast": Settings.preset("fast", **TINY)}
    print_measurements(torch.device("cpu"), [], cpu_too=True, sizes=[(32, 48)], presets=presets, repeat=1)
    printed = capsys.readouterr().out
    assert printed.count("| fast | 48×32 | cpu |") == 1
    assert printed.count("| fast | 48×32 | CPU, ") == 1


def test_what_differs_is_not_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = {"loss": 0.0, "gradient": 0.1, "network": 0.0}
    monkeypatch.setattr("gpu.differences", lambda device: wrong)
    with pytest.raises(SystemExit, match="worth nothing"):
        print_measurements(torch.device("cpu"), [], cpu_too=False)


def test_tensors_lie_where_they_belong() -> None:
    """On a device that is neither the CPU nor CUDA: nothing of a step is left behind."""
    settings = Settings.preset("balanced", **TINY)
    with elsewhere():
        assert set(gpu_measurements.step_seconds(ELSEWHERE, settings, 24, 1)) == {"kernel", "network", "step"}
        assert gpu_measurements.frame_seconds(ELSEWHERE, settings, (32, 32))["frame"] > 0
        assert max(gpu_measurements.differences(ELSEWHERE, window=3).values()) < gpu_measurements.LARGEST_DIFFERENCE


def test_a_step_has_as_many_operations_as_the_predictions_say() -> None:
    """RESULTS.md names them, of nine convolutions; the host of a GPU starts each."""
    assert operations(Settings.preset("balanced", layers=9)) in range(130, 160)
