"""Short shots, and the arguments of the command that corrects them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from helpers.commands import BOX, write_half

FAST = [
    "--steps",
    "3",
    "--warm-steps",
    "3",
    "--patch",
    "16",
    "--batch",
    "2",
    "--window",
    "5",
    *BOX,
]
LAST = 5
Run = Callable[..., tuple[int, str, list[dict[str, Any]]]]


def write_shot(folder: Path, last: int = LAST, **extra: Any) -> Path:
    for n in range(1, last + 1):
        for i, half in enumerate("ab"):
            write_half(folder / f"{half}.{n:04d}.exr", 10 * n + i, **extra)
    return folder


def arguments(folder: Path, *more: object, last: int = LAST, out: str = "out") -> list[str]:
    """The command's arguments; the shot lies in ``folder``, the outputs in a folder of it."""
    (folder / out).mkdir(exist_ok=True)
    names = [str(folder / "a.####.exr"), str(folder / "b.%04d.exr"), "-o", str(folder / out / "x.####.exr")]
    return ["sequence", *names, "--frames", f"1-{last}", *FAST, *map(str, more)]


def outputs(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.exr"))}
