"""The trained stages: tiles, what a half is made of, what they agree with, what they refuse, and the command."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
import torch
from helpers.witness import share_of_witness
from torch import Tensor

import denoisers
from selfcorrect import Frame, Settings, cli, correct, exr
from selfcorrect.cli import memory
from selfcorrect.errors import FileError, FrameError, SettingsError
from selfcorrect.files import Sources
from selfcorrect.frame import mean
from selfcorrect.shot.recipe import recipe
from selfcorrect.stages import STAGES, opened, weights
from selfcorrect.stages.deep_combiner import DeepCombiner, combine_whole, feature_planes
from selfcorrect.stages.deep_combiner_4 import SubImages
from selfcorrect.stages.images import StageImages
from selfcorrect.stages.james_stein import james_stein, relative_weight, variance_of_mean
from selfcorrect.stages.neural_james_stein import NeuralJamesStein, VarianceNetwork, blend_whole, neural_blend
from selfcorrect.stages.stage import Work

SMALL = {"width": 8, "window": 5, "layers": 3, "kernel": 3}
SIZE = (44, 39)
_FLIP = 2 * 2**-8 / SMALL["window"] ** 2  # two of a pixel's weights rounded to their neighbours in bfloat16


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Untrained weights, on disk as float32; a setting for each."""
    folder = tmp_path_factory.mktemp("weights")
    networks = {
        "james_stein_weights": wild(VarianceNetwork(1)),
        "combiner_weights": wild(DeepCombiner(**SMALL, seed=2)),
        "combiner_4_weights": wild(DeepCombiner(4, **SMALL, seed=3)),
    }
    for name, network in networks.items():
        file = folder / f"{name}.safetensors"
        weights.save(file, network, settings={}, data="", attribution="", dtype=torch.float32)
    return {name: str(folder / f"{name}.safetensors") for name in networks}


def wild(network: Any) -> Any:
    """With outputs that differ a lot from pixel to pixel, as those of a trained network."""
    last = network.last if isinstance(network, VarianceNetwork) else network.convolutions[-1]
    with torch.no_grad():
        last.weight.mul_(10)
        last.bias.mul_(0.3)
    return network.eval()


def settings(files: dict[str, str], **changes: object) -> Settings:
    return Settings.preset("balanced", **{"precision": "fp32", "guard": False} | files | changes)


def make_frame(size: tuple[int, int] = SIZE, *, features: bool = True, scale: float = 1.0) -> Frame:
    """The frame of :func:`make_both`."""
    return make_both(size, features=features, scale=scale)[0]


def make_both(size: tuple[int, int] = SIZE, *, features: bool = True, scale: float = 1.0) -> tuple[Frame, SubImages]:
    """A frame and its four sub-images, denoised by a box."""
    generator = torch.Generator().manual_seed(0)
    y, x = torch.meshgrid(*(torch.arange(n) for n in size), indexing="ij")
    albedo = (0.5 + 0.3 * torch.sin(x / 2))[..., None].expand(*size, 3).contiguous()
    truth = scale * albedo * (1 + 0.5 * torch.sin(y / 9))[..., None]
    four = [truth * (0.2 + 0.8 * torch.rand(*size, 3, generator=generator)) for _ in range(4)]
    buffers = {}
    if features:
        normal = torch.nn.functional.normalize(torch.randn(*size, 3, generator=generator), dim=-1)
        depth = 3 + torch.rand(*size, 1, generator=generator)
        buffers = {"albedo": (albedo, albedo), "normal": (normal, -normal), "depth": (depth, depth + 1)}
    color = (mean((four[0], four[1])), mean((four[2], four[3])))
    box = denoisers.create("box")
    frame = Frame(color=color, **buffers).denoise(box)
    return frame, SubImages.of(frame, four).denoise(frame, box)


def planes(image: Tensor) -> Tensor:
    return image.permute(2, 0, 1)[None]


def state_of(frame: Frame, scale: float = 1.0) -> StageImages:
    return StageImages(frame.halves, frame.denoised_full, scale)


