"""What the tests share: fixtures, the development frames, and fresh memory that is never zero by luck."""

import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.commands import write_half
from helpers.shots import Run, write_shot

from selfcorrect import cli

HAS_BLENDER = sys.version_info[:2] == (3, 11) and platform.machine() != "aarch64"
"""Where the package bpy has a wheel, the tests demand it."""

_LACKING = pytest.StashKey[list[pytest.Item]]()

torch.utils.deterministic.fill_uninitialized_memory = True
torch.use_deterministic_algorithms(mode=True)


def has_llvm() -> bool:
    """Whether Mitsuba finds an LLVM library that it can work with; no package installs one."""
    probe = 'import mitsuba as mi; mi.set_variant("llvm_ad_rgb"); assert (mi.Float([1, 2]) + 1)[1] == 3'
    return subprocess.run([sys.executable, "-c", probe], capture_output=True, check=False).returncode == 0


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


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the tests of what this machine cannot have: the development frames, Blender, LLVM; and no others."""
    there = {"shared": shared_folder().is_dir(), "blender": HAS_BLENDER}
    there["llvm"] = any(item.get_closest_marker("llvm") for item in items) and has_llvm()
    if os.environ.get("SELFCORRECT_REQUIRE_SHARED") and not any(item.get_closest_marker("shared") for item in items):
        raise pytest.UsageError("expected tests that need the development frames, but got none")
    there["browser"] = all(shutil.which(program) for program in ("chromium", "chromedriver"))
    lacking = [item for item in items if any(item.get_closest_marker(need) and not there[need] for need in there)]
    config.hook.pytest_deselected(items=lacking)
    config.stash[_LACKING] = [item for item in lacking if item.get_closest_marker("browser")]
    items[:] = [item for item in items if item not in lacking]


def pytest_report_collectionfinish(config: pytest.Config) -> list[str]:
    """Name the tests that lack a browser, which many a machine could have."""
    names = dict.fromkeys(item.name.partition("[")[0] for item in config.stash.get(_LACKING, []))
    return [f"left out without chromium and chromedriver (scripts/setup-chromium): {', '.join(names)}"] if names else []
