"""Files appear whole or not at all, and what a killed process left is removed."""

import fcntl
from pathlib import Path

from selfcorrect.publish import publish, remove_abandoned


def test_temporaries_of_the_living_stay(tmp_path: Path) -> None:
    dead = tmp_path / ".x.0001.0123456789abcdef.selfcorrect-tmp"
    living = tmp_path / ".x.0002.0123456789abcdef.selfcorrect-tmp"
    other = tmp_path / ".x.0003.tmp"
    for path in (dead, living, other):
        path.touch()
    with open(living, "r+b") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        assert remove_abandoned(tmp_path) == [dead]
    assert remove_abandoned(tmp_path) == [living]
    assert list(tmp_path.iterdir()) == [other]


def test_what_is_published_is_whole_and_alone(tmp_path: Path) -> None:
    publish(tmp_path / ("é" * 100 + ".exr"), b"one")
    publish(tmp_path / ("é" * 100 + ".exr"), bytearray(b"two"))
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [b"two"]
