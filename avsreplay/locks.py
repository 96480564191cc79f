"""Locks of outputs: one process writes a file or folder at a time.

The system releases them when the process ends.
"""

from __future__ import annotations

import contextlib
import os
import re
from pathlib import Path
from typing import BinaryIO

from avsreplay.errors import UsageError

PART = re.compile(r"\..+\.\d+\.\d+\.part", re.DOTALL)  # the temporary names beside an output
_WAIT = "wait for it, or name another output"


def lock(part: Path, *, wait: bool = False) -> int | None:
    """Lock a temporary file or folder until this process ends; None if the system cannot.

    ``wait`` for another lock.

    Args:
        part: the temporary file or folder.
        wait: wait for the lock of another process.
    """
    if os.name == "nt":  # an open file cannot be removed there
        return None
    handle = os.open(part, os.O_RDONLY)
    try:
        _hold(handle, wait)
    except OSError:
        os.close(handle)
        return None
    return handle


def _hold(handle: int, wait: bool) -> None:
    """Lock an open file; Windows has no such lock. Raises OSError if that is impossible."""
    with contextlib.suppress(ModuleNotFoundError):
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))


def check_alone(part: Path, place: Path) -> None:
    """Raise UsageError if another process writes the folder ``place`` and has locked its own
    temporary folder.

    Args:
        part: the temporary folder of this process.
        place: the folder that it is to replace.
    """
    name = _output_of(part)
    for other in place.parent.glob("*.part"):
        if other == part or not PART.fullmatch(other.name) or _output_of(other) != name:
            continue
        with contextlib.suppress(FileNotFoundError):  # it has just been completed
            held = lock(other)
            if held is None:
                raise UsageError("another process is writing it", where=str(place), hint=_WAIT)
            os.close(held)


def in_place(stream: BinaryIO, path: Path) -> bool:
    """Return whether an open file is still the one at a path: another process may have renamed or
    removed it before this one had the lock.

    Args:
        stream: the open file.
        path: under which it was opened.
    """
    return path.exists() and os.path.samestat(path.stat(), os.fstat(stream.fileno()))


def _output_of(part: Path) -> str:
    """The name of the output, with a leading dot, to which a temporary name belongs."""
    return part.name.rsplit(".", 3)[0]


def open_alone(path: Path) -> BinaryIO:
    """Open a file for writing, emptied, that no other process writes; the lock ends when the file
    is closed.

    Args:
        path: the file; it is created if it does not exist.

    Raises:
        UsageError: another process writes the file.
        OSError: the file cannot be opened.
    """
    while True:
        stream = path.open("ab")  # the content of another writer is not removed
        try:
            _hold(stream.fileno(), wait=False)
        except BlockingIOError:
            stream.close()
            raise UsageError("another process is writing it", where=str(path), hint=_WAIT) from None
        except OSError:
            pass  # a file system that cannot lock files
        if in_place(stream, path):
            stream.seek(0)
            stream.truncate()
            return stream
        stream.close()  # the other process renamed it between the two calls
