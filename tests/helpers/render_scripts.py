"""The scripts that render the two halves, each with the Python that has its renderer."""

import re
import subprocess
import sys
from pathlib import Path

from helpers.exr_files import three

CHECKOUT = Path(__file__).resolve().parents[2]
BLENDER = CHECKOUT / ".venv-blender" / "bin" / "python"  # with the module bpy; `sh scripts/setup-blender` makes it


def script(name: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    python = BLENDER if "blender" in name else sys.executable
    command = [str(python), str(CHECKOUT / "scripts" / f"{name}.py"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)


def done(name: str, *arguments: object) -> str:
    result = script(name, *arguments)
    assert result.returncode == 0, result.stderr + result.stdout
    return result.stdout


def refused(name: str, *arguments: object) -> str:
    """The one line of an error that the user can fix."""
    result = script(name, *arguments)
    assert result.returncode == 2, result.stderr
    lines = [line for line in result.stderr.splitlines() if re.search(rf"{Path(name).name}(\.py)?: error: ", line)]
    assert len(lines) == 1, result.stderr
    assert "Traceback" not in result.stderr
    return lines[0]


BLENDER_TAKEN = {
    "color": three("ViewLayer.Combined"),
    "albedo": three("ViewLayer.Denoising Albedo"),
    "normal": three("ViewLayer.Denoising Normal", "XYZ"),
    "depth": ["ViewLayer.Denoising Depth.Z"],
}
