"""One contract for every denoiser, and the specifications that name them."""

import os
import shlex
import subprocess
import sys
import types
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.onnx_models import convolution
from numpy.typing import NDArray

import denoisers
from denoisers import Denoise
from selfcorrect.errors import DenoiserError, FrameError, MissingPackageError, SelfcorrectError, SettingsError

Array = NDArray[Any]

COPY_COLOR = "import shutil, sys; shutil.copy(sys.argv[1], sys.argv[-1])"

USER = """
import torch
from dataclasses import dataclass

@dataclass
class Median:
    name: str = "median of three"
    features: frozenset = frozenset({"albedo"})
    multiple: int = 4

    def denoise(self, color, albedo, normal):
        assert normal is None and color.shape[0] % 4 == color.shape[1] % 4 == 0
        color += 0 if albedo is None else 0 * albedo
        return torch.stack([color, color.roll(1, 0), color.roll(-1, 0)]).median(0).values
"""

# The tests may run without the project being installed.
PATHS = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}

KINDS = ("oidn", "oidn:fast", "oidn:none", "joint-bilateral", "box", "onnx", "command", "user")


@pytest.fixture(params=KINDS)
def denoise(request: pytest.FixtureRequest, tmp_path: Path) -> Denoise:
    """A working denoiser of each kind."""
    user = tmp_path / "my_denoiser.py"
    user.write_text(USER)
    model = convolution(tmp_path / "identity.onnx", metadata={"multiple": "8"})
    command = shlex.join([sys.executable, "-c", COPY_COLOR]) + " {color} {albedo} {normal} {output}"
    spec = {"onnx": f"onnx:{model}", "command": f"command:{command}", "user": f"{user}:Median"}
    return denoisers.create(spec.get(request.param, request.param))


def noisy(height: int, width: int, seed: int = 0) -> tuple[Array, Array, Array]:
    """Colour with values far above 1, albedo in [0, 1] and unit normals."""
    rng = np.random.default_rng(seed)
    color = rng.gamma(0.5, 4.0, (height, width, 3))
    normal = rng.standard_normal((height, width, 3))
    return color, rng.random((height, width, 3)), normal / np.linalg.norm(normal, axis=2, keepdims=True)


