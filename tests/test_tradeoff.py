"""The trade of seconds for accuracy: points, Pareto front, recommendation, and the command on a tiny frame."""

import csv
import io
import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import power_laws
import pytest
import torch
from helpers.commands import BALANCED, run, write_half
from hypothesis import given
from hypothesis import strategies as st

from selfcorrect import Frame, Result, Settings, cli, correct, tradeoff
from selfcorrect.errors import FrameError, MissingPackageError, SettingsError
from selfcorrect.tradeoff import Measurement, Point

TINY = Settings.preset("balanced", steps=4, patch=16, batch=2, window=5)


def measurement(
    seconds: float, ratio: float, name: str = "p", *, error: float = 0.0, preset: bool = True
) -> Measurement:
    return Measurement(Point(name, TINY, preset=preset), ratio, error, seconds, 0.0)


def tiny_frame(seed: int) -> Frame:
    generator = torch.Generator().manual_seed(seed)
    stripes = 1 + 0.5 * torch.sin(torch.arange(40) / 3)[None, :, None].expand(32, 40, 3)
    a, b = (stripes + 0.3 * torch.rand(32, 40, 3, generator=generator) for _ in range(2))
    return Frame((a, b), (stripes.flip(1), stripes.flip(1)), denoised_full=stripes.flip(1))


class TestPoints:
    def test_presets_come_first_and_nothing_comes_twice(self) -> None:
        points = tradeoff.points(TINY)
        presets = list(Settings.presets())
        assert [p.name for p in points if p.preset] == [p.name for p in points][: len(presets)] == presets
        assert points[len(presets)] == Point("base", TINY)
        assert len({json.dumps(p.settings.to_dict()) for p in points}) == len(points)

    def test_each_variation_changes_what_its_name_says(self) -> None:
        for one in tradeoff.points(TINY):
            if one.preset or one.name == "base":
                continue
            changed = {k: v for k, v in one.settings.to_dict().items() if v != getattr(TINY, k)}
            named = dict(part.split("=") for part in one.name.split(","))
            assert changed
            assert set(changed) <= set(named)
            assert tradeoff.point(one.name, TINY) == one

    def test_every_setting_is_varied(self) -> None:
        names = " ".join(p.name for p in tradeoff.points(TINY))
        for setting in (
            "steps",
            "patch",
            "batch",
            "window",
            "taps_every",
            "filters",
            "layers",
            "precision",
            "schedule",
        ):
            assert f"{setting}=" in names
        assert "learning_rate=" in names

    def test_a_base_that_is_a_preset_is_not_tried_twice(self) -> None:
        names = [p.name for p in tradeoff.points(Settings.preset("balanced"))]
        assert "base" not in names

    def test_a_base_with_epochs_is_varied_in_epochs(self) -> None:
        points = tradeoff.points(Settings.preset("paper"))
        assert {"epochs=5", "epochs=10", "epochs=40"} <= {p.name for p in points}
        assert not any(p.settings.steps for p in points if not p.preset)

    def test_the_guard_is_on_where_estimates_are_to_be_compared(self) -> None:
        assert not tradeoff.point("paper", TINY).settings.guard
        for name in ("paper", "base", "warm", "window=7", "paper:epochs=2,guard=false"):
            assert tradeoff.point(name, replace(TINY, guard=False), guarded=True).settings.guard
        assert all(p.settings.guard for p in tradeoff.points(Settings.preset("paper"), guarded=True, warm=True))

    def test_presets_take_the_seed_and_nothing_else(self) -> None:
        assert tradeoff.point("paper", replace(TINY, seed=5)).settings == Settings.preset("paper", seed=5)
        changed = tradeoff.point("paper:window=7,guard=true,learning_rate=0.5", TINY).settings
        assert changed == Settings.preset("paper", window=7, guard=True, learning_rate=0.5)

    @pytest.mark.parametrize(
        ("name", "said"),
        [
            ("quick", "expected a point out of balanced"),
            ("window", "SETTING=VALUE"),
            ("speed=3", "SETTING=VALUE"),
            ("window=wide", "the point 'window=wide': expected a whole number for the setting window, but got 'wide'"),
            ("guard=maybe", "expected true or false for the setting guard"),
            ("window=8", "odd window"),
            ("quick:window=7", "expected a preset out of"),
        ],
    )
    def test_a_wrong_name_says_what_is_right(self, name: str, said: str) -> None:
        with pytest.raises(SettingsError, match=said):
            tradeoff.point(name, TINY)