@pytest.mark.parametrize("size", [(1, 1), (5, 70), (64, 64), (101, 83)])
@pytest.mark.parametrize(("precision", "tolerance"), [("fp32", 1e-6), ("bf16", 1e-4)])
def test_tiles_are_equal_to_the_whole(size: tuple[int, int], precision: str, tolerance: float) -> None:
    frame = make_frame(size)
    a, b = frame.color
    normal, albedo = torch.rand(2, *size, 3, generator=torch.Generator().manual_seed(1))
    features = feature_planes(size, normal=normal, albedo=albedo, depth=None)
    combiner, variance_network = wild(DeepCombiner(**SMALL)), wild(VarianceNetwork())

    def both(side: int) -> tuple[Tensor, Tensor]:
        options: dict[str, Any] = {"precision": precision, "side": side}
        one = combine_whole(combiner, (a,), (frame.denoised[0],), features, **options)
        y = frame.denoised
        return one, blend_whole(variance_network, mean((a, b)), ((a - b) / 2) ** 2, *y, **options)

    for whole, pieces, different in zip(both(4096), both(32), (a, mean((a, b))), strict=True):
        found = (pieces - whole).abs()
        assert float(found.quantile(0.999)) <= tolerance
        assert float(found.max()) <= max(tolerance, _FLIP if precision == "bf16" else 0)
        assert size == (1, 1) or float((whole - different).abs().max()) > 0.05, "the stage has done something"


def test_tiles_of_single_precision_are_those_of_the_network() -> None:
    frame, subs = make_both()
    network, four = wild(VarianceNetwork()), wild(DeepCombiner(4, **SMALL))
    x, variance = mean(frame.color), variance_of_mean(frame.color).float()
    given = [planes(image) for image in (x, variance, *frame.denoised)]
    with torch.no_grad():
        expected = neural_blend(*network(*given), *given)
        features = torch.rand(7, *SIZE, generator=torch.Generator().manual_seed(2))
        noisy, denoised = (
            torch.stack([image.permute(2, 0, 1) for image in images])[None] for images in (subs.images, subs.denoised)
        )
        combined = four(noisy, denoised, features[None])
    got = blend_whole(network, x, variance, *frame.denoised, side=16)
    torch.testing.assert_close(planes(got), expected, rtol=1e-5, atol=1e-5)
    got = combine_whole(four, subs.images, subs.denoised, features, side=16)
    torch.testing.assert_close(planes(got), combined, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    "stages", ["neural-james-stein", "deep-combiner", "deep-combiner-4", "deep-combiner-4,neural-james-stein"]
)
@pytest.mark.parametrize("features", [True, False])
def test_exposure_changes_nothing(stages: str, features: bool, files: dict[str, str]) -> None:
    chosen = settings(files, stages=stages)
    (frame, subs), (bright, bright_subs) = (make_both(features=features, scale=scale) for scale in (1.0, 1000.0))
    plain = correct(frame, chosen, extra={"deep-combiner-4": subs}).image
    brighter = correct(bright, chosen, extra={"deep-combiner-4": bright_subs}).image
    torch.testing.assert_close(brighter / 1000, plain, rtol=1e-4, atol=1e-5)
    assert not torch.allclose(plain, frame.denoised_full, atol=1e-3)


def test_composition_with_the_core_and_the_guard(files: dict[str, str]) -> None:
    small = {"patch": 16, "batch": 2, "steps": 2, "window": 5, "layers": 3}
    chosen = settings(files, stages="deep-combiner,core,neural-james-stein", **small | {"guard": True})
    result = correct(make_frame(), chosen)
    assert list(result.seconds) == ["deep-combiner", "train", "infer", "neural-james-stein", "guard"]
    assert result.image.isfinite().all()
    assert result.estimate is not None


@pytest.mark.parametrize("name", ["deep-combiner", "deep-combiner-4"])
def test_a_combined_half_knows_nothing_of_its_witness(name: str, files: dict[str, str]) -> None:
    """Not a bit of half a changes with anything of half b; the full image does."""
    frame, subs = make_both()
    other = Frame(
        color=(frame.color[0], 2 * frame.color[1]),
        denoised=(frame.denoised[0], 3 * frame.denoised[1]),
        albedo=(frame.albedo[0], 0.1 * frame.albedo[1]),
        normal=(frame.normal[0], frame.normal[0]),
        depth=(frame.depth[0], frame.depth[1] ** 2),
        denoised_full=2 * frame.denoised_full,
    )
    others = replace(
        subs,
        images=(*subs.images[:2], *(2 * image for image in subs.images[2:])),
        denoised=(*subs.denoised[:2], *subs.denoised[:2]),
    )
    stage = STAGES[name](settings(files, stages=name))
    one, changed = (
        stage.run(state_of(each, scale=1.5), Work(extra=extra)).state
        for each, extra in ((frame, subs), (other, others))
    )
    assert torch.equal(one.images[0], changed.images[0])
    assert not torch.equal(one.images[1], changed.images[1])
    assert not torch.equal(one.full, changed.full)


