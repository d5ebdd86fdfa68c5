"""selfcorrect: gives denoised Monte Carlo renders their detail back, without a reference image."""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from selfcorrect import start

if TYPE_CHECKING:
    from selfcorrect.aovs import AovSum, correct_aovs, denoiser_of
    from selfcorrect.correct import Result, correct
    from selfcorrect.errors import SelfcorrectError
    from selfcorrect.frame import Frame
    from selfcorrect.settings import Settings
    from selfcorrect.shot.sequence import correct_sequence
    from selfcorrect.shot.state import State, load_state, save_state

__all__ = [
    "AovSum",
    "Frame",
    "Result",
    "SelfcorrectError",
    "Settings",
    "State",
    "correct",
    "correct_aovs",
    "correct_sequence",
    "denoiser_of",
    "load_state",
    "save_state",
]

_MODULES = {
    "aovs": ("AovSum", "correct_aovs", "denoiser_of"),
    "correct": ("Result", "correct"),
    "errors": ("SelfcorrectError",),
    "frame": ("Frame",),
    "settings": ("Settings",),
    "shot.sequence": ("correct_sequence",),
    "shot.state": ("State", "load_state", "save_state"),
}


class _Package(ModuleType):
    """Imports what it shows when it is asked for: most of it needs torch, for which help does not wait."""

    def __getattr__(self, name: str) -> Any:
        for module, names in _MODULES.items():
            if name in names:
                value = getattr(import_module(f"selfcorrect.{module}"), name)
                setattr(self, name, value)
                return value
        raise AttributeError(f"module 'selfcorrect' has no attribute {name!r}")

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "correct" and isinstance(value, ModuleType):  # an import leaves the module of that name here
            value = value.correct
        super().__setattr__(name, value)


start.begin()
sys.modules[__name__].__class__ = _Package
