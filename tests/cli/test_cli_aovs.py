"""The command on files with AOVs: what is written sums, and what cannot be is refused before any work."""

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import BALANCED, call, refused
from helpers.exr_files import save, three

import denoisers
from selfcorrect import exr

SIZE = (24, 30)
FEW = [*BALANCED, "--denoiser", "box", "--candidates", "none"]
ARNOLD = ("diffuse_direct", "diffuse_indirect", "specular_direct", "emission", "background")
GROUPS = ("RGBA_key", "RGBA_fill")


def arnold(path: Path, seed: int, dtype: type = np.float32, **more: np.ndarray) -> Path:
    """A half as Arnold names it, with lobes and light groups that both sum to R, G, B, and alpha."""
    generator = np.random.default_rng(seed)
    channels = {"A": generator.random(SIZE).astype(dtype), "Z": generator.random(SIZE).astype(np.float32)} | more
    for letter in "RGB":
        lobes = generator.random((len(ARNOLD), *SIZE)) ** 2
        lobes[3, :, :10] = 0
        lobes = lobes.astype(dtype).astype(np.float64)
        total = lobes.sum(0)
        share = generator.random(SIZE)
        values = [*lobes, total * share, total * (1 - share), total]
        names = [*(f"{name}.{letter}" for name in (*ARNOLD, *GROUPS)), letter]
        channels |= {name: array.astype(dtype) for name, array in zip(names, values, strict=True)}
    return save(path, channels)


