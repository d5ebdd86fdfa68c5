"""Motion passes: whose they are by their names, and what is made of their numbers."""

from pathlib import Path

import numpy as np
import pytest
from helpers.exr_files import SIZE, arrays, save, three

from selfcorrect import exr, files
from selfcorrect.errors import ChannelError
from selfcorrect.exr import channels, motion

VECTOR = three("ViewLayer.Vector", "XYZW")
COLOR = three("ViewLayer.Combined")


def values(names: list[str]) -> dict[str, np.ndarray]:
    """A constant 1, 2, … in each channel."""
    return {name: np.full(SIZE, i + 1, np.float32) for i, name in enumerate(names)}


def read(path: Path, **named: str) -> list[float]:
    half = exr.load_half(path, mapping=named, shot=True)
    assert half.buffers["motion"].shape == (*SIZE, 4)
    return half.buffers["motion"][0, 0].tolist()


def test_blender(tmp_path: Path) -> None:
    path = save(tmp_path / "a.exr", values(VECTOR) | arrays(COLOR))
    assert read(path) == [1, -2, -3, 4]


def test_renderman(tmp_path: Path) -> None:
    names = ["motionBack.x", "motionBack.y", "motionFore.x", "motionFore.y"]
    extra = arrays([*three("Ci", "rgb"), "motionBack.z", "motionFore.z"])
    assert read(save(tmp_path / "a.exr", values(names) | extra)) == [1, 2, 3, 4]


@pytest.mark.parametrize(
    ("name", "expected"),
    [("motionvector", [1, -2]), ("velocity", [1, -2]), ("MotionVectors", [1, -2]), ("my_motion", [1, 2])],
)
def test_those_whose_unit_the_user_knows(tmp_path: Path, name: str, expected: list[float]) -> None:
    """Two components, to the next frame; how to the last one, nobody says. They are read where they are named."""
    path = save(tmp_path / "a.exr", values(three(name)[:2]) | arrays([*"RGB"]))
    assert "motion" not in exr.load_half(path, shot=True).buffers
    found = read(path, motion=name)
    assert found[2:] == expected
    assert np.isnan(found[:2]).all()


def test_one_of_the_users_own_with_both(tmp_path: Path) -> None:
    path = save(tmp_path / "a.exr", values(three("mine", "XYZW")) | arrays([*"RGB"]))
    assert read(path, motion="mine") == [1, 2, 3, 4]
    assert read(path, motion="mine.Z,mine.W,mine.X,mine.Y") == [3, 4, 1, 2]


def test_what_is_no_motion_is_one_line() -> None:
    names = [*"RGB", *three("mine")[:1], "Z"]
    for wanted in ("mine", "Z", "mine.R", "nowhere"):
        with pytest.raises(ChannelError, match=f"expected 4 or 2 channels named '{wanted}' for motion, but got"):
            channels.choose(names, file="a.exr", mapping={"motion": wanted})


def test_only_a_shot_has_use_for_it(tmp_path: Path) -> None:
    """Of both halves one tells it; of half b where half a does not."""
    a = save(tmp_path / "a.exr", arrays(COLOR))
    b = save(tmp_path / "b.exr", values(VECTOR) | arrays(COLOR, start=9))
    assert files.load(files.Sources(str(a), str(b))).frame.motion is None
    loaded = files.load(files.Sources(str(a), str(b)), shot=True)
    assert loaded.frame.motion is not None
    assert loaded.frame.motion[0].data_ptr() == loaded.frame.motion[1].data_ptr()
    assert loaded.frame.motion[0][0, 0].tolist() == [1, -2, -3, 4]
    assert loaded.origin.taken["motion"] == VECTOR


def test_every_row_says_who_and_how() -> None:
    for row in motion.CONVENTIONS:
        assert row.writer
        assert row.source
        assert len({len(names) for names in row.components}) == 1
        assert row.back is None or len(row.components[0]) == 4
