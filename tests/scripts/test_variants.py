"""Which of Mitsuba's variants is taken: LLVM where it renders, and what a user reads where it does not."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import variants
from variants import LLVM, SCALAR, VariantError, chosen

ABORTS = """
import os, sys
print("LLVM ERROR: Cannot select: fminimum", file=sys.stderr)
print("In function: drjit", file=sys.stderr, flush=True)
os.abort()
"""


@pytest.fixture
def probe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A probe in place of the real one; what was found with it is forgotten."""
    path = tmp_path / "probe.py"
    monkeypatch.setattr(variants, "_PROBE", path)
    variants.failure.cache_clear()
    yield path
    variants.failure.cache_clear()


def test_llvm_that_renders_is_taken(probe: Path, capsys: pytest.CaptureFixture[str]) -> None:
    probe.write_text("")
    assert variants.failure() is None
    assert chosen(None) == chosen(LLVM) == chosen(None, sampler=True) == LLVM
    assert capsys.readouterr() == ("", "")


def test_llvm_that_aborts_gives_way_to_scalar(probe: Path, capsys: pytest.CaptureFixture[str]) -> None:
    probe.write_text(ABORTS)
    assert chosen(None) == SCALAR
    _, err = capsys.readouterr()
    assert err.count("\n") == 1
    assert "Cannot select: fminimum" in err
    assert "DRJIT_LIBLLVM_PATH" in err
    assert err.endswith(f"rendering with {SCALAR}\n")


@pytest.mark.parametrize(("wanted", "sampler"), [(LLVM, False), (None, True)])
def test_what_truly_needs_llvm_is_refused_without(probe: Path, wanted: str | None, sampler: bool) -> None:
    probe.write_text("import sys; print('no library', file=sys.stderr); sys.exit(3)")
    with pytest.raises(VariantError, match=r"expected an LLVM library for .*, but got none .*no library.*libllvm19"):
        chosen(wanted, sampler=sampler)


def test_common_random_numbers_are_refused_in_scalar(probe: Path) -> None:
    probe.write_text("")
    with pytest.raises(VariantError, match=f"expected an LLVM variant with common random numbers, but got {SCALAR}"):
        chosen(SCALAR, sampler=True)


def test_scalar_asks_no_probe(probe: Path) -> None:
    probe.write_text(ABORTS)
    assert chosen(SCALAR) == SCALAR


def test_a_broken_probe_is_not_taken_for_a_missing_library(probe: Path) -> None:
    """Else a mistake in it would quietly leave tests out."""
    probe.write_text("1 / 0")
    with pytest.raises(RuntimeError, match="ZeroDivisionError"):
        chosen(None)
