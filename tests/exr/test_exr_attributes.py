"""Attributes that cannot be written back are found before the work, and said to be the input's."""

import struct
from pathlib import Path

import pytest
from helpers.commands import BALANCED, call, refused
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


NUMBER = struct.pack("<i", 3)
LOST = [
    ("version", "string", b"4.1", "left out"),
    ("name", "int", NUMBER, "left out"),
    ("tiles", "int", NUMBER, "left out"),
    ("tiles", "string", b"many", "left out"),
    ("pixelAspectRatio", "int", NUMBER, "replaced by the float that the format has there"),
    ("pixelAspectRatio", "string", b"wide", "replaced by the float that the format has there"),
    ("screenWindowWidth", "int", NUMBER, "replaced by the float that the format has there"),
    ("screenWindowCenter", "v2i", 2 * NUMBER, "replaced by the v2f that the format has there"),
    ("lineOrder", "string", b"x", "replaced by the lineOrder that the format has there"),
]


@pytest.mark.parametrize(("name", "kind", "data", "outcome"), LOST)
def test_what_would_be_lost_in_silence_is_told_before_the_work(
    name: str, kind: str, data: bytes, outcome: str, tmp_path: Path
) -> None:
    (tmp_path / "a.exr").write_bytes(raw([(name, kind, data), FINE[0]]))
    (line,) = exr.check_source(exr.read(tmp_path / "a.exr"))
    expected = f"a.exr: attribute '{name}' of type {kind} cannot be written back and is {outcome}"
    assert line == f"{tmp_path}/{expected}"
    rewrite(tmp_path / "a.exr", tmp_path / "b.exr")
    before, after = (exr.read(tmp_path / half).parts[0].attributes for half in ("a.exr", "b.exr"))
    assert (name in after) == outcome.startswith("replaced")
    assert name not in after or after[name].data != before[name].data
    assert after[FINE[0][0]].data == FINE[0][2]


def test_the_command_warns_of_what_is_lost_and_writes_the_picture(tmp_path: Path) -> None:
    (tmp_path / "a.exr").write_bytes(raw([("version", "string", b"4.1")]))
    (tmp_path / "b.exr").write_bytes(raw(channels=("R", "G", "B")))
    told = call("frame", tmp_path / "a.exr", tmp_path / "b.exr", "-o", tmp_path / "out.exr", *BALANCED)
    assert told.returncode == 0, told.stderr
    warning = "a.exr: attribute 'version' of type string cannot be written back and is left out"
    lines = told.stderr.splitlines()
    assert [line.startswith("warning: ") for line in lines if warning in line] == [True]
    assert (tmp_path / "out.exr").exists()


def test_of_what_comes_back_nothing_is_told(tmp_path: Path) -> None:
    (tmp_path / "a.exr").write_bytes(raw([*FINE, ("lineOrder", "lineOrder", b"\2")]))
    assert exr.check_source(exr.read(tmp_path / "a.exr")) == []


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
