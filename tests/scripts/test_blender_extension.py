"""The Blender extension: built, installed and used in a real Blender without a window."""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import build_extension
import pytest
from helpers.commands import BALANCED
from helpers.render_scripts import BLENDER, BLENDER_TAKEN, done

from selfcorrect import exr

HERE = Path(__file__).resolve().parent
INSTALL = "sh scripts/install in the folder of selfcorrect"


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_extension.build(tmp_path_factory.mktemp("zip"))


def test_the_zip_holds_what_it_needs_and_the_same_bytes_again(archive: Path, tmp_path: Path) -> None:
    assert build_extension.build(tmp_path).read_bytes() == archive.read_bytes()
    names = {"__init__.py", "job.py", "work.py", "blender_manifest.toml", "render_blender.py", "halves.py", "LICENSE"}
    assert set(zipfile.ZipFile(archive).namelist()) == names


def test_wheels_come_along(tmp_path: Path) -> None:
    (tmp_path / "selfcorrect-0.1.0-py3-none-any.whl").write_bytes(b"wheel")
    (tmp_path / "other-1.0-py3-none-any.whl").write_bytes(b"not ours")
    names = zipfile.ZipFile(build_extension.build(tmp_path / "out", tmp_path)).namelist()
    assert [name for name in names if name.startswith("wheels/")] == ["wheels/selfcorrect-0.1.0-py3-none-any.whl"]


