"""Bands of rows: several at once, and the same bits as one after the other."""

import threading
from collections.abc import Callable, Iterator

import pytest
import torch
from helpers.images import image

from selfcorrect.image.bands import enlarged, in_bands, tile_means

SIZE = (203, 90)


@pytest.fixture(params=[1, 3])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def test_what_bands_give_comes_in_their_order(threads: int) -> None:
    assert [(rows.start, rows.stop) for rows in in_bands(203, lambda rows: rows)][-2:] == [(160, 192), (192, 203)]
    assert in_bands(5, lambda rows: rows.start, 2) == [0, 2, 4]


def test_torch_has_as_many_threads_as_before_and_one_in_each_band(threads: int) -> None:
    together = threading.Barrier(threads, timeout=60)

    def work(_: slice) -> int:
        together.wait()
        return torch.get_num_threads()

    assert in_bands(threads * 32, work) == [1] * threads
    assert torch.get_num_threads() == threads


def test_an_error_in_a_band_is_the_caller_s(threads: int) -> None:
    def work(rows: slice) -> None:
        raise ValueError(f"rows from {rows.start}")

    with pytest.raises(ValueError, match="rows from 0"):
        in_bands(203, work)
    assert torch.get_num_threads() == threads


@pytest.mark.parametrize(
    "made",
    [lambda x: tile_means(SIZE[0], lambda rows: x[:, rows].double().log()), lambda x: enlarged(x[:, :13, :6], SIZE)],
    ids=["tile_means", "enlarged"],
)
def test_bits_do_not_depend_on_threads(made: Callable[[torch.Tensor], torch.Tensor], threads: int) -> None:
    x = image(*SIZE, seed=2).permute(2, 0, 1) + 0.1
    got = made(x)
    torch.set_num_threads(1)
    assert torch.equal(got, made(x))
