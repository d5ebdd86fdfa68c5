"""Shots: the chain, skipping and resuming, states, and what is refused."""

import json
import threading
import weakref
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import write_half
from helpers.shots import LAST, Run, arguments, outputs, write_shot

from selfcorrect import Settings, exr, files
from selfcorrect.shot import run as shot


def test_a_shot_starts_cold_and_goes_on_warm(shot_folder: Path, sequence: Run) -> None:
    code, log, frames = sequence(arguments(shot_folder))
    assert code == 0
    assert [f["frame"] for f in frames] == [1, 2, 3, 4, 5]
    assert [f["outcome"] for f in frames] == ["written"] * LAST
    assert [f["start"]["warm"] for f in frames] == [f["start"]["warm_loss"] is not None for f in frames]
    assert "frame 1: started cold" in log
    assert "frame 2: started warm (loss before training" in log
    # each frame's line has come through, although a file was being read meanwhile
    assert [f"x.{n:04d}.exr: written after" in log for n in range(1, LAST + 1)] == [True] * LAST
    attribute = exr.read(shot_folder / "out" / "x.0003.exr").parts[0].header["selfcorrect/run"]
    assert json.loads(attribute)["recipe"] == frames[2]["recipe"]
    assert json.loads(attribute)["frame"] == 3


def test_warm_settings_are_those_of_warm_frames(shot_folder: Path, sequence: Run) -> None:
    _, _, frames = sequence(arguments(shot_folder, "--warm-steps", 2, last=3))
    assert [f["steps"] for f in frames] == [3, 2, 2]
    assert [f["start"]["warm"] for f in frames] == [False, True, True]
    _, _, frames = sequence(arguments(shot_folder, "--warm-steps", 2, "--cold", last=3))
    assert [f["steps"] for f in frames] == [3, 3, 3]


def test_after_a_cut_nothing_depends_on_what_was_before(shot_folder: Path, sequence: Run) -> None:
    """Frames 1 and 2 are of another scene, and what their network has learned is wrong for the third."""
    for n in (1, 2):  # another scene: bright stripes where the denoised image is flat
        for i, half in enumerate("ab"):
            stripes = np.zeros((24, 30), np.float16)
            stripes[:, ::2] = 8
            noise = np.random.default_rng(99 + 10 * n + i).random((24, 30)).astype(np.float16)
            write_half(shot_folder / f"{half}.{n:04d}.exr", 10 * n + i, **dict.fromkeys("RGB", stripes + noise))
    more = ["--steps", 30, "--learning-rate", 0.01]
    _, log, frames = sequence(arguments(shot_folder, *more))
    assert frames[1]["start"]["warm"]
    assert not frames[2]["start"]["warm"]
    assert "frame 3: did not look like the frame before: started cold" in log
    alone = [a if a != "1-5" else "3-5" for a in arguments(shot_folder, *more, out="alone")]
    assert sequence(alone)[0] == 0
    one, two = outputs(shot_folder / "out"), outputs(shot_folder / "alone")
    for name in two:
        np.testing.assert_array_equal(
            exr.read(shot_folder / "out" / name).pixels("R"), exr.read(shot_folder / "alone" / name).pixels("R")
        )
    assert one["x.0004.exr"] == two["x.0004.exr"]


def test_where_a_chunk_is_cut_decides_nothing(tmp_path: Path, sequence: Run) -> None:
    """A frame sees the same neighbours in the middle of a run and alone: files beyond a chunk's ends are read."""
    albedo = np.random.default_rng(0).random((24, 30)).astype(np.float16)
    write_shot(tmp_path, 8, **dict.fromkeys(("albedo.R", "albedo.G", "albedo.B"), albedo))
    _, _, frames = sequence(arguments(tmp_path, "--cold", last=8))
    assert [len(f["history"]["found"]) for f in frames] == [2, 3, 4, 4, 4, 4, 3, 2]
    whole = outputs(tmp_path / "out")
    for first, last in ((4, 4), (5, 6)):
        chunk = [f"{first}-{last}" if a == "1-8" else a for a in arguments(tmp_path, "--cold", last=8, out="chunk")]
        assert sequence(chunk)[0] == 0
    for name, written in outputs(tmp_path / "chunk").items():
        assert written == whole[name]
    assert len(outputs(tmp_path / "chunk")) == 3


