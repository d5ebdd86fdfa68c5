"""The flags that commands share, and what they say: settings, channel map, images that stages need."""

import argparse
import tomllib
from collections.abc import Collection
from dataclasses import fields
from pathlib import Path
from typing import Any

import denoisers
from selfcorrect.cli.help import Expert, add_help_all
from selfcorrect.errors import FileError, SettingsError
from selfcorrect.settings import ALL_LAYERS, EXTRA_FLAGS, ExtraFlag, Settings, seconds

__all__ = [
    "add_aovs",
    "add_extra",
    "add_halves",
    "add_layers",
    "add_maxmem",
    "add_preset",
    "add_report",
    "add_run_flags",
    "add_settings",
    "add_written",
    "check",
    "denoised",
    "extra_files",
    "mapping",
    "settings_of",
]

_FLAGS = {"layers": "--network-layers"}
"""Of settings whose own name means another thing on the command line: --layers are those of the files."""

_AFTER_WEAK = "deep-combiner,core"
"""Stages for images of the denoisers in :data:`denoisers.WEAK`."""


def add_aovs(parser: argparse.ArgumentParser) -> None:
    """The AOVs to correct."""
    parser.add_argument(
        "--aovs",
        default="none",
        metavar="auto|NAME,NAME|none",
        help="correct these AOVs so that they sum to the corrected picture; auto: every set of light passes or light "
        "groups that sums to it in the render; alpha among the names: also that",
    )


def add_layers(parser: argparse.ArgumentParser) -> None:
    """The view layers to correct."""
    parser.add_argument(
        "--layers",
        dest="view_layers",
        default=ALL_LAYERS,
        metavar="NAME,NAME",
        help="view layers, or views, to correct; by default all of the files'",
    )


def add_halves(parser: argparse.ArgumentParser, *, alone: bool = True) -> None:
    """A frame's two halves, and their denoised images where the user has them; ``alone``: no file comes after them."""
    parser.add_argument("a", metavar="A.exr", help="half a; FILE.exr::LAYER chooses a layer")
    count = argparse.OPTIONAL if alone else None  # halves.check() says more of a missing half than argparse would
    parser.add_argument("b", metavar="B.exr", nargs=count, help="half b, rendered with another seed")
    parser.add_argument("--denoised-a", metavar="DA.exr", help="denoised half a, instead of a denoiser")
    parser.add_argument("--denoised-b", metavar="DB.exr", help="denoised half b")
    parser.add_argument("--denoised", dest="denoised_full", metavar="D.exr", help="denoised mean of both halves")


def add_report(parser: argparse.ArgumentParser) -> None:
    """The flag --report."""
    parser.add_argument("--report", metavar="PAGE.html", help="also write a page to look at, for any browser")


def add_maxmem(parser: argparse.ArgumentParser) -> None:
    """The most memory to take."""
    parser.add_argument(
        "--maxmem",
        metavar="SIZE",
        help="most memory to take, such as 6G; a frame that does not fit is refused at once. OIDN works in what is "
        "left, with the same result; other denoisers are not held to it",
    )


def add_extra(parser: argparse.ArgumentParser) -> None:
    """Images beyond the halves that a stage needs."""
    for extra in EXTRA_FLAGS.values():
        parser.add_argument(extra.flag, nargs=len(extra.files), metavar=extra.files, help=Expert(extra.help))


def add_written(parser: argparse.ArgumentParser) -> None:
    """What goes into the written image beside the corrected colour."""
    parser.add_argument(
        "--diagnostics",
        type=_diagnostics,
        default=[],
        metavar="error,blend",
        help="also write what the guard found, as channels",
    )
    parser.add_argument("--aov", dest="diagnostics", type=_diagnostics, help=Expert("the old name of --diagnostics"))
    parser.add_argument(
        "--pass-through",
        action="store_true",
        help="keep every channel but the picture as half a has it; by default those that are linear in the samples "
        "become the mean of both halves",
    )


def add_run_flags(parser: argparse.ArgumentParser, *, everyday: Collection[str] = ()) -> None:
    """The flags that every command with a correction takes. A flag is one row; help as :class:`Expert` hides it.

    ``everyday``: settings whose own flags the short help lists.
    """
    parser.add_argument("--denoiser", metavar="NAME", help=f"one of {' | '.join(denoisers.names())}")
    add_preset(parser)
    parser.add_argument("--device", default="cpu", help="torch device: cpu (the default), cuda, …")
    parser.add_argument("--threads", type=int, metavar="N", help="CPU threads, by default all")
    parser.add_argument("--map", action="append", default=[], metavar="ROLE=CHANNEL", help="albedo=MyAlbedo, …")
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    add_settings(parser, everyday)
    add_help_all(parser)


def add_preset(parser: argparse.ArgumentParser) -> None:
    """The preset."""
    names = [f"{name} (the default)" if name == Settings.default() else name for name in Settings.presets()]
    parser.add_argument("--preset", default=Settings.default(), metavar="NAME", help=" | ".join(names))


