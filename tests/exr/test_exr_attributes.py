"""Attributes that cannot be written back are found before the work, and said to be the input's."""

import struct
from pathlib import Path

import pytest
from helpers.commands import BALANCED, refused
from helpers.exr_files import WIDTH, assert_passed_through, raw, rewrite

from selfcorrect import exr
from selfcorrect.errors import FileError

ODD = [
    ("chromaticities", "int", struct.pack("<i", 3)),
    ("chromaticities", "string", b"wide"),
]
FINE = [
    ("timeCode", "int", bytes(4)),
    ("envmap", "int", bytes(4)),
    ("screenWindowCenter", "v2f", struct.pack("<ff", float("nan"), 1)),
    ("preview", "preview", struct.pack("<II", 1, 1) + b"abcd"),
    ("vendor", "vendor's own", b"anything"),
]


@pytest.mark.parametrize("attribute", ODD)
def test_what_cannot_be_written_back_is_refused_before_the_work(
    attribute: tuple[str, str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, kind, _ = attribute
    (tmp_path / "a.exr").write_bytes(raw([attribute]))
    (tmp_path / "b.exr").write_bytes(raw())
    out = tmp_path / "out.exr"
    out.write_bytes(b"older")
    monkeypatch.setattr("selfcorrect.cli.runner.correct", lambda *_, **__: pytest.fail("trained"))
    line = refused("frame", tmp_path / "a.exr", tmp_path / "b.exr", "-o", out, *BALANCED)
    assert f"a.exr: expected attributes that can be written back, but got '{name}' of type {kind}" in line
    assert out.read_bytes() == b"older"


def test_of_a_half_that_only_is_read_they_do_not_matter(tmp_path: Path) -> None:
    (tmp_path / "odd.exr").write_bytes(raw([ODD[0]]))
    assert exr.load_half(tmp_path / "odd.exr").buffers["color"].shape[1] == WIDTH


@pytest.mark.parametrize("attribute", FINE)
def test_what_can_be_written_back_is(attribute: tuple[str, str, bytes], tmp_path: Path) -> None:
    (tmp_path / "a.exr").write_bytes(raw([attribute]))
    exr.check_source(exr.read(tmp_path / "a.exr"))
    rewrite(tmp_path / "a.exr", tmp_path / "b.exr")
    read = exr.read(tmp_path / "b.exr").parts[0].attributes
    assert attribute[0] in read


def test_scan_lines_in_no_order_are_written_from_the_top(tmp_path: Path) -> None:
    (tmp_path / "a.exr").write_bytes(raw([("lineOrder", "lineOrder", b"\2")]))
    exr.check_source(exr.read(tmp_path / "a.exr"))
    rewrite(tmp_path / "a.exr", tmp_path / "b.exr")
    assert_passed_through(tmp_path / "a.exr", tmp_path / "b.exr", but=("R", "G", "B", "lineOrder"))
    assert exr.read(tmp_path / "b.exr").parts[0].attributes["lineOrder"].data == b"\0"


def test_the_first_attribute_that_cannot_be_written_is_named_among_good_ones(tmp_path: Path) -> None:
    (tmp_path / "a.exr").write_bytes(raw([*FINE, ODD[0]]))
    with pytest.raises(FileError, match=r"a\.exr: expected attributes .* but got 'chromaticities' of type int"):
        exr.check_source(exr.read(tmp_path / "a.exr"))