class TestSkipExisting:
    """What is there, whole, and made the same way is left alone; all else is made again."""

    def test_nothing_is_left_to_do(self, shot_folder: Path, sequence: Run) -> None:
        sequence(arguments(shot_folder))
        before = {p.name: p.stat().st_mtime_ns for p in (shot_folder / "out").iterdir()}
        code, _, frames = sequence(arguments(shot_folder, "--skip-existing"))
        assert code == 0
        assert {f["outcome"] for f in frames} == {"skipped"}
        assert {p.name: p.stat().st_mtime_ns for p in (shot_folder / "out").iterdir()} == before

    @pytest.mark.parametrize("harm", ["truncated", "foreign", "input", "setting"])
    def test_what_is_not_the_same_is_made_again(self, shot_folder: Path, sequence: Run, harm: str) -> None:
        sequence(arguments(shot_folder, last=3))
        target, more = shot_folder / "out" / "x.0002.exr", []
        match harm:
            case "truncated":
                target.write_bytes(target.read_bytes()[:-100])
            case "foreign":
                target.write_bytes((shot_folder / "a.0001.exr").read_bytes())
            case "input":
                write_half(shot_folder / "b.0002.exr", 777)
            case "setting":
                more = ["--seed", "5"]
        code, log, frames = sequence(arguments(shot_folder, "--skip-existing", *more, last=3))
        assert code == 0
        # another input changes the neighbours, too
        expected = ["written"] * 3 if harm in ("setting", "input") else ["skipped", "written", "skipped"]
        assert [f["outcome"] for f in frames] == expected
        assert "frame 2: " in log
        assert "it is made again" in log
        exr.read(target)

    def test_with_states_the_chain_goes_on_where_it_ended(self, shot_folder: Path, sequence: Run) -> None:
        states = ["--save-state", shot_folder / "state.####.safetensors"]
        sequence(arguments(shot_folder, *states))
        undisturbed = outputs(shot_folder / "out")
        for n in (3, 5):
            (shot_folder / "out" / f"x.{n:04d}.exr").unlink()
        _, log, frames = sequence(arguments(shot_folder, *states, "--skip-existing"))
        assert [f["outcome"] for f in frames] == ["skipped", "skipped", "written", "skipped", "written"]
        assert "frame 3: frame 2 was there and goes on from its state" in log
        assert outputs(shot_folder / "out") == undisturbed

    def test_without_states_the_next_frame_starts_cold(self, shot_folder: Path, sequence: Run) -> None:
        sequence(arguments(shot_folder))
        (shot_folder / "out" / "x.0003.exr").unlink()
        _, _, frames = sequence(arguments(shot_folder, "--skip-existing"))
        assert frames[2]["start"]["warm_loss"] is None

    def test_a_state_made_otherwise_is_not_continued(self, shot_folder: Path, sequence: Run) -> None:
        state = ["--save-state", shot_folder / "state.safetensors"]
        sequence(arguments(shot_folder, *state, last=2))
        write_half(shot_folder / "b.0002.exr", 777)
        sequence(arguments(shot_folder, "--skip-existing", last=2))  # frame 2 anew, without its state
        _, _, frames = sequence(arguments(shot_folder, *state, "--skip-existing", last=3))
        assert [f["outcome"] for f in frames] == ["skipped", "skipped", "written"]
        assert frames[2]["start"]["warm_loss"] is None


