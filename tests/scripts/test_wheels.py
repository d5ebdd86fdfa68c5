"""How the wheels of other systems are compiled: Zig under the names and with the flags that CMake and nanobind use."""

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

BUILD = Path(__file__).parents[2] / "scripts" / "wheels" / "build.py"


@pytest.fixture
def build(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    spec = importlib.util.spec_from_file_location("wheels_build", BUILD)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "wheels_build", module)  # its dataclass looks itself up
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("system", ["linux-aarch64", "windows-x86_64", "macos-arm64"])
def test_the_compiler_that_cmake_calls(
    build: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, system: str
) -> None:
    """Names with spaces stay one; no libdl; a bundle, at which Zig's linker crashes, becomes a library as well."""
    told = tmp_path / "told"
    told.write_text('#!/bin/sh\nprintf "%s\\n" "$@"\n')
    told.chmod(0o755)
    monkeypatch.setattr(build.sys, "executable", str(told))
    target = build.TARGETS[system]
    toolchain = build.toolchain_of(target, tmp_path)
    for tool in ("cxx", "ar", "ranlib"):
        assert f"{tmp_path}/zig-{tool}" in toolchain
    given = ["-O3", "-bundle", "-Wl,@names.sym", "-ldl", "-o", "a b.so", "a b.o"]
    seen = subprocess.run([tmp_path / "zig-cxx", *given], capture_output=True, text=True, check=True).stdout.split("\n")
    assert seen[:5] == ["-m", "ziglang", "c++", "-target", target.triple]
    assert seen[5:-1] == ["-O3", "-dynamiclib", "-Wl,-undefined,dynamic_lookup", "-o", "a b.so", "a b.o"]


def test_names_to_link_against_are_each_once_what_the_stable_abi_has(build: ModuleType) -> None:
    names = (build.HERE / "python3.def").read_text(encoding="utf-8").split()
    assert len(names) == len(set(names)) > 50
    assert all(name.startswith(("Py", "_Py")) for name in names)
