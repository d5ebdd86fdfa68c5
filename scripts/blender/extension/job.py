"""Programs run one after another beside Blender, with progress. Knows nothing of Blender."""

import os
import re
import subprocess
import threading
from dataclasses import dataclass, field
from pathlib import Path

_STEPS = re.compile(r"(?:Sample|step) (\d+)(?:/| of )(\d+)")
CANCELLED = "cancelled"
_KEPT = 40  # lines of output, for the message of a failure


@dataclass(frozen=True)
class Step:
    """One program.

    Attributes:
        label: what the user reads while it runs.
        command: the program and its arguments.
        part: its share of the whole work.
        rounds: how often its own progress goes from nothing to all: once per image that it makes.
        round_ends: text in the line that ends a round.
    """

    label: str
    command: list[str]
    part: float
    rounds: int
    round_ends: str


@dataclass
class Job:
    """Steps that run one after another; call :meth:`poll` now and then.

    Attributes:
        steps: the programs.
        outputs: what they make, for whoever waits.
        page: the report that they write beside, or None.
        progress: from 0 to 1.
        label: what is being done.
        error: why it ended early, or None.
    """

    steps: list[Step]
    outputs: list[Path]
    page: Path | None = None
    progress: float = 0.0
    label: str = ""
    error: str | None = None
    _process: subprocess.Popen[str] | None = field(default=None, repr=False)
    _reader: threading.Thread | None = field(default=None, repr=False)
    _lines: list[str] = field(default_factory=list, repr=False)
    _at: int = -1
    _round: int = 0

    def poll(self) -> bool:
        """Go on; False once all is done, has failed or was cancelled."""
        if self.error is not None:
            return False
        if self._process is None or self._process.poll() is not None:
            if self._process is not None and not self._ended():
                return False
            if self._at + 1 == len(self.steps):
                self.progress = 1.0
                return False
            self._start()
        return self.error is None

    def cancel(self, reason: str = CANCELLED) -> None:
        """End the program that runs; the rest do not start."""
        self.error = self.error or reason
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(5)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        if self._reader is not None:
            self._reader.join()

    def _start(self) -> None:
        self._at, self._round, self._lines = self._at + 1, 0, []
        step = self.steps[self._at]
        self.label = step.label
        # Blender's own Python must not be taken by the Python of selfcorrect
        clean = {name: value for name, value in os.environ.items() if name not in {"PYTHONHOME", "PYTHONPATH"}}
        try:
            self._process = subprocess.Popen(
                step.command,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                text=True,
                encoding="utf-8",
                errors="replace",
                env=clean,
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
            )
        except OSError as error:
            self.error = f"{step.command[0]}: {error.strerror}"
            return
        self._reader = threading.Thread(target=self._read, args=(self._process, step), daemon=True)
        self._reader.start()

    def _read(self, process: subprocess.Popen[str], step: Step) -> None:
        before = sum(s.part for s in self.steps[: self._at])
        assert process.stdout is not None  # a pipe, above
        for line in process.stdout:
            self._lines = [*self._lines, line.strip()][-_KEPT:]
            self._round += step.round_ends in line
            match = _STEPS.search(line)
            within = min(1.0, int(match[1]) / max(1, int(match[2]))) if match else 0.0
            self.progress = before + step.part * min(1.0, (self._round + within) / step.rounds)
        process.stdout.close()

    def _ended(self) -> bool:
        """Whether the program that just ended did well."""
        assert self._process is not None  # poll() has seen it end
        if self._reader is not None:
            self._reader.join()
        if self._process.returncode == 0:
            return True
        errors = [line.rpartition("error: ")[2] for line in self._lines if "error: " in line]
        last = next((line for line in reversed(self._lines) if line), f"exit code {self._process.returncode}")
        self.error = f"{self.label} failed: {errors[-1] if errors else last}"
        return False
