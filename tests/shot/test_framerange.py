"""Frame numbers and the names they make."""

import doctest

import pytest

from selfcorrect.errors import SettingsError
from selfcorrect.shot import framerange
from selfcorrect.shot.framerange import fill, has_frame, parse_frames


@pytest.mark.parametrize(
    ("text", "frames"),
    [
        ("1-4", [1, 2, 3, 4]),
        ("5-5", [5]),
        ("7", [7]),
        ("1-10x3", [1, 4, 7, 10]),
        ("1-10:4", [1, 5, 9]),
        ("1-3,5,7-20:5", [1, 2, 3, 5, 7, 12, 17]),
        ("-3--1", [-3, -2, -1]),
        ("-1-1", [-1, 0, 1]),
        (" 1-2 , 4 ", [1, 2, 4]),
        ("5,1-6", [5, 1, 2, 3, 4, 6]),
    ],
)
def test_ranges(text: str, frames: list[int]) -> None:
    assert parse_frames(text) == frames


@pytest.mark.parametrize("text", ["", "1-", "a", "1..5", "1-5x", "1-5x0", "5-1", "1,,2", "1-99999999", "1-5x2x2"])
def test_what_is_no_range_is_refused(text: str) -> None:
    with pytest.raises(SettingsError):
        parse_frames(text)


@pytest.mark.parametrize(
    ("pattern", "frame", "name"),
    [
        ("a.####.exr", 12, "a.0012.exr"),
        ("a.####.exr", 12345, "a.12345.exr"),
        ("a.####.exr", -5, "a.-005.exr"),
        ("a.#.exr", 12, "a.12.exr"),
        ("a.%04d.exr", 12, "a.0012.exr"),
        ("a.%d.exr", 12, "a.12.exr"),
        ("a.%4d.exr", 12, "a.  12.exr"),
        ("shot#3/v%02d/a.##.exr::Layer #1", 7, "shot#3/v%02d/a.07.exr::Layer #1"),
        ("take#2.####.exr", 7, "take#2.0007.exr"),
    ],
)
def test_names(pattern: str, frame: int, name: str) -> None:
    assert fill(pattern, frame) == name
    assert has_frame(pattern)


@pytest.mark.parametrize("pattern", ["a.exr", "####/a.exr", "a.exr::####", "a.%s.exr"])
def test_a_name_without_a_place_is_refused(pattern: str) -> None:
    assert not has_frame(pattern)
    with pytest.raises(SettingsError, match="####"):
        fill(pattern, 1)


def test_examples() -> None:
    assert doctest.testmod(framerange).failed == 0
