"""Many small pieces of work in threads of our own, each with torch on one thread.

With torch's own threads every short operation ends in a barrier of OpenMP. One that sleeps made the guard of 1920×1080
slower on two threads than on one; one that spins made a filter take 20 times as long while the machine did other work.
"""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

__all__ = ["in_threads"]

Item = TypeVar("Item")
Made = TypeVar("Made")


def in_threads(work: Callable[[Item], Made], items: Iterable[Item], threads: int | None = None) -> list[Made]:
    """What ``work`` gives for each item, in their order; so many at once, by default as many as torch has threads."""
    torch_threads = torch.get_num_threads()
    if threads in (None, 1) and torch_threads == 1:
        return [work(item) for item in items]
    try:
        with ThreadPoolExecutor(threads or torch_threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            return list(pool.map(work, items))
    finally:
        torch.set_num_threads(torch_threads)  # each thread has a number of its own; this is what new ones begin with
