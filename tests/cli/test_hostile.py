"""Names, numbers, streams and signals that nobody sends on purpose: one line, and the picture is written or whole."""

import contextlib
import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest
import safetensors.torch
import torch
from helpers.commands import BALANCED, call, refused

from selfcorrect import cli
from selfcorrect.cli.terminal import EndOnInterrupt
from selfcorrect.errors import FileError
from selfcorrect.publish import publish
from selfcorrect.settings import Settings
from selfcorrect.shot.state import State, _checksum, load_state, save_state
from selfcorrect.stages.core.network import Network, Traits

Halves = tuple[Path, Path]
LONG = "x" * 300


@pytest.mark.parametrize(
    "flags",
    [
        ["--seed", 2**70],
        ["--threads", 2**31],
        ["--threads", 200_000],
        ["--device", "meta"],
        ["--filters", 10**20],
        ["--network-layers", 10**6],
        ["--batch", 10**9],
        ["--patch", 10**20],
        ["--steps", 10**20],
        ["--maxmem", "9" * 400 + "T"],
        ["--denoiser", f"onnx:{LONG}.onnx"],
        ["--denoiser", f"{LONG}.py:Class"],
        ["--report", f"{LONG}.html"],
        ["--stages", "neural-james-stein", "--james-stein-weights", LONG],
    ],
)
def test_what_no_machine_can_do_is_refused(flags: list[object], halves: Halves, tmp_path: Path) -> None:
    assert "but got" in refused("frame", *halves, "-o", tmp_path / "o.exr", *BALANCED, *flags)


@pytest.mark.parametrize(
    "arguments",
    [
        ["inspect", f"{LONG}.exr"],
        ["frame", f"{LONG}.exr", "b.exr", "-o", "o.exr"],
        ["sequence", "a.#.exr", "b.#.exr", "-o", "o.#.exr", "--frames", "1-" + "9" * 5000],
        ["compare", "a.exr", "b.exr", "--seed", 2**70],
    ],
)
def test_long_names_and_numbers_are_refused(arguments: list[object]) -> None:
    assert "but got" in refused(*arguments)


def test_a_long_output_is_refused_before_the_work(
    halves: Halves, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("selfcorrect.cli.runner.correct", lambda *_, **__: pytest.fail("trained"))
    line = refused("frame", *halves, "-o", tmp_path / f"{LONG}.exr", *BALANCED)
    assert "expected a name for the output, but got: File name too long" in line


def test_a_pipe_is_no_file(halves: Halves, tmp_path: Path) -> None:
    pipe = tmp_path / "pipe.exr"
    os.mkfifo(pipe)
    assert "pipe.exr: expected an OpenEXR file, but got a pipe" in refused("inspect", pipe)
    assert "pipe.exr: expected an OpenEXR file" in refused("frame", pipe, halves[1], "-o", tmp_path / "o.exr")
    assert "pipe.exr: expected a file to write" in refused("frame", *halves, "-o", pipe, *BALANCED)
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    with pytest.raises(FileError, match="expected a state of selfcorrect, but got a folder, a pipe"):
        load_state(pipe)


def test_an_overwritten_file_keeps_its_mode(tmp_path: Path) -> None:
    target = tmp_path / "out"
    target.write_bytes(b"older")
    target.chmod(0o640)
    publish(target, b"newer")
    assert (target.read_bytes(), stat.S_IMODE(target.stat().st_mode)) == (b"newer", 0o640)


def crafted() -> dict[str, dict[str, str]]:
    """Metadata of states that nobody saved."""
    traits = '{"buffers": "color+denoised", "combination": "eq10", "window": 5, "layers": 2, "filters": 2, '
    rest = '"log_radiance": true, "input_scale": 0}'
    good = {"traits": traits + rest, "frame": "1", "recipe": ""}
    return {
        "no traits": good | {"traits": ""},
        "a list": good | {"traits": "[]"},
        "deep": good | {"traits": "[" * 100_000},
        "text for a number": good | {"traits": traits.replace("5", '"wide"') + rest},
        "layers": good | {"traits": traits.replace('"layers": 2', '"layers": 1000000') + rest},
        "filters": good | {"traits": traits.replace('"filters": 2', '"filters": 1000000') + rest},
        "an extra trait": good | {"traits": traits + '"more": 1, ' + rest},
        "frame": good | {"frame": "[1]"},
        "endless frame": good | {"frame": "1e999"},
        "no frame": {k: v for k, v in good.items() if k != "frame"},
    }


@pytest.mark.parametrize("kind", [*crafted(), "other tensors", "half precision"])
def test_a_crafted_state_is_refused(kind: str, tmp_path: Path) -> None:
    settings = Settings(filters=2, layers=2, log_radiance=True, window=5, input_scale=0.0)
    network = Network(6, 7, settings, torch.Generator().manual_seed(0))
    network.traits = Traits("color+denoised", "eq10", 5, 2, 2, True, 0.0)
    tensors = {name: value.contiguous() for name, value in network.state_dict().items()}
    if kind == "other tensors":
        tensors = {"weight": torch.zeros(3)}
    if kind == "half precision":
        tensors = {name: value.bfloat16() for name, value in tensors.items()}
    metadata = crafted().get(kind, crafted()["a list"] | {"traits": "{}"})
    metadata |= {"format": "selfcorrect state 1", "version": "0"}
    with contextlib.suppress(TypeError):  # NumPy has no bfloat16
        metadata["checksum"] = _checksum(tensors, metadata)
    path = tmp_path / "s.safetensors"
    safetensors.torch.save_file(tensors, path, metadata)
    with pytest.raises(FileError, match=r"s\.safetensors: expected a state that fits together, but got"):
        load_state(path)
    save_state(path, State(network), settings)
    assert load_state(path).network.traits == network.traits


@pytest.mark.parametrize("command", ["inspect", "compare", "compare --json"])
def test_a_closed_pipe_ends_quietly(command: str, halves: Halves) -> None:
    name, *flags = command.split()
    files = halves[:1] if name == "inspect" else halves
    given = [sys.executable, "-m", "selfcorrect", name, *map(str, files), *flags]
    reader, writer = os.pipe()
    os.close(reader)
    result = subprocess.run(given, stdout=writer, stderr=subprocess.PIPE, text=True, check=False, timeout=120)
    os.close(writer)
    told = [] if name == "inspect" else [f"{path}: R, G, B" for path in halves]  # which channels are compared
    assert (result.returncode, result.stderr.splitlines()) == (0, told)


def test_a_full_disk_for_results_is_one_line(halves: Halves) -> None:
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "selfcorrect", "compare", *map(str, halves)]
        result = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False, timeout=120)
    assert result.returncode == 2
    assert result.stderr.splitlines() == [
        *(f"{path}: R, G, B" for path in halves),
        "selfcorrect: error: stdout: expected room for the results, but got: No space left on device; "
        "write them elsewhere",
    ]


