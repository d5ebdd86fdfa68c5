"""The pipeline that trains the networks: samples, the denoiser, a run that is killed, export and evaluation."""

import contextlib
import csv
import io
import itertools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cut_frames
import dataset
import evaluate
import export
import held_out
import onnx
import pytest
import torch
import train
from denoiser import TAPS, Denoiser, filtered, filtered_reference
from helpers.render_scripts import CHECKOUT
from helpers.tolerances import SAMPLES
from helpers.views import make_view, write_dataset
from samples import HALVES, MEMBERS, SINGLES, WHOLE, Memory, draw, spread
from torch import Tensor

import denoisers
from selfcorrect import Frame
from selfcorrect.errors import DenoiserError
from selfcorrect.stages import weights
from selfcorrect.stages.bilateral_combiner import BilateralCombiner
from selfcorrect.stages.deep_combiner import DeepCombiner
from selfcorrect.stages.neural_james_stein import VarianceNetwork

SCRIPTS = CHECKOUT / "scripts" / "train"
MAINS = {"train": train.main, "export": export.main, "evaluate": evaluate.main, "held_out": held_out.main}
NARROW = ("--width", 8, "--window", 5, "--layers", 3, "--kernel", 3)
BILATERAL = ("--width", 8, "--window", 5, "--layers", 3)
NETWORKS = {
    "denoiser": (),
    "james-stein": (),
    "bilateral-combiner": BILATERAL,
    "deep-combiner": NARROW,
    "deep-combiner-4": NARROW,
}


def command(script: str, *arguments: object) -> list[str]:
    return [sys.executable, str(SCRIPTS / f"{script}.py"), *map(str, arguments)]


def ran(script: str, *arguments: object) -> str:
    """What a script prints; in this process, since it takes seconds to load torch."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        MAINS[script](list(map(str, arguments)))
    return said.getvalue()


def training(network: str, data: Path, out: Path, *arguments: object) -> tuple[object, ...]:
    shared = ("--data", data, "--out", out, "--crop", 32, "--batch", 2, "--validation-views", 1)
    return ("train", network, *NETWORKS[network], *shared, *arguments)


def table(path: Path) -> list[list[str]]:
    """Rows of a CSV file without the seconds."""
    with path.open(newline="") as file:
        return [[value for i, value in enumerate(row) if i != 1] for row in csv.reader(file)]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def runs(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few steps of every network."""
    folder = tmp_path_factory.mktemp("runs")
    for network in NETWORKS:
        ran(*training(network, data, folder / network, "--steps", 4))
    return folder


class TestSamples:
    def memory(self) -> Memory:
        return Memory.of(make_view(0, 32, clean=False))

    @pytest.mark.parametrize("keys", [(0,), (4,), (WHOLE,), HALVES, (1, 3), SINGLES])
    def test_no_input_shares_a_render_with_the_target(self, keys: tuple[int, ...]) -> None:
        """Each render is a number of its own, so that the means tell which are in them."""
        values = 10.0 ** torch.arange(5).view(5, 1, 1, 1).expand(5, 32, 32, 3)
        memory = Memory.of(make_view(0, 32, clean=False)._replace(color=values, smooth=values[4]))
        assert memory.target.unique().tolist() == [10.0**4]
        expected = [sum(10.0**i for i in MEMBERS[key]) / len(MEMBERS[key]) for key in keys]
        assert [float(image.mean()) for image in memory.noisy(keys)] == pytest.approx(expected)

    def test_all_planes_of_a_pixel_stay_together(self) -> None:
        memory = self.memory()
        one = memory.color[0].half()
        same = memory._replace(
            color=one.float().expand(4, 3, 32, 32),
            target=one.float(),
            denoised={"oidn": one.expand(7, 3, 32, 32)},
            albedo=one,
            depth=one[:1],
        )
        for seed in range(20):
            generator = torch.Generator().manual_seed(seed)
            sample = draw(same, HALVES, "oidn", generator, crop=16, biased=one.float().expand(2, 3, 32, 32))
            assert sample.target.shape == (3, 16, 16)
            for image in (*sample.noisy, *sample.denoised, *sample.biased, sample.level):
                torch.testing.assert_close(image, sample.target)
            if sample.albedo.any():
                ratio = sample.target / sample.albedo
                torch.testing.assert_close(ratio, ratio.mean().expand_as(ratio), rtol=SAMPLES, atol=0)

    def test_spreading_outliers_keeps_the_light(self) -> None:
        level = torch.full((3, 64, 64), 0.5)
        target = level + 0.1 * torch.rand(3, 64, 64, generator=torch.Generator().manual_seed(0))
        torch.testing.assert_close(spread(target, level), target)  # without outliers nothing is changed
        target[:, 30, 33] = 1000.0
        found = spread(target, level)
        assert found.max() < 4
        torch.testing.assert_close(found.mean(), target.mean())

    def test_the_same_seed_gives_the_same_sample(self) -> None:
        memory = self.memory()
        first, again, other = (
            draw(memory, (0,), "oidn", torch.Generator().manual_seed(seed), crop=16) for seed in (1, 1, 2)
        )
        assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
        assert not torch.equal(first.noisy, other.noisy)


