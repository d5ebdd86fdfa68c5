"""The flags that commands share, and what they say: settings, channel map, images that stages need."""

import argparse
from collections.abc import Iterator
from dataclasses import fields
from typing import Any

import denoisers
from selfcorrect.errors import SettingsError
from selfcorrect.settings import Settings
from selfcorrect.stages import STAGES
from selfcorrect.stages.stage import Extra

__all__ = ["add_aovs", "add_extra", "add_halves", "add_run_flags", "denoised", "extra_files", "mapping", "settings_of"]


def add_halves(parser: argparse.ArgumentParser) -> None:
    """A frame's two halves, and their denoised images where the user has them."""
    parser.add_argument("a", metavar="A.exr", help="half a; FILE.exr::LAYER chooses a layer")
    parser.add_argument("b", metavar="B.exr", help="half b, rendered with another seed")
    parser.add_argument("--denoised-a", metavar="DA.exr", help="denoised half a, instead of a denoiser")
    parser.add_argument("--denoised-b", metavar="DB.exr")
    parser.add_argument("--denoised", dest="denoised_full", metavar="D.exr", help="denoised mean of both halves")


def add_aovs(parser: argparse.ArgumentParser) -> None:
    """The AOVs to correct."""
    parser.add_argument(
        "--aovs",
        default="none",
        metavar="auto|NAME,NAME|none",
        help="correct these AOVs so that they sum to the corrected picture; auto: every set of light passes or light "
        "groups that sums to it in the render; alpha among the names: also that",
    )


def add_extra(parser: argparse.ArgumentParser) -> None:
    """Images beyond the halves that a stage needs."""
    for _, extra in _extras():
        parser.add_argument(extra.flag, nargs=len(extra.files), metavar=extra.files, help=extra.help)


def add_run_flags(parser: argparse.ArgumentParser) -> None:
    """The flags that every command with a correction takes; the settings' fields are among them."""
    parser.add_argument("--denoiser", metavar="NAME", help=f"one of {' | '.join(denoisers.names())}")
    parser.add_argument("--preset", default=Settings.default(), help=" | ".join(Settings.presets()))
    parser.add_argument("--device", default="cpu", help="torch device: cpu, cuda, …")
    parser.add_argument("--threads", type=int, metavar="N", help="CPU threads, by default all")
    parser.add_argument("--map", action="append", default=[], metavar="ROLE=CHANNEL", help="albedo=MyAlbedo, …")
    parser.add_argument(
        "--diagnostics",
        type=_diagnostics,
        default=[],
        metavar="error,blend",
        help="also write what the guard found, as channels",
    )
    parser.add_argument("--aov", dest="diagnostics", type=_diagnostics, help=argparse.SUPPRESS)  # its name of old
    parser.add_argument(
        "--pass-through",
        action="store_true",
        help="keep every channel but the picture as half a has it; by default those that are linear in the samples "
        "become the mean of both halves",
    )
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    group = parser.add_argument_group("settings, by default those of the preset")
    for f in fields(Settings):
        how: dict[str, Any] = {"type": type(f.default), "metavar": "|".join(f.metadata["choices"]) or "N"}
        if f.metadata["unit"] == "s":
            how = {"type": _seconds, "metavar": "10s"}
        if isinstance(f.default, bool):
            how = {"action": argparse.BooleanOptionalAction}
        if f.metadata["unit"] == "file":
            group.add_argument(f"--{f.name.replace('_', '-')}", metavar="FILE", help=f.metadata["help"])
            continue
        presets = ", ".join(f"{name}: {getattr(s, f.name)}" for name, s in Settings.presets().items())
        group.add_argument(
            f"--{f.name.replace('_', '-')}", default=None, help=f"{f.metadata['help']} ({presets})", **how
        )


def settings_of(options: argparse.Namespace) -> Settings:
    """The preset, with what the flags change."""
    changes = {f.name: getattr(options, f.name) for f in fields(Settings)}
    return Settings.preset(options.preset, **{k: v for k, v in changes.items() if v is not None})


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
    for stage, extra in _extras():
        named, wanted = getattr(options, _destination(extra), None), stage in settings.stage_names
        if wanted and not named:
            usage = " ".join((extra.flag, *extra.files))
            raise SettingsError(f"expected {usage}, of the command frame, with the stage {stage}, but got none")
        if named and not wanted:
            raise SettingsError(f"expected the stage {stage} with {extra.flag}, but got {settings.stages!r}")
        if named:
            found[stage] = named
    return found


def _extras() -> Iterator[tuple[str, Extra]]:
    return ((name, stage.extra) for name, stage in STAGES.items() if stage.extra is not None)


def _destination(extra: Extra) -> str:
    return extra.flag.removeprefix("--").replace("-", "_")


def _seconds(text: str) -> float:
    """Seconds from 10, 10s, 2m or 1h."""
    units = {"s": 1.0, "m": 60.0, "h": 3600.0}
    number, unit = (text[:-1], units[text[-1]]) if text[-1:] in units else (text, 1.0)
    try:
        return float(number) * unit
    except ValueError:
        raise SettingsError(f"expected a time like 10s or 2m, but got {text!r}") from None


def _diagnostics(text: str) -> list[str]:
    names = text.split(",")
    if not set(names) <= {"error", "blend"}:
        raise SettingsError(
            f"expected --diagnostics error, blend or both, but got {text!r}; AOVs of the file are --aovs"
        )
    return names
