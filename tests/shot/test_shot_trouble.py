"""Everything that can happen to the run of a shot: inputs that are missing, full disks, kills, company."""

import multiprocessing
import random
import resource
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers.commands import write_half
from helpers.shots import LAST, Run, arguments, outputs, write_shot

from selfcorrect import cli, exr


def test_a_truncated_or_missing_frame_is_reported_and_the_rest_go_on(shot_folder: Path, sequence: Run) -> None:
    whole = (shot_folder / "a.0002.exr").read_bytes()
    (shot_folder / "a.0002.exr").write_bytes(whole[: len(whole) // 2])  # a renderer is still writing it
    (shot_folder / "b.0004.exr").unlink()
    code, log, frames = sequence(arguments(shot_folder))
    assert code == 1
    assert [(f["frame"], f["outcome"]) for f in frames] == [
        (1, "written"),
        (2, "failed"),
        (3, "written"),
        (4, "failed"),
        (5, "written"),
    ]
    assert "a.0002.exr: expected" in frames[1]["reason"]
    assert "b.0004.exr" in frames[3]["reason"]
    assert "selfcorrect: 2 of 5 frames failed" in log
    (shot_folder / "a.0002.exr").write_bytes(whole)
    write_half(shot_folder / "b.0004.exr", 41)
    code, _, frames = sequence(arguments(shot_folder, "--skip-existing"))
    assert code == 0
    assert [f["outcome"] for f in frames] == ["written"] * LAST  # what had been left out is a neighbour of all


def test_without_history_a_frame_that_comes_late_changes_no_other(shot_folder: Path, sequence: Run) -> None:
    whole = (shot_folder / "a.0002.exr").read_bytes()
    (shot_folder / "a.0002.exr").write_bytes(whole[: len(whole) // 2])
    assert sequence(arguments(shot_folder, "--frame-radius", 0))[0] == 1
    (shot_folder / "a.0002.exr").write_bytes(whole)
    code, _, frames = sequence(arguments(shot_folder, "--frame-radius", 0, "--skip-existing"))
    assert code == 0
    assert [f["outcome"] for f in frames] == ["skipped", "written", "skipped", "skipped", "skipped"]


def test_fail_fast_ends_with_the_first_failure(shot_folder: Path, sequence: Run) -> None:
    (shot_folder / "a.0002.exr").write_bytes(b"")
    code, _, frames = sequence(arguments(shot_folder, "--fail-fast"))
    assert code == 1
    assert [f["outcome"] for f in frames] == ["written", "failed"]
    assert set(outputs(shot_folder / "out")) == {"x.0001.exr"}


def test_a_full_disk_leaves_what_was_there(shot_folder: Path) -> None:
    """The system lets the process write no file as large as an output."""
    (shot_folder / "out").mkdir()
    (shot_folder / "out" / "x.0001.exr").write_bytes(b"an older output")
    command = [sys.executable, "-m", "selfcorrect", *arguments(shot_folder, last=2)]
    limit = (4096, 4096)
    result = subprocess.run(
        command,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, limit),
    )
    assert result.returncode == 1, result.stderr
    assert result.stderr.count("File too large") == 2
    assert [p.name for p in (shot_folder / "out").iterdir()] == ["x.0001.exr"]
    assert (shot_folder / "out" / "x.0001.exr").read_bytes() == b"an older output"


def test_a_folder_that_cannot_be_written_to(shot_folder: Path, sequence: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests may run as root, who may write anywhere: the system's answer is the one part that is made up."""
    monkeypatch.setattr("os.access", lambda *_: False)
    code, log, _ = sequence(arguments(shot_folder))
    assert code == 2
    assert "is read-only" in log


def test_two_processes_on_one_shot(shot_folder: Path) -> None:
    given = [sys.executable, "-m", "selfcorrect"]
    both = [subprocess.Popen([*given, *arguments(shot_folder)], stderr=subprocess.PIPE) for _ in range(2)]
    for process in both:
        _, log = process.communicate(timeout=300)
        assert process.returncode == 0, log.decode()
    assert cli.main(arguments(shot_folder, out="alone")) == 0
    assert outputs(shot_folder / "out") == outputs(shot_folder / "alone")
    assert len(list((shot_folder / "out").iterdir())) == LAST


def test_killed_at_any_moment(tmp_path: Path) -> None:
    """Fifty processes are killed; no file with a final name is ever half-written, and the shot is finished in the end.

    The processes run the command from a fork server that has imported it, since they would otherwise spend all
    their life with that.
    """
    last, rng = 6, random.Random(1)
    shot_folder = write_shot(tmp_path, last)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["selfcorrect.cli", "torch._dynamo"])  # the latter is imported by the first step

    def started(out: str) -> multiprocessing.process.BaseProcess:
        state = ["--save-state", shot_folder / out / "state.####.safetensors"]
        given = arguments(shot_folder, *state, "--skip-existing", last=last, out=out)
        process = context.Process(target=cli.main, args=(given,))
        process.start()
        return process

    started("warm-up").join()  # the server imports the command
    begin = time.perf_counter()
    started("undisturbed").join()
    whole = time.perf_counter() - begin
    undisturbed = outputs(shot_folder / "undisturbed")
    assert len(undisturbed) == last

    checked: set[tuple[Path, int]] = set()
    kills = 0
    while kills < 50:
        process = started("out")
        process.join(rng.uniform(0, whole))
        if process.exitcode is None:
            process.kill()
            kills += 1
        process.join()
        there = {(path, path.stat().st_mtime_ns) for path in (shot_folder / "out").glob("*.exr")}
        for path, _ in there - checked:
            exr.read(path)
            assert path.read_bytes() == undisturbed[path.name]
        checked |= there
        if len(there) == last:  # once more from the start
            for path in [*(shot_folder / "out").glob("*.exr"), *(shot_folder / "out").glob("state.*")]:
                path.unlink()
    started("out").join()
    assert outputs(shot_folder / "out") == undisturbed
    assert not list(shot_folder.rglob("*tmp*"))
    assert len(checked) > last  # the kills did not all come before the first frame
