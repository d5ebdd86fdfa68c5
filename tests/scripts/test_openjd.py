"""The render farm: the job template runs in openjd's own scheduler, over the real command."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import write_half
from helpers.render_scripts import CHECKOUT

from selfcorrect import exr

TEMPLATE = CHECKOUT / "scripts" / "openjd" / "selfcorrect.yaml"
FLAGS = "--steps 4 --patch 16 --batch 2 --window 5 --threads 1"


def openjd(*arguments: object) -> subprocess.CompletedProcess[str]:
    """The command `openjd`, with this environment's `python` and `selfcorrect` on PATH."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    command = [sys.executable, "-c", "from openjd.cli import main; main()", *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=600, env=os.environ | {"PATH": path}
    )


def run(folder: Path, **parameters: object) -> tuple[int, str]:
    """Run the whole job; its exit code and what it said."""
    named = {"HalvesDir": folder / "halves", "OutputDir": folder / "out", "MoreFlags": FLAGS, "Denoiser": "box"}
    given = [text for name, value in (named | parameters).items() for text in ("-p", f"{name}={value}")]
    result = openjd("run", TEMPLATE, "--step", "Correct", *given)
    return result.returncode, result.stdout + result.stderr


def written(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in sorted((folder / "out").iterdir())}


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    """Five frames."""
    (tmp_path / "halves").mkdir()
    for frame in range(1, 6):
        for number, half in enumerate("ab"):
            write_half(tmp_path / "halves" / f"shot_{half}.{frame:04d}.exr", 10 * frame + number)
    return tmp_path


def test_the_template_is_valid() -> None:
    result = openjd("check", TEMPLATE)
    assert result.returncode == 0, result.stdout
    assert "passes validation checks" in result.stdout


def test_chunks_fail_and_go_on(shot: Path) -> None:
    """Chunks 1-2, 3-4, 5-5; half b of frame 4 arrives truncated, and whole later."""
    late = shot / "halves" / "shot_b.0004.exr"
    whole = late.read_bytes()
    late.write_bytes(whole[: len(whole) // 2])
    code, said = run(shot, Frames="1-5", ChunkSize=2)
    assert code != 0
    assert re.findall(r"openjd_status: (.*)", said) == [
        "frames 1-2",
        "frame 1 written",
        "frame 2 written",
        "frames 3-4",
        "frame 3 written",
        "frame 4 failed",
    ]
    assert re.findall(r"openjd_progress: (.*)", said) == ["50.0", "100.0", "50.0", "100.0"]
    (reason,) = re.findall(r"openjd_fail: (.*)", said)
    assert reason.startswith("frame 4: ")
    assert "shot_b.0004.exr: expected" in reason
    assert list(written(shot)) == ["shot.0001.exr", "shot.0002.exr", "shot.0003.exr"]

    late.write_bytes(whole)
    code, said = run(shot, Frames="1-5", ChunkSize=2)
    assert code == 0, said
    assert re.findall(r"openjd_status: frame (.*)", said) == [
        f"{frame} written"  # frame 4 is a neighbour's neighbour of all
        for frame in range(1, 6)
    ]
    assert "openjd_fail" not in said
    assert list(written(shot)) == [f"shot.{frame:04d}.exr" for frame in range(1, 6)]
    code, said = run(shot, Frames="1-5", ChunkSize=2)
    assert code == 0, said
    assert re.findall(r"openjd_status: frame (.*)", said) == [f"{frame} skipped" for frame in range(1, 6)]


def test_a_key_frame_makes_every_chunk_start_warm(shot: Path) -> None:
    halves = [str(shot / "halves" / f"shot_{half}.####.exr") for half in "ab"]
    state = shot / "halves" / "key.safetensors"
    key = [*halves, "-o", str(shot / "key.####.exr"), "--frames", "3", "--save-state", str(state), "--denoiser", "box"]
    subprocess.run([sys.executable, "-m", "selfcorrect", "sequence", *key, *FLAGS.split()], check=True, timeout=300)
    code, said = run(shot, Frames="1-2", ChunkSize=2, WarmStart=state.name)
    assert code == 0, said
    assert said.count("loss before training") == 2  # it is told of every frame that was offered a network


def test_chunks_change_nothing_but_where_a_chain_starts(shot: Path) -> None:
    images = {}
    for size in (2, 4):
        code, said = run(shot, Frames="1-4", ChunkSize=size, OutputDir=shot / f"by{size}")
        assert code == 0, said
        assert said.count("loss before training") == 4 - 4 // size
        files = [shot / f"by{size}" / f"shot.{frame:04d}.exr" for frame in (1, 2)]
        images[size] = np.stack([exr.load_half(path).buffers["color"] for path in files])
    assert np.array_equal(images[2], images[4])


def test_a_wrong_flag_fails_with_its_line(shot: Path) -> None:
    code, said = run(shot, Frames="1-2", MoreFlags="--stepps 4")
    assert code != 0
    assert re.search(r"openjd_fail: unrecognized arguments: --stepps", said)


@pytest.mark.parametrize(
    ("parameter", "value"),
    [("HalfA", "../away.####.exr"), ("Output", "../x.####.exr"), ("Output", "/tmp/x.####.exr"), ("WarmStart", "../s")],
)
def test_names_stay_in_their_folders(shot: Path, parameter: str, value: str) -> None:
    code, said = run(shot, Frames="1-1", **{parameter: value})
    assert code != 0
    (reason,) = re.findall(r"openjd_fail: (.*)", said)
    assert reason.startswith(f"{parameter}: expected a name inside {shot}")
    assert "Traceback" not in said


def test_an_unbalanced_quote_is_one_line(shot: Path) -> None:
    code, said = run(shot, Frames="1-1", MoreFlags="--steps '4")
    assert code != 0
    assert re.search(r"openjd_fail: MoreFlags: expected flags .* No closing quotation", said)
    assert "Traceback" not in said
