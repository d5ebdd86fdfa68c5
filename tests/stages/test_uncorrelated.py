"""Uncorrelated weighting: the equations by hand, bias and error in simulation, and the command."""

import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.tolerances import EXACT, near
from torch import Tensor

from selfcorrect import cli, exr
from selfcorrect.errors import FrameError, SettingsError
from selfcorrect.image.windows import reflect
from selfcorrect.stages import uncorrelated
from selfcorrect.stages.uncorrelated import GAMMAS, WINDOW, combine

SIZE = (24, 28)


def images(seed: int, sigma: float = 0.3, size: tuple[int, int] = SIZE) -> tuple[Tensor, tuple, tuple]:
    """Truth with an edge and texture; y with independent noise, z with the same noise in all pixels of one material."""
    generator = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in size), indexing="ij")
    material = (x > size[1] / 2).double()[..., None]
    truth = (1 + material + 0.3 * torch.sin(x)[..., None] * torch.cos(y / 2)[..., None]).expand(*size, 3)

    def normal(*shape: int) -> Tensor:
        return sigma * torch.randn(*shape, 3, generator=generator, dtype=torch.float64)

    independent = tuple(truth + normal(*size) for _ in range(4))
    correlated = tuple(
        truth + material * normal(1, 1) + (1 - material) * normal(1, 1) + 0.1 * normal(*size) for _ in range(4)
    )
    return truth, independent, correlated


def test_published_numbers() -> None:
    assert WINDOW == 15
    assert GAMMAS == (0.01, 0.025, 0.05, 0.1, 0.2, 0.5, 1, 1.5, 2, 2.5)
    assert uncorrelated.KERNELS == ("uncorrelated", "cross-weighting", "uniform")


@pytest.mark.parametrize("kernel", ["uncorrelated", "cross-weighting", "uniform"])
@pytest.mark.parametrize("crossed", [False, True])
def test_eqs_5_and_8_by_hand(kernel: str, crossed: bool) -> None:
    size, samples, gamma = (4, 5), 3, 0.5
    _, y, z = images(1, size=size)
    got, chosen = combine(y, z, samples=samples, crossed=crossed, kernel=kernel, gammas=(gamma,))
    assert chosen == (0.0 if kernel == "uniform" else gamma)
    rows, columns = (reflect(-7, n + 7, n).tolist() for n in size)
    pairs = {"a": (0, 1), "b": (2, 3)}
    for row, column, channel in ((0, 0, 0), (2, 3, 1), (3, 4, 2)):
        c, results = (row, column, channel), []
        for half, opposite in (("a", "b"), ("b", "a")):
            own = pairs[half]
            shown = pairs[opposite if crossed else half]
            weighed = pairs[opposite if crossed or kernel == "cross-weighting" else half]
            total = sum(y[k][c] for k in own) / 2
            for i in range(15):
                for j in range(15):
                    at = (rows[row + i], columns[column + j], channel)
                    difference = (z[weighed[0]][c] - z[weighed[0]][at]) - (z[weighed[1]][c] - z[weighed[1]][at])
                    k = 1.0 if kernel == "uniform" else torch.exp(-gamma * samples * difference**2)
                    dz = sum(z[s][c] - z[s][at] for s in shown) / 2
                    dy = sum(y[s][c] - y[s][at] for s in own) / 2
                    total = total + k / 225 * (dz - dy)
            results.append(float(total))
        assert float(got[c]) == pytest.approx(sum(results) / 2, rel=EXACT, abs=0)


@pytest.mark.parametrize("crossed", [False, True])
def test_weights_do_not_tell_noise_from_its_mirror_image(crossed: bool) -> None:
    """Why symmetric noise, however large, leaves no bias: the errors of μ over z and its mirror image cancel."""
    truth, _, z = images(2)
    mirrored = tuple(2 * truth - image for image in z)
    both = [combine((truth,) * 4, four, samples=4, crossed=crossed, gammas=(0.5,))[0] for four in (z, mirrored)]
    assert (both[0] - truth).square().mean() > 1e-4
    torch.testing.assert_close((both[0] + both[1]) / 2, truth, rtol=EXACT, atol=0)


