"""What is particular to denoisers from outside: a command line, and a user's class."""

import shlex
import sys
import tempfile
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
from helpers.images import image, read, stacked

import denoisers
from denoisers.command import Command
from selfcorrect.errors import DenoiserError, FileError


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
        with pytest.raises(DenoiserError, match="program: expected a program to run, but got: Exec format error"):
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