@pytest.mark.parametrize("heavy", [False, True])
def test_a_james_stein_half_knows_little_of_its_witness(heavy: bool, files: dict[str, str]) -> None:
    """As for the classical variant: of half b it sees the variance alone, never the image."""
    assert abs(share_of_witness(NeuralJamesStein(settings(files)), heavy=heavy, side=96)) < 0.005


def test_neural_james_stein_by_hand(files: dict[str, str]) -> None:
    """The full image mixes the halves' images, moved by what the full one has beyond their mean."""
    frame = make_frame()
    state = state_of(frame)._replace(full=frame.denoised_full + 0.1)
    stage = NeuralJamesStein(settings(files))
    got, network = stage.run(state, Work()).state, stage.network
    beyond = frame.denoised_full + 0.1 - mean(frame.denoised)
    x, variance = mean(frame.color), variance_of_mean(frame.color).float()
    given = [planes(image) for image in (x, variance, *(image + beyond for image in frame.denoised))]
    torch.testing.assert_close(planes(got.full), neural_blend(*network(*given), *given), rtol=1e-5, atol=1e-5)
    own = [planes(image) for image in (frame.color[1], 2 * variance, frame.denoised[1], frame.denoised[1])]
    torch.testing.assert_close(planes(got.images[1]), neural_blend(*network(*own), *own), rtol=1e-5, atol=1e-5)


def test_flat_weights_are_the_classical_stage(tmp_path: Path) -> None:
    """With all weights equal, both halves' shares ½ and a flat variance, neural and classical step agree."""
    network = VarianceNetwork()
    with torch.no_grad():
        network.last.weight.zero_()
    weights.save(tmp_path / "flat.safetensors", network, settings={}, data="", attribution="")
    frame = make_frame()
    a, b = frame.color[0], frame.color[0] + 0.3
    state = StageImages((frame.halves[0], frame.halves[1]._replace(color=b)), mean(frame.denoised))
    stage = NeuralJamesStein(settings({}, james_stein_weights=str(tmp_path / "flat.safetensors")))
    got = stage.run(state, Work()).state.full
    x, variance = mean((a, b)), variance_of_mean((a, b))
    q = relative_weight(x)
    smoothed = torch.nn.functional.avg_pool2d(
        torch.nn.functional.pad(planes(q * variance), (7, 7, 7, 7), mode="reflect"), 15, stride=1
    )
    expected = james_stein(x, state.full, smoothed[0].permute(1, 2, 0) / q, q, sigma=0)
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-5)


def test_g_buffers_as_the_combiner_sees_them() -> None:
    normal, albedo = torch.rand(2, 3, 3), torch.rand(2, 3, 3, dtype=torch.float16)
    depth = torch.tensor([[0.0, 1.0, 4.0], [2.0, 1e10, -1.0]])[..., None]
    got = feature_planes((2, 3), normal=normal, albedo=albedo, depth=depth)
    assert torch.equal(got[:3], normal.permute(2, 0, 1))
    assert torch.equal(got[3:6], albedo.float().permute(2, 0, 1))
    assert torch.equal(got[6], torch.tensor([[0, 0.25, 1], [0.5, 0, 0]]))
    assert feature_planes((2, 3), normal=None, albedo=None, depth=None).eq(0).all()
    assert feature_planes((2, 3), normal=None, albedo=None, depth=0 * depth).isfinite().all()


@pytest.mark.parametrize("stages", ["neural-james-stein", "deep-combiner", "deep-combiner-4"])
@pytest.mark.parametrize("extreme", [0.0, 1e20])
def test_extremes_stay_finite(stages: str, extreme: float, files: dict[str, str]) -> None:
    for size in ((1, 1), (9, 30)):
        four = [torch.rand(*size, 3) if extreme else torch.zeros(*size, 3) for _ in range(4)]
        four[0][0, 0] = extreme
        box = denoisers.create("box")
        frame = Frame(color=(mean(four[:2]), mean(four[2:]))).denoise(box)
        extra = {"deep-combiner-4": SubImages.of(frame, four).denoise(frame, box)}
        for precision in ("fp32", "bf16"):
            image = correct(frame, settings(files, stages=stages, precision=precision), extra=extra).image
            assert image.isfinite().all()
            assert image.min() >= 0


