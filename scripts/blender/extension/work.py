"""What the operators do: find the command, plan the programs, show the result."""

import os
import shutil
import sys
import tempfile
from pathlib import Path

import bpy

from .job import Job, Step

WHEELS = Path(__file__).parent / "wheels"  # where build_extension.py was given some
LINKS = Path.home() / ".local" / "bin"  # where scripts/install puts the command; a desktop's PATH may lack it
RENDER_PART = 0.6  # of the time; the rest is correcting


class WorkError(Exception):
    """Something that the user can fix; one line."""


def find_command(preferences: bpy.types.AddonPreferences) -> str | None:
    """Path of the `selfcorrect` command: the one of the preferences, else the one on PATH."""
    if preferences.command:
        return shutil.which(bpy.path.abspath(preferences.command))
    return shutil.which("selfcorrect") or shutil.which("selfcorrect", path=LINKS)


def how_to_install(wheels: Path = WHEELS) -> str:
    """What to run in a terminal: pip takes that of the wheels here which fits its Python and machine."""
    if not any(wheels.glob("*.whl")):
        return "sh scripts/install in the folder of selfcorrect"
    first = f'pip install --no-index --no-deps --find-links "{wheels}" selfcorrect'
    return f'{first} && pip install "selfcorrect[oidn,flow]"'


def output_folder(scene: bpy.types.Scene) -> Path:
    """Folder of the halves and of the result; of the system's temporary files for a scene never saved."""
    wanted = scene.selfcorrect.output or "//"
    if wanted.startswith("//") and not bpy.data.filepath:
        return Path(tempfile.gettempdir()) / "selfcorrect"
    return Path(os.path.abspath(bpy.path.abspath(wanted)))


def plan(scene: bpy.types.Scene, command: str | None, frames: range, scratch: Path) -> Job:
    """The programs that render and correct some frames.

    Another Blender renders a copy of the file, so this one stays usable and none of its settings change.

    Args:
        scene: the scene; all its view layers are corrected.
        command: the `selfcorrect` command, None where there is none.
        frames: one frame, or those of a shot.
        scratch: folder for the copy, to be removed afterwards.

    Raises:
        WorkError: there is no command, the scene is not rendered with Cycles, or it cannot be saved.
    """
    if command is None:
        raise WorkError(f"selfcorrect is not installed; run in a terminal: {how_to_install()}")
    if scene.render.engine != "CYCLES":
        raise WorkError("selfcorrect needs a scene rendered with Cycles")
    own = scene.selfcorrect
    folder = output_folder(scene)
    name = Path(bpy.data.filepath).stem or "untitled"
    copy = scratch / "scene.blend"
    try:
        bpy.ops.wm.save_as_mainfile(filepath=str(copy), copy=True, check_existing=False)
    except RuntimeError as error:
        raise WorkError(f"{copy}: {' '.join(str(error).split())}") from None
    samples = own.samples or scene.cycles.samples
    shot = f"{frames[0]}-{frames[-1]}x{frames.step}"
    flags = ["-o", str(folder), "--spp", str(samples + samples % 2), f"--frames={shot}", "--name", name]
    a, b, corrected = (str(folder / f"{name}{half}.####.exr") for half in ("_a", "_b", ""))
    outputs = [folder / f"{name}.{frame:04d}.exr" for frame in frames]
    if len(frames) == 1:
        correct = [command, "frame", *(text.replace("####", f"{frames[0]:04d}") for text in (a, b))]
        correct += ["-o", str(outputs[0])]
    else:
        correct = [command, "sequence", a, b, "-o", corrected, f"--frames={shot}"]
    denoiser = {"best": "", "oidn": own.prefilter, "other": own.other}.get(own.denoiser, own.denoiser)
    correct += ["--denoiser", denoiser] if denoiser else []
    correct += ["--preset", own.preset]
    correct += ["--aovs", "auto"] if own.aovs else []
    page = outputs[0].with_suffix(".html") if own.page else None
    correct += ["--report", str(page)] if page is not None else []
    render = [*_blender(copy), "--scene-name", scene.name, *flags]
    return Job(
        [
            Step("Rendering two halves", render, RENDER_PART, 2 * len(frames), " spp, "),
            Step("Correcting", correct, 1 - RENDER_PART, len(frames), ": written after"),
        ],
        outputs,
        page,
    )


def _blender(copy: Path) -> list[str]:
    """Another Blender with the render script, up to the script's own arguments."""
    script = str(Path(__file__).parent / "render_blender.py")
    if not bpy.app.binary_path:  # Blender as a Python module
        return [sys.executable, script, str(copy)]
    # drivers in Python run there if they run here
    scripts = [] if bpy.app.autoexec_fail else ["--enable-autoexec"]
    start = [bpy.app.binary_path, "--background", *scripts, str(copy), "--python-exit-code", "1"]
    return [*start, "--python", script, "--"]


def show(outputs: list[Path], screens: list[bpy.types.Screen]) -> bpy.types.Image:
    """Load the result as the image `selfcorrect` and put it into every image editor that shows a render.

    A shot becomes an image sequence.

    Raises:
        WorkError: the result is not there.
    """
    if not outputs[0].is_file():
        raise WorkError(f"{outputs[0]}: expected the corrected image, but got nothing")
    image = bpy.data.images.get("selfcorrect")
    if image is None:
        image = bpy.data.images.load(str(outputs[0]))
        image.name = "selfcorrect"
    image.filepath = str(outputs[0])
    image.source = "FILE" if len(outputs) == 1 else "SEQUENCE"
    image.reload()
    spaces = [area.spaces.active for screen in screens for area in screen.areas if area.type == "IMAGE_EDITOR"]
    for space in spaces:
        if space.image is None or space.image == image or space.image.type == "RENDER_RESULT":
            space.image = image
            space.image_user.frame_duration = len(outputs)
    return image