def test_a_terminal_without_unicode(halves: Halves, capfd: pytest.CaptureFixture[str]) -> None:
    with open(1, "w", encoding="ascii", closefd=False) as ascii_only, contextlib.redirect_stdout(ascii_only):
        assert cli.main(["inspect", str(halves[0])]) == 0
    assert "30\\xd724 pixels" in capfd.readouterr().out


def test_a_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    assert "file/x" in refused("demo", "-o", tmp_path / "file" / "x", *BALANCED)


def test_no_temporary_folder(halves: Halves, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tempfile.mkdtemp", full)
    line = refused("frame", *halves, "-o", tmp_path / "o.exr", "--denoiser", "command:cp {color} {output}")
    assert "expected a temporary folder, but got: No space left on device; set TMPDIR" in line
    monkeypatch.undo()
    monkeypatch.setattr("denoisers.command._write", full)
    line = refused("frame", *halves, "-o", tmp_path / "o.exr", "--denoiser", "command:cp {color} {output}")
    assert "expected room for color.exr in" in line


def test_two_interrupts_while_a_kernel_is_busy_are_two() -> None:
    """Both come while Python has no chance to call its handler; the system's own counts them."""
    twice = "kill -INT {0}; sleep 0.05; kill -INT {0}; sleep 0.05".format(os.getpid())
    with EndOnInterrupt() as stop:
        sender = subprocess.Popen(["sh", "-c", twice])
        with pytest.raises(KeyboardInterrupt):
            _busy(sender)
        assert stop()
    sender.wait()


def _busy(sender: "subprocess.Popen[bytes]") -> None:
    matrix = torch.rand(3000, 3000)
    while sender.poll() is None:
        torch.linalg.svd(matrix)
    time.sleep(0.1)


def test_being_told_to_end_ends_the_denoiser_too(halves: Halves, tmp_path: Path) -> None:
    temporary, marker = tmp_path / "tmp", tmp_path / "pid"
    temporary.mkdir()
    script = tmp_path / "slow.sh"
    script.write_text(f"sleep 300 &\necho $! > {marker}.part; mv {marker}.part {marker}; wait\n")
    spec = f"command:sh {script} {{color}} {{output}}"
    command = [sys.executable, "-m", "selfcorrect", "frame", *map(str, halves), "-o", str(tmp_path / "o.exr")]
    process = subprocess.Popen(
        [*command, "--denoiser", spec], env=os.environ | {"TMPDIR": str(temporary)}, stderr=subprocess.DEVNULL
    )
    end = time.monotonic() + 120
    while not marker.exists() and time.monotonic() < end:
        time.sleep(0.05)
    process.terminate()
    assert process.wait(60) == 128 + signal.SIGTERM
    assert not [path for path in temporary.iterdir() if path.name.startswith("denoiser-")]
    assert not _running(int(marker.read_text()))
    assert not (tmp_path / "o.exr").exists()


def _running(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text(encoding="ascii").split()[2]
    except FileNotFoundError:
        return False
    return state not in "ZX"


def test_a_call_leaves_signals_as_they_were(halves: Halves) -> None:
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    assert call("inspect", halves[0]).returncode == 0
    assert (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)) == before
