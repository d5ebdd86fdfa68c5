"""What is particular to OIDN, the joint bilateral filter, the box, commands and a user's class."""

import shlex
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
import torch
from mitsuba_oidn import Device, DeviceType
from numpy.typing import NDArray

import denoisers
from denoisers import Denoise
from denoisers.command import Command
from denoisers.joint_bilateral import JointBilateral
from denoisers.mirror import mirrored
from denoisers.oidn import MODES, Oidn, PrefilteringOidn
from selfcorrect import Frame
from selfcorrect.errors import DenoiserError, FileError
from selfcorrect.stages.deep_combiner_4 import SubImages

Array = NDArray[Any]


def image(height: int, width: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed))


def read(path: Path) -> dict[str, Array]:
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: channel.pixels.astype(np.float32) for name, channel in file.channels().items()}


def stacked(channels: dict[str, Array], *names: str) -> Array:
    return np.stack([channels[name] for name in names], axis=2)


def in_another_thread(function: Callable[[], int]) -> int:
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(function).result()


@pytest.mark.parametrize("size", [(1, 1), (2, 5), (9, 4)])
@pytest.mark.parametrize("border", [(0, 0, 0, 0), (1, 2, 3, 4), (0, 15, 0, 11), (40, 7, 9, 33)])
def test_mirrored_is_numpys_symmetric(size: tuple[int, int], border: tuple[int, int, int, int]) -> None:
    top, bottom, left, right = border
    expected = np.pad(image(*size).numpy(), ((top, bottom), (left, right), (0, 0)), "symmetric")
    result = mirrored(image(*size), top=top, bottom=bottom, left=left, right=right)
    np.testing.assert_array_equal(result, expected)


class TestBox:
    @pytest.mark.parametrize("size", [(1, 1), (4, 9), (30, 17)])
    def test_it_is_the_mean_of_the_window(self, size: tuple[int, int]) -> None:
        color = image(*size).double().numpy() * 100
        padded = np.pad(color, ((7, 7), (7, 7), (0, 0)), "symmetric")
        windows = np.lib.stride_tricks.sliding_window_view(padded, (15, 15), axis=(0, 1))
        np.testing.assert_allclose(denoisers.create("box")(color), windows.mean((3, 4)), rtol=1e-6)


class TestJointBilateral:
    @pytest.mark.parametrize(("size", "tile"), [((5, 3), 1), ((45, 33), 13), ((45, 33), 32), ((160, 170), 150)])
    def test_tiles_do_not_show(self, size: tuple[int, int], tile: int) -> None:
        inputs = image(*size, 0) * 20, image(*size, 1), image(*size, 2)
        whole = JointBilateral(tile=1000).denoise(*inputs)
        tiled = JointBilateral(tile=tile).denoise(*inputs)
        torch.testing.assert_close(tiled, whole, rtol=1e-5, atol=0)

    def test_threads_change_no_bit_and_leave_torch_as_it_was(self) -> None:
        before = torch.get_num_threads(), in_another_thread(torch.get_num_threads)
        inputs = image(45, 33, 0) * 20, image(45, 33, 1), None
        one, three = (JointBilateral(threads, tile=10).denoise(*inputs) for threads in (1, 3))
        assert torch.equal(one, three)
        assert before == (torch.get_num_threads(), in_another_thread(torch.get_num_threads))

    def test_it_is_the_filter_that_the_docstring_describes(self) -> None:
        color, albedo = image(9, 11, 0) * 20, image(9, 11, 1)
        result = JointBilateral().denoise(color, albedo, None)
        pixels, features = color.double().numpy(), albedo.double().numpy()
        framed = np.pad(pixels, ((1, 1), (1, 1), (0, 0)), "symmetric")
        windows = np.lib.stride_tricks.sliding_window_view(framed, (3, 3), axis=(0, 1))
        median = np.median(windows, axis=(3, 4))
        guide = np.concatenate([np.log1p(median / median.mean()) / 0.25, features / 0.1], axis=2)
        pixels, guide = (np.pad(array, ((7, 7), (7, 7), (0, 0)), "symmetric") for array in (pixels, guide))
        y, x = 4, 6
        window = np.s_[y : y + 15, x : x + 15]
        distance = ((guide[window] - guide[y + 7, x + 7]) ** 2).sum(2)
        offset = np.arange(-7, 8) ** 2
        weight = np.exp(-(offset[:, None] + offset) / (2 * 4.0**2) - distance / 2)[:, :, None]
        expected = (weight * pixels[window]).sum((0, 1)) / weight.sum()
        np.testing.assert_allclose(result[y, x], expected, rtol=1e-4)

    def test_exposure_does_not_matter(self) -> None:
        color = image(20, 20) * 3
        result = JointBilateral().denoise(color, None, None)
        torch.testing.assert_close(JointBilateral().denoise(color * 1024, None, None) / 1024, result)

    def test_a_firefly_is_spread_and_not_kept(self) -> None:
        color = torch.ones(31, 31, 3)
        color[15, 15] = 1000
        result = JointBilateral().denoise(color, None, None)
        assert result.max() < 20
        torch.testing.assert_close(result.mean(), color.mean(), rtol=1e-4, atol=0)

    def test_edges_of_features_are_kept(self) -> None:
        albedo = torch.zeros(20, 20, 3)
        albedo[:, 10:] = 1
        color = albedo + 0.05 * image(20, 20)
        for features in ((albedo, None), (None, albedo)):
            result = JointBilateral().denoise(color, *features)
            assert result[:, :10].max() < 0.06
            assert result[:, 10:].min() > 0.99


