"""Settings: ranges, presets, and every default with its source."""

from dataclasses import fields, replace

import pytest

from selfcorrect import Settings
from selfcorrect.errors import SettingsError


def test_every_default_names_its_source() -> None:
    for f in fields(Settings):
        assert f.metadata["source"], f.name
        assert f.metadata["help"], f.name


def test_presets_round_trip() -> None:
    for name, settings in Settings.presets().items():
        assert Settings.preset(name) == settings
        assert Settings.from_dict(settings.to_dict()) == settings


def test_preset_with_changes() -> None:
    assert Settings.preset("paper", window=7) == replace(Settings.preset("paper"), window=7)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"window": 4}, "odd window"),
        ({"window": 33}, "odd window"),
        ({"window": 0}, "at least 1"),
        ({"window": 3.0}, "whole number"),
        ({"window": True}, "whole number"),
        ({"epochs": -1}, "at least 0"),
        ({"learning_rate": float("nan")}, "learning_rate"),
        ({"learning_rate": float("inf")}, "learning_rate"),
        ({"combination": "eq4"}, "eq10, eq3"),
        ({"combination": 3}, "a name"),
        ({"stride": 200}, "stride"),
    ],
)
def test_values_out_of_range_are_named(changes: dict[str, object], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        Settings.preset("paper", **changes)


def test_unknown_names_are_errors() -> None:
    with pytest.raises(SettingsError, match="'nonsense'"):
        Settings.preset("nonsense")
    with pytest.raises(SettingsError, match="'windw'"):
        Settings.from_dict({"windw": 3})
