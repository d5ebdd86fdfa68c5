"""Short help, all of it, settings by name and from files, and the version."""

import json
import subprocess
from collections.abc import Iterator
from dataclasses import fields
from importlib.metadata import version
from pathlib import Path

import pytest
from helpers.commands import call, refused

from selfcorrect import Settings, cli
from selfcorrect.cli.help import Expert

COMMANDS = ("frame", "sequence", "bench", "inspect", "compare", "report", "combine", "settings", "demo", "completion")
RUNS = ("frame", "sequence", "bench", "demo")


def flags() -> Iterator[tuple[str, str, bool]]:
    """Each command's flags, and whether they are an expert's."""
    (commands,) = (action for action in cli._parser()._actions if action.choices)
    for name, parser in dict(commands.choices or {}).items():
        for action in parser._actions:
            for flag in action.option_strings:
                yield name, flag, isinstance(action.help, Expert)


def told(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit) as ended:
        cli.main(arguments)
    assert ended.value.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("command", COMMANDS)
def test_short_help_fits_a_screen(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    text = told(capsys, command, "--help")
    assert len(text.splitlines()) <= 50
    shown = [flag for name, flag, expert in flags() if name == command and not expert]
    hidden = [flag for name, flag, expert in flags() if name == command and expert]
    words = text.replace(",", " ").split()
    assert set(shown) <= set(words)
    assert not set(hidden) & set(words)
    assert bool(hidden) == (command in RUNS or command == "settings")


@pytest.mark.parametrize("command", RUNS)
def test_all_help_has_every_flag(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = told(capsys, command, "--help-all").replace(",", " ").split()
    assert {flag for name, flag, _ in flags() if name == command} <= set(words)
    assert "--help-all" in told(capsys, command, "--help")


def test_short_help_lists_a_flag_where_it_does_something(capsys: pytest.CaptureFixture[str]) -> None:
    """Frames beside one are a shot's; a budget is a frame's; bench writes no image."""
    commands = {
        flag: {command for command in (*RUNS, "settings") if flag in told(capsys, command, "--help").split()}
        for flag in ("--frame-radius", "--time-budget", "--diagnostics", "--pass-through")
    }
    writing = {"frame", "sequence", "demo"}
    assert commands == {
        "--frame-radius": {"sequence"},
        "--time-budget": writing,
        "--diagnostics": writing,
        "--pass-through": writing,
    }
    assert "unrecognized arguments: --diagnostics" in refused("bench", "a.exr", "b.exr", "--diagnostics", "error")


def test_every_flag_says_what_it_does() -> None:
    (commands,) = (action for action in cli._parser()._actions if action.choices)
    parsers = dict(commands.choices or {})
    assert set(parsers) == set(COMMANDS)
    silent = [(name, action.dest) for name, parser in parsers.items() for action in parser._actions if not action.help]
    assert silent == []


def test_the_default_preset_is_marked(capsys: pytest.CaptureFixture[str]) -> None:
    assert "balanced (the default) | fast | best | paper" in " ".join(told(capsys, "frame", "--help").split())


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert told(capsys, "--version") == f"selfcorrect {version('selfcorrect')}\n"


def settings_told(*arguments: object) -> dict[str, object]:
    result = call("settings", "--json", *arguments)
    assert result.returncode == 0, result.stderr
    found: dict[str, object] = json.loads(result.stdout)
    return found


@pytest.mark.parametrize("preset", Settings.presets())
def test_settings_of_a_preset(preset: str) -> None:
    assert settings_told("--preset", preset) == Settings.preset(preset).to_dict()


def test_settings_by_name_by_file_and_by_flag(tmp_path: Path) -> None:
    """A file comes before what is named on the line; all kinds of value are read as people write them."""
    file = tmp_path / "own.toml"
    file.write_text('window = 9\nlayers = 5\nlearning_rate = 1\nschedule = "constant"\n')
    given = [
        "--settings",
        file,
        "--set",
        "window=7",
        "--set",
        "guard=off",
        "--set",
        "time-budget = 2m",
        "--patch",
        "32",
    ]
    expected = Settings.preset(
        "fast",
        window=7,
        layers=5,
        learning_rate=1.0,
        schedule="constant",
        guard=False,
        time_budget=120.0,
        patch=32,
    )
    found = settings_told("--preset", "fast", *given)
    assert found == expected.to_dict()
    assert isinstance(found["learning_rate"], float)


def test_the_table_has_value_meaning_and_source() -> None:
    result = call("settings", "--set", "window=7")
    lines = result.stdout.splitlines()
    assert lines[0].split() == ["setting", "value", "meaning", "source"]
    starts = {line.split()[0]: line for line in lines[1:] if not line.startswith(" ")}
    assert set(starts) == {f.name for f in fields(Settings)}
    assert starts["window"].split()[1] == "7"
    assert starts["guard"].split()[1] == "on"
    assert "side of the cross-bilateral" in starts["window"]
    assert "Back et al. 2022, Sec. 4" in starts["window"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--set", "window"], "expected --set NAME=VALUE, but got 'window'"),
        (["--set", "windows=7"], "but got 'windows'"),
        (["--set", "window=wide"], "expected a whole number for the setting window, but got 'wide'"),
        (["--set", "guard=perhaps"], "expected true or false for the setting guard, but got 'perhaps'"),
        (["--set", "time_budget=soon"], "expected a time like 10s or 2m, but got 'soon'"),
        (["--set", "window=8"], "expected an odd window"),
        (["--set", "window=7", "--window", "9"], "expected window once, but got --set window and --window"),
        (["--preset", "nonsense"], "expected a preset out of balanced"),
    ],
)
def test_what_is_no_setting_is_refused(arguments: list[str], message: str) -> None:
    assert message in refused("settings", *arguments)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"window = \n", "expected lines such as window = 7"),
        (b"windows = 7\n", "but got 'windows'"),
        (b'window = "7"\n', "expected a whole number for the setting window, but got '7'"),
        (b"\xff\n", "expected lines such as window = 7"),
        (None, "expected a file of settings"),
    ],
)
def test_a_file_of_settings_that_does_not_fit_is_named(text: bytes | None, message: str, tmp_path: Path) -> None:
    file = tmp_path / "own.toml"
    if text is not None:
        file.write_bytes(text)
    line = refused("settings", "--settings", file)
    assert f"own.toml: {message}" in line or ("own.toml: " in line and message in line)


def completed(line: str) -> list[str]:
    """What bash offers at the end of a line."""
    script = call("completion", "bash").stdout
    words = line.split(" ")
    ask = f'COMP_WORDS=("$@") COMP_CWORD={len(words) - 1}; _selfcorrect; printf "%s\\n" "${{COMPREPLY[@]}}"'
    command = ["bash", "-c", f"{script}\n{ask}", "bash", *words]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()


def test_the_shell_completes() -> None:
    assert completed("selfcorrect fr") == ["frame"]
    assert completed("selfcorrect ") == [*COMMANDS]
    assert completed("selfcorrect frame a.exr b.exr --denoised-") == ["--denoised-a", "--denoised-b"]
    assert completed("selfcorrect frame --preset ") == list(Settings.presets())
    assert "oidn:fast" in completed("selfcorrect frame --denoiser oidn")
    assert completed("selfcorrect frame a") == []
    assert completed("selfcorrect inspect --j") == ["--json"]
    assert call("completion", "zsh").stdout.startswith("autoload")