class TestContract:
    @pytest.mark.parametrize("size", [(1, 1), (5, 7), (37, 20)])
    @pytest.mark.parametrize("dtype", ["float16", "float32", "float64"])
    def test_kind_dtype_and_size_are_kept(self, denoise: Denoise, size: tuple[int, int], dtype: str) -> None:
        arrays = [array.astype(dtype) for array in noisy(*size)]
        result = denoise(*arrays)
        assert isinstance(result, np.ndarray)
        assert result.dtype == dtype
        assert result.shape == (*size, 3)
        assert np.isfinite(result).all()
        tensor = denoise(*map(torch.from_numpy, arrays))
        assert isinstance(tensor, torch.Tensor)
        assert tensor.dtype == getattr(torch, dtype)
        assert tensor.device == torch.device("cpu")
        np.testing.assert_array_equal(tensor.numpy(), result)

    def test_kinds_of_features_may_differ(self, denoise: Denoise) -> None:
        color, albedo, normal = noisy(9, 6)
        expected = denoise(color, albedo, normal)
        mixed = denoise(color, torch.from_numpy(albedo).requires_grad_(), torch.from_numpy(normal))
        np.testing.assert_array_equal(mixed, expected)

    @pytest.mark.parametrize("given", [(False, False), (True, False), (False, True), (True, True)])
    def test_features_may_be_absent(self, denoise: Denoise, given: tuple[bool, bool]) -> None:
        color, *features = noisy(20, 18)
        result = denoise(color, *(feature if there else None for feature, there in zip(features, given, strict=True)))
        assert result.shape == color.shape
        assert np.isfinite(result).all()

    def test_layout_in_memory_does_not_matter(self, denoise: Denoise) -> None:
        arrays = [array.astype(np.float32) for array in noisy(12, 17)]
        expected = denoise(*arrays)
        planes = [np.asfortranarray(array) for array in arrays]
        backwards = [array[::-1, ::-1].copy()[::-1, ::-1] for array in arrays]
        swapped = [array.astype(array.dtype.newbyteorder()) for array in arrays]
        strided = [torch.from_numpy(array).permute(2, 0, 1).contiguous().permute(1, 2, 0) for array in arrays]
        for other in (planes, backwards, swapped, strided):
            np.testing.assert_array_equal(np.asarray(denoise(*other)), expected)

    def test_inputs_stay_as_they_are(self, denoise: Denoise) -> None:
        arrays = [array.astype(np.float32) for array in noisy(16, 16)]
        copies = [array.copy() for array in arrays]
        result = denoise(*arrays)
        denoise(*map(torch.from_numpy, arrays))
        result[:] = -1
        for array, copy in zip(arrays, copies, strict=True):
            np.testing.assert_array_equal(array, copy)

    def test_read_only_input(self, denoise: Denoise) -> None:
        color = noisy(8, 8)[0].astype(np.float32)
        color.flags.writeable = False
        assert denoise(color).flags.writeable

    @pytest.mark.parametrize("size", [(1, 1), (37, 20), (64, 48)])
    def test_hdr_is_not_clamped(self, denoise: Denoise, size: tuple[int, int]) -> None:
        result = denoise(np.full((*size, 3), 50.0))
        # OIDN is a network: its worst pixel here is 3.6 % off. The others are means or copies.
        np.testing.assert_allclose(result, 50, rtol=0.05 if denoise.name.startswith("oidn") else 1e-6)

    @pytest.mark.parametrize("value", [0.0, -0.0, 1e6])
    def test_extremes_stay_finite(self, denoise: Denoise, value: float) -> None:
        flat = np.broadcast_to(np.float32([0, 0, 1]), (19, 33, 3))
        result = denoise(np.full((19, 33, 3), value, np.float32), flat, flat)
        assert np.isfinite(result).all()
        assert abs(result.mean() - value) <= 0.02 * value + 1e-3

    def test_fireflies_stay_finite(self, denoise: Denoise) -> None:
        color = noisy(24, 24)[0]
        color[5, 6] = color[20, 3] = 1e6
        assert np.isfinite(denoise(color)).all()
        assert np.isfinite(denoise(color.clip(max=65504).astype(np.float16))).all()

    def test_same_input_same_bits(self, denoise: Denoise) -> None:
        arrays = noisy(40, 33)
        first = denoise(*arrays)
        denoise(*noisy(21, 50, seed=1))
        np.testing.assert_array_equal(denoise(*arrays), first)

    @pytest.mark.parametrize(
        ("color", "albedo", "message"),
        [
            (np.zeros((4, 5)), None, r"color: expected .*\(H, W, 3\), but got \(4, 5\)"),
            (np.zeros((4, 5, 4)), None, r"color: .* got \(4, 5, 4\)"),
            (np.zeros((0, 5, 3)), None, r"color: .* got \(0, 5, 3\)"),
            (torch.zeros(1, 3, 4, 5), None, r"color: .* got \(1, 3, 4, 5\)"),
            (np.zeros((4, 5, 3), np.uint8), None, "color: .* float array .* got uint8"),
            (torch.zeros(4, 5, 3, dtype=torch.int32), None, "color: .* got torch.int32"),
            ([[[0.0] * 3]], None, "color: .* got list"),
            (
                np.zeros((4, 5, 3)),
                np.zeros((5, 4, 3)),
                r"albedo: expected .*\(4, 5, 3\), but got \(5, 4, 3\)",
            ),
            (np.zeros((4, 5, 3)), np.zeros((4, 5, 1)), r"albedo: .* got \(4, 5, 1\)"),
            (np.full((4, 5, 3), np.nan), None, "color: expected finite values, but got 60"),
            (np.full((4, 5, 3), 1e300), None, "color: expected finite values, but got 60"),
        ],
    )
    def test_misshapen_input_is_refused(
        self, denoise: Denoise, color: Array, albedo: Array | None, message: str
    ) -> None:
        with pytest.raises(FrameError, match=message):
            denoise(color, albedo)

    def test_features_prefiltered_by_hand_give_the_same_bits(self, denoise: Denoise) -> None:
        color, albedo, normal = (torch.from_numpy(array) for array in noisy(20, 18))
        given = denoise.prefilter(albedo, normal)
        assert torch.equal(denoise(color, *given, prefiltered=True), denoise(color, albedo, normal))

    def test_nothing_else_keeps_it_alive(self) -> None:
        for spec in ("oidn", "joint-bilateral", "box"):
            denoise = denoisers.create(spec)
            denoise(noisy(8, 8)[0])
            alive = weakref.ref(denoise.plugin)
            del denoise
            assert alive() is None, spec


