"""The estimates of scripts/bench/uncorrelated.py, pair by pair, and where the truth is known."""

import itertools

import numpy as np
import pytest
from helpers.tolerances import EXACT
from uncorrelated import relmse, squared_bias


def rounds(count: int, side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """y of variance 1 around 1, and an image of bias 1/2 and variance 1/100; weights."""
    generator = np.random.default_rng(0)
    y = 1 + generator.normal(size=(count, side, side, 3))
    images = 1.5 + 0.1 * generator.normal(size=y.shape)
    return images, y, generator.uniform(0.5, 1, (side, side, 1))


def test_they_are_the_means_over_different_rounds() -> None:
    images, y, weight = rounds(5, 3)
    apart = [
        np.mean(weight * (images[r] - y[s]) * (images[r] - y[t])) for r, s, t in itertools.permutations(range(5), 3)
    ]
    assert relmse(images, y, weight)[0] == pytest.approx(np.mean(apart), rel=EXACT)
    d = images - y
    pairs = [np.mean(weight * d[r] * d[s]) for r, s in itertools.permutations(range(5), 2)]
    assert squared_bias(d, weight)[0] == pytest.approx(np.mean(pairs), rel=EXACT)


def test_noise_does_not_enter() -> None:
    images, y, weight = rounds(40, 24)
    of_weight = weight.mean()
    for found, expected in (
        (relmse(images, y, weight), 0.26),
        (relmse(y, y, weight), 1.0),
        (squared_bias(images - y, weight), 0.25),
    ):
        assert abs(found[0] / of_weight - expected) < 4 * found[1] / of_weight + 0.02 * expected