def test_sub_images_are_checked() -> None:
    frame, subs = make_both()
    four = subs.images
    rounded = [image.half().float() for image in four]
    SubImages.of(Frame(color=tuple(half.half().float() for half in frame.color)), rounded)
    with pytest.raises(FrameError, match="four arrays"):
        SubImages.of(frame, four[:3])
    with pytest.raises(FrameError, match="mean is half a"):
        SubImages.of(frame, (*four[2:], *four[:2]))
    with pytest.raises(FrameError, match="mean is half b"):
        SubImages.of(frame, (*four[:2], four[2], four[2]))
    with pytest.raises(FrameError, match="sub_images of half b, second of 39x44"):
        SubImages.of(frame, (*four[:3], four[3][:-1]))


def test_sub_images_are_repaired() -> None:
    frame, subs = make_both()
    broken = [image.clone() for image in subs.images]
    broken[0][3, 4], broken[3][0, 0, 1] = float("nan"), float("inf")
    broken[1][8, 8] = -1
    repaired = SubImages.of(frame, broken)
    assert repaired.repairs["sub_images"] == (2, 1)
    assert all(image.isfinite().all() and image.min() >= 0 for image in repaired.images)
    assert torch.equal(repaired.images[2], subs.images[2])


def test_sub_images_are_denoised_each_on_its_own() -> None:
    """Also by a denoiser that takes two at once: those of half a are never shown with those of half b."""
    frame, subs = make_both()
    box, nlm = denoisers.create("box"), denoisers.create("nlm")
    for image, denoised in zip(subs.images, subs.denoised, strict=True):
        torch.testing.assert_close(denoised, box(image))
    dual = subs.denoise(frame, nlm).denoised
    features = {name: getattr(frame, name) for name in ("albedo", "normal", "depth")}
    own = nlm.pair(subs.images[2:], visibility=None, **{name: (p[1], p[1]) for name, p in features.items()})
    assert torch.equal(dual[2], own[0])
    assert torch.equal(dual[3], own[1])


def test_what_cannot_be_run_is_refused(files: dict[str, str]) -> None:
    frame, subs = make_both()
    plain, four = Frame(color=frame.color, denoised=frame.denoised), settings(files, stages="deep-combiner-4")
    with pytest.raises(FrameError, match="sub-images for the stage deep-combiner-4, but got none"):
        correct(plain, four)
    with pytest.raises(FrameError, match="not denoised"):
        correct(plain, four, extra={"deep-combiner-4": SubImages.of(plain, subs.images)})
    with pytest.raises(SettingsError, match="as the first stage"):
        opened(settings(files, stages="core,deep-combiner-4"))
    with pytest.raises(FileError, match="--combiner-weights"):
        correct(frame, settings(files, stages="deep-combiner", combiner_weights="missing.safetensors"))


NAMES = ["R", "G", "B", "albedo.R", "albedo.G", "albedo.B", "nn.X", "nn.Y", "nn.Z", "dd.T"]


def write(path: Path, images: list[np.ndarray]) -> str:
    channels = dict(zip(NAMES, np.moveaxis(np.concatenate(images, -1), -1, 0).astype(np.float16), strict=False))
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {name: np.ascontiguousarray(plane) for name, plane in channels.items()}).write(str(path))
    return str(path)