class Returning:
    """A plug-in that returns what it was made with."""

    name = "returning"
    features = frozenset({"albedo", "normal"})

    def __init__(self, result: Any):
        self.result = result

    def denoise(self, color: torch.Tensor, albedo: torch.Tensor | None, normal: torch.Tensor | None) -> torch.Tensor:
        result: torch.Tensor = self.result
        return result


class TestHost:
    @pytest.mark.parametrize(
        ("result", "message"),
        [
            (None, "got NoneType"),
            (np.zeros((4, 5, 3), np.float32), "got ndarray"),
            (torch.zeros(4, 5, 3, dtype=torch.int64), "got torch.int64"),
            (torch.zeros(3, 4, 5), r"shape \(4, 5, 3\), but got \(3, 4, 5\)"),
            (torch.full((4, 5, 3), torch.nan), "got 60 of 60 values that are NaN or infinite"),
            (torch.eye(5)[:4, :, None].expand(4, 5, 3) / 0, "got 60 of 60 values that are NaN or infinite"),
        ],
    )
    def test_a_bad_result_is_refused_by_name(self, result: object, message: str) -> None:
        with pytest.raises(DenoiserError, match="denoiser returning: .*" + message):
            Denoise(Returning(result))(np.ones((4, 5, 3)))

    def test_padding_mirrors_and_is_cropped(self) -> None:
        seen: dict[str, torch.Tensor | None] = {}

        class Watching:
            name = "watching"
            multiple = 4
            features = frozenset({"normal"})

            def denoise(
                self, color: torch.Tensor, albedo: torch.Tensor | None, normal: torch.Tensor | None
            ) -> torch.Tensor:
                seen.update(color=color.clone(), albedo=albedo, normal=normal)
                return color * 2

        color, albedo, normal = (array.astype(np.float32) for array in noisy(5, 3))
        result = Denoise(Watching())(color, albedo, normal)
        np.testing.assert_array_equal(result, 2 * color)
        assert seen["albedo"] is None
        for name, array in (("color", color), ("normal", normal)):
            np.testing.assert_array_equal(seen[name], np.pad(array, ((0, 3), (0, 1), (0, 0)), "symmetric"))

    def test_result_does_not_share_memory_with_the_plugin(self) -> None:
        kept = torch.ones(4, 5, 3)
        Denoise(Returning(kept))(np.zeros((4, 5, 3), np.float32))[:] = 7
        Denoise(Returning(kept))(torch.zeros(4, 5, 3))[:] = 7
        assert (kept == 1).all()

    def test_what_float16_cannot_hold_saturates(self) -> None:
        result = Denoise(Returning(torch.full((1, 1, 3), -1e6)))(np.ones((1, 1, 3), np.float16))
        assert (result == -65504).all()

    def test_bfloat16_and_longdouble(self) -> None:
        plugin = Returning(torch.full((1, 1, 3), 1e5))
        assert Denoise(plugin)(torch.zeros(1, 1, 3, dtype=torch.bfloat16)).dtype == torch.bfloat16
        assert Denoise(plugin)(np.zeros((1, 1, 3), np.longdouble)).dtype == np.longdouble

    def test_no_gradient_leaks_in_or_out(self) -> None:
        color = torch.rand(4, 5, 3, requires_grad=True)
        assert not denoisers.create("box")(color).requires_grad


