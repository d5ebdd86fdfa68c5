"""What is told, and where: results on stdout, everything else on stderr; and Ctrl-C."""

import contextlib
import json
import os
import signal
import sys
from collections.abc import Callable, Mapping
from typing import Any

from tqdm import tqdm

from selfcorrect.errors import printable
from selfcorrect.exr.file import OUTPUT

__all__ = ["EndOnInterrupt", "Progress", "answer", "log"]


def log(*lines: str) -> None:
    """Lines on stderr, in one piece; what files put into them is escaped. Where nothing can be told, so be it."""
    if sys.stderr is None:  # closed before Python began; print would take stdout
        return
    with OUTPUT, contextlib.suppress(OSError, ValueError):
        print("\n".join(map(printable, lines)), file=sys.stderr, flush=True)


def answer(report: Mapping[str, Any]) -> None:
    """One JSON object, in one line on stdout."""
    with OUTPUT:
        print(json.dumps(report), flush=True)


class EndOnInterrupt:
    """While it is entered, the first Ctrl-C asks training to end; the second one interrupts as usual."""

    def __init__(self) -> None:
        self._asked = False
        self._before: Any = None

    def __call__(self) -> bool:
        """Whether training is asked to end."""
        return self._asked

    def __enter__(self) -> "EndOnInterrupt":
        self._before = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGINT, self._before)

    def _handle(self, *_: object) -> None:
        if self._asked:
            raise KeyboardInterrupt
        self._asked = True
        # not log(): its lock may be held by the very thread that this interrupts
        with contextlib.suppress(OSError):
            os.write(2, b"interrupted: writing what has been learned so far; again to write nothing\n")


class Progress:
    """A bar on a terminal, a plain line for every tenth in a log.

    Args:
        meanwhile: called after every step.
    """

    def __init__(self, meanwhile: Callable[[], None] | None = None) -> None:
        self._bar: Any = None
        self._meanwhile = meanwhile

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def __call__(self, step: int, steps: int, loss: float) -> None:
        """Tell of an optimiser step; not of its loss, which is that of a few patches and wanders from step to step."""
        if self._meanwhile is not None:
            self._meanwhile()
        if sys.stderr is not None and sys.stderr.isatty():
            if self._bar is None:
                self._bar = tqdm(total=steps, desc="training", unit="step", file=sys.stderr)
            self._bar.update(step - self._bar.n)
        elif step * 10 // steps > (step - 1) * 10 // steps:
            log(f"training: step {step} of {steps}")
