"""Make wheels for several systems on one machine, with Zig as the compiler.

    sh scripts/build_wheels [TARGET …]

The headers of Python are this machine's: Linux on ARM64 and macOS have the sizes of Linux on x86-64, and windows.h here
says what differs on Windows. The wheels of Windows link against a list of the names that they use of python3.dll.
"""

import argparse
import os
import shutil
import subprocess
import sys
import sysconfig
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
WORK = ROOT / "build" / "wheels"


@dataclass(frozen=True)
class Target:
    """A system: Zig's name of it, CMake's names, and the tag of its wheels."""

    triple: str
    system: str
    processor: str
    tag: str


TARGETS = {
    "linux-x86_64": Target("x86_64-linux-gnu.2.28", "Linux", "x86_64", "manylinux_2_28_x86_64"),
    "linux-aarch64": Target("aarch64-linux-gnu.2.28", "Linux", "aarch64", "manylinux_2_28_aarch64"),
    "windows-x86_64": Target("x86_64-windows-gnu", "Windows", "AMD64", "win_amd64"),
    "macos-arm64": Target("aarch64-macos.11.0", "Darwin", "arm64", "macosx_11_0_arm64"),
}
# nanobind hands Apple's linker a file of the names that Python brings at run time; Zig's own takes no such file. It
# also crashes where it is asked for a bundle: Python loads a library as well. CMake takes libdl for needed on Windows,
# since this machine's Python needs it; where there is one, Zig links it unasked.
OWN_LINKER = """
for argument do
    shift
    case "$argument" in
        -Wl,@*) argument=-Wl,-undefined,dynamic_lookup ;;
        -bundle) argument=-dynamiclib ;;
        -ldl) continue ;;
    esac
    set -- "$@" "$argument"
done
"""
STABLE = sys.version_info >= (3, 12)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", metavar="TARGET", nargs="*", help=f"{', '.join(TARGETS)}, any; by default all")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "dist", help="folder; by default dist")
    options = parser.parse_args()
    wanted = options.targets or [*TARGETS, "any"]
    if unknown := set(wanted) - {*TARGETS, "any"}:
        parser.error(f"expected targets out of {', '.join(TARGETS)} and any, but got {', '.join(sorted(unknown))}")
    if not STABLE:
        print(
            "Python 3.11: these wheels are for 3.11 alone, and for Linux; with PYTHON=python3.12 or later for all later"
        )
        wanted = [name for name in wanted if name == "any" or name.startswith("linux")]
    for name in wanted:
        print(pure(options.output) if name == "any" else compiled(TARGETS[name], options.output), flush=True)


def pure(output: Path) -> Path:
    """The wheel without kernels."""
    return moved(wheel(WORK / "any", {"SELFCORRECT_KERNELS": "none"}, []), output)


def compiled(target: Target, output: Path) -> Path:
    """A wheel of one system."""
    folder = WORK / target.tag
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    toolchain = folder / "toolchain.cmake"
    toolchain.write_text(toolchain_of(target, folder))
    defines = {"CMAKE_TOOLCHAIN_FILE": toolchain, "Python_INCLUDE_DIR": headers(target, folder)}
    if target.system == "Windows":
        defines |= {"Python_SABI_LIBRARY": import_library(target, folder), "SKBUILD_SOSABI": ""}
    flags = [f"-Ccmake.define.{name}={value}" for name, value in defines.items()]
    made = wheel(folder, {"CMAKE_GENERATOR": "Ninja"}, [*flags, f"-Cbuild-dir={folder / 'build'}"])
    call([sys.executable, "-m", "wheel", "tags", "--remove", "--platform-tag", target.tag, str(made)])
    (tagged,) = made.parent.glob("*.whl")
    return moved(tagged, output)


def wheel(folder: Path, environment: dict[str, str], flags: list[str]) -> Path:
    """What the build backend makes of the checkout."""
    shutil.rmtree(folder / "wheel", ignore_errors=True)
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder / "wheel")]
    call([*build, *flags, str(ROOT)], {**os.environ, **environment})
    (made,) = (folder / "wheel").glob("*.whl")
    return made


def moved(made: Path, output: Path) -> Path:
    output.mkdir(parents=True, exist_ok=True)
    return Path(shutil.move(made, output / made.name))


def call(command: list[str], environment: dict[str, str] | None = None) -> None:
    """Run a program, and show what it says only where it fails."""
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if result.returncode:
        sys.exit(result.stdout + result.stderr)


def toolchain_of(target: Target, folder: Path) -> str:
    """For CMake: Zig's compiler under names that CMake takes for programs."""
    for name in ("c++", "ar", "ranlib"):
        flags = f" -target {target.triple}" if name == "c++" else ""
        program = folder / f"zig-{name.replace('+', 'x')}"
        program.write_text(f'#!/bin/sh\n{OWN_LINKER}exec "{sys.executable}" -m ziglang {name}{flags} "$@"\n')
        program.chmod(0o755)
    return f"""
set(CMAKE_SYSTEM_NAME {target.system})
set(CMAKE_SYSTEM_PROCESSOR {target.processor})
set(CMAKE_CXX_COMPILER {folder}/zig-cxx)
set(CMAKE_AR {folder}/zig-ar)
set(CMAKE_RANLIB {folder}/zig-ranlib)
set(CMAKE_CXX_FLAGS_INIT "-include cstdio")  # nanobind counts on some other header to bring it; libc++'s do not
"""


def headers(target: Target, folder: Path) -> Path:
    """Python's headers, with the sizes of another system where they differ."""
    include = folder / "include"
    own = Path(sysconfig.get_path("include"))
    shutil.copytree(own, include, ignore=shutil.ignore_patterns("pyconfig.h"))
    if target.system == "Windows":
        shutil.copyfile(HERE / "windows.h", include / "pyconfig.h")
    else:
        shutil.copyfile(sizes(), include / "pyconfig.h")
    return include


def sizes() -> Path:
    """This machine's pyconfig.h; Debian's own only names the one of each machine, in a folder beside."""
    named = Path(sysconfig.get_config_h_filename())
    own = named.parent.parent / str(sysconfig.get_config_var("MULTIARCH")) / named.parent.name / "pyconfig.h"
    return own if own.is_file() else named


def import_library(target: Target, folder: Path) -> Path:
    """Python's stable ABI on Windows, as a library to link against."""
    names = sorted({*(HERE / "python3.def").read_text(encoding="utf-8").split()})
    listed = folder / "python3.def"
    listed.write_text("\n".join(["LIBRARY python3.dll", "EXPORTS", *names, ""]))
    library = folder / "libpython3.a"
    call([sys.executable, "-m", "ziglang", "dlltool", "-m", "i386:x86-64", "-d", str(listed), "-l", str(library)])
    return library


if __name__ == "__main__":
    main()
