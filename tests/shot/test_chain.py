"""What a frame starts from: the rule itself, and that the API and the command both keep to it, to the bit."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.commands import write_half
from helpers.shots import FAST, Run, arguments, outputs, write_shot

import denoisers
from selfcorrect import Frame, Settings, correct_sequence, exr, files, load_state
from selfcorrect.errors import FrameError
from selfcorrect.kernel.guides import Guides
from selfcorrect.shot.chain import Chain, Link, fits
from selfcorrect.stages.core.network import Network

PLAIN = dict.fromkeys(["albedo.R", "albedo.G", "albedo.B"])
"""Channels that a half without albedo lacks."""

Make = Callable[..., tuple[Frame, Network]]


@pytest.fixture(scope="module")
def make() -> Make:
    """A frame with these features, and a network that has seen such a one."""

    def one(*features: str) -> tuple[Frame, Network]:
        generator = np.random.default_rng(0)
        channels = {name: 1 if name in ("visibility", "depth") else 3 for name in ("color", "denoised", *features)}
        buffers: dict[str, Any] = {
            name: tuple(generator.random((8, 8, count), dtype=np.float32) for _ in "ab")
            for name, count in channels.items()
        }
        frame = Frame(**buffers)
        half, settings = frame.halves[0], Settings(layers=2, filters=2)
        guides = Guides.of_half(half._asdict(), margin=9)
        return frame, Network.for_guides(guides, settings, torch.Generator().manual_seed(0))

    return one


@pytest.mark.parametrize("features", [(), ("albedo",), ("normal",), ("albedo", "normal", "visibility"), ("depth",)])
def test_what_fits(make: Make, features: tuple[str, ...]) -> None:
    frame, network = make(*features)
    assert fits(network, frame)
    assert fits(network, make(*features, "depth")[0] if "depth" not in features else frame)  # it sees no depth
    assert not fits(network, make("visibility")[0])


class TestRule:
    """Networks of two kinds, with albedo and without."""

    def test_the_last_frame_comes_first_and_then_what_was_given(self, make: Make) -> None:
        (rich, given), (plain, other) = make("albedo"), make()
        last = make("albedo")[1]
        chain = Chain(given)
        assert chain.link(rich) == Link(given)
        chain.corrected(last)
        assert chain.link(rich) == Link(last)
        assert chain.link(plain) == Link(None, ("other buffers than the frame before and the warm start: starts cold",))
        chain.corrected(other)
        assert chain.link(plain) == Link(other)
        assert chain.link(rich) == Link(given, ("other buffers than the frame before: starts from the warm start",))

    def test_without_a_warm_start_other_buffers_start_cold(self, make: Make) -> None:
        (rich, last), (plain, _) = make("albedo"), make()
        chain = Chain()
        assert chain.link(rich) == Link(None)
        chain.corrected(last)
        assert chain.link(plain) == Link(None, ("other buffers than the frame before: starts cold",))

    def test_where_the_shot_begins_a_warm_start_that_does_not_fit_is_for_the_correction_to_refuse(
        self, make: Make
    ) -> None:
        given, plain = make("albedo")[1], make()[0]
        chain = Chain(given)
        assert chain.link(plain) == Link(given)
        assert chain.link(plain) == Link(given)  # the first one has failed: the shot has not begun

    def test_cold_knows_the_warm_start_alone(self, make: Make) -> None:
        (rich, given), (plain, other) = make("albedo"), make()
        chain = Chain(given, cold=True)
        chain.corrected(other)
        assert chain.link(rich) == Link(given)
        assert chain.link(plain) == Link(None, ("other buffers than the warm start: starts cold",))

    @pytest.mark.parametrize("warm", [True, False])
    def test_a_frame_that_was_left_out_hands_on_its_state(self, make: Make, warm: bool) -> None:
        (rich, state), (plain, given) = make("albedo"), make()
        chain = Chain(given if warm else None)
        chain.left_out("frame 3", state)
        note = "frame 3 was there and goes on from its state"
        assert chain.link(rich) == Link(state, (note,))
        how = "starts from the warm start" if warm else "starts cold"
        assert chain.link(plain) == Link(given if warm else None, (note, f"other buffers than the frame before: {how}"))
        chain.corrected(state)
        assert chain.link(rich) == Link(state)

    def test_without_a_state_there_is_nothing_to_go_on_from(self, make: Make) -> None:
        rich, given = make("albedo")
        chain = Chain(given)
        chain.corrected(make("albedo")[1])
        chain.left_out("frame 2", None)
        assert chain.link(rich) == Link(
            given, ("frame 2 was there and left no state: this frame does not go on from it",)
        )


def settings_of(flags: list[str]) -> Settings:
    names = [name.removeprefix("--").replace("-", "_") for name in flags[::2]]
    values = dict(zip(names, flags[1::2], strict=True))
    return Settings.preset(
        Settings.default(),
        **{name: int(value) for name, value in values.items() if name not in ("denoiser", "threads")},
    )


@pytest.mark.usefixtures("one_thread")
class TestApiAndCommand:
    """Frames 1, 2 and 5 have an albedo, 3 and 4 have none."""

    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        write_shot(tmp_path)
        for frame in (3, 4):
            for i, half in enumerate("ab"):
                write_half(tmp_path / f"{half}.{frame:04d}.exr", 10 * frame + i, **PLAIN)
        return tmp_path

    def of_api(self, folder: Path, numbers: list[int], **how: Any) -> list[tuple[np.ndarray[Any, Any], Any]]:
        box = denoisers.create("box", threads=1)
        read = (files.load(files.Sources(*(str(folder / f"{h}.{n:04d}.exr") for h in "ab"))).frame for n in numbers)
        results = correct_sequence((frame.denoise(box) for frame in read), settings_of(FAST), denoiser=box, **how)
        return [(result.image.half().numpy(), result.start._asdict()) for result in results]

    @pytest.mark.parametrize("cold", [False, True])
    @pytest.mark.parametrize("warm", [False, True])
    def test_they_agree_where_buffers_change(self, folder: Path, sequence: Run, cold: bool, warm: bool) -> None:
        state, flags = folder / "state.safetensors", ["--cold"] if cold else []
        assert sequence(arguments(folder, "--save-state", state, last=1, out="first"))[0] == 0
        if warm:
            flags += ["--warm-start", str(state)]
        code, _, told = sequence(arguments(folder, *flags))
        assert code == 0
        given = load_state(state).network if warm else None
        expected = self.of_api(folder, [1, 2, 3, 4, 5], cold=cold, warm_start=given)
        for (image, start), frame in zip(expected, told, strict=True):
            assert frame["start"] == start
            written = exr.load_half(frame["output"]).buffers["color"]
            np.testing.assert_array_equal(written, image.astype(np.float32))
        whence = {  # which frames have something to start from
            (False, False): [False, True, False, True, False],
            (False, True): [True, True, False, True, True],
            (True, False): [False] * 5,
            (True, True): [True, True, False, False, True],
        }
        assert [frame["start"]["warm_loss"] is not None for frame in told] == whence[cold, warm]

    def test_they_agree_on_a_warm_start_that_does_not_fit_where_the_shot_begins(
        self, folder: Path, sequence: Run
    ) -> None:
        state = folder / "state.safetensors"
        assert sequence(arguments(folder, "--save-state", state, last=1, out="first"))[0] == 0
        later = [a if a != "1-5" else "3-5" for a in arguments(folder, "--warm-start", state)]
        code, _, told = sequence(later)
        assert code == 1
        assert [frame["outcome"] for frame in told] == ["failed", "failed", "written"]
        with pytest.raises(FrameError) as refused:
            self.of_api(folder, [3, 4, 5], warm_start=load_state(state).network)
        assert told[0]["reason"] == told[1]["reason"] == str(refused.value)

    def test_a_run_that_is_resumed_where_buffers_change_makes_what_the_whole_run_made(
        self, folder: Path, sequence: Run
    ) -> None:
        state = folder / "state.safetensors"
        assert sequence(arguments(folder, "--save-state", state, last=1, out="first"))[0] == 0
        flags = ["--warm-start", state, "--save-state", folder / "after.####.safetensors", "--skip-existing"]
        assert sequence(arguments(folder, *flags))[0] == 0
        whole = outputs(folder / "out")
        for frame in (3, 5):
            (folder / "out" / f"x.{frame:04d}.exr").unlink()
        code, log, _ = sequence(arguments(folder, *flags))
        assert code == 0
        assert "frame 3: other buffers than the frame before and the warm start: starts cold" in log
        assert "frame 5: other buffers than the frame before: starts from the warm start" in log
        assert outputs(folder / "out") == whole
