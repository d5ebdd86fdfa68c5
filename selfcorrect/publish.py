"""Files that appear under their name only when they are whole.

A file is written under a temporary name in the folder of the target and then renamed. Whoever writes holds a lock on
the temporary file, which the system releases with the process however that ends: so a later run can tell what a killed
one left behind from what another one is writing at this moment, also in another container. Where files cannot be
locked, what is older than a day counts as left behind; on Windows an open file cannot be deleted in the first place.
"""

import contextlib
import os
import re
import secrets
import stat
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from selfcorrect.errors import FileError

if sys.platform != "win32":
    import fcntl

__all__ = ["publish", "remove_abandoned"]

_NAME = re.compile(r"\..*\.[0-9a-f]{16}\.selfcorrect-tmp")
_OLD = 24 * 3600  # seconds


def publish(target: Path, data: bytes | bytearray | memoryview) -> None:
    """Write a file; an existing one survives any failure.

    Raises:
        FileError: the disk is full, or the folder cannot be written to.
    """
    temporary = None
    try:
        with _created(target) as (temporary, stream):
            _keep_mode(stream, target)
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
            if sys.platform != "win32":
                os.replace(temporary, target)  # while the lock is held: nobody takes it for abandoned
        if sys.platform == "win32":
            os.replace(temporary, target)  # an open file cannot be renamed on Windows
    except OSError as error:
        raise FileError(
            f"{target}: expected a folder to write to, but got: {error.strerror}; choose another output"
        ) from None
    finally:
        if temporary is not None:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)


def _keep_mode(stream: BinaryIO, target: Path) -> None:
    """Who may read and write an existing file may do so when it is overwritten."""
    if sys.platform != "win32":
        with contextlib.suppress(OSError):
            os.fchmod(stream.fileno(), stat.S_IMODE(os.stat(target).st_mode))


@contextlib.contextmanager
def _created(target: Path) -> Iterator[tuple[Path, BinaryIO]]:
    """A new temporary file, locked."""
    while True:
        # 50 characters of at most four bytes: the name stays below the 255 bytes that file systems allow
        path = target.with_name(f".{target.stem[:50]}.{secrets.token_hex(8)}.selfcorrect-tmp")
        with open(path, "xb") as stream:
            # Between its creation and its lock a file looks abandoned: where it was removed, another is made.
            if _lock(stream, wait=True) and os.fstat(stream.fileno()).st_nlink == 0:
                continue
            yield path, stream
            return


def remove_abandoned(folder: Path) -> list[Path]:
    """Remove the temporary files in a folder that killed runs have left behind.

    Returns:
        What was removed. Files that are being written, and those that may not be removed, stay.
    """
    removed = []
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        found = [Path(entry.path) for entry in entries if _NAME.fullmatch(entry.name)]
        for path in found:
            with contextlib.suppress(OSError):
                if _remove(path):
                    removed.append(path)
    return removed


def _remove(path: Path) -> bool:
    if sys.platform == "win32":
        path.unlink()  # refused while it is open
        return True
    with open(path, "r+b") as stream:  # NFS locks only what is open for writing
        if not _lock(stream, wait=False) and time.time() - os.fstat(stream.fileno()).st_mtime < _OLD:
            return False
        path.unlink()
    return True


def _lock(stream: BinaryIO, *, wait: bool) -> bool:
    """Whether the file could be locked; no where another process holds the lock, or where there are no locks."""
    if sys.platform != "win32":
        with contextlib.suppress(OSError):
            fcntl.flock(stream, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
    return False
