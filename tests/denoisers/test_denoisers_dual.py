"""Denoisers of both halves at once: their numbers, their halves' independence, extremes, and what they gain."""

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.tolerances import near
from torch import Tensor

import denoisers
from denoisers import nfor, nlm
from selfcorrect import Frame, exr, metrics
from selfcorrect.errors import DenoiserError, FrameError
from selfcorrect.frame import mean

SPECS = ("nlm", "nfor")
SIZE = (48, 56)


def scene(size: tuple[int, int] = SIZE) -> tuple[Tensor, dict[str, Tensor]]:
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float32) for n in size), indexing="ij")
    albedo = (0.5 + 0.3 * torch.sin(x / 3) * torch.sin(y / 5))[..., None].expand(*size, 3).contiguous()
    normal = torch.stack([torch.sin(x / 20), torch.cos(y / 17), torch.ones(size)], -1)
    return albedo * (1 + 0.5 * torch.sin((x + 2 * y) / 11))[..., None], {
        "albedo": albedo,
        "normal": normal,
        "depth": (x / size[1])[..., None],
        "visibility": (y > 20).float()[..., None],
    }


def pair_of(size: tuple[int, int], seed: int, sigma: float = 0.3) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return tuple(sigma * torch.randn(*size, 3, generator=generator) for _ in "ab")


def test_published_numbers() -> None:
    assert (nlm.PATCH_RADIUS, nlm.K) == (3, 0.45)
    assert 7 <= nlm.RADIUS <= 10
    assert (nfor.RADIUS, nfor.PATCH_RADIUS, nfor.BANDWIDTHS) == (9, 3, (0.5, 1.0))


@pytest.mark.parametrize("spec", SPECS)
def test_noise_is_removed_and_texture_kept(spec: str) -> None:
    truth, features = scene()
    errors = pair_of(SIZE, 1)
    frame = Frame(
        color=tuple((truth + e).clamp(min=0) for e in errors), **{k: (f, f.clone()) for k, f in features.items()}
    )
    denoised = frame.denoise(denoisers.create(spec, threads=2))
    noisy, after = (float(((image - truth) ** 2).mean()) for image in (mean(frame.color), denoised.denoised_full))
    assert after < (0.3 if spec == "nlm" else 0.12) * noisy
    torch.testing.assert_close(denoised.denoised_full, mean(denoised.denoised))


@pytest.mark.parametrize("spec", SPECS)
def test_halves_stay_each_others_witness(spec: str) -> None:
    """Covariance of half a's result with half b's noise over its variance: 0 but for what was pooled."""
    truth, features = scene()
    denoise, shares = denoisers.create(spec, threads=2), []
    for seed in range(6):
        errors = pair_of(SIZE, 10 + seed)
        results = denoise.pair(tuple(truth + e for e in errors), **{k: (f, f) for k, f in features.items()})
        shares += [float(((results[i] - truth) * errors[1 - i]).mean() / errors[1 - i].var()) for i in (0, 1)]
    error = float(np.std(shares)) / len(shares) ** 0.5
    assert abs(np.mean(shares)) < 3 * error + 0.0005, (np.mean(shares), error)
    assert error < 0.0015


@pytest.mark.parametrize("spec", SPECS)
def test_consistent(spec: str) -> None:
    """Without noise the image comes back."""
    truth, features = scene()
    result, _ = denoisers.create(spec).pair((truth, truth.clone()), **{k: (f, f.clone()) for k, f in features.items()})
    torch.testing.assert_close(result, truth, **near("dual keeps what is linear"))


@pytest.mark.parametrize("spec", SPECS)
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (12, 2)])
@pytest.mark.parametrize("extreme", [0.0, 1e20, 3e38])
def test_extremes_stay_finite(spec: str, size: tuple[int, int], extreme: float) -> None:
    truth, features = scene(size)
    color = tuple((truth + e).clamp(min=0) for e in pair_of(size, 3))
    color[0][0, 0, 0] = extreme
    for given in ({}, {"depth": features["depth"]}, features):
        results = denoisers.create(spec).pair(color, **{k: (1e6 * f, f.clone()) for k, f in given.items()})
        assert all(result.isfinite().all() for result in results)


@pytest.mark.parametrize("spec", SPECS)
def test_same_kind_and_any_exposure(spec: str) -> None:
    truth, features = scene()
    color = tuple((truth + e).clamp(min=0) for e in pair_of(SIZE, 3))
    given = {k: (f, f.clone()) for k, f in features.items()}
    denoise = denoisers.create(spec)
    plain = denoise.pair(color, **given)[0]
    bright = denoise.pair(tuple(1e3 * c for c in color), **given)[0]
    torch.testing.assert_close(bright / 1e3, plain, **near("dual exposure"))
    array = denoise.pair(tuple(c.numpy().astype(np.float16) for c in color), **given)[0]
    assert array.dtype == np.float16


def test_wrong_calls_are_named() -> None:
    truth, features = scene((8, 9))
    denoise = denoisers.create("nfor")
    with pytest.raises(DenoiserError, match="both halves"):
        denoise(truth)
    with pytest.raises(DenoiserError, match="single image"):
        denoisers.create("box").pair((truth, truth))
    with pytest.raises(FrameError, match="color: expected"):
        denoise.pair((truth, truth[:4]))
    with pytest.raises(FrameError, match="depth: expected"):
        denoise.pair((truth, truth), depth=(truth, truth))
    with pytest.raises(FrameError, match="albedo: expected"):
        denoise.pair((truth, truth), albedo=(features["albedo"], features["albedo"][:4]))


@pytest.mark.shared
def test_nfor_against_oidn_and_joint_bilateral(shared: Path) -> None:
    """Below OIDN's error where there is little noise; ``scripts/bench/stages.py`` has every frame."""
    halves = [exr.load_half(shared / "frames" / f"staircase_256spp_{h}.exr").buffers for h in "AB"]
    references = [
        exr.load_half(shared / "frames" / f"staircase_ref_{r}.exr").buffers["color"] for r in ("A", "B", "smooth")
    ]
    frame = Frame(**{name: (halves[0][name], halves[1][name]) for name in ("color", "albedo", "normal", "depth")})
    errors = {
        spec: metrics.relmse(frame.denoise(denoisers.create(spec, threads=2)).denoised_full, *references)
        for spec in ("nfor", "oidn", "joint-bilateral")
    }
    assert errors["nfor"] < errors["oidn"] < errors["joint-bilateral"]