class TestCutFrames:
    def test_pieces_hold_what_the_frame_has_there(self) -> None:
        pair = [(image, image + 1) for image in torch.rand(5, 20, 36, 3)]
        color, albedo, normal, depth, reference = pair
        frame = Frame(color=color, albedo=albedo, normal=normal, depth=tuple(image[..., :1] for image in depth))
        made = torch.arange(7.0).view(7, 1, 1, 1) + color[0]
        found = list(cut_frames.views("x", frame, {"oidn": made}, torch.stack(reference), color[0], 16))
        assert [view.name for view in found] == ["x-0002-0002", "x-0002-0018"]
        memory = Memory.of(found[1])
        at = (slice(2, 18), slice(18, 34))
        expected = {4: color[0][at], 5: color[1][at], WHOLE: color[0][at] + 0.5}
        for key, value in expected.items():
            torch.testing.assert_close(memory.noisy((key,))[0], value.permute(2, 0, 1))
        torch.testing.assert_close(found[1].color[4], reference[0][at] + 0.5)
        torch.testing.assert_close(found[1].denoised["oidn"][WHOLE], 6 + color[0][at])


class TestDenoiser:
    @pytest.mark.parametrize(("height", "width"), [(1, 1), (7, 4), (9, 16)])
    def test_the_fast_filter_is_the_reference(self, height: int, width: int) -> None:
        generator = torch.Generator().manual_seed(0)
        image = torch.rand(2, 4, height, width, dtype=torch.float64, generator=generator, requires_grad=True)
        kernel = torch.rand(2, TAPS, height, width, dtype=torch.float64, generator=generator, requires_grad=True)
        expected, found = filtered_reference(image, kernel), filtered(image, kernel)
        torch.testing.assert_close(found, expected)
        upstream = torch.rand(found.shape, dtype=torch.float64, generator=generator)
        pairs = (torch.autograd.grad(each, (image, kernel), upstream) for each in (expected, found))
        for of_reference, of_fast in zip(*pairs, strict=True):
            torch.testing.assert_close(of_fast, of_reference)
        if height * width < 30:
            assert torch.autograd.gradcheck(filtered, (image, kernel))

    @torch.no_grad()
    def test_any_radiance_gives_finite_radiance(self) -> None:
        torch.manual_seed(0)
        network = Denoiser().eval()
        features = torch.rand(1, 3, 32, 32), torch.rand(1, 3, 32, 32)
        black = torch.zeros(1, 3, 32, 32)
        firefly = torch.rand(1, 3, 32, 32)
        firefly[0, :, 5, 6] = 1e6
        assert torch.equal(network(black, *features), black)
        for color in (firefly, firefly * 1e-12, firefly * 1e24, torch.full_like(black, 1e-30)):
            result = network(color, *features)
            assert result.isfinite().all()
            assert (result >= 0).all()

    @torch.no_grad()
    def test_it_is_invariant_to_exposure_and_keeps_a_constant(self) -> None:
        torch.manual_seed(0)
        network = Denoiser().eval()
        color, albedo, normal = torch.rand(3, 1, 3, 32, 48)
        torch.testing.assert_close(network(color * 1e4, albedo, normal), network(color, albedo, normal) * 1e4)
        flat = torch.full((1, 3, 32, 48), 0.7)
        torch.testing.assert_close(network(flat, torch.ones_like(flat), normal), flat)


