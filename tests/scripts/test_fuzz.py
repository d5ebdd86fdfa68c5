"""Damaged files: half a minute of them over the command, and that what is wrong would be seen."""

from pathlib import Path

import fuzz
import numpy as np
import OpenEXR
import pytest


def test_half_a_minute_of_damaged_files() -> None:
    found = [one for _, one in fuzz.mutants(seed=7, seconds=30, most=10**9)]
    assert found
    assert [one for one in found if one.outcome not in fuzz.GOOD] == []


def test_a_mutant_is_always_the_same(tmp_path: Path) -> None:
    made = []
    for name in ("first", "second"):
        folder = tmp_path / name
        folder.mkdir()
        command, damage, _ = fuzz.mutant(3, 5, folder)
        made.append((command, damage, (folder / "a.0001.exr").read_bytes(), (folder / "b.0001.exr").read_bytes()))
    assert made[0] == made[1]


@pytest.mark.parametrize("damage", fuzz.DAMAGES)
def test_damage_is_done(damage: str) -> None:
    generator = np.random.default_rng(1)
    good = fuzz.whole(generator, "ZIP", "two parts")
    changed = [fuzz.DAMAGES[damage](generator, good) != good for _ in range(20)]
    assert any(changed) == (damage != "pixel values")


def test_what_is_wrong_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "out.0001.exr").write_bytes(b"")
    assert fuzz.judged("inspect", 1, "", "", tmp_path / "..")[0] == "another exit code"
    assert fuzz.judged("inspect", 0, "", "", tmp_path / "..")[0] == "nothing done"
    assert fuzz.judged("inspect", 2, "told", "selfcorrect: error: expected", tmp_path / "..")[0] == "badly refused"
    plane = np.full((2, 2), np.nan, np.float32)
    OpenEXR.File({}, dict.fromkeys("RGB", plane)).write(str(tmp_path / "out.0001.exr"))
    assert fuzz.judged("frame", 0, "", "", tmp_path)[0] == "not finite"
    (tmp_path / ".x.selfcorrect-tmp").write_bytes(b"")
    assert fuzz.judged("frame", 0, "", "", tmp_path)[0] == "left behind"

    def odd(_: object) -> int:
        raise KeyError("odd")

    monkeypatch.setattr("selfcorrect.cli.main", odd)
    assert fuzz.one(0, 0, tmp_path).outcome == "traceback"


@pytest.mark.parametrize(
    ("code", "outcome"),
    [("import os; os.abort()", "crash"), ("while True: pass", "hang"), ("import time; time.sleep(999)", "hang")],
)
def test_a_worker_that_dies_or_hangs_is_counted(code: str, outcome: str, monkeypatch: pytest.MonkeyPatch) -> None:
    popen = fuzz.subprocess.Popen
    monkeypatch.setattr("fuzz.LIMIT", 1.0)
    monkeypatch.setattr("fuzz.STUCK", 5.0 if "sleep" in code else 900.0)
    monkeypatch.setattr("subprocess.Popen", lambda command, **how: popen([command[0], "-c", code], **how))
    assert [one.outcome for _, one in fuzz.mutants(seed=0, seconds=60, most=1)] == [outcome]
