"""Denoisers behind one protocol: linear HDR colour in, denoised colour out.

>>> import denoisers
>>> denoise = denoisers.create("oidn")
>>> z = denoise(color, albedo=albedo, normal=normal)  # (H, W, 3), NumPy or torch, as the colour is

A plug-in (:class:`Plugin`) is an object with one method on float32 tensors; the host (:class:`Denoise`)
converts, checks, pads and crops. One plug-in is one file here; a user's own is ``file.py:Class``.
"""

import importlib
import importlib.util
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from selfcorrect.errors import DenoiserError, MissingPackageError, SettingsError

__all__ = [
    "PACKAGED",
    "WEAK",
    "Denoise",
    "DualPlugin",
    "Plugin",
    "check_threads",
    "create",
    "default",
    "fallback",
    "names",
    "variants",
]

if TYPE_CHECKING:
    from denoisers.host import Denoise, DualPlugin, Plugin

PACKAGED = Path(__file__).resolve().parent / "weights" / "denoiser.onnx"
"""The project's own model: ``onnx`` without a path."""

WEAK = ("joint-bilateral",)
"""Those whose images the deep combiner makes a better start for the core: `scripts/train/held_out.py` measures it."""

_MOST_THREADS = 1024


def __getattr__(name: str) -> Any:
    """What the host has, when it is asked for: it imports torch, for which names and help do not wait."""
    if name in ("Denoise", "DualPlugin", "Plugin"):
        return getattr(importlib.import_module("denoisers.host"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def names() -> tuple[str, ...]:
    """Return every form of a denoiser's specification that :func:`create` takes."""
    return (
        "oidn",
        "oidn:fast",
        "oidn:none",
        "joint-bilateral",
        "box",
        "nlm",
        "nfor",
        "onnx",
        "onnx:MODEL.onnx",
        "command:PROGRAM AND ARGS",
        "file.py:Class",
    )


def default() -> str:
    """Return the denoiser that is used when none is named: of oidn, onnx and joint-bilateral the first installed."""
    for package, name in (("mitsuba_oidn", "oidn"), ("onnxruntime", "onnx")):
        if importlib.util.find_spec(package) is not None:
            return name
    return "joint-bilateral"


def fallback() -> str:
    """Return one line on what :func:`default` does without and how to get it; empty where it is ``oidn``.

    The errors are those of `scripts/train/evaluate.py`, over OIDN's on 15 frames; RESULTS.md has the table.
    """
    error = {"oidn": "", "onnx": "1.9", "joint-bilateral": "4.7"}[default()]
    return error and (
        f"oidn is not installed: {default()} denoises instead, with {error} times its error on average; "
        "run: pip install 'selfcorrect[oidn]'"
    )


def variants(spec: str) -> tuple[str, ...]:
    """Return the other ways in which a denoiser can go about a frame, as specifications; most have none.

    >>> variants("oidn")
    ('oidn:fast', 'oidn:none')
    """
    modes = ("oidn", "oidn:fast", "oidn:none")
    return tuple(mode for mode in modes if mode != spec) if spec in modes else ()


def create(spec: str, *, threads: int | None = None, scratch: int | None = None) -> "Denoise":
    """Create a denoiser from its specification.

    Args:
        spec: one of the forms that :func:`names` returns.
        threads: CPU threads of ``oidn``, ``onnx``, ``joint-bilateral``, ``nlm`` and ``nfor``, at least 1; None
            leaves the number to them. A command and a user's class choose their own threads.
        scratch: bytes that ``oidn`` may take beside its images; the others manage their own memory.

    Raises:
        DenoiserError: the specification is unknown, the model, the command or the class does not fit, or OIDN does not
            load.
        FileError: the model or the Python file is missing.
        MissingPackageError: the denoiser needs an optional package; the message says what to run.
        SettingsError: ``threads`` is out of range.
    """
    if threads is not None:
        check_threads(threads)
    host: type[Denoise] = importlib.import_module("denoisers.host").Denoise
    return host(_plugin(spec, threads, scratch))


def check_threads(threads: int, name: str = "threads") -> None:
    """Refuse a number of threads that no machine has: the libraries below end the process over it.

    Args:
        threads: how many.
        name: what messages call the number.

    Raises:
        SettingsError: it is less than 1 or more than 1024.
    """
    if not 1 <= threads <= _MOST_THREADS:
        raise SettingsError(f"expected {name} from 1 to {_MOST_THREADS}, but got {threads}")


def _plugin(spec: str, threads: int | None, scratch: int | None) -> "Plugin | DualPlugin":
    plugin: Plugin | DualPlugin
    match spec.split(":", maxsplit=1):
        case ["oidn", *_]:
            plugin = _adapter("oidn", extra="oidn").oidn(spec, threads, scratch)
        case ["joint-bilateral"]:
            plugin = _adapter("joint_bilateral").JointBilateral(threads)
        case ["box"]:
            plugin = _adapter("box").Box()
        case ["nlm"]:
            plugin = _adapter("nlm").NonLocalMeans(threads)
        case ["nfor"]:
            plugin = _adapter("nfor").Nfor(threads)
        case ["onnx"]:
            plugin = _adapter("onnx", extra="onnx").Onnx(str(PACKAGED), threads)
        case ["onnx", path] if path:
            plugin = _adapter("onnx", extra="onnx").Onnx(path, threads)
        case ["command", line] if line:
            plugin = _adapter("command").Command(line)
        case _:
            path, _, name = spec.rpartition(":")
            if not (path.endswith(".py") and name):
                raise DenoiserError(f"expected a denoiser of {', '.join(names())}, but got {spec!r}")
            plugin = _adapter("user").load(path, name)
    return plugin


def _adapter(module: str, *, extra: str | None = None) -> ModuleType:
    """Import an adapter only when it is asked for: its packages may be missing, and are slow to load."""
    try:
        return importlib.import_module(f"denoisers.{module}")
    except ImportError as error:
        if extra is None:
            raise
        raise MissingPackageError(f"the denoiser {module}", extra) from error