@pytest.mark.blender
def test_blender_takes_the_zip_for_valid(archive: Path) -> None:
    (tool,) = BLENDER.parent.parent.glob("lib/*/site-packages/bpy/*/scripts/addons_core/bl_pkg/cli/blender_ext.py")
    result = subprocess.run([BLENDER, tool, "validate", archive], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "No errors" in result.stdout or "Success" in result.stdout, result.stdout


def program(folder: Path) -> Path:
    """Stands for the program `blender`, which no registry has: the same flags, and the module bpy behind."""
    script, path = folder / "program.py", folder / "blender"
    script.write_text(
        "import runpy, sys, bpy\n"
        "flags = sys.argv[1 : sys.argv.index('--')]\n"
        "assert flags[0] == '--background' and flags[-4:-1] == ['--python-exit-code', '1', '--python'], flags\n"
        "bpy.ops.wm.open_mainfile(filepath=flags[-5])\n"
        "runpy.run_path(flags[-1], run_name='__main__')\n"
    )
    path.write_text(f'#!/bin/sh\nexec "{BLENDER}" "{script}" "$@"\n')
    path.chmod(0o755)
    return path


@pytest.fixture(scope="module")
def found(archive: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What a session of Blender brought (see in_blender.py), and the folder it wrote to."""
    folder = tmp_path_factory.mktemp("blender")
    (folder / "scratch").mkdir()
    done("blender/build_shot", folder / "room.blend")
    command = folder / "selfcorrect"  # the real one, with less training
    flags = " ".join(BALANCED)
    command.write_text(f'#!/bin/sh\nverb=$1\nshift\nexec "{sys.executable}" -m selfcorrect "$verb" {flags} "$@"\n')
    command.chmod(0o755)
    small = "import bpy; bpy.ops.wm.open_mainfile(filepath={0!r}); r = bpy.context.scene.render; "
    small += "r.resolution_x, r.resolution_y = 40, 24; bpy.ops.wm.save_mainfile()"
    subprocess.run([BLENDER, "-c", small.format(str(folder / "room.blend"))], check=True, capture_output=True)
    environment = os.environ | {"BLENDER_USER_RESOURCES": str(folder / "user"), "TMPDIR": str(folder / "scratch")}
    arguments = [archive, folder / "room.blend", command, program(folder), folder / "out"]
    result = subprocess.run(
        [str(BLENDER), str(HERE / "in_blender.py"), *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        timeout=1800,
        env=environment,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return json.loads(result.stdout.splitlines()[-1]) | {"folder": folder}


@pytest.mark.blender
def test_a_frame_is_rendered_corrected_and_loaded(found: dict[str, Any]) -> None:
    assert found["frame"] == ["FINISHED"]
    path = found["folder"] / "out" / "room.0001.exr"
    assert found["image"] == {"path": str(path), "type": "MULTILAYER"}
    half = exr.load_half(path)
    assert half.taken == BLENDER_TAKEN | {"alpha": ["ViewLayer.Combined.A"]}
    assert half.buffers["color"].shape == (24, 40, 3)
    assert "selfcorrect/settings" in half.file.parts[0].header
    assert half.file.parts[0].header["cycles.ViewLayer.samples"] == "2"


@pytest.mark.blender
def test_the_settings_of_the_user_stay(found: dict[str, Any]) -> None:
    assert found["settings after"] == found["settings before"] == found["settings after failing"]


@pytest.mark.blender
def test_without_selfcorrect_it_says_how_to_install_it(found: dict[str, Any]) -> None:
    assert f"selfcorrect is not installed; run in a terminal: {INSTALL}" in found["missing"]
    assert {"selfcorrect is not installed", f"In a terminal: {INSTALL}", "Preferences"} <= set(found["missing panel"])
    assert "Frame" not in found["missing panel"]
    assert {"samples", "output", "denoiser", "preset", "aovs", "page", "Frame", "Animation"} <= set(found["panel"])
    assert {"prefilter", "other", "Open Report"}.isdisjoint(found["panel"])


@pytest.mark.blender
def test_what_the_panel_offers_reaches_the_command(found: dict[str, Any]) -> None:
    assert "prefilter" in found["oidn panel"]
    assert "other" in found["other panel"]
    planned, out = found["planned"], found["folder"] / "out"
    flags = ["--denoiser", "oidn:fast", "--preset", "fast", "--aovs", "auto"]
    assert planned[1] == "sequence"
    assert planned[-8:] == [*flags, "--report", str(out / "room.0001.html")]
    assert (out / "room.0001.html").is_file()  # of the animation
    assert "Open Report" in found["page panel"]


@pytest.mark.blender
def test_a_failure_is_shown_in_one_line(found: dict[str, Any]) -> None:
    assert "Correcting failed: expected a denoiser" in found["failing"]
    assert "nonsense" in found["failing"]
    assert "needs a scene rendered with Cycles" in found["engine"]


@pytest.mark.blender
def test_cancelling_ends_the_process(found: dict[str, Any]) -> None:
    assert found["cancelled"]["error"] == "cancelled"
    assert 0 < found["cancelled"]["progress"] < 0.6
    assert found["cancelled"]["returncode"] not in {0, None}
    assert found["cancelled"]["polls"] is False


@pytest.mark.blender
def test_the_button_leaves_blender_to_the_user_meanwhile(found: dict[str, Any]) -> None:
    again, cancelled = found["again"], found["cancelled again"]
    assert again["answers"] == [["RUNNING_MODAL"], ["PASS_THROUGH"], ["FINISHED"]]
    assert again["reports"] == [f"room.0001.exr in {found['folder'] / 'out'}"]
    assert cancelled["answers"] == [["RUNNING_MODAL"], ["PASS_THROUGH"], ["CANCELLED"]]
    assert cancelled["reports"] == ["cancelled"]
    assert cancelled["kinds"] == again["kinds"] == ["INFO"]
    assert again["status"][0].startswith("selfcorrect: 0%")
    assert any("Correcting   Esc: cancel" in text for text in again["status"][:-1])
    assert again["status"][-1] is cancelled["status"][-1] is None  # Blender's own text again
    assert again["timers"] == cancelled["timers"] == 0
    assert "selfcorrect.cancel" in again["drawn"]
    assert found["images again"] == found["images"]


@pytest.mark.blender
def test_escape_cancels_and_a_failure_pops_up(found: dict[str, Any]) -> None:
    escaped, failing = found["escaped"], found["failing in a window"]
    assert escaped["answers"] == [["RUNNING_MODAL"], ["PASS_THROUGH"], ["RUNNING_MODAL"], ["CANCELLED"]]
    assert (escaped["reports"], escaped["kinds"], escaped["status"][-1]) == (["cancelled"], ["INFO"], None)
    assert failing["kinds"] == ["ERROR"]  # which Blender shows as a pop-up of its own
    assert "Correcting failed: expected a denoiser" in failing["reports"][0]


@pytest.mark.blender
def test_an_animation(found: dict[str, Any]) -> None:
    assert found["animation"] == ["FINISHED"]
    assert found["source"] == "SEQUENCE"
    names = {path.name for path in (found["folder"] / "out").glob("room*.exr")}
    assert names == {f"room{half}.{frame}.exr" for half in ("", "_a", "_b") for frame in ("0001", "0003")}


@pytest.mark.blender
def test_nothing_is_left_behind(found: dict[str, Any]) -> None:
    assert found["disabled"] == found["before"]
    assert found["enabled"] != found["before"]
    assert list((found["folder"] / "scratch").glob("selfcorrect-*")) == []
    assert [path.name for path in (found["folder"] / "out").glob(".*")] == []
