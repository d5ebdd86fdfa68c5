"""``--help`` on every script: it is told, and no file is written."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.render_scripts import BLENDER

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
PYTHON = sorted(path for path in SCRIPTS.rglob("*.py") if "__main__" in path.read_text(encoding="utf-8"))
SHELL = sorted(path for path in SCRIPTS.rglob("*") if path.is_file() and path.read_bytes().startswith(b"#!/bin/sh"))
IN_BLENDER = {"render_blender.py", "build_shot.py", "ghosts.py", "light_passes.py", "outliers.py"}

TOLD = """
import contextlib, io, json, pathlib, runpy, sys
told = {}
for path in sys.argv[1:]:
    sys.argv, sys.path[0] = [path, "--help"], str(pathlib.Path(path).parent)
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        runpy.run_path(path, run_name="__main__")
    told[path] = text.getvalue()
print(json.dumps(told))
"""


def check(python: str | Path, paths: list[Path], folder: Path) -> None:
    """One process for all: it takes a while to import what they need."""
    command = [str(python), "-c", TOLD, *map(str, paths)]
    result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300, cwd=folder)
    assert result.returncode == 0, result.stderr
    told = json.loads(result.stdout.splitlines()[-1])
    silent = [path for path in map(str, paths) if "usage: " not in told[path]]
    assert silent == []
    assert list(folder.iterdir()) == []


def test_python_scripts(tmp_path: Path) -> None:
    paths = [path for path in PYTHON if path.name not in IN_BLENDER]
    assert len(paths) > 20
    check(sys.executable, paths, tmp_path)


@pytest.mark.blender
def test_scripts_for_blender(tmp_path: Path) -> None:
    paths = [path for path in PYTHON if path.name in IN_BLENDER]
    assert len(paths) == len(IN_BLENDER)
    check(BLENDER, paths, tmp_path)


@pytest.mark.parametrize("path", [pytest.param(path, id=path.name) for path in SHELL])
def test_shell_scripts(path: Path) -> None:
    """None of them begins its work."""
    result = subprocess.run(["sh", path, "--help"], capture_output=True, text=True, check=True, timeout=10)
    first = path.read_text(encoding="utf-8").splitlines()[1].removeprefix("# ")
    assert result.stdout.splitlines()[0] == first
    assert result.stderr == ""