class TestFront:
    @given(st.lists(st.tuples(st.integers(1, 6), st.integers(1, 6)), max_size=12))
    def test_it_holds_what_no_other_point_beats(self, pairs: list[tuple[int, int]]) -> None:
        points = [measurement(s, r, str(i)) for i, (s, r) in enumerate(pairs)]

        def beaten(one: Measurement) -> bool:
            return any(
                other.seconds <= one.seconds
                and other.ratio <= one.ratio
                and (other.seconds, other.ratio) != (one.seconds, one.ratio)
                for other in points
            )

        front = tradeoff.pareto_front(points)
        assert {m.point.name for m in front} == {m.point.name for m in points if not beaten(m)}
        assert [m.seconds for m in front] == sorted(m.seconds for m in front)

    def test_the_quickest_preset_near_the_best_is_recommended(self) -> None:
        best = measurement(9, 0.50, "best", error=0.02)
        near, far = measurement(3, 0.54, "near"), measurement(1, 0.56, "far")
        variation = measurement(0.1, 0.4, "window=7", preset=False)
        assert tradeoff.recommended([best, far, near, variation]) is near  # within a tenth of the gain
        assert tradeoff.recommended([replace(best, standard_error=0.07), far, near]) is far  # within one error
        assert tradeoff.recommended([variation]) is None

    def test_without_any_gain_the_quickest_is_recommended(self) -> None:
        slow, quick = measurement(9, 1.0), measurement(1, 1.0)
        assert tradeoff.recommended([slow, quick, measurement(0.5, 1.2)]) is quick

    def test_the_mean_over_frames_is_geometric_in_error(self) -> None:
        both = tradeoff.over_frames([measurement(1, 0.5, error=0.05), measurement(3, 2.0, error=0.2)])
        assert both.ratio == pytest.approx(1.0)
        assert both.seconds == pytest.approx(2.0)
        assert both.standard_error == pytest.approx(math.sqrt(0.1**2 + 0.1**2) / 2)
        with pytest.raises(FrameError, match="ratios above 0"):
            tradeoff.over_frames([measurement(1, -0.1)])


class TestSweep:
    def test_it_gives_what_correct_gives(self) -> None:
        frame = tiny_frame(1)
        points = [tradeoff.point(name, TINY, guarded=True) for name in ("base", "paper:epochs=1,patch=16,stride=16")]
        found = list(tradeoff.sweep(frame, points))
        assert [m.point for m in found] == points
        for one in found:
            estimate = correct(frame, one.point.settings).estimate
            assert estimate is not None
            assert (one.ratio, one.standard_error) == (1 + estimate.change, estimate.standard_error)
            assert one.train > 0
            assert one.infer > 0
        assert found[0].ratio < 1  # the flipped stripes leave much to gain

    def test_a_judge_that_needs_no_guard(self) -> None:
        point = tradeoff.point("guard=false", TINY)
        with pytest.raises(SettingsError, match="guard=True"):
            next(tradeoff.sweep(tiny_frame(1), [point]))
        found = next(tradeoff.sweep(tiny_frame(1), [point], lambda result: (float(len(result.losses)), 0.5)))
        assert (found.ratio, found.standard_error) == (TINY.steps, 0.5)

    def test_a_warm_point_starts_from_the_frame_before(self) -> None:
        settings = replace(TINY, steps=30, warm_steps=2)
        points = [tradeoff.point(name, settings) for name in ("base", "warm")]
        cold, warm = tradeoff.sweep(tiny_frame(1), points, previous=tiny_frame(2))
        assert not cold.started_warm
        assert warm.started_warm
        with pytest.raises(FrameError, match="the frame before for the point 'warm'"):
            list(tradeoff.sweep(tiny_frame(1), points[1:]))


