"""The windowed regression: the reference by hand, and the compiled variants against it at awkward sizes."""

import math

import pytest
import torch
from helpers.kernel import TOLERANCE as TABLE
from helpers.tolerances import REGRESSION_EXACT
from torch import Tensor

from selfcorrect.errors import FrameError, SettingsError
from selfcorrect.kernel.backend import instruction_sets
from selfcorrect.kernel.compiled import functions
from selfcorrect.kernel.regression import cpu, regress
from selfcorrect.kernel.regression import reference as regression_reference

TOLERANCE = TABLE[torch.float32]["regression"]
VARIANTS = instruction_sets()
GROUPS = [(v, s) for v in range(4) for s in range(3) if v + s]
OPTIONS = {"window": 7, "ridge": 1e-3, "bandwidth": 0.5}


def image(size: tuple[int, int], channels: int, seed: int) -> Tensor:
    return torch.rand(*size, channels, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def make(size: tuple[int, int], vectors: int = 3, scalars: int = 2) -> tuple[list[Tensor], Tensor]:
    features = [image(size, 3, k) for k in range(vectors)] + [image(size, 1, 9 + k) for k in range(scalars)]
    return features, 4 * image(size, 3, 20) ** 3


def compare(features: list[Tensor], targets: Tensor, isa: str, **options: float) -> None:
    expected = regression_reference.regress(features, targets, **OPTIONS | options)
    got = cpu.regress(features, targets, **OPTIONS | options, threads=2, isa=isa)
    worst = float((got.double() - expected).abs().max() / expected.abs().max().clamp(min=1e-9))
    assert worst < TOLERANCE, f"off by {worst:.2e} of the maximum"


def test_reference_by_hand() -> None:
    """One pixel, with plain loops; the least squares by torch's own solver on the stacked rows."""
    size, radius, bandwidth, ridge = (9, 10), 1, 0.5, 1e-3
    (z, depth), x = make(size, 1, 1)
    got = regression_reference.regress([z, depth], x, window=3, ridge=ridge, bandwidth=bandwidth)
    pixel = (4, 5)

    def around(row: int, column: int) -> list[tuple[int, int]]:
        return [(row + i, column + j) for i in range(-radius, radius + 1) for j in range(-radius, radius + 1)]

    total, weights = torch.zeros(3, dtype=torch.float64), 0.0
    for c in around(*pixel):
        w = torch.stack([torch.exp(-((z[i] - z[c]) ** 2).sum() / bandwidth) for i in around(*c)])
        w_c = torch.exp(-((z[pixel] - z[c]) ** 2).sum() / bandwidth)
        reach = [max(float((f[i] - f[c]).norm()) for i in around(*c)) for f in (z, depth)]
        rows = []
        for i in (*around(*c), pixel):
            scaled = [(f[i] - f[c]) / r for f, r in zip((z, depth), reach, strict=True)]
            rows.append(torch.cat([torch.ones(1, dtype=torch.float64), *scaled]))
        roots = (w / w.sum()).sqrt()
        ridges = ridge**0.5 * torch.eye(5, dtype=torch.float64)[1:]
        left = torch.cat([roots[:, None] * torch.stack(rows[:-1]), ridges])
        right = torch.cat([roots[:, None] * torch.stack([x[i] for i in around(*c)]), torch.zeros(4, 3).double()])
        total += w_c * (rows[-1] @ torch.linalg.lstsq(left, right).solution)
        weights += w_c
    torch.testing.assert_close(got[pixel], total / weights)


@pytest.mark.parametrize("isa", VARIANTS)
@pytest.mark.parametrize(("vectors", "scalars"), GROUPS)
def test_every_set_of_features(vectors: int, scalars: int, isa: str) -> None:
    compare(*make((11, 19), vectors, scalars), isa)


@pytest.mark.parametrize("isa", VARIANTS)
@pytest.mark.parametrize("stride", [1, 2, 3, 4])
@pytest.mark.parametrize("size", [(1, 1), (1, 18), (17, 1), (5, 7), (18, 33)])
def test_awkward_sizes(size: tuple[int, int], stride: int, isa: str) -> None:
    compare(*make(size), isa, stride=stride)


@pytest.mark.parametrize("isa", VARIANTS)
@pytest.mark.parametrize("window", [1, 3, 13, 27])
def test_windows(window: int, isa: str) -> None:
    compare(*make((8, 17)), isa, window=window, stride=min(2, window))


@pytest.mark.parametrize("isa", VARIANTS)
def test_rank_deficient_windows(isa: str) -> None:
    """Constant features, a feature given twice, a black region: no slope where nothing determines one."""
    features, targets = make((12, 20), 2, 2)
    features[1] = features[0].clone()
    features[2][:] = 0.3
    targets[:, :9] = 0
    features[0][:, :9] = 0
    compare(features, targets, isa)
    constant = [torch.full((12, 20, 3), 0.5)]
    targets = torch.rand(12, 20, 3, generator=torch.Generator().manual_seed(0))
    compare([c.double() for c in constant], targets.double(), isa)


@pytest.mark.parametrize("isa", VARIANTS)
def test_a_pixel_like_no_centre(isa: str) -> None:
    """Between the centres of a strided grid; its weights alone would all be zero, and the pixel black."""
    features, targets = make((12, 20))
    features[0][3, 5] += 100.0
    compare(features, targets, isa, stride=2)
    assert cpu.regress(features, targets, **OPTIONS, stride=2, isa=isa)[3, 5].abs().min() > 1e-3


@pytest.mark.parametrize("isa", VARIANTS)
def test_a_firefly_stays_finite(isa: str) -> None:
    features, targets = make((12, 20))
    targets[3, 4] = 1e20
    features[0][5, 6] = 1e20
    result = cpu.regress(features, targets, **OPTIONS, isa=isa)
    assert result.isfinite().all()


def test_an_affine_function_of_the_features_is_found() -> None:
    features, _ = make((30, 40))
    targets = 2 + features[0] - 3 * features[1] + features[3]
    result = regress(features, targets, window=15, ridge=1e-7, bandwidth=10.0)
    torch.testing.assert_close(result.double(), targets, atol=REGRESSION_EXACT, rtol=0)


def test_threads_do_not_change_a_bit() -> None:
    features, targets = make((20, 30))
    results = [regress(features, targets, **OPTIONS, stride=2, threads=n) for n in (1, 2, 5)]
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])