class TestOidn:
    def test_less_scratch_gives_the_same_bits(self) -> None:
        color, albedo, normal = image(600, 700), image(600, 700, 1) * 1.4 - 0.2, image(600, 700, 2) * 2.6 - 1.3
        whole = Oidn(1).denoise(color, albedo.clamp(0, 1), normal.clamp(-1, 1))
        assert torch.equal(Oidn(1, scratch=1).denoise(color, albedo, normal), whole), "OIDN clamps by itself"

    @pytest.mark.parametrize("spec", ["oidn:fast", "oidn:none"])
    def test_half_floats_are_read_where_they_are(self, spec: str) -> None:
        color, albedo, normal = image(64, 48), image(64, 48, 1).half(), image(64, 48, 2).half()
        denoise = denoisers.create(spec, threads=1)
        assert torch.equal(denoise(color, albedo, normal), denoise(color, albedo.float(), normal.float()))

    def test_it_denoises(self) -> None:
        clean = 1 + image(1, 1).expand(64, 64, 3)
        noisy = clean * -torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(1)).log()
        result = denoisers.create("oidn")(noisy)
        assert (result - clean).square().mean() < 0.01 * (noisy - clean).square().mean()

    def test_threads_are_honoured_and_hardly_matter(self) -> None:
        color, albedo, normal = image(272, 480) * 20, image(272, 480, 1), image(272, 480, 2)
        first, second, third = (Oidn(threads).denoise(color, albedo, normal) for threads in (1, 2, 2))
        assert torch.equal(second, third)
        torch.testing.assert_close(first, second, rtol=2e-5, atol=1e-6)  # 5.4e-6 measured
        assert Oidn(2).device.num_threads == 2

    @pytest.mark.parametrize("spec", MODES)
    def test_features_out_of_range_are_clamped(self, spec: str) -> None:
        color, albedo, normal = image(40, 40) * 5, image(40, 40, 1) * 3 - 1, image(40, 40, 2) * 6 - 3
        denoise = denoisers.create(spec)
        expected = denoise(color, albedo.clamp(0, 1), normal.clamp(-1, 1))
        assert torch.equal(denoise(color, albedo, normal), expected)

    @pytest.mark.parametrize("spec", MODES)
    def test_a_normal_without_an_albedo_is_left_out(self, spec: str) -> None:
        color, normal = image(40, 40) * 5, image(40, 40, 2)
        denoise = denoisers.create(spec)
        assert torch.equal(denoise(color, None, normal), denoise(color))
        assert not torch.equal(denoise(color, normal.abs(), normal), denoise(color, normal.abs()))


