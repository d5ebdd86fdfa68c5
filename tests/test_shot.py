"""Shots: the chain, skipping and resuming, and everything that can happen to a run."""

import fcntl
import json
import multiprocessing
import random
import resource
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.commands import write_half

from selfcorrect import Settings, cli, exr, files, shot
from selfcorrect.network import Network
from selfcorrect.publish import publish, remove_abandoned

FAST = [
    "--steps",
    "3",
    "--warm-steps",
    "3",
    "--patch",
    "16",
    "--batch",
    "2",
    "--window",
    "5",
    "--denoiser",
    "box",
    "--threads",
    "1",
]
LAST = 5
Run = Callable[..., tuple[int, str, list[dict[str, Any]]]]


def write_shot(folder: Path, last: int = LAST, **extra: Any) -> Path:
    for n in range(1, last + 1):
        for i, half in enumerate("ab"):
            write_half(folder / f"{half}.{n:04d}.exr", 10 * n + i, **extra)
    return folder


def arguments(folder: Path, *more: object, last: int = LAST, out: str = "out") -> list[str]:
    """The command's arguments; the shot lies in ``folder``, the outputs in a folder of it."""
    (folder / out).mkdir(exist_ok=True)
    names = [str(folder / "a.####.exr"), str(folder / "b.%04d.exr"), "-o", str(folder / out / "x.####.exr")]
    return ["sequence", *names, "--frames", f"1-{last}", *FAST, *map(str, more)]


def outputs(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.exr"))}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_shot(tmp_path)


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str]) -> Run:
    """The command in this process: exit code, stderr, and the JSON objects of stdout."""

    def one(given: list[str]) -> tuple[int, str, list[dict[str, Any]]]:
        capfd.readouterr()
        code = cli.main([*given, "--json"])
        out, err = capfd.readouterr()
        return code, err, [json.loads(line) for line in out.splitlines()]

    return one


def test_a_shot_starts_cold_and_goes_on_warm(folder: Path, run: Run) -> None:
    code, log, frames = run(arguments(folder))
    assert code == 0
    assert [f["frame"] for f in frames] == [1, 2, 3, 4, 5]
    assert [f["outcome"] for f in frames] == ["written"] * LAST
    assert [f["start"]["warm"] for f in frames] == [f["start"]["warm_loss"] is not None for f in frames]
    assert "frame 1: started cold" in log
    assert "frame 2: started warm (loss before training" in log
    # each frame's line has come through, although a file was being read meanwhile
    assert [f"x.{n:04d}.exr: written after" in log for n in range(1, LAST + 1)] == [True] * LAST
    attribute = exr.read(folder / "out" / "x.0003.exr").parts[0].header["selfcorrect/run"]
    assert json.loads(attribute)["recipe"] == frames[2]["recipe"]
    assert json.loads(attribute)["frame"] == 3


def test_warm_settings_are_those_of_warm_frames(folder: Path, run: Run) -> None:
    _, _, frames = run(arguments(folder, "--warm-steps", 2, last=3))
    assert [f["steps"] for f in frames] == [3, 2, 2]
    assert [f["start"]["warm"] for f in frames] == [False, True, True]
    _, _, frames = run(arguments(folder, "--warm-steps", 2, "--cold", last=3))
    assert [f["steps"] for f in frames] == [3, 3, 3]


def test_after_a_cut_nothing_depends_on_what_was_before(folder: Path, run: Run) -> None:
    """Frames 1 and 2 are of another scene, and what their network has learned is wrong for the third."""
    for n in (1, 2):  # another scene: bright stripes where the denoised image is flat
        for i, half in enumerate("ab"):
            stripes = np.zeros((24, 30), np.float16)
            stripes[:, ::2] = 8
            noise = np.random.default_rng(99 + 10 * n + i).random((24, 30)).astype(np.float16)
            write_half(folder / f"{half}.{n:04d}.exr", 10 * n + i, **dict.fromkeys("RGB", stripes + noise))
    more = ["--steps", 30, "--learning-rate", 0.01]
    _, log, frames = run(arguments(folder, *more))
    assert frames[1]["start"]["warm"]
    assert not frames[2]["start"]["warm"]
    assert "frame 3: did not look like the frame before: started cold" in log
    alone = [a if a != "1-5" else "3-5" for a in arguments(folder, *more, out="alone")]
    assert run(alone)[0] == 0
    one, two = outputs(folder / "out"), outputs(folder / "alone")
    for name in two:
        np.testing.assert_array_equal(
            exr.read(folder / "out" / name).pixels("R"), exr.read(folder / "alone" / name).pixels("R")
        )
    assert one["x.0004.exr"] == two["x.0004.exr"]


