"""The intact chunks of a log file: where they are, and the last two of them inflated."""

from __future__ import annotations

import zlib
from array import array

from avsreplay.log.byte_file import ByteFile
from avsreplay.log.cursor import BadMessage
from avsreplay.log.inflate import inflate
from avsreplay.log.mcap_records import ChunkHead

__all__ = ["ChunkStore"]

_COMPRESSIONS = ("", "zstd", "lz4", "bz2")
_KEPT = 2


class ChunkStore:
    """Chunks by number, in file order.

    Args:
        file: the file they are in.  limit: most bytes a chunk may have, packed or inflated.
    """

    def __init__(self, file: ByteFile, limit: int) -> None:
        self._file, self._limit = file, limit
        self._offset, self._packed, self._compression, self._size = (array("q") for _ in range(4))
        self._cache: dict[int, bytes] = {}

    def __len__(self) -> int:
        return len(self._offset)

    def check(self, at: int, head: ChunkHead) -> bytes:
        """The inflated chunk at ``at``. Raises BadMessage where its checksum does not hold or it is over the limit."""
        if max(head.size, head.data_size) > self._limit:
            raise BadMessage(f"a chunk of {head.size} bytes is over the limit of {self._limit}")
        data = inflate(self._file.read(at + head.data_at, head.data_size), head.compression, head.size)
        if head.crc and zlib.crc32(data) != head.crc:
            raise BadMessage("the checksum of a chunk does not hold")
        return data

    def add(self, at: int, head: ChunkHead) -> int:
        """Take in a checked chunk and return its number."""
        values = (at + head.data_at, head.data_size, _COMPRESSIONS.index(head.compression), head.size)
        for column, value in zip((self._offset, self._packed, self._compression, self._size), values, strict=True):
            column.append(value)
        return len(self._offset) - 1

    def __getitem__(self, number: int) -> bytes:
        """The inflated chunk. Raises BadMessage where the file has changed meanwhile."""
        if number not in self._cache:
            if len(self._cache) >= _KEPT:
                self._cache.pop(next(iter(self._cache)))
            packed = self._file.read(self._offset[number], self._packed[number])
            self._cache[number] = inflate(packed, _COMPRESSIONS[self._compression[number]], self._size[number])
        return self._cache[number]
