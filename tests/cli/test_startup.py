"""Help, the version and wrong flags do not wait for torch; what the package shows is there all the same."""

import resource
import subprocess
import sys
from types import FunctionType

import pytest

SLOW = ("torch", "numpy", "OpenEXR", "kornia", "tqdm")
SECONDS = 1.0  # of processor time; 0.2 here where torch alone takes 3.5


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["--help"], 0),
        (["--version"], 0),
        (["frame", "--help"], 0),
        (["frame", "--help-all"], 0),
        (["sequence", "--help"], 0),
        (["settings"], 0),
        (["completion", "bash"], 0),
        ([], 2),
        (["nonsense"], 2),
        (["frame", "a.exr", "b.exr", "--nonsense"], 2),
        (["frame", "a.exr", "b.exr", "--window", "x"], 2),
        (["frame", "a.exr", "b.exr"], 2),
        (["frame", "a.exr", "b.exr", "-o", "out.exr", "--window", "8"], 2),
        (["frame", "a.exr", "b.exr", "-o", "out.exr", "--set", "nonsense=1"], 2),
        (["frame", "a.exr", "b.exr", "-o", "out.exr", "--threads", "0"], 2),
        (["frame", "a.exr", "b.exr", "-o", "out.exr", "--map", "albedo"], 2),
        (["frame", "a.exr", "b.exr", "-o", "out.exr", "--stages", "core,deep-combiner-4"], 2),
        (["bench", "a.exr", "b.exr", "--preset", "nonsense"], 2),
        (["sequence", "a.#.exr", "b.#.exr", "-o", "o.#.exr", "--frames", "1-2", "--preset", "nonsense"], 2),
    ],
)
def test_nothing_slow_is_imported(arguments: list[str], code: int) -> None:
    script = f"""
import sys
from selfcorrect import cli
try:
    code = cli.main({arguments!r})
except SystemExit as end:
    code = end.code or 0
there = [name for name in {SLOW!r} if name in sys.modules]
sys.exit("imported: " + ", ".join(there) if there else code)
"""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert ran.returncode == code, ran.stderr
    assert (ran.stdout == "") == (code == 2)
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < SECONDS


def test_what_the_package_shows_is_there_in_any_order() -> None:
    """The function ``correct``, not the module of its name, which any import leaves in the package."""
    script = """
import selfcorrect
import selfcorrect.correct
import selfcorrect.cli.runner
from selfcorrect import correct
print(type(correct).__name__, *(getattr(selfcorrect, name).__name__ for name in selfcorrect.__all__))
"""
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    import selfcorrect

    assert ran.stdout.split() == [FunctionType.__name__, *selfcorrect.__all__]


def test_other_names_are_no_attributes() -> None:
    import denoisers
    import selfcorrect

    unknown = "nonsense"
    for module in (selfcorrect, denoisers):
        with pytest.raises(AttributeError, match=unknown):
            getattr(module, unknown)