def test_a_truncated_or_missing_frame_is_reported_and_the_rest_go_on(folder: Path, run: Run) -> None:
    whole = (folder / "a.0002.exr").read_bytes()
    (folder / "a.0002.exr").write_bytes(whole[: len(whole) // 2])  # a renderer is still writing it
    (folder / "b.0004.exr").unlink()
    code, log, frames = run(arguments(folder))
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
    (folder / "a.0002.exr").write_bytes(whole)
    write_half(folder / "b.0004.exr", 41)
    code, _, frames = run(arguments(folder, "--skip-existing"))
    assert code == 0
    assert [f["outcome"] for f in frames] == ["skipped", "written", "skipped", "written", "skipped"]


def test_fail_fast_ends_with_the_first_failure(folder: Path, run: Run) -> None:
    (folder / "a.0002.exr").write_bytes(b"")
    code, _, frames = run(arguments(folder, "--fail-fast"))
    assert code == 1
    assert [f["outcome"] for f in frames] == ["written", "failed"]
    assert set(outputs(folder / "out")) == {"x.0001.exr"}


class TestSkipExisting:
    """What is there, whole, and made the same way is left alone; all else is made again."""

    def test_nothing_is_left_to_do(self, folder: Path, run: Run) -> None:
        run(arguments(folder))
        before = {p.name: p.stat().st_mtime_ns for p in (folder / "out").iterdir()}
        code, _, frames = run(arguments(folder, "--skip-existing"))
        assert code == 0
        assert {f["outcome"] for f in frames} == {"skipped"}
        assert {p.name: p.stat().st_mtime_ns for p in (folder / "out").iterdir()} == before

    @pytest.mark.parametrize("harm", ["truncated", "foreign", "input", "setting"])
    def test_what_is_not_the_same_is_made_again(self, folder: Path, run: Run, harm: str) -> None:
        run(arguments(folder, last=3))
        target, more = folder / "out" / "x.0002.exr", []
        match harm:
            case "truncated":
                target.write_bytes(target.read_bytes()[:-100])
            case "foreign":
                target.write_bytes((folder / "a.0001.exr").read_bytes())
            case "input":
                write_half(folder / "b.0002.exr", 777)
            case "setting":
                more = ["--seed", "5"]
        code, log, frames = run(arguments(folder, "--skip-existing", *more, last=3))
        assert code == 0
        expected = ["written"] * 3 if harm == "setting" else ["skipped", "written", "skipped"]
        assert [f["outcome"] for f in frames] == expected
        assert "frame 2: " in log
        assert "it is made again" in log
        exr.read(target)

    def test_with_states_the_chain_goes_on_where_it_ended(self, folder: Path, run: Run) -> None:
        states = ["--save-state", folder / "state.####.safetensors"]
        run(arguments(folder, *states))
        undisturbed = outputs(folder / "out")
        for n in (3, 5):
            (folder / "out" / f"x.{n:04d}.exr").unlink()
        _, log, frames = run(arguments(folder, *states, "--skip-existing"))
        assert [f["outcome"] for f in frames] == ["skipped", "skipped", "written", "skipped", "written"]
        assert "frame 3: frame 2 was there and goes on from its state" in log
        assert outputs(folder / "out") == undisturbed

    def test_without_states_the_next_frame_starts_cold(self, folder: Path, run: Run) -> None:
        run(arguments(folder))
        (folder / "out" / "x.0003.exr").unlink()
        _, _, frames = run(arguments(folder, "--skip-existing"))
        assert frames[2]["start"]["warm_loss"] is None

    def test_a_state_of_another_making_is_not_gone_on_from(self, folder: Path, run: Run) -> None:
        state = ["--save-state", folder / "state.safetensors"]
        run(arguments(folder, *state, last=2))
        write_half(folder / "b.0002.exr", 777)
        run(arguments(folder, "--skip-existing", last=2))  # frame 2 anew, without its state
        _, _, frames = run(arguments(folder, *state, "--skip-existing", last=3))
        assert [f["outcome"] for f in frames] == ["skipped", "skipped", "written"]
        assert frames[2]["start"]["warm_loss"] is None


class TestState:
    """A state makes a chunk's first frame warm, and is refused where it does not fit."""

    @pytest.fixture
    def state(self, folder: Path, run: Run) -> Path:
        path = folder / "state.safetensors"
        assert run(arguments(folder, "--save-state", path, last=1))[0] == 0
        return path

    def test_chunks_make_what_the_whole_makes(self, folder: Path, run: Run, state: Path) -> None:
        run(arguments(folder, last=3))
        chunk = [a if a != "1-3" else "2-3" for a in arguments(folder, "--warm-start", state, last=3, out="chunk")]
        assert run(chunk)[0] == 0
        chunks, whole = outputs(folder / "chunk"), outputs(folder / "out")
        assert chunks == {name: whole[name] for name in ("x.0002.exr", "x.0003.exr")}

    def test_cold_from_a_state_knows_no_chunks(self, folder: Path, run: Run, state: Path) -> None:
        key = ["--cold", "--warm-start", state]
        run(arguments(folder, *key, last=3))
        run([a if a != "1-3" else "3-3" for a in arguments(folder, *key, last=3, out="chunk")])
        assert outputs(folder / "chunk")["x.0003.exr"] == outputs(folder / "out")["x.0003.exr"]

    @pytest.mark.parametrize(
        ("flags", "reason"),
        [
            (["--window", "7"], "window 7, but got one with 5"),
            (["--no-log-radiance"], "log_radiance False"),
            (["--combination", "eq3"], "combination eq3"),
            (["--input-scale", "1"], "input_scale 1"),
        ],
    )
    def test_other_settings(self, folder: Path, run: Run, state: Path, flags: list[str], reason: str) -> None:
        code, log, _ = run(arguments(folder, "--warm-start", state, *flags))
        assert code == 2
        assert f"selfcorrect: error: {state}: " in log
        assert reason in log

    def test_other_buffers(self, folder: Path, run: Run, state: Path) -> None:
        none = dict.fromkeys(["albedo.R", "albedo.G", "albedo.B"])
        write_shot(folder, 2, **none)
        code, log, _ = run(arguments(folder, "--warm-start", state, last=2))
        assert code == 1
        assert "buffers color+normal+denoised, but got one with color+albedo+normal+denoised" in log

    def test_a_damaged_one(self, folder: Path, run: Run, state: Path) -> None:
        data = bytearray(state.read_bytes())
        for harmed, reason in (
            (data[:-7], "intact state"),
            (data[:-5] + b"\x01" + data[-4:], "checksum"),
            (b"", "intact state"),
        ):
            state.write_bytes(harmed)
            code, log, _ = run(arguments(folder, "--warm-start", state))
            assert code == 2
            assert reason in log
        state.unlink()
        assert run(arguments(folder, "--warm-start", state))[0] == 2

    def test_other_buffers_within_a_shot_start_cold(self, folder: Path, run: Run) -> None:
        for half, seed in (("a", 20), ("b", 21)):
            write_half(folder / f"{half}.0002.exr", seed, **dict.fromkeys(["albedo.R", "albedo.G", "albedo.B"]))
        code, log, _ = run(arguments(folder, last=3))
        assert code == 0
        assert "frame 2: other buffers than the frame before: starts cold" in log


class TestRefused:
    """Before any work, in one line, with exit code 2."""

    @pytest.mark.parametrize(
        ("change", "reason"),
        [
            ({"a.####.exr": "a.0001.exr"}, "a place for the frame number"),
            ({"x.####.exr": "x.exr"}, "a place for the frame number"),
            ({"1-5": "5-1"}, "rising order"),
            ({"out": "nowhere"}, "create it first"),
            ({"out/x.####.exr": "a.####.exr"}, "apart from the inputs"),
        ],
    )
    def test_names_and_ranges(self, folder: Path, run: Run, change: dict[str, str], reason: str) -> None:
        given = arguments(folder)
        for old, new in change.items():
            given = [new if a == old else a.replace(f"/{old}", f"/{new}") for a in given]
        code, log, _ = run(given)
        assert code == 2
        assert reason in log.splitlines()[-1]

    def test_a_state_that_cannot_be_written(self, folder: Path, run: Run) -> None:
        assert run(arguments(folder, "--save-state", folder / "state.pt"))[0] == 2
        assert run(arguments(folder, "--save-state", folder / "no" / "s.safetensors"))[0] == 2


def test_given_denoised_halves(folder: Path, run: Run) -> None:
    given = arguments(folder, last=2)
    i = given.index("--denoiser")
    del given[i : i + 2]
    names = [folder / "a.####.exr", folder / "b.####.exr", folder / "a.####.exr"]
    flags = zip(("--denoised-a", "--denoised-b", "--denoised-full"), map(str, names), strict=True)
    code, _, frames = run([*given, *(x for pair in flags for x in pair)])
    assert code == 0
    assert {f["denoiser"] for f in frames} == {"given"}


def test_a_full_disk_leaves_what_was_there(folder: Path) -> None:
    """The system lets the process write no file as large as an output."""
    (folder / "out").mkdir()
    (folder / "out" / "x.0001.exr").write_bytes(b"an older output")
    command = [sys.executable, "-m", "selfcorrect", *arguments(folder, last=2)]
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
    assert [p.name for p in (folder / "out").iterdir()] == ["x.0001.exr"]
    assert (folder / "out" / "x.0001.exr").read_bytes() == b"an older output"


def test_a_folder_that_cannot_be_written_to(folder: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests may run as root, who may write anywhere: the system's answer is the one part that is made up."""
    monkeypatch.setattr("selfcorrect.exr.os.access", lambda *_: False)
    code, log, _ = run(arguments(folder))
    assert code == 2
    assert "is read-only" in log


def test_two_processes_on_one_shot(folder: Path) -> None:
    given = [sys.executable, "-m", "selfcorrect"]
    both = [subprocess.Popen([*given, *arguments(folder)], stderr=subprocess.PIPE) for _ in range(2)]
    for process in both:
        _, log = process.communicate(timeout=300)
        assert process.returncode == 0, log.decode()
    assert cli.main(arguments(folder, out="alone")) == 0
    assert outputs(folder / "out") == outputs(folder / "alone")
    assert len(list((folder / "out").iterdir())) == LAST


def test_frames_are_read_ahead_and_written_behind(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """While a frame is worked on, the next one is read and the last one written; three are in memory at most."""
    read, begun = ([threading.Event() for _ in range(LAST + 1)] for _ in "rb")
    alive: list[weakref.ref[files.Loaded]] = []
    most = 0
    load = files.load

    def watched(sources: files.Sources) -> files.Loaded:
        loaded = load(sources)
        alive.append(weakref.ref(loaded))
        read[len(alive)].set()
        return loaded

    def work(job: shot.Job) -> shot.Done:
        nonlocal most
        begun[job.frame].set()
        assert job.frame == LAST or read[job.frame + 1].wait(60)  # read while this frame is being worked on
        most = max(most, sum(ref() is not None for ref in alive))
        network = Network(3, 3, Settings(), torch.Generator())

        def write() -> str:
            assert job.frame == LAST or begun[job.frame + 1].wait(60)  # work on the next frame goes on meanwhile
            return f"{job.frame} of {job.loaded.frame.size}"

        return shot.Done(network, write)

    monkeypatch.setattr("selfcorrect.shot.files.load", watched)
    (folder / "out").mkdir()
    names = [str(folder / name) for name in ("a.####.exr", "b.####.exr", "out/x.####.exr")]
    habits = shot.Habits(Settings(), {})
    outcomes: list[shot.Outcome] = []
    assert shot.run(shot.Shot(*names, range(1, LAST + 1)), habits, work, outcomes.append, print) == 0
    assert [(o.frame, o.kind, o.report) for o in outcomes] == [
        (n, "written", f"{n} of (24, 30)") for n in range(1, LAST + 1)
    ]
    assert most <= 3


def test_killed_at_any_moment(tmp_path: Path) -> None:
    """Fifty processes are killed; no file with a final name is ever half-written, and the shot is finished in the end.

    The processes run the command from a fork server that has imported it, since they would otherwise spend all
    their life with that.
    """
    last, rng = 6, random.Random(1)
    folder = write_shot(tmp_path, last)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["selfcorrect.cli", "torch._dynamo"])  # the latter is imported by the first step

    def started(out: str) -> multiprocessing.process.BaseProcess:
        state = ["--save-state", folder / out / "state.####.safetensors"]
        given = arguments(folder, *state, "--skip-existing", last=last, out=out)
        process = context.Process(target=cli.main, args=(given,))
        process.start()
        return process

    started("warm-up").join()  # the server imports the command
    begin = time.perf_counter()
    started("undisturbed").join()
    whole = time.perf_counter() - begin
    undisturbed = outputs(folder / "undisturbed")
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
        there = {(path, path.stat().st_mtime_ns) for path in (folder / "out").glob("*.exr")}
        for path, _ in there - checked:
            exr.read(path)
            assert path.read_bytes() == undisturbed[path.name]
        checked |= there
        if len(there) == last:  # once more from the start
            for path in [*(folder / "out").glob("*.exr"), *(folder / "out").glob("state.*")]:
                path.unlink()
    started("out").join()
    assert outputs(folder / "out") == undisturbed
    assert not list(folder.rglob("*tmp*"))
    assert len(checked) > last  # the kills did not all come before the first frame


def test_temporaries_of_the_living_stay(tmp_path: Path) -> None:
    dead = tmp_path / ".x.0001.0123456789abcdef.selfcorrect-tmp"
    living = tmp_path / ".x.0002.0123456789abcdef.selfcorrect-tmp"
    other = tmp_path / ".x.0003.tmp"
    for path in (dead, living, other):
        path.touch()
    with open(living, "r+b") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        assert remove_abandoned(tmp_path) == [dead]
    assert remove_abandoned(tmp_path) == [living]
    assert list(tmp_path.iterdir()) == [other]


def test_what_is_published_is_whole_and_alone(tmp_path: Path) -> None:
    publish(tmp_path / ("é" * 100 + ".exr"), b"one")
    publish(tmp_path / ("é" * 100 + ".exr"), bytearray(b"two"))
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [b"two"]
