"""Which ONNX models fit, what they are fed, and how the others are refused."""

from pathlib import Path

import numpy as np
import onnx
import pytest
from helpers.onnx_models import NCHW, NHWC, Shape, convolution, info, save, sum_of
from helpers.tolerances import HALF_MODEL
from helpers.views import make_view
from onnx import TensorProto, helper

import denoisers
from denoisers.onnx import Onnx
from selfcorrect import metrics
from selfcorrect.errors import DenoiserError, FileError

RNG = np.random.default_rng(0)
COLOR, ALBEDO, NORMAL = (RNG.random((6, 10, 3), dtype=np.float32) for _ in range(3))


def create(path: Path) -> denoisers.Denoise:
    return denoisers.create(f"onnx:{path}")


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("nhwc", [False, True])
@pytest.mark.parametrize(("channels", "expected"), [(3, COLOR), (6, COLOR + 2 * ALBEDO), (9, None)])
def test_one_input(tmp_path: Path, half: bool, nhwc: bool, channels: int, expected: np.ndarray | None) -> None:
    shape: Shape = (1, "h", "w", channels) if nhwc else ("batch", channels, "h", "w")
    denoise = create(convolution(tmp_path / "model.onnx", shape, name="input", half=half))
    result = denoise(COLOR, ALBEDO, NORMAL)
    if expected is None:
        expected = COLOR + 2 * ALBEDO + 4 * NORMAL
    np.testing.assert_allclose(result, expected, rtol=2e-3 if half else 1e-6)
    assert denoise.features == {3: set(), 6: {"albedo"}, 9: {"albedo", "normal"}}[channels]


def test_named_inputs_each_in_its_own_layout(tmp_path: Path) -> None:
    # The order of the declaration is not the order of the names: only the names count.
    denoise = create(sum_of(tmp_path / "model.onnx", {"normal": NHWC, "color": NCHW}))
    np.testing.assert_allclose(denoise(COLOR, ALBEDO, NORMAL), COLOR + NORMAL, rtol=1e-6)
    assert denoise.features == {"normal"}


@pytest.mark.parametrize("output", [None, ("a", "b", "c", "d")])
def test_an_undeclared_output_has_the_layout_of_the_colour(tmp_path: Path, output: Shape | None) -> None:
    path = sum_of(tmp_path / "model.onnx", {"color": NCHW, "albedo": NCHW}, output)
    np.testing.assert_allclose(create(path)(COLOR, ALBEDO), COLOR + ALBEDO, rtol=1e-6)


def test_multiple_comes_from_the_metadata(tmp_path: Path) -> None:
    fixed = convolution(tmp_path / "fixed.onnx", (1, 3, 8, 16), metadata={"multiple": "8"})
    denoise = create(fixed)
    assert denoise.multiple == 8
    np.testing.assert_array_equal(denoise(COLOR), COLOR)
    with pytest.raises(DenoiserError, match=r"fixed\.onnx: expected an image of 16x8, but got 16x16"):
        denoise(np.ones((9, 9, 3)))
    with pytest.raises(DenoiserError, match=r"bare\.onnx: expected an image of 16xh, but got 10x6"):
        create(convolution(tmp_path / "bare.onnx", (1, 3, "h", 16)))(COLOR)


@pytest.mark.parametrize("multiple", ["0", "-8", "8.0", "eight", ""])
def test_a_bad_multiple_is_refused(tmp_path: Path, multiple: str) -> None:
    path = convolution(tmp_path / "model.onnx", metadata={"multiple": multiple})
    with pytest.raises(DenoiserError, match=r"model\.onnx: expected the metadata multiple .* from 1"):
        create(path)


def test_a_frame_without_what_the_model_takes_is_refused(tmp_path: Path) -> None:
    denoise = create(convolution(tmp_path / "model.onnx", (1, 9, "h", "w")))
    with pytest.raises(DenoiserError, match=r"model\.onnx: expected a frame with normal, but got one without"):
        denoise(COLOR, ALBEDO)


def test_a_half_model_is_fed_what_half_can_hold(tmp_path: Path) -> None:
    denoise = create(convolution(tmp_path / "model.onnx", half=True))
    image = np.ones((64, 64, 3))
    image[3, 4] = 1e6
    assert (denoise(image)[3, 4] == 65504).all()
    bright = np.full((2, 2, 3), 1e6)  # brought into the range that denoisers are used to
    np.testing.assert_allclose(denoise(bright), bright, rtol=HALF_MODEL)


def test_threads_are_honoured(tmp_path: Path) -> None:
    plugin = Onnx(str(convolution(tmp_path / "model.onnx")), threads=1)
    assert plugin.session.get_session_options().intra_op_num_threads == 1


def identity(path: Path, *declared: onnx.ValueInfoProto, outputs: int = 1) -> Path:
    """Write a model that passes its first input on, to so many outputs, whatever it is declared as."""
    names = ["out", "second"][:outputs]
    nodes = [helper.make_node("Identity", [declared[0].name], [name]) for name in names]
    results = []
    for name in names:
        result = onnx.ValueInfoProto()
        result.CopyFrom(declared[0])
        result.name = name
        results.append(result)
    return save(path, helper.make_graph(nodes, "identity", list(declared), results))


