"""The list of all error texts is that of the source, and each says what was expected and what came instead."""

import re

import error_texts
import pytest

PASSES_ON = re.compile(r"\{(error|EXPECTED|expected|wanted|problem|message|_one_line\(error\))\}")
"""Texts that are made of another one."""


def test_the_list_is_that_of_the_source() -> None:
    assert error_texts.PAGE.read_text(encoding="utf-8") == error_texts.page(), "run scripts/bench/error_texts.py"


def every() -> list[str]:
    return [line for line in error_texts.page().splitlines() if line.startswith("- ") and not PASSES_ON.search(line)]


def test_each_says_what_was_expected_and_what_came() -> None:
    assert len(every()) > 150
    assert [line for line in every() if not re.search(r"expected .*\bbut\b", line)] == []


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ('raise FileError(f"{path}: expected x, but got {y!r}")', [("FileError", "{path}: expected x, but got {y}")]),
        ('def f():\n    return FrameError("a " "b")', [("FrameError", "a b")]),
        ('raise ValueError("inner")', []),
        ("raise FileError(text)", []),
    ],
)
def test_texts_are_found(source: str, found: list[tuple[str, str]]) -> None:
    assert list(error_texts.texts(source)) == found
