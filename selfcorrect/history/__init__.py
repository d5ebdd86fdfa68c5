"""What neighbouring frames of a shot know of a frame: their motion, and their samples fetched along it."""

from selfcorrect.history.histories import NAME, Histories, History, with_history
from selfcorrect.history.motion import Motion, available, between

__all__ = ["NAME", "Histories", "History", "Motion", "available", "between", "with_history"]