class TestState:
    """A state makes a chunk's first frame warm, and is refused where it does not fit."""

    @pytest.fixture
    def state(self, shot_folder: Path, sequence: Run) -> Path:
        path = shot_folder / "state.safetensors"
        assert sequence(arguments(shot_folder, "--save-state", path, last=1))[0] == 0
        return path

    def test_chunks_make_what_the_whole_makes(self, shot_folder: Path, sequence: Run, state: Path) -> None:
        sequence(arguments(shot_folder, last=3))
        chunk = [a if a != "1-3" else "2-3" for a in arguments(shot_folder, "--warm-start", state, last=3, out="chunk")]
        assert sequence(chunk)[0] == 0
        chunks, whole = outputs(shot_folder / "chunk"), outputs(shot_folder / "out")
        assert chunks == {name: whole[name] for name in ("x.0002.exr", "x.0003.exr")}

    def test_cold_from_a_state_knows_no_chunks(self, shot_folder: Path, sequence: Run, state: Path) -> None:
        key = ["--cold", "--warm-start", state]
        sequence(arguments(shot_folder, *key, last=3))
        sequence([a if a != "1-3" else "3-3" for a in arguments(shot_folder, *key, last=3, out="chunk")])
        assert outputs(shot_folder / "chunk")["x.0003.exr"] == outputs(shot_folder / "out")["x.0003.exr"]

    @pytest.mark.parametrize(
        ("flags", "reason"),
        [
            (["--window", "7"], "window 7, but got one with 5"),
            (["--no-log-radiance"], "log_radiance False"),
            (["--combination", "eq3"], "combination eq3"),
            (["--input-scale", "1"], "input_scale 1"),
        ],
    )
    def test_other_settings(self, shot_folder: Path, sequence: Run, state: Path, flags: list[str], reason: str) -> None:
        code, log, _ = sequence(arguments(shot_folder, "--warm-start", state, *flags))
        assert code == 2
        assert f"selfcorrect: error: {state}: " in log
        assert reason in log

    def test_other_buffers(self, shot_folder: Path, sequence: Run, state: Path) -> None:
        none = dict.fromkeys(["albedo.R", "albedo.G", "albedo.B"])
        write_shot(shot_folder, 2, **none)
        code, log, _ = sequence(arguments(shot_folder, "--warm-start", state, last=2))
        assert code == 1
        assert "buffers color+normal+denoised, but got one with color+albedo+normal+denoised" in log

    def test_a_damaged_one(self, shot_folder: Path, sequence: Run, state: Path) -> None:
        data = bytearray(state.read_bytes())
        for harmed, reason in (
            (data[:-7], "intact state"),
            (data[:-5] + b"\x01" + data[-4:], "checksum"),
            (b"", "intact state"),
        ):
            state.write_bytes(harmed)
            code, log, _ = sequence(arguments(shot_folder, "--warm-start", state))
            assert code == 2
            assert reason in log
        state.unlink()
        assert sequence(arguments(shot_folder, "--warm-start", state))[0] == 2

    def test_other_buffers_within_a_shot_start_cold(self, shot_folder: Path, sequence: Run) -> None:
        for half, seed in (("a", 20), ("b", 21)):
            write_half(shot_folder / f"{half}.0002.exr", seed, **dict.fromkeys(["albedo.R", "albedo.G", "albedo.B"]))
        code, log, _ = sequence(arguments(shot_folder, last=3))
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
    def test_names_and_ranges(self, shot_folder: Path, sequence: Run, change: dict[str, str], reason: str) -> None:
        given = arguments(shot_folder)
        for old, new in change.items():
            given = [new if a == old else a.replace(f"/{old}", f"/{new}") for a in given]
        code, log, _ = sequence(given)
        assert code == 2
        assert reason in log.splitlines()[-1]

    def test_a_state_that_cannot_be_written(self, shot_folder: Path, sequence: Run) -> None:
        assert sequence(arguments(shot_folder, "--save-state", shot_folder / "state.pt"))[0] == 2
        assert sequence(arguments(shot_folder, "--save-state", shot_folder / "no" / "s.safetensors"))[0] == 2


def test_given_denoised_halves(shot_folder: Path, sequence: Run) -> None:
    given = arguments(shot_folder, last=2)
    i = given.index("--denoiser")
    del given[i : i + 2]
    names = [shot_folder / "a.####.exr", shot_folder / "b.####.exr", shot_folder / "a.####.exr"]
    flags = zip(("--denoised-a", "--denoised-b", "--denoised-full"), map(str, names), strict=True)
    code, _, frames = sequence([*given, *(x for pair in flags for x in pair)])
    assert code == 0
    assert {f["denoiser"] for f in frames} == {"given"}


def test_frames_are_read_ahead_and_written_behind(shot_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """While a frame is worked on, the next one is read and the last one written; three are in memory at most."""
    read, begun = ([threading.Event() for _ in range(LAST + 1)] for _ in "rb")
    alive: list[weakref.ref[files.Loaded]] = []
    most = 0
    load = files.load

    def watched(sources: files.Sources, **how: bool) -> files.Loaded:
        loaded = load(sources, **how)
        alive.append(weakref.ref(loaded))
        read[len(alive)].set()
        return loaded

    def work(job: shot.Job) -> shot.Done:
        nonlocal most
        begun[job.frame].set()
        assert job.frame == LAST or read[job.frame + 1].wait(60)  # read while this frame is being worked on
        most = max(most, sum(ref() is not None for ref in alive))

        def write() -> str:
            assert job.frame == LAST or begun[job.frame + 1].wait(60)  # work on the next frame goes on meanwhile
            return f"{job.frame} of {job.loaded.frame.size}"

        return shot.Done(None, write)

    monkeypatch.setattr("selfcorrect.shot.run.files.load", watched)
    (shot_folder / "out").mkdir()
    names = [str(shot_folder / name) for name in ("a.####.exr", "b.####.exr", "out/x.####.exr")]
    outcomes: list[shot.Outcome] = []
    frames = shot.Shot(*names, range(1, LAST + 1))
    assert shot.run(frames, shot.Options(Settings(), {}), work, outcomes.append, print) == 0
    assert [(o.frame, o.kind, o.report) for o in outcomes] == [
        (n, "written", f"{n} of (24, 30)") for n in range(1, LAST + 1)
    ]
    assert most <= 3
