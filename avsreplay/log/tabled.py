"""What the readers of single files have in common: one table of messages, and for two of them one store of chunks."""

from __future__ import annotations

from avsreplay.log.byte_file import ByteFile
from avsreplay.log.chunks import ChunkStore
from avsreplay.log.options import TopicInfo
from avsreplay.log.recording import CloudIndex, MessageTable

__all__ = ["Chunked", "Tabled"]


class Tabled:
    """A log whose messages stand in one table."""

    _table: MessageTable

    def topics(self) -> list[TopicInfo]:
        """Every topic that has a message or was declared, by name."""
        return self._table.topics()

    def clouds(self, topic: str) -> CloudIndex:
        """The index of a cloud topic."""
        return self._table.clouds(topic)

    def encoding(self, topic: str) -> str:
        """The message encoding of a topic."""
        return self._table.encoding(topic)


class Chunked(Tabled):
    """A file whose clouds stand in numbered chunks, or outside any (container -1)."""

    _file: ByteFile
    _chunks: ChunkStore

    def read(self, topic: str, place: int) -> bytes | memoryview:
        """The payload of a cloud. Raises BadMessage where it cannot be had."""
        index = self._table.clouds(topic)
        chunk, offset, size = index.container[place], index.offset[place], index.size[place]
        if chunk < 0:
            return self._file.read(offset, size)
        return memoryview(self._chunks[chunk])[offset : offset + size]

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()