def reference_oidn(color: torch.Tensor, features: dict[str, torch.Tensor], *, prefilter: bool) -> torch.Tensor:
    """What OIDN's documentation says of ``cleanAux``, with the bindings alone."""
    device = Device(DeviceType.CPU)
    device.num_threads = 1

    def filtered(images: dict[str, torch.Tensor], **flags: bool) -> torch.Tensor:
        output = torch.empty_like(next(iter(images.values())))
        rt = device.new_filter("RT")
        for name, value in (images | {"output": output}).items():
            rt.set_image(name, value)
        for name, flag in flags.items():
            rt.set_bool(name, flag)
        rt.execute()
        return output

    if prefilter:
        features = {name: filtered({name: value}) for name, value in features.items()}
    return filtered({"color": color} | features, hdr=True, cleanAux=True)


class TestPrefiltering:
    """``oidn`` denoises albedo and normal first, once for all images that go with them."""

    color, albedo, normal = image(48, 64) * 5, image(48, 64, 1), image(48, 64, 2) * 2 - 1

    @pytest.mark.parametrize(("spec", "prefilter"), [("oidn", True), ("oidn:fast", False)])
    @pytest.mark.parametrize("names", [("albedo",), ("albedo", "normal")])
    def test_it_is_what_the_documentation_says(self, spec: str, prefilter: bool, names: tuple[str, ...]) -> None:
        features = {name: getattr(self, name) for name in names}
        expected = reference_oidn(self.color, features, prefilter=prefilter)
        assert torch.equal(denoisers.create(spec, threads=1)(self.color, **features), expected)

    def test_the_three_differ_with_features_and_only_then(self) -> None:
        three = [denoisers.create(spec, threads=1) for spec in MODES]
        accurate, fast, none = (denoise(self.color, self.albedo, self.normal) for denoise in three)
        assert not torch.equal(accurate, fast)
        assert not torch.equal(fast, none)
        accurate, fast, none = (denoise(self.color) for denoise in three)
        assert torch.equal(accurate, fast)
        assert torch.equal(fast, none)

    def test_half_floats_stay_half_floats(self) -> None:
        denoise = denoisers.create("oidn", threads=1)
        albedo, normal = denoise.prefilter(self.albedo.half(), self.normal.half())
        assert isinstance(albedo, torch.Tensor)
        assert isinstance(normal, torch.Tensor)
        assert albedo.dtype == normal.dtype == torch.float16
        torch.testing.assert_close(denoise.prefilter(self.albedo.half().float())[0], albedo.float(), rtol=1e-3, atol=0)

    def test_odd_sizes_are_padded_and_cropped(self) -> None:
        albedo, normal = self.albedo[:37, :41], self.normal[:37, :41]
        clean = denoisers.create("oidn", threads=1).prefilter(albedo, normal)
        mirror = [mirrored(feature, bottom=11, right=7) for feature in (albedo, normal)]
        for result, expected in zip(clean, PrefilteringOidn(1).prefilter(*mirror), strict=True):
            assert isinstance(result, torch.Tensor)
            assert isinstance(expected, torch.Tensor)
            assert torch.equal(result, expected[:37, :41])

    def test_a_frame_prefilters_each_half_and_their_mean_once(self) -> None:
        seen: list[str] = []

        class Counting(PrefilteringOidn):
            def _filtered(self, images: dict[str, torch.Tensor], *, hdr: bool, clean_aux: bool) -> torch.Tensor:
                seen.append(" ".join(images))
                return super()._filtered(images, hdr=hdr, clean_aux=clean_aux)

        denoise = Denoise(Counting(1))
        color = self.color, image(48, 64, 3) * 5
        albedo, normal = (self.albedo, image(48, 64, 4)), (self.normal, image(48, 64, 5) * 2 - 1)
        frame = Frame(color, albedo=albedo, normal=normal).denoise(denoise)
        assert seen == ["albedo", "normal", "color albedo normal"] * 3
        assert frame.denoised is not None
        assert torch.equal(frame.denoised[1], denoise(color[1], albedo[1], normal[1]).clamp(min=0))
        means = ((a + b) / 2 for a, b in (color, albedo, normal))
        torch.testing.assert_close(frame.denoised_full, denoise(*means).clamp(min=0), rtol=1e-5, atol=1e-6)

        seen.clear()
        sub_images = SubImages.of(frame, (color[0], color[0], color[1], color[1]))
        assert sub_images.denoise(frame, denoise).denoised is not None
        assert seen == ["albedo", "normal", *["color albedo normal"] * 2] * 2
        seen.clear()
        Frame(color, albedo=albedo).denoise(denoise)
        assert seen == ["albedo", "color albedo"] * 3
        seen.clear()
        Frame(color).denoise(denoise)
        assert seen == ["color"] * 3

    def test_a_prefilter_that_returns_rubbish_is_refused_by_name(self) -> None:
        class Broken(PrefilteringOidn):
            def prefilter(
                self, albedo: torch.Tensor | None, normal: torch.Tensor | None
            ) -> tuple[torch.Tensor | None, torch.Tensor | None]:
                return None if albedo is None else albedo * torch.nan, normal

        with pytest.raises(DenoiserError, match="denoiser oidn: expected a finite float tensor"):
            Denoise(Broken(1))(self.color, self.albedo)


