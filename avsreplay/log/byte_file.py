"""A file read by place, so that a short read is an error and never a shorter answer."""

from __future__ import annotations

import os
from pathlib import Path

from avsreplay.errors import UnreadableInput
from avsreplay.log.cursor import BadMessage
from avsreplay.log.text import shown

__all__ = ["ByteFile"]

_SMALL, _BLOCK = 256, 1 << 16  # heads of records are taken out of a block, not asked for one by one


class ByteFile:
    """A file opened for reading by place.

    Attributes:
        size: bytes when it was opened.

    Raises:
        UnreadableInput: not there, not a file, or not to be read.
    """

    def __init__(self, path: Path) -> None:
        try:
            self._file = os.open(path, os.O_RDONLY)
            self.size = os.fstat(self._file).st_size
            self._block = (0, b"")
        except FileNotFoundError:
            raise UnreadableInput("no such file", where=shown(path), hint="check the path") from None
        except OSError as error:
            what = error.strerror or "cannot be read"
            raise UnreadableInput(what, where=shown(path), hint="check the path") from None

    def read(self, offset: int, size: int) -> bytes:
        """Exactly ``size`` bytes. Raises BadMessage where they are not there."""
        if size > _SMALL:
            return self._read(offset, size)
        begin, block = self._block
        if not begin <= offset <= offset + size <= begin + len(block):
            begin, block = self._block = offset, self._read(offset, max(min(_BLOCK, self.size - offset), size))
        return block[offset - begin : offset - begin + size]

    def _read(self, offset: int, size: int) -> bytes:
        try:
            data = os.pread(self._file, size, offset)
            while len(data) < size:
                more = os.pread(self._file, size - len(data), offset + len(data))
                if not more:
                    raise BadMessage(f"the file ends at byte {offset + len(data)}, {offset + size} needed")
                data += more
        except OSError as error:
            raise BadMessage(f"byte {offset} cannot be read: {error.strerror}") from None
        return data

    def upto(self, offset: int, size: int) -> bytes:
        """``size`` bytes or as many as there are before the end."""
        return self.read(offset, max(min(size, self.size - offset), 0))

    def close(self) -> None:
        """Let go of the file."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
