"""Ctrl-C and the time budget, in the real command."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.commands import BOX, call, refused

from selfcorrect import cli, start

ENDLESS = [
    "--steps",
    "1000000",
    "--visits",
    "0",
    "--patch",
    "16",
    "--batch",
    "1",
    "--window",
    "5",
    *BOX,
]


def interrupted(out: Path, halves: tuple[Path, Path]) -> subprocess.CompletedProcess[str]:
    """The command, with Ctrl-C pressed once training has begun."""
    command = [sys.executable, "-m", "selfcorrect", "frame", *map(str, halves), "-o", str(out), *ENDLESS]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    lines = []
    for line in process.stderr:
        lines.append(line)
        if line.startswith("denoiser:"):
            break
    time.sleep(1.5)  # the box is done at once; then it trains
    process.send_signal(signal.SIGINT)
    output, rest = process.communicate(timeout=120)
    return subprocess.CompletedProcess(command, process.returncode, output, "".join(lines) + rest)


def test_one_interrupt_writes_what_has_been_learned(halves: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "out.exr"
    result = interrupted(out, halves)
    assert result.returncode == 0, result.stderr
    assert "again to write nothing" in result.stderr
    assert result.stderr.count("written after") == 1
    assert out.exists()
    assert sorted(os.listdir(tmp_path)) == ["a.exr", "b.exr", "out.exr"]


def test_a_second_interrupt_writes_nothing(
    halves: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.exr"
    out.write_bytes(b"what was there before")
    asked, before = [], signal.getsignal(signal.SIGINT)

    def twice(*_: object) -> None:
        asked.append(True)
        for _ in range(2):
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("selfcorrect.cli.terminal.Progress.__call__", twice)
    assert cli.main(["frame", *map(str, halves), "-o", str(out), *ENDLESS]) == 130
    assert len(asked) == 1
    assert "nothing" in capfd.readouterr().err
    assert signal.getsignal(signal.SIGINT) is before
    assert out.read_bytes() == b"what was there before"
    assert sorted(os.listdir(tmp_path)) == ["a.exr", "b.exr", "out.exr"]


LOADED = ["libc10", "libtorch_cpu", "libtorch_python", "_multiarray_umath", "_safetensors_rust", "OpenEXR"]
"""Libraries that the imports load one after the other: each is a moment of the start."""


@pytest.fixture
def heeded() -> Iterator[None]:
    """Interrupts that processes started here heed, also where the tests run in a shell's background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("heeded")
@pytest.mark.parametrize("library", LOADED)
@pytest.mark.parametrize("how", ["module", "script"])
def test_an_interrupt_during_the_imports_ends_quietly(library: str, how: str, halves: tuple[Path, Path]) -> None:
    script = Path(sys.executable).with_name("selfcorrect")
    start = {"module": [sys.executable, "-m", "selfcorrect"], "script": [str(script)]}[how]
    process = subprocess.Popen(
        [*start, "inspect", str(halves[0])], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    mapped = Path(f"/proc/{process.pid}/maps")
    end = time.monotonic() + 120
    while library not in mapped.read_text(encoding="utf-8", errors="replace") and time.monotonic() < end:
        time.sleep(0.002)
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=120) == ("", "")
    assert process.returncode == 130


def test_the_package_leaves_signals_to_whoever_imports_it() -> None:
    code = "import signal; before = signal.getsignal(2); import selfcorrect.cli; assert signal.getsignal(2) is before"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


@pytest.mark.parametrize("ignored", [True, False])
def test_the_command_ignores_what_its_parent_has_it_ignore(ignored: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """As nohup and a shell's & do."""
    monkeypatch.setattr("sys.argv", ["selfcorrect"])
    before = signal.signal(signal.SIGINT, signal.SIG_IGN if ignored else signal.default_int_handler)
    try:
        start.begin()
        assert (signal.getsignal(signal.SIGINT) is signal.SIG_IGN) == ignored
        start.begun()
        expected = signal.SIG_IGN if ignored else signal.default_int_handler
        assert signal.getsignal(signal.SIGINT) is expected
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("text", ["soon", "10x", ""])
def test_a_time_that_is_none_is_named(halves: tuple[Path, Path], tmp_path: Path, text: str) -> None:
    assert "a time like 10s or 2m" in refused("frame", *halves, "-o", tmp_path / "o.exr", "--time-budget", text)


def test_the_time_budget_ends_training(halves: tuple[Path, Path], tmp_path: Path) -> None:
    result = call("frame", *halves, "-o", tmp_path / "o.exr", *ENDLESS, "--time-budget", "0.05m", "--json")
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert report["settings"]["time_budget"] == 3.0
    assert report["steps"] < 1_000_000
    assert report["seconds"]["train"] < 3.5