@pytest.mark.parametrize(
    ("declared", "has"),
    [
        ([info("color", (1, 4, "h", "w"))], "inputs color (float)[1, 4, 'h', 'w']"),
        ([info("color", (1, "c", "h", "w"))], "inputs color (float)[1, 'c', 'h', 'w']"),
        ([info("color", (2, 3, "h", "w"))], "inputs color (float)[2, 3, 'h', 'w']"),
        ([info("color", (3, "h", "w"))], "inputs color (float)[3, 'h', 'w']"),
        ([info("color", NCHW, TensorProto.DOUBLE)], "inputs color (double)[1, 3, 'height', 'width']"),
        ([info("color", NCHW, TensorProto.UINT8)], "inputs color (uint8)[1, 3, 'height', 'width']"),
        ([info("color", NCHW), info("depth", NCHW)], "depth (float)[1, 3, 'height', 'width']"),
        ([info("albedo", NCHW), info("normal", NCHW)], "inputs albedo (float)[1, 3, 'height', 'width']"),
        ([info("color", NCHW), info("albedo", (1, 1, "h", "w"))], "albedo (float)[1, 1, 'h', 'w']"),
        ([info("color", (1, 6, "h", "w"))], "outputs out (float)[1, 6, 'h', 'w']"),
    ],
)
def test_a_model_that_does_not_fit_says_what_it_has(
    tmp_path: Path, declared: list[onnx.ValueInfoProto], has: str
) -> None:
    path = identity(tmp_path / "model.onnx", *declared)
    with pytest.raises(DenoiserError) as caught:
        create(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: expected inputs color[, albedo][, normal] of 3 channels")
    assert has in message.partition(", but got ")[2]
    assert "\n" not in message


def test_two_outputs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DenoiserError, match=r"outputs out .*, second"):
        create(identity(tmp_path / "model.onnx", info("color", NCHW), outputs=2))


def test_an_output_of_another_size_is_refused(tmp_path: Path) -> None:
    nodes = [helper.make_node("MaxPool", ["color"], ["out"], kernel_shape=[2, 2], strides=[2, 2])]
    path = tmp_path / "half.onnx"
    save(path, helper.make_graph(nodes, "pool", [info("color", NCHW)], [info("out", (1, 3, "h", "w"))]))
    with pytest.raises(DenoiserError, match=r"onnx half\.onnx: .*\(6, 10, 3\), but got \(3, 5, 3\)"):
        create(path)(COLOR)


def test_what_fails_inside_the_model_is_one_line(tmp_path: Path) -> None:
    nodes = [helper.make_node("Reshape", ["color", "shape"], ["out"])]
    shape = helper.make_tensor("shape", TensorProto.INT64, [4], [1, 3, 4, 4])
    path = tmp_path / "model.onnx"
    save(path, helper.make_graph(nodes, "reshape", [info("color", NCHW)], [info("out", NCHW)], [shape]))
    with pytest.raises(DenoiserError, match=r"model\.onnx: .*[Rr]eshape") as caught:
        create(path)(COLOR)
    assert "\n" not in str(caught.value)


def test_no_file_and_no_model(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"none\.onnx: expected an ONNX model, but found no such file"):
        create(tmp_path / "none.onnx")
    for content in (b"", b"no model", convolution(tmp_path / "whole.onnx").read_bytes()[:-40]):
        (tmp_path / "bad.onnx").write_bytes(content)
        with pytest.raises(DenoiserError, match=r"bad\.onnx: expected an ONNX model, but got"):
            create(tmp_path / "bad.onnx")


class TestPackaged:
    """The project's own model: ``onnx`` without a path."""

    @pytest.mark.parametrize("seed", range(3))
    def test_it_denoises_what_it_was_not_trained_on(self, seed: int) -> None:
        view = make_view(seed, 61, clean=True)
        assert view.reference is not None
        noisy, clean = view.color[:4].mean(0), view.reference[0]
        denoise = denoisers.create("onnx", threads=1)
        before = metrics.relmse(noisy, clean)
        assert metrics.relmse(denoise(noisy, albedo=view.albedo, normal=view.normal), clean) < before / 2
        assert metrics.relmse(denoise(noisy), clean) < before

    def test_it_is_small_and_says_whose_scenes_it_has_seen(self) -> None:
        assert denoisers.PACKAGED.stat().st_size < 4e6
        facts = {entry.key: entry.value for entry in onnx.load(denoisers.PACKAGED).metadata_props}
        assert facts["multiple"] == "16"
        assert len(facts["data"]) == 64
        for author in ("Mareck", "NovaZeeke", "Wig42", "Jay-Artist"):
            assert author in facts["attribution"]

    @pytest.mark.parametrize("value", [0.0, 1e6, 1e30])
    def test_extremes_stay_finite(self, value: float) -> None:
        color = COLOR.copy()
        color[3, 4] = value
        result = denoisers.create("onnx", threads=1)(color, ALBEDO, NORMAL)
        assert np.isfinite(result).all()
        assert not denoisers.create("onnx", threads=1)(0 * color, ALBEDO, NORMAL).any()