def add_settings(parser: argparse.ArgumentParser, everyday: Collection[str] = ()) -> None:
    """Settings: from a file, by name, and each by a flag of its own, for experts where it is not ``everyday``."""
    parser.add_argument(
        "--settings", dest="settings_file", metavar="FILE.toml", help="settings, a line NAME = VALUE for each"
    )
    parser.add_argument(
        "--set",
        dest="changes",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a setting; `selfcorrect settings` lists them",
    )
    for f in fields(Settings):
        shown: type[str] = str if f.name in everyday else Expert
        how: dict[str, Any] = {"type": type(f.default), "metavar": "|".join(f.metadata["choices"]) or "N"}
        if f.metadata["unit"]:
            how = {"type": seconds, "metavar": "10s"} if f.metadata["unit"] == "s" else {"metavar": "FILE"}
        if isinstance(f.default, bool):
            how = {"action": argparse.BooleanOptionalAction}
        parser.add_argument(_flag(f.name), dest=f.name, default=None, help=shown(f.metadata["help"]), **how)


def check(options: argparse.Namespace) -> None:
    """Raise what flags alone have wrong, before anything slow is imported to find it.

    Raises:
        SettingsError: a setting, the threads, a --map, or an image that a stage lacks.
        FileError: the file of settings cannot be read.
    """
    settings = settings_of(options)
    if options.threads is not None:
        denoisers.check_threads(options.threads, "--threads")
    mapping(options)
    extra_files(options, settings)


def settings_of(options: argparse.Namespace) -> Settings:
    """The preset, with what --settings, --set and single flags change.

    A weak denoiser's images go through the deep combiner first, unless stages are named or the preset is ``paper``.

    Raises:
        SettingsError: a setting is unknown, out of its range, or given by --set and by a flag.
    """
    flags = {f.name: getattr(options, f.name) for f in fields(Settings)}
    given = {name: value for name, value in flags.items() if value is not None}
    named = {}
    for change in options.changes:
        name, equals, text = change.partition("=")
        name = name.strip().replace("-", "_")
        if not equals:
            raise SettingsError(f"expected --set NAME=VALUE, but got {change!r}")
        named[name] = Settings.parsed(name, text.strip())
    if twice := sorted(given.keys() & named.keys()):
        raise SettingsError(f"expected {twice[0]} once, but got --set {twice[0]} and {_flag(twice[0])}")
    changes = _from_file(options.settings_file) | given | named
    denoiser = getattr(options, "denoiser", None) or denoisers.default()
    if options.preset != "paper" and denoiser in denoisers.WEAK:
        changes = {"stages": _AFTER_WEAK} | changes
    return Settings.preset(options.preset, **changes)


def _from_file(path: str | None) -> dict[str, Any]:
    """The settings in a TOML file.

    Raises:
        FileError: it cannot be read.
        SettingsError: it is no TOML, or has settings that there are not.
    """
    if path is None:
        return {}
    try:
        values = tomllib.loads(Path(path).read_text(encoding="utf-8"))
        Settings.from_dict(values)
    except OSError as error:
        raise FileError(f"{path}: expected a file of settings, but got: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path}: expected lines such as window = 7, but got: {error}") from None
    except SettingsError as error:
        raise SettingsError(f"{path}: {error}") from None
    kinds = {f.name: type(f.default) for f in fields(Settings)}
    return {name: float(value) if kinds[name] is float else value for name, value in values.items()}


def _flag(setting: str) -> str:
    return _FLAGS.get(setting, f"--{setting.replace('_', '-')}")


def mapping(options: argparse.Namespace) -> dict[str, str]:
    """Role → channel, from --map."""
    pairs = [entry.partition("=") for entry in options.map]
    for role, equals, channel in pairs:
        if not (role and equals and channel):
            raise SettingsError(f"expected --map ROLE=CHANNEL, but got {role + equals + channel!r}")
    return {role: channel for role, _, channel in pairs}


def denoised(options: argparse.Namespace) -> dict[str, str | None]:
    """The denoised images that are named: of half a, of half b, and of both."""
    return {name: getattr(options, name) for name in ("denoised_a", "denoised_b", "denoised_full")}


def extra_files(options: argparse.Namespace, settings: Settings) -> dict[str, list[str]]:
    """By name of a stage, the files that its flag names.

    Raises:
        SettingsError: a stage lacks what it needs, or a flag was given without its stage.
    """
    found = {}
    for stage, extra in EXTRA_FLAGS.items():
        named, wanted = getattr(options, _destination(extra), None), stage in settings.stage_names
        if wanted and not named:
            usage = " ".join((extra.flag, *extra.files))
            raise SettingsError(f"expected {usage}, of the command frame, with the stage {stage}, but got none")
        if named and not wanted:
            raise SettingsError(f"expected the stage {stage} with {extra.flag}, but got {settings.stages!r}")
        if named:
            found[stage] = named
    return found


def _destination(extra: ExtraFlag) -> str:
    return extra.flag.removeprefix("--").replace("-", "_")


def _diagnostics(text: str) -> list[str]:
    names = text.split(",")
    if not set(names) <= {"error", "blend"}:
        raise SettingsError(
            f"expected --diagnostics error, blend or both, but got {text!r}; AOVs of the file are --aovs"
        )
    return names
