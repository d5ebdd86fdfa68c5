"""Regions of an image that are worked on one after the other."""

from collections.abc import Iterator

__all__ = ["Region", "tiles"]

Region = tuple[int, int, int, int]
"""Top, left, bottom and right, the last two outside."""


def tiles(size: tuple[int, int], side: int) -> Iterator[Region]:
    """Regions (top, left, bottom, right) that cover an image of this size once.

    >>> list(tiles((3, 5), 4))
    [(0, 0, 3, 4), (0, 4, 3, 5)]
    """
    for top in range(0, size[0], side):
        for left in range(0, size[1], side):
            yield top, left, min(top + side, size[0]), min(left + side, size[1])