class TestTelling:
    def test_the_table_is_csv(self) -> None:
        rows = [measurement(1, 0.5, "a,b=1", error=0.01), measurement(2, 0.6, "q", preset=False)]
        text = tradeoff.table(rows, frame=["x", "y"]).decode()
        read = list(csv.DictReader(io.StringIO(text)))
        assert [row["frame"] for row in read] == ["x", "y"]
        assert [row["point"] for row in read] == ["a,b=1", "q"]
        assert [row["front"] for row in read] == ["1", "0"]
        assert [float(row["seconds"]) for row in read] == [1, 2]
        assert Settings.from_dict(json.loads(read[0]["settings"])) == TINY

    def test_the_plot_is_a_png(self) -> None:
        rows = [measurement(1, 0.5, error=math.inf), measurement(2, 0.6, preset=False)]
        assert tradeoff.plot(rows, "error").startswith(b"\x89PNG")

    def test_without_matplotlib_it_says_what_to_run(
        self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
        with pytest.raises(MissingPackageError, match=r"pip install 'matplotlib>="):
            tradeoff.plot([measurement(1, 1)], "error")
        halves = [str(write_half(tmp_path / f"{i}.exr", i)) for i in range(2)]
        picture = tmp_path / "out.png"
        assert cli.main(["bench", *halves, "--plot", str(picture), *BALANCED]) == 2
        assert "pip install 'matplotlib>=" in capsys.readouterr().err.splitlines()[-1]
        assert not picture.exists()


class TestCommand:
    points = ("--points", "base", "window=3", "warm", "paper:epochs=1,patch=16,stride=16,window=5")

    def test_it_prints_keeps_and_draws(self, halves: tuple[Path, Path], tmp_path: Path) -> None:
        table, picture = tmp_path / "out.csv", tmp_path / "out.png"
        before = [*map(str, halves)]
        result = run(
            "bench", *halves, *self.points, "--previous", *before, *BALANCED, "--csv", table, "--plot", picture
        )
        assert result.returncode == 0, result.stderr
        *lines, last = result.stdout.splitlines()
        assert [line.split()[0] for line in lines] == ["point", *self.points[1:]]
        assert any(line.endswith("*") for line in lines)
        assert last == "no preset was among the points: none is recommended"
        assert "4 of 4: paper:epochs=1" in result.stderr
        with table.open(newline="") as stream:
            assert [row["point"] for row in csv.DictReader(stream)] == [*self.points[1:]]
        assert picture.read_bytes().startswith(b"\x89PNG")
        assert {p.name for p in tmp_path.iterdir()} == {"a.exr", "b.exr", "out.csv", "out.png"}

    def test_it_recommends_a_preset(
        self,
        halves: tuple[Path, Path],
        capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        presets = {"balanced": TINY, "paper": Settings(patch=16, stride=16, epochs=1, window=5)}
        monkeypatch.setattr(Settings, "presets", classmethod(lambda cls: presets))  # the real ones take a minute
        names = ["--points", "balanced", "paper"]
        files = [*map(str, halves)]
        assert cli.main(["bench", *files, *names, "--denoiser", "box", "--threads", "1", "--json"]) == 0
        told = json.loads(capsys.readouterr().out)
        assert told["recommended"] in presets
        assert set(told["front"]) <= set(presets)
        assert told["size"] == {"width": 30, "height": 24}
        assert [p["settings"]["guard"] for p in told["points"]] == [True, True]
        assert cli.main(["bench", *files, *names, "--denoiser", "box", "--threads", "1"]) == 0
        last = capsys.readouterr().out.splitlines()[-1]
        assert "recommended: --preset" in last or "no gain by any preset" in last

    @pytest.mark.parametrize(
        ("flags", "said"),
        [
            (["--points", "warm"], "expected --previous"),
            (["--csv", "out.txt"], "name ends in .csv"),
            (["--plot", "out.jpg"], "name ends in .png"),
            (["--no-guard"], "--no-guard"),
            (["--diagnostics", "blend"], "--diagnostics"),
        ],
    )
    def test_wrong_input_is_refused_in_one_line(
        self, halves: tuple[Path, Path], flags: list[str], said: str, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert cli.main(["bench", *map(str, halves), *BALANCED, *flags]) == 2
        out, err = capsys.readouterr()
        assert out == ""
        assert [said in line for line in err.splitlines()] == [True]

    def test_an_interrupted_sweep_tells_what_it_has(
        self, halves: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        table = tmp_path / "out.csv"
        judge = tradeoff.estimated
        calls = []

        def interrupted(result: Result) -> tuple[float, float]:
            calls.append(result)
            if len(calls) == 2:
                raise KeyboardInterrupt
            return judge(result)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(tradeoff.sweep, "__defaults__", (interrupted,))
            command = ["bench", *map(str, halves), *BALANCED, "--csv", str(table), "--points", "base", "window=3"]
            assert cli.main(command) == 130
        assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == ["point", "base", "no"]
        assert len(table.read_text().splitlines()) == 2


class TestScaling:
    def test_a_power_law_is_found_again(self) -> None:
        x = np.array([16.0, 64.0, 256.0])
        y = 3 * x**-0.7
        assert power_laws.exponent(x.tolist(), y.tolist()) == pytest.approx(-0.7)
        for at in (4.0, 16.0, 30.0, 64.0, 200.0, 1000.0):
            assert power_laws.interpolated(x.tolist(), y.tolist(), at) == pytest.approx(3 * at**-0.7)

    def test_each_segment_has_its_own_slope(self) -> None:
        x, y = [1.0, 10.0, 100.0], [1.0, 0.1, 0.1]
        assert power_laws.interpolated(x, y, 10**0.5) == pytest.approx(10**-0.5)
        assert power_laws.interpolated(x, y, 50.0) == pytest.approx(0.1)
        assert power_laws.interpolated(x, y, 0.1) == pytest.approx(10)

    @pytest.mark.parametrize(
        ("ratios", "expected"),
        [
            ([0.5, 0.6, 0.7], 16),
            ([2.0, 0.5, 0.5], 32),
            ([0.5, 2.0, 0.5], 128),
            ([0.5, 0.5, 1.0], None),
            ([1.0, 0.5, 0.5], 16),
        ],
    )
    def test_winning_begins_where_it_stays(self, ratios: list[float], expected: float | None) -> None:
        found = power_laws.wins_from([16.0, 64.0, 256.0], ratios)
        assert found == (expected if expected is None else pytest.approx(expected))

    def test_what_has_no_logarithm_is_refused(self) -> None:
        with pytest.raises(FrameError, match="above 0"):
            power_laws.interpolated([1.0, 2.0], [1.0, 0.0], 1.5)
        with pytest.raises(FrameError, match="increasing"):
            power_laws.interpolated([2.0, 1.0], [1.0, 1.0], 1.5)
        with pytest.raises(FrameError, match="two different"):
            power_laws.exponent([2.0, 2.0], [1.0, 1.0])
