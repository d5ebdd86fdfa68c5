"""Non-local means: the compiled variants against the reference, the regression with its weights, extremes."""

import math
from functools import partial

import pytest
import torch
from helpers.kernel import TOLERANCE as TABLE
from helpers.tolerances import EXACT, near
from torch import Tensor

from selfcorrect.errors import FrameError, SettingsError
from selfcorrect.image.windows import reflect
from selfcorrect.kernel import nlm, regression
from selfcorrect.kernel.backend import instruction_sets
from selfcorrect.kernel.nlm import cpu
from selfcorrect.kernel.nlm import reference as nlm_reference

TOLERANCE = TABLE[torch.float32]["nlm"]
VARIANTS = instruction_sets()
OPTIONS = {"radius": 3, "patch_radius": 2, "k": 0.6}


def image(size: tuple[int, int], channels: int, seed: int) -> Tensor:
    return torch.rand(*size, channels, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def make(size: tuple[int, int], channels: int = 3) -> tuple[Tensor, Tensor, Tensor]:
    """Values, guide and variance; the noise is such that the weights are neither all 0 nor all 1."""
    guide = image(size, channels, 1)
    return image(size, 3, 0), guide, 0.04 * image(size, channels, 2) + 0.03


def test_reference_by_hand() -> None:
    """Eqs. 3–5 with plain loops, for one pair of pixels."""
    _, u, v = make((12, 13))
    got = nlm_reference.weights(u, v, **OPTIONS)
    p, (dy, dx) = (6, 6), (1, -2)
    total = 0.0
    for i in range(-2, 3):
        for j in range(-2, 3):
            for c in range(3):
                at, other = (p[0] + i, p[1] + j, c), (p[0] + dy + i, p[1] + dx + j, c)
                top = (u[at] - u[other]) ** 2 - (v[at] + min(v[at], v[other]))
                total += float(top / (1e-10 + 0.6**2 * (v[at] + v[other])))
    expected = math.exp(-max(0.0, total / (3 * 25)))
    assert 0.05 < expected < 0.95
    assert float(got[(*p, (dy + 3) * 7 + dx + 3)]) == pytest.approx(expected, rel=EXACT, abs=0)


@pytest.mark.parametrize("isa", VARIANTS)
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("size", [(1, 1), (1, 17), (18, 1), (5, 7), (16, 33)])
def test_awkward_sizes(size: tuple[int, int], channels: int, isa: str) -> None:
    arguments = make(size, channels)
    expected = nlm_reference.non_local_means(*arguments, **OPTIONS)
    got = cpu.non_local_means(*(a.float() for a in arguments), **OPTIONS, threads=2, isa=isa)
    assert float((got - expected).abs().max() / expected.abs().max()) < TOLERANCE


@pytest.mark.parametrize("isa", VARIANTS)
@pytest.mark.parametrize(("radius", "patch_radius"), [(0, 0), (1, 3), (5, 1)])
def test_radii(radius: int, patch_radius: int, isa: str) -> None:
    arguments = make((14, 18))
    options = {"radius": radius, "patch_radius": patch_radius, "k": 0.5}
    expected = nlm_reference.non_local_means(*arguments, **options)
    got = cpu.non_local_means(*(a.float() for a in arguments), **options, isa=isa)
    assert float((got - expected).abs().max() / expected.abs().max()) < TOLERANCE


def test_strips_do_not_change_a_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    values, guide, variance = (a.float() for a in make((20, 30)))
    features = [guide, variance]

    def both() -> list[Tensor]:
        return [
            nlm.non_local_means(values, guide, variance, **OPTIONS),
            regression.regress_non_local(
                features, values, partial(nlm.strips, guide, variance, **OPTIONS), radius=3, ridge=1e-3
            ),
        ]

    whole = both()
    monkeypatch.setattr(cpu, "_STRIP", 49 * 32 * 3)
    for one, other in zip(whole, both(), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("isa", VARIANTS)
def test_regression_with_these_weights(isa: str) -> None:
    """Every model and every mean by torch's own solver."""
    x, u, v = make((9, 11))
    feature = image((9, 11), 3, 7)
    radius = 3
    got = regression.cpu.regress_non_local(
        [feature], x, partial(cpu.strips, u, v, **OPTIONS, isa=isa), radius=radius, ridge=1e-3, isa=isa
    )
    w = nlm_reference.weights(u, v, **OPTIONS)
    rows, columns = (reflect(-radius, n + radius, n) for n in (9, 11))

    def around(row: int, column: int) -> tuple[Tensor, Tensor]:
        y, x = torch.meshgrid(rows[row : row + 7], columns[column : column + 7], indexing="ij")
        return y.flatten(), x.flatten()

    models = torch.empty(9, 11, 4, 3, dtype=torch.float64)
    for row in range(9):
        for column in range(11):
            at = around(row, column)
            d = feature[at] - feature[row, column]
            reach = d.norm(dim=1).max()
            phi = torch.cat([torch.ones(len(d), 1).double(), d / reach], 1)
            share = w[row, column] / w[row, column].sum()
            left = phi.T @ (share[:, None] * phi) + torch.diag(torch.tensor([0, 1e-3, 1e-3, 1e-3]).double())
            models[row, column] = torch.linalg.solve(left, phi.T @ (share[:, None] * x[at]))
            models[row, column, 1:] /= reach
    for row, column in ((0, 0), (4, 5), (8, 10), (2, 9)):
        at = around(row, column)
        d = feature[row, column] - feature[at]
        said = models[at][:, 0] + torch.einsum("ti,tik->tk", d, models[at][:, 1:])
        expected = (w[row, column][:, None] * said).sum(0) / w[row, column].sum()
        torch.testing.assert_close(got[row, column].double(), expected, **near("nlm in place"))


@pytest.mark.parametrize("isa", VARIANTS)
def test_extremes_stay_finite(isa: str) -> None:
    values, guide, variance = (a.float() for a in make((10, 12)))
    guide[2, 3], values[2, 3], variance[2, 3] = 1e20, 1e20, 3e38
    variance[5] = 0
    guide[7] = 0.25
    assert cpu.non_local_means(values, guide, variance, **OPTIONS, isa=isa).isfinite().all()


def test_bad_arguments_are_named() -> None:
    values, guide, variance = (a.float() for a in make((10, 12)))
    with pytest.raises(FrameError, match="one shape"):
        nlm.non_local_means(values, guide, variance[:9], **OPTIONS)
    with pytest.raises(FrameError, match="values"):
        nlm.non_local_means(values[:9], guide, variance, **OPTIONS)
    for wrong in ({"radius": 16}, {"patch_radius": -1}, {"k": 0.0}):
        with pytest.raises(SettingsError, match="radius to 15"):
            nlm.non_local_means(values, guide, variance, **OPTIONS | wrong)


def test_every_backend_gives_the_same() -> None:
    """Also of half floats and doubles: the compiled form turns them into float32."""
    arguments = make((10, 12))
    expected = nlm.non_local_means(*arguments, **OPTIONS, backend="reference")
    assert expected.dtype == torch.float64
    assert torch.equal(expected, nlm_reference.non_local_means(*arguments, **OPTIONS))
    got = nlm.non_local_means(*arguments, **OPTIONS)
    assert torch.equal(got, nlm.non_local_means(*arguments, **OPTIONS, backend="cpu"))
    assert torch.equal(got, nlm.non_local_means(*(a.float() for a in arguments), **OPTIONS))
    assert float((got - expected).abs().max() / expected.abs().max()) < TOLERANCE
