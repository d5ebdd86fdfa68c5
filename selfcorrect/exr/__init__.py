"""Layered OpenEXR files in and out: halves to correct come in, everything but the colour passes through."""

from selfcorrect.exr.file import ExrFile, read
from selfcorrect.exr.inspection import Inspection, inspect
from selfcorrect.exr.load import HalfFile, load_half, load_picture
from selfcorrect.exr.write import check_source, check_target, write

__all__ = [
    "ExrFile",
    "HalfFile",
    "Inspection",
    "check_source",
    "check_target",
    "inspect",
    "load_half",
    "load_picture",
    "read",
    "write",
]