@pytest.fixture(scope="module")
def renders(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """A corner of the packaged frame as half-float files: halves a and b, then the sub-images of each."""
    folder = tmp_path_factory.mktemp("renders")
    generator, halves, subs = np.random.default_rng(0), [], []
    data = Path(exr.__file__).parents[1] / "data"
    for which in "ab":
        buffers = exr.load_half(str(data / f"demo_064spp_{which.upper()}.exr")).buffers
        color, *others = (buffers[name][100:164, 90:160] for name in ("color", "albedo", "normal", "depth"))
        apart = color * generator.uniform(-0.5, 0.5, color.shape)
        subs += [write(folder / f"{which}{i}.exr", [color + sign * apart]) for i, sign in ((1, 1), (2, -1))]
        halves.append(write(folder / f"{which}.exr", [color, *others]))
    return [*halves, *subs]


def test_the_command(
    renders: list[str], files: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With OIDN, on all stages at once; the written image is that of the API."""
    output = str(tmp_path / "out.exr")
    flags = [part for name, file in files.items() for part in (f"--{name.replace('_', '-')}", file)]
    stages = "deep-combiner-4,neural-james-stein"
    command = [
        "frame",
        *renders[:2],
        "--sub-images",
        *renders[2:],
        "-o",
        output,
        "--denoiser",
        "oidn",
        "--threads",
        "1",
    ]
    chosen = [*flags, "--stages", stages, "--no-guard", "--precision", "fp32"]
    threads = torch.get_num_threads()
    try:
        assert cli.main([*command, *chosen, "--json"]) == 0
        report = json.loads(capsys.readouterr().out)
        loaded = [exr.load_half(path).buffers for path in renders]
        pairs = {name: tuple(half[name] for half in loaded[:2]) for name in ("color", "albedo", "normal", "depth")}
        oidn = denoisers.create("oidn", threads=1)
        frame = Frame(**pairs).denoise(oidn)
        subs = SubImages.of(frame, [half["color"] for half in loaded[2:]]).denoise(frame, oidn)
        extra = {"deep-combiner-4": subs}
        expected = correct(frame, settings(files, stages=stages), extra=extra).image
    finally:
        torch.set_num_threads(threads)
    assert report["settings"]["combiner_4_weights"] == files["combiner_4_weights"]
    assert {"deep-combiner-4", "neural-james-stein"} <= report["seconds"].keys()
    assert report["repairs"]["sub_images"] == {"non_finite": 0, "negative": 0}
    np.testing.assert_allclose(exr.load_half(output).buffers["color"], expected, rtol=2e-3, atol=1e-4)


def test_the_command_refuses(
    renders: list[str], files: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In one line each, before any work, and the output that was there stays."""
    output = tmp_path / "out.exr"
    output.write_bytes(b"before")
    flags = [part for name, file in files.items() for part in (f"--{name.replace('_', '-')}", file)]
    frame = ["frame", *renders[:2], "-o", str(output), "--denoiser", "box", *flags]
    four, subs = ["--stages", "deep-combiner-4"], ["--sub-images", *renders[2:]]
    small = write(tmp_path / "small.exr", [np.zeros((5, 5, 3))])
    given = ["frame", *renders[:2], "-o", str(output), *flags, "--denoised-a", renders[0], "--denoised-b", renders[1]]
    for command, line in (
        ([*frame, *four], "expected --sub-images"),
        ([*frame, *subs], "expected the stage deep-combiner-4"),
        ([*frame, *four, "--sub-images", *renders[2:5]], "--sub-images"),
        ([*frame, *four, "--sub-images", *renders[2:5], renders[2]], "the same file twice"),
        ([*frame, *four, "--sub-images", *renders[2:5], small], "expected 70x64 pixels"),
        ([*frame, *four, "--sub-images", renders[2], *renders[4:1:-1][:2], renders[5]], "mean is half a"),
        ([*frame, *four, "--sub-images", *renders[2:5], str(tmp_path / "none.exr")], "none.exr"),
        ([*given, *four, *subs], "expected --denoiser NAME"),
        ([*frame, "--stages", "core,deep-combiner-4", *subs], "as the first stage"),
        ([*frame, "--stages", "neural-james-stein", "--james-stein-weights", renders[0]], "intact trained weights"),
        ([*frame, "--stages", "deep-combiner", "--combiner-weights", "nowhere"], "nowhere: expected the weights"),
    ):
        assert cli.main(command) == 2, line
        told = capsys.readouterr()
        errors = [told_line for told_line in told.err.splitlines() if "error:" in told_line]
        assert len(errors) == 1
        assert line in errors[0]
        assert told.out == ""
        assert output.read_bytes() == b"before"


def test_other_weights_are_another_recipe(renders: list[str], files: dict[str, str], tmp_path: Path) -> None:
    """A shot's frame that was made with other weights under the same name is not left out."""
    own = tmp_path / "own.safetensors"
    recipes = []
    for name in ("combiner_weights", "combiner_4_weights"):
        own.write_bytes(Path(files[name]).read_bytes())
        chosen = settings({}, combiner_weights=str(own))
        recipes.append(recipe(Sources(*renders[:2]), chosen, {}))
    assert recipes[0] != recipes[1]


def test_sub_images_count_as_memory(renders: list[str]) -> None:
    sources = Sources(*renders[:2])
    with_them, without = (memory.needs(sources, Settings(), extra=count) for count in (4, 0))
    image = 64 * 70 * 12  # bytes
    grown = [one - other for one, other in zip(with_them, without, strict=True)]
    assert grown == [4 * image, 8 * image, 8 * image, 0]


def test_help_names_the_weights(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["frame", "--help"])
    assert ended.value.code == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "--sub-images A1.exr A2.exr B1.exr B2.exr" in told
    assert "--james-stein-weights FILE trained weights of the stage neural-james-stein" in told
    assert "--combiner-4-weights FILE" in told
