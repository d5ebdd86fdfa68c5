"""Any external program as a denoiser, over temporary EXR files: ``command:PROGRAM AND ARGS``.

``command:"prog {color} {albedo} {normal} {output}"``. The line is split into arguments as a POSIX shell
splits words, but no shell runs. In each argument a placeholder is replaced by the path of an EXR file:

=============  =====================================================================================
``{color}``    input: linear radiance in the channels R, G, B
``{albedo}``   input: albedo in R, G, B
``{normal}``   input: normal x, y, z in R, G, B
``{output}``   the file that the program writes: linear radiance in R, G, B (float or half), same size
=============  =====================================================================================

All files that the program reads are float32, uncompressed, in one folder that is removed afterwards.
``{color}`` and ``{output}`` are required. Where the frame has no albedo or no normal, every argument with
that placeholder is left out; if the argument is the placeholder alone, an option before it (an argument
that begins with ``-``) is left out too. So both ``--albedo={albedo}`` and ``--albedo {albedo}`` vanish as a
whole; a switch that takes no value must not stand directly before a bare ``{albedo}`` or ``{normal}``.
"""

import contextlib
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import OpenEXR
import torch

from selfcorrect.errors import DenoiserError

__all__ = ["Command"]

PLACEHOLDERS = ("color", "albedo", "normal", "output")


class Command:
    """An external program; exit code 0 and a readable ``{output}`` are success."""

    multiple = 1

    def __init__(self, line: str):
        try:
            self.template = shlex.split(line)
        except ValueError as error:
            raise DenoiserError(f"command: expected a command line, but got {line!r}: {error}") from error
        if not self.template:
            raise DenoiserError("command: expected a program and its arguments, but got nothing")
        self.name = f"command {self.template[0]}"
        used = set(re.findall(r"\{(\w+)\}", line))
        unknown = sorted(used - set(PLACEHOLDERS))
        if unknown:
            known = ", ".join(f"{{{name}}}" for name in PLACEHOLDERS)
            raise DenoiserError(f"{self.name}: expected placeholders of {known}, but got {{{unknown[0]}}}")
        for name in ("color", "output"):
            if name not in used:
                raise DenoiserError(f"{self.name}: expected a placeholder {{{name}}}, but got {line!r}")
        if shutil.which(self.template[0]) is None:
            raise DenoiserError(f"{self.name}: expected a program, but found none of this name")
        self.features = frozenset(used & {"albedo", "normal"})

    def denoise(self, color: torch.Tensor, albedo: torch.Tensor | None, normal: torch.Tensor | None) -> torch.Tensor:
        """Write the images, run the program, read its output (H, W, 3).

        Raises:
            DenoiserError: there is no room for the files; the program cannot be run, or exits with another code
                than 0 (the message ends with the last line of its stderr); or its output is missing, unreadable or of
                another size.
        """
        images = {"color": color, "albedo": albedo, "normal": normal}
        with self._folder() as folder:
            paths = {"output": Path(folder, "output.exr")}
            for name, image in images.items():
                if image is not None:
                    paths[name] = Path(folder, f"{name}.exr")
                    self._write(paths[name], image)
            self._run(_arguments(self.template, paths))
            return self._read(paths["output"], (color.shape[0], color.shape[1]))

    def _folder(self) -> "tempfile.TemporaryDirectory[str]":
        try:
            return tempfile.TemporaryDirectory(prefix="denoiser-", ignore_cleanup_errors=True)
        except OSError as error:
            raise DenoiserError(
                f"{self.name}: expected a temporary folder, but got: {error.strerror}; set TMPDIR to one with room"
            ) from error

    def _write(self, path: Path, image: torch.Tensor) -> None:
        """Write an image (H, W, 3) as float32 R, G, B."""
        try:
            _write(path, image)
        except (OSError, RuntimeError) as error:  # what OpenEXR raises where the disk is full
            raise DenoiserError(
                f"{self.name}: expected room for {path.name} in {path.parent}, but got: "
                f"{' '.join(str(error).split())}; set TMPDIR to a folder with room"
            ) from error

    def _run(self, arguments: list[str]) -> None:
        """Run the program, and end it with all that it has started where this process is told to end."""
        try:
            process = subprocess.Popen(
                arguments,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                errors="replace",
                start_new_session=True,
            )
        except OSError as error:
            raise DenoiserError(f"{self.name}: expected a program to run, but got: {error.strerror}") from error
        try:
            _, told = process.communicate()
        except BaseException:
            _end(process)
            raise
        if process.returncode != 0:
            said = told.strip().splitlines()[-1:] or ["it printed nothing to stderr"]
            raise DenoiserError(f"{self.name}: expected exit code 0, but got {process.returncode}: {said[0]}")

    def _read(self, path: Path, size: tuple[int, int]) -> torch.Tensor:
        expected = f"{self.name}: expected {{output}} as an EXR of {size[1]}x{size[0]} with R, G, B, but got"
        if not path.exists():
            raise DenoiserError(f"{expected} no file")
        try:
            with OpenEXR.File(str(path), separate_channels=True) as file:
                channels = {name: channel.pixels for name, channel in file.channels().items()}
        except (RuntimeError, ValueError) as error:  # what OpenEXR raises for a broken or truncated file
            raise DenoiserError(f"{expected} a file that cannot be read: {error}") from error
        if not {"R", "G", "B"} <= channels.keys():
            raise DenoiserError(f"{expected} the channels {', '.join(channels)}")
        planes = [channels[name] for name in "RGB"]
        for plane in planes:
            if plane.shape != size:
                raise DenoiserError(f"{expected} {'x'.join(map(str, reversed(plane.shape)))}")
        return torch.from_numpy(np.stack(planes, axis=2).astype(np.float32))


def _end(process: "subprocess.Popen[str]") -> None:
    """End a process and those that it has started."""
    if sys.platform == "win32":
        process.kill()
    else:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _arguments(template: list[str], paths: dict[str, Path]) -> list[str]:
    """Fill in the paths; leave out the arguments of images that are absent (see above)."""
    absent = [f"{{{name}}}" for name in PLACEHOLDERS if name not in paths]
    kept: list[str] = []
    for before, argument in zip(["", *template], template, strict=False):
        if not any(placeholder in argument for placeholder in absent):
            kept.append(argument)
        elif argument in absent and before.startswith("-") and kept[-1] is before:
            kept.pop()
    return [re.sub(r"\{(\w+)\}", lambda match: str(paths[match[1]]), argument) for argument in kept]


def _write(path: Path, image: torch.Tensor) -> None:
    """Write an image (H, W, 3) as float32 R, G, B."""
    pixels = {name: image[:, :, index].contiguous().numpy() for index, name in enumerate("RGB")}
    header = {"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, pixels).write(str(path))