@pytest.mark.parametrize("chance", [0.125, 0.5, 0.75])
def test_skewed_noise_leaves_the_bias_of_the_equations(chance: float) -> None:
    """A dark wall beside a lamp of radiance m that an image of z meets with a chance p, as m/p, or does not, as 0.

    Weights of a large γ are 1 where both sub-images agree on the lamp, and else 0. Of a share f of lamp in its window a
    pixel of the wall is thus off by −f Cov(k, z̄) = f m (1 − p) (1 − 2p): brighter for rare paths, right at p = ½.
    """
    height, width, lamp = 3, 40, 2.0
    truth = torch.zeros(height, width, 1, dtype=torch.float64)
    truth[:, width // 2 :] = lamp
    expected = torch.zeros_like(truth)
    for met in itertools.product((0, 1), repeat=4):
        probability = math.prod(chance if hit else 1 - chance for hit in met)
        z = tuple(truth * (hit / chance) for hit in met)
        expected += probability * combine((truth,) * 4, z, samples=8, gammas=(1e3,))[0]
    share = (truth[0, :, 0].index_select(0, reflect(-7, width + 7, width)).unfold(0, WINDOW, 1) > 0).double().mean(-1)
    wall = slice(0, width // 2)
    bias = share[wall] * lamp * (1 - chance) * (1 - 2 * chance)
    torch.testing.assert_close(expected[1, wall, 0], bias, rtol=EXACT, atol=EXACT)


def test_unbiased_and_better_than_either_baseline() -> None:
    """Squared bias from independent rounds, by products of two: what noise is left does not enter."""
    rounds = 16
    bias, error = {}, {}
    for kernel in uncorrelated.KERNELS:
        results = []
        for seed in range(rounds):
            truth, y, z = images(seed)
            results.append(combine(y, z, samples=16, kernel=kernel, gammas=(0.1, 0.5))[0] - truth)
        stacked = torch.stack(results)
        error[kernel] = float((stacked**2).mean())
        halves = stacked[::2].mean(0), stacked[1::2].mean(0)
        bias[kernel] = float((halves[0] * halves[1]).mean())
    noisy = 0.3**2 / 4
    assert error["uncorrelated"] < 0.4 * noisy
    assert error["uncorrelated"] < error["uniform"]
    assert abs(bias["uncorrelated"]) < 0.05 * error["uncorrelated"]


def test_gamma_is_chosen_by_the_difference_of_the_halves() -> None:
    _, y, z = images(0)
    image, gamma = combine(y, z, samples=16)
    assert gamma in GAMMAS
    torch.testing.assert_close(image, combine(y, z, samples=16, gammas=(gamma,))[0])


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (70, 3)])
def test_awkward_sizes_and_extremes(size: tuple[int, int]) -> None:
    _, y, z = images(0, size=size)
    y[0][0, 0], z[1][0, 0] = 1e20, 1e20
    assert combine(y, z, samples=1)[0].isfinite().all()


def test_bad_arguments_are_named() -> None:
    _, y, z = images(0)
    with pytest.raises(FrameError, match="four images"):
        combine(y[:3], z, samples=1)
    with pytest.raises(FrameError, match="one shape"):
        combine(y, (*z[:3], z[3][:4]), samples=1)
    for wrong in ({"samples": 0}, {"samples": 1, "kernel": "deep"}, {"samples": 1, "gammas": ()}):
        with pytest.raises(SettingsError, match="expected a kernel"):
            combine(y, z, **wrong)


def write(folder: Path, name: str, image: Tensor) -> str:
    import OpenEXR

    path = folder / f"{name}.exr"
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    planes = {c: np.ascontiguousarray(image[..., i].numpy().astype(np.float32)) for i, c in enumerate("RGB")}
    with OpenEXR.File(header, planes) as file:
        file.write(str(path))
    return str(path)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, y, z = images(0)
    paths = [
        [write(tmp_path, f"{kind}{i}", image) for i, image in enumerate(four)] for kind, four in (("y", y), ("z", z))
    ]
    output = str(tmp_path / "out.exr")
    command = ["combine", *paths[0], "--correlated", *paths[1], "-o", output, "--samples", "16"]
    assert cli.main([*command, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    expected, gamma = combine(tuple(i.float() for i in y), tuple(i.float() for i in z), samples=16)
    assert report["gamma"] == gamma
    np.testing.assert_allclose(exr.load_half(output).buffers["color"], expected, **near("combine to file"))
    before = Path(output).read_bytes()
    small = write(tmp_path, "small", z[0][:5])
    assert cli.main(["combine", *paths[0], "--correlated", *paths[1][:3], small, "-o", output, "--samples", "16"]) == 2
    assert small in capsys.readouterr().err
    assert (
        cli.main(["combine", *paths[0], "--correlated", *paths[1][:3], paths[1][0], "-o", output, "--samples", "1"])
        == 2
    )
    assert "twice" in capsys.readouterr().err
    assert Path(output).read_bytes() == before
