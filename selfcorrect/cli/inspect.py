"""The command `inspect`: which channels a file has, and which would be used for what."""

import argparse

from selfcorrect import exr
from selfcorrect.cli import memory
from selfcorrect.cli.terminal import answer, log, show
from selfcorrect.exr.file import headers
from selfcorrect.exr.limits import stored_bytes

__all__ = ["run"]

# A file of some kilobytes may claim any number of pixels; those of renders take up to so many times their file.
_MOST = memory.GIB // 4
_BLOWN_UP = 32


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    taken, size = stored_bytes(options.file), headers(options.file.partition("::")[0])[1]
    most = max(_MOST, _BLOWN_UP * size) if options.maxmem is None else memory.parse_size(options.maxmem) - memory.BASE
    found = exr.inspect(options.file, most=int(most))
    if taken > most:
        log(
            f"warning: {options.file}: its pixels are not read: by its header they take {taken / memory.GIB:.1f}G; "
            f"--maxmem {memory.rounded(taken + memory.BASE)} reads them"
        )
    if options.json:
        answer(found.to_dict())
    else:
        show(*found.lines())
