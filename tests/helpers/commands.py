"""The command, in this process or in one of its own, and halves for it to read."""

import contextlib
import io
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import torch

from selfcorrect import cli

BOX = ["--denoiser", "box", "--threads", "1"]
BALANCED = ["--steps", "4", "--patch", "16", "--batch", "2", "--window", "5", *BOX]


def write_half(path: Path, seed: int, size: tuple[int, int] = (24, 30), **extra: Any) -> Path:
    """A half as Mitsuba writes it, with alpha and an attribute to pass through."""
    generator = np.random.default_rng(seed)
    names = ["R", "G", "B", "A", "albedo.R", "albedo.G", "albedo.B", "nn.X", "nn.Y", "nn.Z", "dd.T"]
    channels = {name: generator.random(size, dtype=np.float32).astype(np.float16) for name in names} | extra
    channels = {name: values for name, values in channels.items() if values is not None}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "owner": "a renderer"}
    OpenEXR.File(header, channels).write(str(path))
    return path


def run(*arguments: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """The installed command in a process of its own."""
    command = [sys.executable, "-m", "selfcorrect", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=300, **options)


def call(*arguments: object) -> subprocess.CompletedProcess[str]:
    """The command in this process, which starts nothing and is as it was afterwards."""
    given, threads = [str(argument) for argument in arguments], torch.get_num_threads()
    out, err = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = cli.main(given)
    finally:
        torch.set_num_threads(threads)
    return subprocess.CompletedProcess(given, code, out.getvalue(), err.getvalue())


def refused(*arguments: object, how: Any = call) -> str:
    """The one line that a refused run prints; exit code 2, nothing on stdout.

    Args:
        arguments: of the command.
        how: :func:`call`, or :func:`run` where the process is part of the test.
    """
    result = how(*arguments)
    assert result.returncode == 2, result.stderr
    assert result.stdout == ""
    lines = [line for line in result.stderr.splitlines() if line.startswith("selfcorrect: error: ")]
    assert len(lines) == 1, result.stderr
    assert result.stderr.splitlines()[-1] == lines[0]
    assert "Traceback" not in result.stderr
    return lines[0]
