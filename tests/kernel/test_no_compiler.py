"""Without the compiled kernels, in processes that cannot import them: everything runs by the reference, and says so."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.commands import BALANCED, write_half

from selfcorrect.exr import load_half

HIDDEN = "import sys; sys.modules['selfcorrect.kernel._cpu'] = None\n"
CORRECT = """
import json, warnings
import torch
import denoisers
from selfcorrect import Frame, Settings, correct
from selfcorrect.kernel import backend

torch.set_num_threads(1)
generator = torch.Generator().manual_seed(3)
truth = torch.linspace(0.1, 1, 40 * 36 * 3).view(40, 36, 3)
color = tuple(truth + 0.2 * torch.rand(40, 36, 3, generator=generator) for _ in "ab")
albedo = tuple((truth * 0.5).clone() for _ in "ab")
found = {"sets": backend.instruction_sets()}
frame = Frame(color=color, albedo=albedo).denoise(denoisers.create("box"))
settings = Settings.preset("fast", steps=2, window=5, batch=2, patch=16)
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("default")
    images = [correct(frame, settings).image for _ in "12"]
found["warnings"] = [f"{each.category.__name__}: {each.message}" for each in caught]
found["same"] = torch.equal(*images)
found["image"] = images[0].flatten().tolist()
small = Frame(color=tuple(image[:12, :14] for image in color), albedo=tuple(image[:12, :14] for image in albedo))
for name in ("nlm", "nfor"):
    found[name] = small.denoise(denoisers.create(name)).denoised_full.flatten().tolist()
with_regression = Settings.preset("fast", stages="regression")
found["regression"] = correct(small.denoise(denoisers.create("box")), with_regression).image.flatten().tolist()
print(json.dumps(found))
"""


def run(source: str, *arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", source, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder, timeout=300)


def test_the_same_image_and_one_warning(tmp_path: Path) -> None:
    with_kernels, without = (run(start + CORRECT, folder=tmp_path) for start in ("", HIDDEN))
    assert with_kernels.returncode == 0, with_kernels.stderr
    assert without.returncode == 0, without.stderr
    fast, slow = (json.loads(result.stdout) for result in (with_kernels, without))
    assert (fast["sets"][0], slow["sets"]) == ("baseline", [])
    assert fast["warnings"] == []
    assert len(slow["warnings"]) == 1
    assert "MissingKernelsWarning: the compiled kernels are not installed" in slow["warnings"][0]
    assert "about 30 times slower" in slow["warnings"][0]
    assert slow["same"]
    for name in ("image", "nlm", "nfor", "regression"):
        assert slow[name] == pytest.approx(fast[name], rel=2e-5), name  # 4e-6


COMMAND = "import selfcorrect.cli; sys.exit(selfcorrect.cli.main(sys.argv[1:]))"


def test_the_command_tells_once(tmp_path: Path) -> None:
    """Before it begins, and though two denoisers and every step would have a reason to."""
    a, b = write_half(tmp_path / "a.exr", 1), write_half(tmp_path / "b.exr", 2)
    outputs = []
    for name, start in (("compiled", "import sys\n"), ("torch", HIDDEN)):
        outputs.append(str(tmp_path / f"{name}.exr"))
        result = run(start + COMMAND, "frame", str(a), str(b), "-o", outputs[-1], *BALANCED, folder=tmp_path)
        assert result.returncode == 0, result.stderr
        told = [line for line in result.stderr.splitlines() if "compiled kernels are not installed" in line]
        assert len(told) == (name == "torch"), result.stderr
    assert told[0].startswith("warning: ")
    assert "pip install --force-reinstall --no-deps ." in told[0]
    assert f"Python reads the sources in {Path(__file__).parents[2]}: start it elsewhere" in told[0]
    one, other = (load_half(Path(path)).buffers["color"] for path in outputs)
    assert float(abs(one - other).max()) < 2e-3 * float(one.mean())  # half floats


def test_asked_for_by_name(tmp_path: Path) -> None:
    """Choosing the compiled form by name is one clear line."""
    source = (
        "import torch; from selfcorrect.kernel.backend import choose; from selfcorrect.errors import SettingsError\n"
        "try: choose('cpu', [torch.zeros(1)])\nexcept SettingsError as error: print(error)"
    )
    told = run(HIDDEN + source, folder=tmp_path).stdout
    assert told.startswith("expected the compiled kernels for the backend cpu, but got none: the compiled kernels")
