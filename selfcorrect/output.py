"""The process's stdout and stderr, which belong to one at a time."""

import threading

__all__ = ["OUTPUT"]

OUTPUT = threading.RLock()
"""Held while a library's stdout and stderr are silenced: take it to print from another thread, or lose the text."""
