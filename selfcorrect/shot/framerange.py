"""Frame numbers of a shot and the file names that they make, in the forms that render farms write."""

import re
from pathlib import Path

from selfcorrect.errors import SettingsError

__all__ = ["fill", "has_frame", "parse_frames", "there"]

_RANGE = re.compile(r"(-?\d{1,9})(?:-(-?\d{1,9})(?:[x:](\d{1,9}))?)?", re.ASCII)
_MOST = 1_000_000  # frames; a slip such as 1-10000000 must not fill the memory


def parse_frames(text: str) -> list[int]:
    """Frame numbers of a range, in its order, each once.

    ``first-last``, both inside; ``first-last:step`` or ``first-lastxstep`` takes every step-th; single numbers;
    commas between them. Numbers may be negative.

    >>> parse_frames("1-3,5,7-20:5")
    [1, 2, 3, 5, 7, 12, 17]
    >>> parse_frames("5-5"), parse_frames("-2-2x2")
    ([5], [-2, 0, 2])

    Raises:
        SettingsError: the text is no range, runs backwards, or holds more than a million frames.
    """
    frames: dict[int, None] = {}
    for entry in text.split(","):
        match = _RANGE.fullmatch(entry.strip())
        if match is None:
            raise SettingsError(f"expected frames such as 1-240, 1-240x2 or 1-3,5,7-20:2, but got {text!r}")
        first = int(match[1])
        last, step = int(match[2] or first), int(match[3] or 1)
        if last < first:
            raise SettingsError(f"expected frames in rising order, but got {entry.strip()!r}")
        if step < 1:
            raise SettingsError(f"expected a step of at least 1 between frames, but got {entry.strip()!r}")
        if len(frames) + (last - first) // step >= _MOST:
            raise SettingsError(f"expected at most {_MOST} frames, but got {text!r}")
        frames |= dict.fromkeys(range(first, last + 1, step))
    return list(frames)


_PLACE = re.compile(r"#+|%0?\d*d")


def has_frame(pattern: str) -> bool:
    """Whether a file name has a place for the frame number."""
    return _place(pattern) is not None


def fill(pattern: str, frame: int) -> str:
    """The file name of one frame.

    >>> fill("shot_a.####.exr", 7), fill("a.%04d.exr::Layer", -7), fill("#.exr", 123)
    ('shot_a.0007.exr', 'a.-007.exr::Layer', '123.exr')

    Raises:
        SettingsError: the name has no place for the number.
    """
    place = _place(pattern)
    if place is None:
        raise SettingsError(f"expected a place for the frame number, #### or %04d, but got {pattern!r}")
    text = place[0]
    number = f"{frame:0{len(text)}d}" if text.startswith("#") else text % frame
    return pattern[: place.start()] + number + pattern[place.end() :]


def there(pattern: str) -> list[int]:
    """The numbers of the frames whose files are there, ascending.

    Raises:
        SettingsError: the name has no place for the number.
    """
    fill(pattern, 0)
    path = Path(pattern.partition("::")[0])
    numbers = {int(digits) for other in path.parent.glob("*") for digits in re.findall(r"-?\d+", other.name)}
    return sorted(n for n in numbers if Path(fill(pattern, n).partition("::")[0]).is_file())


def _place(pattern: str) -> re.Match[str] | None:
    """The last place in the file's name: folders and layers may hold # and % for other reasons."""
    path, _, _ = pattern.partition("::")
    start = len(path) - len(Path(path).name)
    places = list(_PLACE.finditer(path, start))
    return places[-1] if places else None