class TestSpecifications:
    def test_names_and_default(self, monkeypatch: pytest.MonkeyPatch) -> None:
        assert denoisers.names()[:5] == ("oidn", "oidn:fast", "oidn:none", "joint-bilateral", "box")
        assert denoisers.default() == "oidn"
        monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
        assert denoisers.default() == "onnx"
        monkeypatch.setitem(sys.modules, "onnxruntime", None)
        assert denoisers.default() == "joint-bilateral"

    def test_what_the_default_falls_back_to_is_said(self, monkeypatch: pytest.MonkeyPatch) -> None:
        assert denoisers.fallback() == ""
        for package, name, times in (("mitsuba_oidn", "onnx", "1.9"), ("onnxruntime", "joint-bilateral", "4.7")):
            monkeypatch.setitem(sys.modules, package, None)
            assert denoisers.fallback() == (
                f"oidn is not installed: {name} denoises instead, with {times} times its error on average; "
                "run: pip install 'selfcorrect[oidn]'"
            )

    @pytest.mark.parametrize("spec", ["", "optix", "OIDN", "box:3", "onnx:", "command:", "my.py", "my.py:", "a:b"])
    def test_an_unknown_one_lists_what_there_is(self, spec: str) -> None:
        with pytest.raises(DenoiserError) as caught:
            denoisers.create(spec)
        assert repr(spec) in str(caught.value)
        for name in denoisers.names():
            assert name in str(caught.value)

    @pytest.mark.parametrize("spec", ["oidn:slow", "oidn:", "oidn:fast:none", "oidn:Fast"])
    def test_a_mode_of_oidn_that_is_none_lists_the_three(self, spec: str) -> None:
        with pytest.raises(DenoiserError) as caught:
            denoisers.create(spec)
        assert str(caught.value) == f"expected oidn, oidn:fast or oidn:none, but got {spec!r}"

    @pytest.mark.parametrize("threads", [0, -1])
    def test_threads_are_checked(self, threads: int) -> None:
        with pytest.raises(SettingsError, match=f"expected threads from 1 to 1024, but got {threads}"):
            denoisers.create("box", threads=threads)

    @pytest.mark.parametrize(
        ("spec", "package", "extra"),
        [
            ("oidn", "mitsuba_oidn", "oidn"),
            ("oidn:fast", "mitsuba_oidn", "oidn"),
            ("onnx:model.onnx", "onnxruntime", "onnx"),
        ],
    )
    def test_a_missing_package_says_what_to_run(
        self, monkeypatch: pytest.MonkeyPatch, spec: str, package: str, extra: str
    ) -> None:
        monkeypatch.setitem(sys.modules, package, None)
        monkeypatch.delitem(sys.modules, f"denoisers.{extra}", raising=False)
        with pytest.raises(
            MissingPackageError, match=rf"{extra} needs .* pip install '{package.replace('_', '-')}>=[\d.]+'$"
        ):
            denoisers.create(spec)

    def test_oidn_without_its_library_is_one_line(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def refused(name: str) -> None:
            raise RuntimeError(f"could not load the thread pool library for {name}")

        package = types.ModuleType("mitsuba_oidn")
        monkeypatch.setattr(package, "__getattr__", refused, raising=False)
        monkeypatch.setitem(sys.modules, "mitsuba_oidn", package)
        monkeypatch.delitem(sys.modules, "denoisers.oidn", raising=False)
        with pytest.raises(DenoiserError, match=r"^OIDN does not load; .* needs libatomic1: could not load"):
            denoisers.create("oidn")

    def test_importing_the_package_imports_no_denoiser(self) -> None:
        heavy = ("kornia", "mitsuba_oidn", "onnxruntime")
        code = f"import sys, denoisers; print([m for m in {heavy} if m in sys.modules])"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=PATHS)
        assert done.stdout.strip() == "[]"

    def test_messages_are_one_line(self, tmp_path: Path) -> None:
        (tmp_path / "bad.onnx").write_text("no model")
        (tmp_path / "bad.py").write_text("def")
        for spec in (
            "optix",
            f"onnx:{tmp_path}/bad.onnx",
            f"{tmp_path}/bad.py:X",
            "command:'x",
            "command:\n",
        ):
            with pytest.raises(SelfcorrectError) as caught:
                denoisers.create(spec)
            assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["oidn", "joint-bilateral", "box", "onnx", "nlm", "nfor"])
def test_radiance_times_a_factor_gives_the_result_times_it(name: str) -> None:
    """OIDN left to itself brightens a frame of 1e-9 by 200."""
    color, albedo, normal = (torch.from_numpy(array.astype(np.float32)) for array in noisy(32, 48))
    other = torch.from_numpy(noisy(32, 48, 1)[0].astype(np.float32))
    denoise = denoisers.create(name, threads=1)

    def run(factor: float) -> torch.Tensor:
        if denoise.dual:
            pair = (color * factor, other * factor)
            return denoise.pair(pair, albedo=(albedo, albedo), normal=(normal, normal))[0]
        return denoise(color * factor, albedo=albedo, normal=normal)

    expected = run(1.0).double()
    for factor in (1e-30, 1e-9, 1e-3, 1e3, 1e30):
        assert float((run(factor).double() / factor - expected).abs().max()) < 1e-4 * float(expected.max())
    assert torch.equal(run(0.0), torch.zeros(32, 48, 3)), "black stays black, whatever the features show"
