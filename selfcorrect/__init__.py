"""selfcorrect: gives denoised Monte Carlo renders their detail back, without a reference image."""

from selfcorrect import start  # isort: split

start.begin()

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