def python(program: str, *arguments: str) -> str:
    """Return a command line that runs a Python program: placeholders in ``arguments`` are kept."""
    return shlex.join([sys.executable, "-c", program, *arguments])


COPY = "import shutil, sys; shutil.copy(sys.argv[1], sys.argv[2])"
IN_OUT = ("{color}", "{output}")


class TestCommand:
    @pytest.fixture(autouse=True)
    def folder(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        """A folder of temporary files that must be empty again after every test."""
        folder = tmp_path / "temporary files"  # a path with a space in it
        folder.mkdir()
        monkeypatch.setattr(tempfile, "tempdir", str(folder))
        return folder

    @pytest.mark.parametrize("feature", ["color", "albedo", "normal"])
    def test_the_files_hold_the_images(self, tmp_path: Path, feature: str) -> None:
        images = {name: image(5, 8, seed) for seed, name in enumerate(("color", "albedo", "normal"))}
        images["color"] *= 1e5
        keep = tmp_path / "kept.exr"
        program = f"{COPY}; shutil.copy(sys.argv[3], {str(keep)!r})"
        result = Command(python(program, *IN_OUT, f"{{{feature}}}")).denoise(**images)
        assert torch.equal(result, images["color"])
        np.testing.assert_array_equal(stacked(read(keep), "R", "G", "B"), images[feature])
        with OpenEXR.File(str(keep), separate_channels=True) as file:
            assert {str(channel.pixels.dtype) for channel in file.channels().values()} == {"float32"}

    @pytest.mark.parametrize(
        ("albedo", "normal", "expected"),
        [
            (True, True, ["--hdr", "--alb", "albedo", "normal", "-n=normal", "mean", "-o", "output"]),
            (False, True, ["--hdr", "normal", "-n=normal", "mean", "-o", "output"]),
            (True, False, ["--hdr", "--alb", "albedo", "mean", "-o", "output"]),
            (False, False, ["--hdr", "mean", "-o", "output"]),
        ],
    )
    def test_arguments_of_absent_images_are_left_out(
        self, tmp_path: Path, albedo: bool, normal: bool, expected: list[str]
    ) -> None:
        log = tmp_path / "arguments"
        program = (
            "import pathlib, shutil, sys; shutil.copy(sys.argv[1], sys.argv[-1]);"
            f"pathlib.Path({str(log)!r}).write_text(chr(10).join(sys.argv[2:]))"
        )
        line = python(
            program,
            "{color}",
            "--hdr",
            "--alb",
            "{albedo}",
            "{normal}",
            "-n={normal}",
            "mean",
            "-o",
            "{output}",
        )
        Command(line).denoise(image(2, 2), image(2, 2) if albedo else None, image(2, 2) if normal else None)
        seen = [
            f"-n={Path(argument[3:]).stem}" if argument.startswith("-n=") else Path(argument).stem
            for argument in log.read_text().splitlines()
        ]
        assert seen == expected

    def test_features_are_those_it_names(self) -> None:
        assert Command(python(COPY, *IN_OUT)).features == frozenset()
        assert Command(python(COPY, *IN_OUT, "-n={normal}")).features == {"normal"}

    def test_no_shell_reads_the_line(self, tmp_path: Path) -> None:
        victim = tmp_path / "victim"
        line = python(COPY, *IN_OUT, ";", "touch", str(victim), "$HOME", "`id`")
        denoisers.create(f"command:{line}")(image(3, 4))
        assert not victim.exists()

    def test_a_half_float_output_will_do(self) -> None:
        program = (
            "import numpy, OpenEXR, sys; f = OpenEXR.File(sys.argv[1], separate_channels=True);"
            "c = {k: v.pixels.astype(numpy.float16) for k, v in f.channels().items()};"
            "OpenEXR.File({}, c).write(sys.argv[2])"
        )
        result = denoisers.create("command:" + python(program, *IN_OUT))(image(5, 8))
        torch.testing.assert_close(result, image(5, 8), rtol=1e-3, atol=1e-6)

    @pytest.mark.parametrize(
        ("program", "message"),
        [
            ("import sys; sys.exit(3)", "expected exit code 0, but got 3: it printed nothing to stderr"),
            (
                "import sys; sys.exit('first\\nlast words\\n\\n')",
                "expected exit code 0, but got 1: last words$",
            ),
            ("raise ValueError('no GPU')", "but got 1: ValueError: no GPU"),
            ("pass", "as an EXR of 6x4 with R, G, B, but got no file"),
            ("import sys; open(sys.argv[2], 'w').write('text')", "but got a file that cannot be read"),
            (
                "import sys; d = open(sys.argv[1], 'rb').read(); open(sys.argv[2], 'wb').write(d[:-50])",
                "but got a file that cannot be read",
            ),
            (
                "import numpy, OpenEXR, sys; z = numpy.zeros((4, 7), 'f');"
                "OpenEXR.File({}, dict(R=z, G=z, B=z)).write(sys.argv[2])",
                "6x4 with R, G, B, but got 7x4",
            ),
            (
                "import numpy, OpenEXR, sys;OpenEXR.File({}, dict(Y=numpy.zeros((4, 6), 'f'))).write(sys.argv[2])",
                "6x4 with R, G, B, but got the channels Y",
            ),
            (
                "import numpy, OpenEXR, sys; z = numpy.full((4, 6), numpy.nan, 'f');"
                "OpenEXR.File({}, dict(R=z, G=z, B=z)).write(sys.argv[2])",
                "but got 72 of 72 values that are NaN or infinite",
            ),
        ],
    )
    def test_failures_are_one_line_and_leave_nothing(self, folder: Path, program: str, message: str) -> None:
        denoise = denoisers.create("command:" + python(program, *IN_OUT))
        with pytest.raises(DenoiserError, match=message) as caught:
            denoise(image(4, 6))
        assert sys.executable in str(caught.value)
        assert "\n" not in str(caught.value)
        assert list(folder.iterdir()) == []

    def test_success_leaves_nothing(self, folder: Path) -> None:
        denoisers.create("command:" + python(COPY, *IN_OUT))(image(4, 6))
        assert list(folder.iterdir()) == []

    def test_a_program_that_cannot_be_started(self, tmp_path: Path) -> None:
        program = tmp_path / "program"
        program.write_text("neither a script nor a binary")
        program.chmod(0o755)
        with pytest.raises(DenoiserError, match="program: Exec format error"):
            denoisers.create(f"command:{program} {{color}} {{output}}")(image(4, 6))

    @pytest.mark.parametrize(
        ("line", "message"),
        [
            ("python {color}", r"expected a placeholder \{output\}, but got 'python \{color\}'"),
            ("python {output}", r"expected a placeholder \{color\}"),
            ("python {color} {depth} {output}", r"of \{color\}, .*\{output\}, but got \{depth\}"),
            ("no-such-program {color} {output}", "no-such-program: expected a program, but found none"),
            ("python '{color} {output}", "expected a command line, but got .*No closing quotation"),
            ("  ", "expected a program and its arguments, but got nothing"),
        ],
    )
    def test_a_bad_line_is_refused_at_once(self, line: str, message: str) -> None:
        with pytest.raises(DenoiserError, match=message):
            denoisers.create(f"command:{line}")


GOOD = """
class Twice:
    name = "twice"
    features = {"normal"}
    def denoise(self, color, albedo, normal):
        return 2 * color
"""


class TestUser:
    def test_the_least_a_class_needs(self, tmp_path: Path) -> None:
        path = tmp_path / "mine.py"
        path.write_text(GOOD)
        denoise = denoisers.create(f"{path}:Twice")
        assert (denoise.name, denoise.multiple, denoise.features) == ("twice", 1, {"normal"})
        assert torch.equal(denoise(image(3, 4)), 2 * image(3, 4))

    def test_the_file_is_read_anew_each_time(self, tmp_path: Path) -> None:
        path = tmp_path / "mine.py"
        path.write_text(GOOD)
        denoisers.create(f"{path}:Twice")
        path.write_text(GOOD.replace("2 * color", "-30 * color"))
        assert torch.equal(denoisers.create(f"{path}:Twice")(image(3, 4)), -30 * image(3, 4))

    @pytest.mark.parametrize(
        ("source", "message"),
        [
            ("def", r"mine\.py: expected Python that can be imported, but got: .*line 1"),
            ("import no_such_module", r"mine\.py: .*but got: No module named 'no_such_module'"),
            ("import pathlib\nclass Other: pass\nclass Third: pass", "a class Twice, but got Other, Third$"),
            ("from pathlib import Path", "expected a class Twice, but got no class$"),
            ("Twice = 3", "expected a class Twice, but got no class$"),
            ("class Twice: pass", r"mine\.py:Twice: expected a method denoise\("),
            (GOOD + "    def __init__(self, x): pass", "needs no arguments, but got: missing .* 'x'"),
            (GOOD.replace("name", "title"), "expected an attribute name, a string, but got None"),
            (GOOD.replace("features", "needs"), "expected an attribute features, .* but got None"),
            (GOOD.replace('"normal"', '"depth"'), r"expected an attribute features, .* but got \{'depth'\}"),
            (GOOD + "    multiple = 0", "expected an attribute multiple, an integer from 1, but got 0"),
        ],
    )
    def test_what_does_not_fit_is_said(self, tmp_path: Path, source: str, message: str) -> None:
        path = tmp_path / "mine.py"
        path.write_text(source)
        with pytest.raises(DenoiserError, match=message):
            denoisers.create(f"{path}:Twice")

    def test_no_file(self, tmp_path: Path) -> None:
        with pytest.raises(FileError, match=r"none\.py: expected a Python file with the class X, but found no"):
            denoisers.create(f"{tmp_path}/none.py:X")

    def test_errors_of_the_class_itself_keep_their_traceback(self, tmp_path: Path) -> None:
        path = tmp_path / "mine.py"
        path.write_text(GOOD.replace("return 2 * color", "return {}[3]"))
        with pytest.raises(KeyError):
            denoisers.create(f"{path}:Twice")(image(3, 4))


@pytest.mark.shared
@pytest.mark.parametrize("name", ["bathroom", "classroom", "dining-room", "living-room-2", "staircase"])
@pytest.mark.parametrize(
    # Measured at worst: OIDN leaves 0.25 of the noisy relMSE (staircase) and moves 1.5 % of the light
    # (classroom), joint-bilateral 0.86 (bathroom) and 0.3 % (classroom).
    ("spec", "most", "light"),
    [("oidn", 0.3, 0.02), ("joint-bilateral", 0.9, 0.005)],
)
def test_real_frames(shared: Path, name: str, spec: str, most: float, light: float) -> None:
    halves = [read(shared / "frames" / f"{name}_064spp_{half}.exr") for half in "AB"]
    frame = {channel: (halves[0][channel] + halves[1][channel]) / 2 for channel in halves[0]}
    references = [stacked(read(shared / "frames" / f"{name}_ref_{half}.exr"), *"RGB") for half in "AB"]
    smooth = stacked(read(shared / "frames" / f"{name}_ref_smooth.exr"), *"RGB")

    def relative_error(x: Array) -> float:
        weight = smooth.mean(2, keepdims=True) ** 2 + 0.01
        return float(((x - references[0]) * (x - references[1]) / weight).mean(dtype=np.float64))

    color = stacked(frame, *"RGB")
    albedo = stacked(frame, "albedo.R", "albedo.G", "albedo.B")
    normal = stacked(frame, "nn.X", "nn.Y", "nn.Z")
    result = denoisers.create(spec)(color, albedo, normal)
    assert relative_error(result) < most * relative_error(color)
    assert abs(result.mean() / color.mean() - 1) < light