def sums(path: Path, names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """The sum of AOVs and the picture, (3, H, W)."""
    file = exr.read(path)
    total = np.stack([sum(file.pixels(f"{name}.{letter}").astype(np.float64) for name in names) for letter in "RGB"])
    return total, np.stack([file.pixels(letter).astype(np.float64) for letter in "RGB"])


@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_two_decompositions_of_arnold_both_sum(tmp_path: Path, dtype: type) -> None:
    halves = [arnold(tmp_path / f"{half}.exr", seed, dtype) for half, seed in (("a", 1), ("b", 2))]
    out = tmp_path / "out.exr"
    result = call("frame", *halves, "-o", out, *FEW, "--aovs", "auto", "--json")
    assert result.returncode == 0, result.stderr
    for names in (ARNOLD, GROUPS):
        total, picture = sums(out, names)
        if dtype is np.float32:
            assert np.all(abs(total - picture) <= 1e-5 * picture + 1e-7)
        else:
            ulps = sum(
                np.spacing(np.stack([exr.read(out).pixels(f"{name}.{letter}") for letter in "RGB"])).astype(float)
                for name in names
            )
            assert np.all(abs(total - picture) <= ulps / 2 + np.spacing(picture.astype(np.float16)).astype(float) / 2)
    file = exr.read(out)
    assert all((file.pixels(f"emission.{letter}") >= 0).all() for letter in "RGB")
    assert all((file.pixels(f"emission.{letter}")[:, :9] == 0).all() for letter in "RGB")
    assert "AOVs: Arnold's lobes (5) sum to the picture within" in result.stderr
    assert "AOVs: light groups RGBA_… (2) sum to the picture within" in result.stderr
    assert "other channels: 21 corrected, 1 the mean of both halves, 1 as in half a" in result.stderr
    told = json.loads(result.stdout)
    assert told["aovs"]["Arnold's lobes"]["left"] < 1e-6
    assert told["other_channels"] == {"mean": 1, "kept": 1, "corrected": 21, "lacking": []}


def test_sets_that_share_an_aov_both_sum(tmp_path: Path) -> None:
    """Lobes as a whole beside the same in two parts: emission is in both sets."""
    halves = []
    for half, seed in (("a", 1), ("b", 2)):
        generator = np.random.default_rng(seed)
        channels = {}
        for letter in "RGB":
            direct, indirect, emission = generator.random((3, *SIZE), dtype=np.float32)
            named = {"diffuse_direct": direct, "diffuse_indirect": indirect, "diffuse": direct + indirect}
            channels |= {f"{name}.{letter}": values for name, values in (named | {"emission": emission}).items()}
            channels[letter] = direct + indirect + emission
        halves.append(save(tmp_path / f"{half}.exr", channels))
    out = tmp_path / "out.exr"
    result = call("frame", *halves, "-o", out, *FEW, "--aovs", "auto")
    assert result.returncode == 0, result.stderr
    assert result.stderr.count("sum to the picture within") == 2
    for names in (("diffuse_direct", "diffuse_indirect", "emission"), ("diffuse", "emission")):
        total, picture = sums(out, names)
        assert np.all(abs(total - picture) <= 1e-5 * picture + 1e-7)


def test_blenders_products_sum(tmp_path: Path) -> None:
    """Light is written divided by the colour beside it, in one part per pass as Blender 5 has it."""
    halves = []
    for half, seed in (("a", 1), ("b", 2)):
        generator = np.random.default_rng(seed)
        lights = ("Diffuse Direct", "Diffuse Indirect", "Emission")
        planes = {n: generator.random((3, *SIZE), dtype=np.float32) for n in (*lights, "Diffuse Color")}
        planes["Diffuse Color"][:, :, :4] = planes["Diffuse Direct"][:, :, :4] = 0
        planes["Diffuse Indirect"][:, :, :4] = 0
        light = planes["Diffuse Direct"] + planes["Diffuse Indirect"]
        planes["Combined"] = light * planes["Diffuse Color"] + planes["Emission"]
        parts = [
            (f"V.{name}", dict(zip(three(f"V.{name}"), values, strict=True)), {}) for name, values in planes.items()
        ]
        halves.append(save(tmp_path / f"{half}.exr", *parts))
    out = tmp_path / "out.exr"
    assert call("frame", *halves, "-o", out, *FEW, "--aovs", "auto").returncode == 0
    file = exr.read(out)
    planes = {
        name: np.stack([file.pixels(channel).astype(np.float64) for channel in three(f"V.{name}")]) for name in planes
    }
    total = (planes["Diffuse Direct"] + planes["Diffuse Indirect"]) * planes["Diffuse Color"] + planes["Emission"]
    assert np.all(abs(total - planes["Combined"]) <= 1e-5 * planes["Combined"] + 1e-7)
    assert (planes["Diffuse Direct"][:, :, :4] == 0).all()


@pytest.fixture
def halves(tmp_path: Path) -> list[Path]:
    extra = {f"only_a.{letter}": np.ones(SIZE, np.float32) for letter in "RGB"}
    return [arnold(tmp_path / "a.exr", 1, **extra), arnold(tmp_path / "b.exr", 2)]


def test_named_aovs_alone_are_written(halves: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "out.exr"
    result = call("frame", *halves, "-o", out, *FEW, "--aovs", "emission,alpha")
    assert result.returncode == 0, result.stderr
    a, b, written = (exr.read(path) for path in (*halves, out))
    assert "other channels: 4 corrected" in result.stderr
    mean = (a.pixels("background.G").astype(np.float64) + b.pixels("background.G")) / 2
    assert np.array_equal(written.pixels("background.G"), mean.astype(np.float32))
    alpha, noisy = written.pixels("A"), (a.pixels("A") + b.pixels("A")) / 2
    assert alpha.min() >= 0
    assert alpha.max() <= 1
    assert not np.array_equal(alpha, noisy)


def test_alpha_stays_whole_where_it_is(tmp_path: Path) -> None:
    """Denoised at the noisy edge between what is solid and what is empty, exact on both sides of it."""
    halves = []
    for half, seed in (("a", 1), ("b", 2)):
        alpha = np.random.default_rng(seed).random(SIZE, dtype=np.float32)
        alpha[:, :10], alpha[:, 20:] = 1, 0
        halves.append(arnold(tmp_path / f"{half}.exr", seed, A=alpha))
    out = tmp_path / "out.exr"
    generated = [exr.read(path).pixels("A") for path in halves]
    assert call("frame", *halves, "-o", out, *FEW, "--aovs", "alpha").returncode == 0
    alpha = exr.read(out).pixels("A")
    assert (alpha[:, :9] == 1).all()
    assert (alpha[:, 21:] == 0).all()
    assert ((alpha >= 0) & (alpha <= 1)).all()
    assert alpha[:, 11:19].var() < ((generated[0] + generated[1]) / 2)[:, 11:19].var()


def test_a_set_that_does_not_sum_is_said_and_left(tmp_path: Path) -> None:
    halves = []
    for half, seed in (("a", 1), ("b", 2)):
        file = exr.read(arnold(tmp_path / f"{half}.exr", seed))
        kept = {n: file.pixels(n) for n in file.channel_names if not n.startswith(("background", "RGBA"))}
        halves.append(save(tmp_path / f"{half}.exr", kept))
    result = call("frame", *halves, "-o", tmp_path / "out.exr", *FEW, "--aovs", "auto")
    assert result.returncode == 0, result.stderr
    assert "Arnold's lobes (4) do not sum to the picture: off by" in result.stderr
    assert "no set of them sums to the picture; none is corrected" in result.stderr
    assert "corrected, " not in result.stderr


def test_refusals_before_any_work(halves: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "out.exr"
    command = ("frame", *halves, "-o", out, *FEW)
    assert "expected an AOV 'nothing' with R, G, B beside the colour" in refused(*command, "--aovs", "nothing")
    told = refused(*command, "--aovs", "only_a")
    assert "b.exr: expected the AOV 'only_a' like" in told
    assert not out.exists()


def test_aovs_beside_denoised_halves_are_denoised_by_the_usual_denoiser(halves: list[Path], tmp_path: Path) -> None:
    """The picture is what was given; the AOVs sum to what is made of that."""
    denoised = [
        save(tmp_path / f"d{half.name}", {letter: np.full(SIZE, 1.5, np.float32) for letter in "RGB"})
        for half in halves
    ]
    out, few = tmp_path / "out.exr", [flag for flag in FEW if flag not in ("--denoiser", "box")]
    given = ("--denoised-a", denoised[0], "--denoised-b", denoised[1])
    result = call("frame", *halves, "-o", out, *few, *given, "--aovs", "auto", "--json")
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["denoiser"] == "given"
    assert f"AOVs: denoised by {denoisers.default()}: --denoised-a and --denoised-b are of the" in result.stderr
    for names in (ARNOLD, GROUPS):
        total, picture = sums(out, names)
        assert np.all(abs(total - picture) <= 1e-5 * picture + 1e-7)


def test_a_shot_takes_aovs(halves: list[Path], tmp_path: Path) -> None:
    names = [path.rename(path.with_name(f"{path.stem}.0001.exr")) for path in halves]
    patterns = [str(name).replace("0001", "####") for name in names]
    result = call("sequence", *patterns, "-o", tmp_path / "o.####.exr", "--frames", "1", *FEW, "--aovs", "auto")
    assert result.returncode == 0, result.stderr
    total, picture = sums(tmp_path / "o.0001.exr", GROUPS)
    assert np.all(abs(total - picture) <= 1e-5 * picture + 1e-7)
