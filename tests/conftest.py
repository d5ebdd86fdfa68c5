"""What the tests share: fixtures, the development frames, and fresh memory that is never zero by luck."""

import json
import os
import platform
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")  # Triton reads it when it is imported

import variants
from helpers.commands import write_half
from helpers.shots import Run, write_shot

from selfcorrect import cli

HAS_BLENDER = sys.version_info[:2] == (3, 11) and platform.machine() != "aarch64"
"""Where the package bpy has a wheel, the tests demand it."""

torch.utils.deterministic.fill_uninitialized_memory = True
torch.use_deterministic_algorithms(mode=True)


def shared_folder() -> Path:
    here = Path(__file__).resolve().parent.parent.parent / "shared"
    return Path(os.environ.get("SELFCORRECT_SHARED", here))


@pytest.fixture
def halves(tmp_path: Path) -> tuple[Path, Path]:
    """Two halves of one frame, in files."""
    return write_half(tmp_path / "a.exr", 1), write_half(tmp_path / "b.exr", 2)


@pytest.fixture
def shot_folder(tmp_path: Path) -> Path:
    """A folder that holds the halves of a short shot."""
    return write_shot(tmp_path)


@pytest.fixture
def sequence(capfd: pytest.CaptureFixture[str]) -> Run:
    """The command in this process: exit code, stderr, and the JSON objects of stdout."""

    def one(given: list[str]) -> tuple[int, str, list[dict[str, Any]]]:
        capfd.readouterr()
        code = cli.main([*given, "--json"])
        out, err = capfd.readouterr()
        return code, err, [json.loads(line) for line in out.splitlines()]

    return one


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """Torch on one thread; what it was before comes back."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of the development frames, beside the checkout or where SELFCORRECT_SHARED says."""
    return shared_folder()


LACKED = ("shared", "blender", "browser", "llvm")
LEFT_OUT = pytest.StashKey[dict[str, list[str]]]()
"""Of each need that this machine lacks, the names of the tests left out for it."""


def needs(item: pytest.Item) -> list[str]:
    """What a test is marked to need, of what a machine may lack."""
    return [need for need in LACKED if item.get_closest_marker(need)]


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the tests of what this machine cannot have (see LACKED), and no others."""
    there = {"shared": shared_folder().is_dir(), "blender": HAS_BLENDER}
    there["browser"] = all(shutil.which(program) for program in ("chromium", "chromedriver"))
    there["llvm"] = any("llvm" in needs(item) for item in items) and variants.failure() is None
    left_out: dict[str, list[str]] = {}
    lacking = []
    for item in items:
        missing = [need for need in needs(item) if not there[need]]
        lacking += [item] if missing else []
        for need in missing:
            left_out.setdefault(need, []).append(item.name.partition("[")[0])
    config.stash[LEFT_OUT] = left_out
    if lacking:
        config.hook.pytest_deselected(items=lacking)
        items[:] = [item for item in items if item not in lacking]


def pytest_deselected(items: list[pytest.Item]) -> None:
    """Where the development frames are required, no test of them may be left out, by whatever means."""
    if os.environ.get("SELFCORRECT_REQUIRE_SHARED") and any("shared" in needs(item) for item in items):
        raise pytest.UsageError("expected every test that needs the development frames to run, but some were left out")


def pytest_collection_finish(session: pytest.Session) -> None:
    """Where the development frames are required, there must be tests of them."""
    if os.environ.get("SELFCORRECT_REQUIRE_SHARED") and not any("shared" in needs(item) for item in session.items):
        raise pytest.UsageError("expected tests that need the development frames, but got none")


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """One line for each thing that this machine lacks: the tests left out for it, by name."""
    reasons = {"shared": "no development frames", "blender": "no package bpy for this Python"}
    reasons["browser"] = "no chromium and chromedriver on the PATH"
    for need, names in config.stash.get(LEFT_OUT, {}).items():
        why = reasons.get(need) or variants.refusal("Mitsuba")
        terminalreporter.write_line(f"left out: {', '.join(dict.fromkeys(names))}: {why}")
