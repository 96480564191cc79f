"""The records of an MCAP file that a reader needs, parsed with every length checked."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from avsreplay.log.cursor import BadMessage

__all__ = [
    "ATTACHMENT",
    "CHANNEL",
    "CHUNK",
    "CHUNK_PREFIX",
    "DATA_END",
    "FOOTER",
    "HEADER",
    "MAGIC",
    "MESSAGE",
    "MESSAGE_INDEX",
    "METADATA",
    "SCHEMA",
    "STATISTICS",
    "Channel",
    "ChunkHead",
    "Fields",
    "Tap",
    "chunk_candidates",
    "chunk_head",
    "is_mcap",
    "records",
]

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = 1, 2, 3, 4, 5, 6, 7
ATTACHMENT, STATISTICS, METADATA, DATA_END = 9, 11, 12, 15
CHUNK_PREFIX = 9 + 8 + 8 + 8 + 4 + 4 + 4 + 8  # opcode and length, then the longest head of a chunk
_HEAD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")
_SIGNATURE = re.compile(rb"(?=\x06[\s\S]{36}(?:\x00{4}|\x03\x00{3}lz4|\x04\x00{3}zstd))")


@dataclass(frozen=True, slots=True)
class Channel:
    """A channel with its schema's name and text."""

    id: int
    topic: str
    type: str
    encoding: str
    schema_encoding: str = ""
    schema: bytes = b""
    metadata: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ChunkHead:
    """What a chunk says of itself; ``data_at`` counts from the record's opcode."""

    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    data_at: int
    data_size: int


class Fields:
    """A walk over one record's content. Raises BadMessage past its end."""

    __slots__ = ("at", "view")

    def __init__(self, view: memoryview) -> None:
        self.view, self.at = view, 0

    def number(self, size: int) -> int:
        """An unsigned little-endian number."""
        raw = self.view[self.at : self.at + size]
        if len(raw) < size:
            raise BadMessage("a record ends inside a number")
        self.at += size
        return int.from_bytes(raw, "little")

    def take(self, size: int) -> memoryview:
        """So many bytes."""
        if self.at + size > len(self.view):
            raise BadMessage(f"a record holds {len(self.view) - self.at} of {size} bytes")
        self.at += size
        return self.view[self.at - size : self.at]

    def text(self) -> str:
        r"""A string; bytes that are not UTF-8 stay readable as ``\xNN``."""
        return bytes(self.take(self.number(4))).decode("utf-8", "backslashreplace")

    def mapping(self) -> dict[str, str]:
        """A map of strings."""
        inner = Fields(self.take(self.number(4)))
        out: dict[str, str] = {}
        while inner.at < len(inner.view):
            key = inner.text()
            out[key] = inner.text()
        return out


def records(view: memoryview) -> Iterator[tuple[int, int, int]]:
    """(opcode, begin, end) of the content of each record. Raises BadMessage where the last one is cut."""
    at, size = 0, len(view)
    while at + 9 <= size:
        opcode, length = _HEAD.unpack_from(view, at)
        if length > size - at - 9:
            raise BadMessage("a record ends past its container")
        yield opcode, at + 9, at + 9 + length
        at += 9 + length
    if at != size:
        raise BadMessage("bytes after the last record of a container")


def chunk_head(view: memoryview | bytes, record_size: int | None = None) -> ChunkHead:
    """Parse a chunk record from its opcode on. Raises BadMessage where its lengths contradict each other."""
    if len(view) < 49 or view[0] != CHUNK:
        raise BadMessage("no chunk")
    _, length = _HEAD.unpack_from(view, 0)
    start, end, size, crc, name_size = _CHUNK.unpack_from(view, 9)
    if name_size > 16 or len(view) < 49 + name_size:
        raise BadMessage("a chunk names no known compression")
    name = bytes(view[41 : 41 + name_size]).decode("ascii", "replace")
    if name not in ("", "zstd", "lz4"):
        raise BadMessage("a chunk names no known compression")
    data_size = int.from_bytes(view[41 + name_size : 49 + name_size], "little")
    if length != 40 + name_size + data_size or (record_size is not None and length + 9 > record_size):
        raise BadMessage("a chunk's lengths contradict each other")
    if start > end:
        raise BadMessage("a chunk ends before it starts")
    return ChunkHead(start, end, size, crc, name, 49 + name_size, data_size)


def chunk_candidates(window: bytes) -> Iterator[int]:
    """Places in ``window`` where a chunk record may begin."""
    return (match.start() for match in _SIGNATURE.finditer(window))


def is_mcap(path: Path) -> bool:
    """Does a file begin as MCAP does?"""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(8) == MAGIC


class Tap(Protocol):
    """Takes every intact record of a file, in file order; times are (log, publish or creation) [ns]."""

    def message(self, channel: Channel, sequence: int, times: tuple[int, int], payload: memoryview) -> None:
        """A message."""

    def attachment(self, name: str, media: str, times: tuple[int, int], data: memoryview) -> None:
        """An attachment whose checksum holds."""

    def metadata(self, name: str, values: dict[str, str]) -> None:
        """A metadata record."""