def test_bad_arguments_are_named() -> None:
    features, targets = make((8, 9))
    with pytest.raises(SettingsError, match="odd window"):
        regress(features, targets, window=4, ridge=1e-3, bandwidth=1.0)
    for options in ({"stride": 0}, {"stride": 8}, {"ridge": 0.0}, {"bandwidth": float("inf")}):
        with pytest.raises(SettingsError, match="stride from 1"):
            regress(features, targets, **OPTIONS | options)
    for wrong in ([], features[::-1], [features[0][:4]], [features[0]] * 4):
        with pytest.raises(FrameError, match="features"):
            regress(wrong, targets, **OPTIONS)
    with pytest.raises(FrameError, match="targets"):
        regress(features, targets[..., :2], **OPTIONS)


def test_every_backend_gives_the_same() -> None:
    features, targets = make((10, 12))
    expected = regress(features, targets, **OPTIONS, stride=2, backend="reference")
    assert torch.equal(expected, regression_reference.regress(features, targets, **OPTIONS, stride=2))
    got = regress(features, targets, **OPTIONS, stride=2)
    assert torch.equal(got, regress(features, targets, **OPTIONS, stride=2, backend="cpu"))
    assert float((got.double() - expected).abs().max() / expected.abs().max()) < TOLERANCE


@pytest.mark.parametrize("isa", VARIANTS)
@pytest.mark.parametrize("stride", [1, 2])
def test_models_of_features_that_are_nearly_one(isa: str, stride: int) -> None:
    """A grey image: only the ridge tells its three slopes apart, and rounding could lead them anywhere."""
    size, ridge, bandwidth = (9, 20), 1e-4, 10.0
    features = [torch.linspace(0.1, 1, 180).view(9, 20, 1) + 1e-3 * image(size, 3, 0)]
    targets = image(size, 3, 1)
    rows, columns = range(0, 9, stride), range(0, 20, stride)
    around = regression_reference._Windows(features[0], targets, 6, columns)
    difference, values = around.of(rows)
    weight = regression_reference._weight(difference, 3, bandwidth)
    expected = regression_reference._models(difference, values, weight, [3], ridge)
    layout = cpu.Layout.of(features, targets, 6, stride)
    got = torch.empty(12, layout.height, layout.width)
    functions.solve(*layout.arguments, ridge, 1 / (bandwidth * math.log(2)), None, 0, layout.height, isa, 1, got)
    models = got.double().unflatten(0, (3, 4)).permute(2, 3, 1, 0)

    def said(models: Tensor) -> Tensor:
        return models[..., :1, :] + torch.einsum("yxti,yxik->yxtk", difference, models[..., 1:, :])

    for name, one, other in (("models", models, expected), ("what models say", said(models), said(expected))):
        worst = float((one - other).abs().max() / other.abs().max())
        assert worst < TABLE[torch.float32][f"regression {name}"], f"{name} off by {worst:.1e} of the maximum"
