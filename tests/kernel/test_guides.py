"""The padded guide buffers: borders, order, what is scaled and what is missing."""

import numpy as np
import pytest
import torch
from helpers.kernel import EVERY_SET, Terms, make_guides, names

from selfcorrect.buffers import BUFFERS, COLOR, DENOISED, INPUTS, TERMS
from selfcorrect.errors import FrameError
from selfcorrect.kernel.guides import Guides, mirror

every_set = pytest.mark.parametrize("terms", EVERY_SET, ids=names)


def constants(terms: Terms) -> dict[str, torch.Tensor]:
    """Each buffer full of its place in the table, from 1."""
    return {term.name: torch.full((3, 4, term.channels), 1.0 + BUFFERS.index(term)) for term in terms}


def test_mirror_is_numpy_symmetric() -> None:
    for size in (1, 2, 5):
        expected = np.pad(np.arange(size), 13, mode="symmetric")
        assert mirror(-13, size + 13, size).tolist() == expected.tolist()


@every_set
def test_planes_are_in_the_order_of_the_inputs(terms: Terms) -> None:
    guides = Guides.of_half(constants(terms), margin=1)
    assert guides.terms == tuple(term for term in TERMS if term in terms)
    expected = [1.0 + BUFFERS.index(term) for term in INPUTS if term in terms for _ in range(term.channels)]
    assert guides.planes[:, 0, 0].tolist() == expected
    for term in terms:
        assert guides.planes[guides.channels(term)].eq(1 + BUFFERS.index(term)).all()
        assert len(guides.planes[guides.channels(term)]) == term.channels
    assert guides.radiance.eq(1 + BUFFERS.index(COLOR)).all()
    assert guides.denoised.eq(1 + BUFFERS.index(DENOISED)).all()


@every_set
def test_radiance_alone_is_scaled(terms: Terms) -> None:
    planes = Guides.of_half(constants(terms), margin=0, scale=0.5)
    for term in terms:
        factor = 0.5 if term.kind == "radiance" else 1.0
        assert planes.planes[planes.channels(term)].eq(factor * (1 + BUFFERS.index(term))).all()


def test_radiance_comes_first_and_last() -> None:
    """The convolutions show the network the logarithm of these channels."""
    radiance = [term.kind == "radiance" for term in INPUTS]
    assert radiance[0]
    assert radiance[-1]
    assert not any(radiance[1:-1])


def test_none_is_a_buffer_that_is_not_there() -> None:
    half = constants(EVERY_SET[0])
    absent = {buffer.name: None for buffer in BUFFERS if buffer.name not in half}
    assert Guides.of_half(half | absent, margin=1).terms == EVERY_SET[0]
    with pytest.raises(FrameError, match="expected a half with the buffer denoised, but got color"):
        Guides.of_half({"color": half["color"], "denoised": None}, margin=1)


def test_stacked_crops_lie_below_one_another() -> None:
    crops = [make_guides(6, 5, margin=2, seed=seed) for seed in (0, 1, 2)]
    stacked = Guides.stack(crops, len(crops))
    for index, crop in enumerate(crops):
        corner = torch.tensor([[1 + index * stacked.pitch, 2]])
        assert torch.equal(stacked.patches(corner, (4, 3)), crop.patches(torch.tensor([[1, 2]]), (4, 3)))
