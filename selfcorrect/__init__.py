"""selfcorrect: gives denoised Monte Carlo renders their detail back, without a reference image."""

from selfcorrect.correct import Result, correct
from selfcorrect.errors import SelfcorrectError
from selfcorrect.frame import Frame
from selfcorrect.settings import Settings

__all__ = ["Frame", "Result", "SelfcorrectError", "Settings", "correct"]