class TestTraining:
    def test_a_killed_run_continues_with_the_losses_of_an_unbroken_one(self, data: Path, tmp_path: Path) -> None:
        steps = ("--steps", 14)
        ran(*training("denoiser", data, tmp_path / "unbroken", *steps))
        broken = training("denoiser", data, tmp_path / "broken", *steps, "--checkpoint-seconds", 0)
        process = subprocess.Popen(command(*map(str, broken)), stdout=subprocess.DEVNULL)
        while not (tmp_path / "broken" / "losses.csv").exists():
            assert process.poll() is None
            time.sleep(0.01)
        os.kill(process.pid, signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        assert 1 < len(table(tmp_path / "broken" / "losses.csv")) < 15, "it was killed before the end"
        assert "goes on at step" in ran(*broken)
        for name in ("losses.csv", "validation.csv"):
            assert table(tmp_path / "broken" / name) == table(tmp_path / "unbroken" / name)
        states = [
            torch.load(tmp_path / each / "checkpoint.pt", weights_only=True)["run"] for each in ("broken", "unbroken")
        ]
        for name in ("network", "mean"):
            assert all(torch.equal(a, b) for a, b in zip(*(state[name].values() for state in states), strict=True))

    def test_a_scene_is_held_out(self, tmp_path: Path) -> None:
        """Training sees no view of it, validation nothing else."""
        for part, scene in itertools.product(("train", "validation"), ("one", "two")):
            (tmp_path / part).mkdir(exist_ok=True)
            view = make_view(0, 16, clean=part == "validation")._replace(scene=scene)
            dataset.save(tmp_path / part / f"{scene}.safetensors", view, {})
        options = train.parse(["denoiser", "--steps", "1", "--out", "x", "--data", str(tmp_path), "--hold-out", "two"])
        found = train.files_of(options)
        assert [path.stem for path in found["train"]] == ["one"]
        assert [path.stem for path in found["validation"]] == ["two"]

    def test_fewer_views_are_taken_evenly(self, tmp_path: Path) -> None:
        for part, i in itertools.product(("train", "validation"), range(6)):
            (tmp_path / part).mkdir(exist_ok=True)
            dataset.save(tmp_path / part / f"{i}.safetensors", make_view(0, 16, clean=False), {})
        for count, expected in ((2, "03"), (4, "0134"), (6, "012345"), (9, "012345")):
            shared = ["denoiser", "--steps", "1", "--out", "x", "--data", str(tmp_path)]
            found = train.files_of(train.parse([*shared, "--at-most", str(count)]))
            assert "".join(path.stem for path in found["train"]) == expected

    def test_another_run_is_not_continued(self, data: Path, runs: Path) -> None:
        with pytest.raises(SystemExit, match="use another --out"):
            ran(*training("denoiser", data, runs / "denoiser", "--steps", 5))

    @pytest.mark.parametrize("network", NETWORKS)
    def test_a_run_leaves_its_log_and_curves(self, runs: Path, network: str) -> None:
        folder = runs / network
        losses = table(folder / "losses.csv")
        assert [row[0] for row in losses] == ["step", "0", "1", "2", "3"]
        assert len(table(folder / "validation.csv")) == 2
        assert (folder / "curves.png").read_bytes().startswith(b"\x89PNG")


@pytest.fixture(scope="module")
def model(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("export") / "denoiser.onnx"
    said = ran("export", runs / "denoiser", "--out", path)
    assert float(said.split("torch: ")[1].split()[0]) < 1e-4
    return path


class TestExport:
    def test_the_model_says_where_it_comes_from(self, model: Path, data: Path) -> None:
        facts = {entry.key: entry.value for entry in onnx.load(model).metadata_props}
        assert facts["data"] == dataset.checksum(dataset.views(data / "train"))
        assert "Jay-Artist" in facts["attribution"]
        assert '"steps": 4' in facts["settings"]
        assert model.stat().st_size < 4e6
        assert str(CHECKOUT).encode() not in model.read_bytes()

    @pytest.mark.parametrize("size", [(33, 57), (16, 16)])
    def test_it_is_an_ordinary_denoiser_of_any_size(self, model: Path, runs: Path, size: tuple[int, int]) -> None:
        generator = torch.Generator().manual_seed(0)
        color, albedo, normal = torch.rand(3, *size, 3, generator=generator)
        denoise = denoisers.create(f"onnx:{model}", threads=1)
        result = denoise(color, albedo=albedo, normal=normal)
        assert result.std() < color.std(), "an untrained kernel is a mean"
        bare = denoise(color)
        torch.testing.assert_close(bare, denoise(color, albedo=0 * albedo, normal=0 * normal))
        with torch.no_grad():
            network = Denoiser()
            network.load_state_dict(torch.load(runs / "denoiser" / "checkpoint.pt", weights_only=True)["run"]["mean"])
            if size == (16, 16):
                torch.testing.assert_close(result, image(network(*map(planes, (color, albedo, normal)))))

    def test_a_model_that_needs_a_feature_still_says_so(self, model: Path, tmp_path: Path) -> None:
        other = onnx.load(model)
        kept = [entry for entry in other.metadata_props if entry.key != "optional"]
        del other.metadata_props[:]
        other.metadata_props.extend(kept)
        onnx.save(other, tmp_path / "strict.onnx")
        with pytest.raises(DenoiserError, match="expected a frame with albedo, but got one without"):
            denoisers.create(f"onnx:{tmp_path / 'strict.onnx'}")(torch.rand(16, 16, 3))

    @pytest.mark.parametrize("network", [network for network in NETWORKS if network != "denoiser"])
    def test_weights_are_what_the_stages_load(self, runs: Path, tmp_path: Path, network: str) -> None:
        path = tmp_path / f"{network}.safetensors"
        ran("export", runs / network, "--out", path)
        found = weights.load(path, VarianceNetwork, DeepCombiner, BilateralCombiner).state_dict()
        mean = torch.load(runs / network / "checkpoint.pt", weights_only=True)["run"]["mean"]
        assert all(torch.equal(found[name], value.half().float()) for name, value in mean.items())


class TestEvaluate:
    def test_rows_are_measured_once_and_the_table_holds_their_means(self, data: Path, tmp_path: Path) -> None:
        out = tmp_path / "table.csv"
        methods = ("noisy", "oidn", "james-stein", "box,james-stein")
        shared = ("quality", "--data", data, "--out", out, "--methods")
        ran("evaluate", *shared, *methods[:2])
        first = out.read_text()
        said = ran("evaluate", *shared, *methods)
        assert out.read_text().startswith(first)
        with out.open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert sorted((row["frame"], row["method"]) for row in rows) == sorted(
            itertools.product(("000", "001"), methods)
        )
        errors = {row["method"]: float(row["relmse"]) for row in rows if row["frame"] == "000"}
        assert errors["box,james-stein"] < errors["noisy"]
        means = {
            line.split(" | ")[0].strip("| "): line.split(" | ") for line in said.splitlines() if line.startswith("|")
        }
        assert means["noisy"][3] == means["oidn"][5] == "1"
        assert float(means["oidn"][3]) < 1


class TestHeldOut:
    def test_the_table_is_over_the_denoiser_of_each_frame(self) -> None:
        rows = [
            {"frame": name, "spp": "64", "denoiser": "oidn", "stages": stages, "relmse": error, "radiance": "0.99"}
            for name, stages, error in (
                ("a", "none", "0.1"),
                ("a", "deep-combiner", "0.05"),
                ("b", "none", "0.4"),
                ("b", "deep-combiner", "0.8"),
                ("b", "core", "0.2"),
            )
        ]
        assert held_out.table(rows).splitlines()[2:] == [
            "| oidn | core | 1 | 0.500 (0.50) | 0.9900 |",
            "| oidn | deep-combiner | 2 | 1.000 (2.00) | 0.9900 |",
        ]

    @pytest.mark.shared
    def test_rows_are_measured_once_with_the_scenes_own_weights(self, shared: Path, tmp_path: Path) -> None:
        frames, out = tmp_path / "frames", tmp_path / "table.csv"
        frames.mkdir()
        for path in (shared / "frames").glob("staircase_*"):
            if "ref" in path.name or "016" in path.name:
                (frames / path.name).symlink_to(path)
        network = BilateralCombiner(8, 5, 3)
        weights.save(tmp_path / "staircase.safetensors", network, settings={}, data="", attribution="")
        options = ("measure", frames, "--weights", tmp_path, "--out", out, "--spp", 16, "--denoisers", "box")
        said = ran("held_out", *options)
        assert "| box | deep-combiner | 1 |" in said
        first = out.read_text()
        assert len(first.splitlines()) == 3
        ran("held_out", *options)
        assert out.read_text() == first


@pytest.mark.mitsuba
def test_rendered_views_go_all_the_way(tmp_path: Path) -> None:
    """Two procedural rooms, really rendered by whichever variant works here, trained on and measured."""
    data = tmp_path / "data"
    few = ("--views", 1, "--validation", 1, "--size", 32, "--reference-spp", 4, "--workers", 1)
    (tmp_path / "no scenes").mkdir()
    rendering = command("render_dataset", tmp_path / "no scenes", "-o", data, *few)
    subprocess.run(rendering, check=True, stdout=subprocess.DEVNULL, timeout=900)  # compiled for every room
    ran(*training("deep-combiner", data, tmp_path / "run", "--steps", 2))
    said = ran("evaluate", "quality", "--data", data, "--out", tmp_path / "table.csv", "--methods", "noisy", "oidn")
    assert "| oidn | 1 |" in said


def planes(pixels: Tensor) -> Tensor:
    return pixels.permute(2, 0, 1)[None]


def image(result: Tensor) -> Tensor:
    return result[0].permute(1, 2, 0)
