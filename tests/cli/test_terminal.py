"""What is told while a network trains."""

import sys

import pytest

from selfcorrect.cli.terminal import Progress


def test_a_log_gets_ten_lines_without_a_loss(capsys: pytest.CaptureFixture[str]) -> None:
    called: list[None] = []
    with Progress(lambda: called.append(None)) as progress:
        for step in range(1, 38):
            progress(step, 37, 0.123 * step)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 10
    assert lines[-1] == "training: step 37 of 37"
    assert not any("loss" in line or "0.12" in line for line in lines)
    assert len(called) == 37


def test_a_terminal_gets_a_bar_without_a_loss(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with Progress() as progress:
        for step in (1, 2, 3):
            progress(step, 3, 7.7)
    told = capsys.readouterr().err
    assert "training: 100%" in told
    assert "3/3" in told
    assert "loss" not in told
    assert "7.7" not in told
