"""What is told, and where: results on stdout, everything else on stderr; Ctrl-C, and being told to end."""

import contextlib
import json
import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from typing import Any, NoReturn

from selfcorrect.errors import FileError, printable
from selfcorrect.output import OUTPUT

__all__ = ["EndOnInterrupt", "Progress", "answer", "log", "show", "terminable"]


def log(*lines: str) -> None:
    """Lines on stderr, in one piece; what files put into them is escaped. Where nothing can be told, so be it."""
    if sys.stderr is None or not lines:  # closed before Python began; print would take stdout
        return
    with OUTPUT, contextlib.suppress(OSError, ValueError):
        _print(sys.stderr, lines)


def answer(report: Mapping[str, Any]) -> None:
    """One JSON object, in one line on stdout."""
    show(json.dumps(report))


def show(*lines: str) -> None:
    """Lines on stdout, in one piece; what files put into them, and what stdout cannot write, is escaped.

    Whoever reads may stop doing so, which is no error: what comes after is shown to nobody.

    Raises:
        FileError: stdout cannot be written to for any other reason; it is not tried again.
    """
    if sys.stdout is None:  # closed before Python began
        return
    try:
        with OUTPUT:
            _print(sys.stdout, lines)
    except (OSError, ValueError) as error:
        _discard(sys.stdout)
        if not isinstance(error, BrokenPipeError):
            reason = getattr(error, "strerror", None) or error
            raise FileError(f"stdout: expected room for the results, but got: {reason}; write them elsewhere") from None


def _print(stream: Any, lines: tuple[str, ...]) -> None:
    text = "\n".join(map(printable, lines))
    encoding = getattr(stream, "encoding", None) or "utf-8"
    print(text.encode(encoding, "backslashreplace").decode(encoding), file=stream, flush=True)


def _discard(stream: Any) -> None:
    """Let what a stream still holds, and what it is yet to be given, go nowhere; else Python tells of it at its end."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """While it is entered, SIGTERM ends the process as an exception does: children and temporary files go with it.

    Anywhere but in the main thread signals stay as they are.
    """

    def end(*_: object) -> NoReturn:
        raise SystemExit(128 + signal.SIGTERM)

    try:
        before = signal.signal(signal.SIGTERM, end)
    except ValueError:
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


class EndOnInterrupt:
    """While it is entered, the first Ctrl-C asks training to end; the second one interrupts as usual.

    Python calls a handler once for all signals of a kind that came while it was busy, as in a long kernel. So they are
    counted where they arrive: for each the system's own handler writes a byte to a pipe.
    """

    def __init__(self) -> None:
        self._count = 0
        self._before: Any = None
        self._wakeup = -1
        self._pipe = (-1, -1)

    def __call__(self) -> bool:
        """Whether training is asked to end."""
        return self._count > 0

    def __enter__(self) -> "EndOnInterrupt":
        self._pipe = os.pipe()
        for end in self._pipe:
            os.set_blocking(end, False)
        self._wakeup = signal.set_wakeup_fd(self._pipe[1], warn_on_full_buffer=False)
        self._before = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGINT, self._before)
        signal.set_wakeup_fd(self._wakeup)
        for end in self._pipe:
            os.close(end)

    def _handle(self, *_: object) -> None:
        arrived = b""
        with contextlib.suppress(BlockingIOError):
            arrived = os.read(self._pipe[0], 4096)
        self._count += max(1, arrived.count(signal.SIGINT))
        if self._count > 1:
            raise KeyboardInterrupt
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
                self._bar = import_module("tqdm").tqdm(total=steps, desc="training", unit="step", file=sys.stderr)
            self._bar.update(step - self._bar.n)
        elif step * 10 // steps > (step - 1) * 10 // steps:
            log(f"training: step {step} of {steps}")
