"""What neighbouring frames of a shot know of a frame: their motion, and their samples fetched along it."""

from selfcorrect.history.gather import History, with_history
from selfcorrect.history.motion import Motion, between

__all__ = ["History", "Motion", "between", "with_history"]
