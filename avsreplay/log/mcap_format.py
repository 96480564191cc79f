"""The MCAP format: records, chunks and the summary section, with every length checked."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import field, replace
from enum import IntEnum
from pathlib import Path
from typing import Protocol

from avsreplay.errors import value_class
from avsreplay.log.bytes_io import BadMessage, ByteFile

WRITTEN_CHUNK_BYTES = 1 << 20  # of a chunk that is written
MCAP_MAGIC = b"\x89MCAP0\r\n"


class Opcode(IntEnum):
    """Kinds of records of an MCAP file."""

    HEADER = 1
    FOOTER = 2
    SCHEMA = 3
    CHANNEL = 4
    MESSAGE = 5
    CHUNK = 6
    MESSAGE_INDEX = 7
    ATTACHMENT = 9
    STATISTICS = 11
    METADATA = 12
    DATA_END = 15


# opcode and length, then the longest head of a chunk
CHUNK_PREFIX_BYTES = 9 + 8 + 8 + 8 + 4 + 4 + 4 + 8
_RECORD_HEAD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")
_KNOWN_OPCODES = frozenset(range(1, 16))
# Records of unknown kinds after which a part is not read on: zeros are millions of empty records.
MAX_FOREIGN_RECORDS = 10_000
_SIGNATURE = re.compile(rb"(?=\x06[\s\S]{36}(?:\x00{4}|\x03\x00{3}lz4|\x04\x00{3}zstd))")


@value_class(eq=True)
class Channel:
    """A channel with the name, encoding and text of its schema."""

    id: int
    topic: str
    type: str
    encoding: str
    schema_encoding: str = ""
    schema: bytes = b""
    metadata: dict[str, str] = field(default_factory=dict)


@value_class(eq=True)
class ChunkHead:
    """The fields before a chunk's data; ``data_at`` is the offset of the data from the
    record's opcode.
    """

    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    data_at: int
    data_size: int


class Fields:
    """A reader of one record's fields; each method raises BadMessage at the end of the record."""

    __slots__ = ("at", "view")

    def __init__(self, view: memoryview) -> None:
        self.view, self.at = view, 0

    def number(self, size: int) -> int:
        """Return the next unsigned little-endian number of ``size`` bytes.

        Raises:
            BadMessage: the record ends before it.
        """
        raw = self.view[self.at : self.at + size]
        if len(raw) < size:
            raise BadMessage("a record ends inside a number")
        self.at += size
        return int.from_bytes(raw, "little")

    def take(self, size: int) -> memoryview:
        """Return the next ``size`` bytes.

        Raises:
            BadMessage: the record ends before them.
        """
        if self.at + size > len(self.view):
            raise BadMessage(f"a record holds {len(self.view) - self.at} of {size} bytes")
        self.at += size
        return self.view[self.at - size : self.at]

    def text(self) -> str:
        r"""Return the next string; bytes that are not UTF-8 become ``\xNN``."""
        return bytes(self.take(self.number(4))).decode("utf-8", "backslashreplace")

    def mapping(self) -> dict[str, str]:
        """Return the next map of strings."""
        inner = Fields(self.take(self.number(4)))
        out: dict[str, str] = {}
        while inner.at < len(inner.view):
            key = inner.text()
            out[key] = inner.text()
        return out


def records(view: memoryview) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, begin, end) of the content of each record.

    Raises BadMessage if the last one is cut.
    """
    at, size, foreign = 0, len(view), 0
    while at + 9 <= size:
        opcode, length = _RECORD_HEAD.unpack_from(view, at)
        if length > size - at - 9:
            raise BadMessage("a record ends past its container")
        foreign += opcode not in _KNOWN_OPCODES
        if opcode == 0 or foreign > MAX_FOREIGN_RECORDS:
            raise BadMessage("records of unknown kinds")
        yield opcode, at + 9, at + 9 + length
        at += 9 + length
    if at != size:
        raise BadMessage("bytes after the last record of a container")


def chunk_head(view: memoryview | bytes, record_size: int | None = None) -> ChunkHead:
    """Parse a chunk record from its opcode on.

    Raises BadMessage if its lengths contradict each other.
    """
    if len(view) < 49 or view[0] != Opcode.CHUNK:
        raise BadMessage("not a chunk")
    _, length = _RECORD_HEAD.unpack_from(view, 0)
    start, end, size, crc, name_size = _CHUNK.unpack_from(view, 9)
    if name_size > 16 or len(view) < 49 + name_size:
        raise BadMessage("a chunk with an unknown compression")
    name = bytes(view[41 : 41 + name_size]).decode("ascii", "replace")
    if name not in ("", "zstd", "lz4"):
        raise BadMessage("a chunk with an unknown compression")
    data_size = int.from_bytes(view[41 + name_size : 49 + name_size], "little")
    if length != 40 + name_size + data_size or (
        record_size is not None and length + 9 > record_size
    ):
        raise BadMessage("a chunk's lengths contradict each other")
    if start > end:
        raise BadMessage("a chunk ends before it starts")
    return ChunkHead(start, end, size, crc, name, 49 + name_size, data_size)


def chunk_candidates(window: bytes) -> Iterator[int]:
    """Return the offsets in ``window`` where a chunk record may begin."""
    return (match.start() for match in _SIGNATURE.finditer(window))


def is_mcap(path: Path) -> bool:
    """Return whether the file begins with the MCAP magic."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(8) == MCAP_MAGIC


class RecordSink(Protocol):
    """Receives every intact record of a file, in file order; times are (log, publish or
    creation) [ns].
    """

    def message(
        self, channel: Channel, sequence: int, times: tuple[int, int], payload: memoryview
    ) -> None:
        """Receive a message."""

    def attachment(self, name: str, media: str, times: tuple[int, int], data: memoryview) -> None:
        """Receive an attachment whose checksum is correct."""

    def metadata(self, name: str, values: dict[str, str]) -> None:
        """Receive a metadata record."""


TAIL_BYTES = 37  # footer record (29 bytes) and closing magic
_DATA_END = re.compile(rb"\x0f\x04\x00{7}")
_SUMMARY_SEARCH_BYTES = 4 << 20  # end of a file in which a moved summary is searched
_FOOTER_HEAD = b"\x02\x14\x00\x00\x00\x00\x00\x00\x00"


@value_class(eq=True)
class SummarySection:
    """The summary section.

    Attributes:
        start: its offset, 0 if there is no valid one.
        messages: number of messages in the file, None if not stated.
        definitions: its schema and channel records.
        trouble: what is wrong with it, empty if nothing is.
    """

    start: int = 0
    messages: int | None = None
    definitions: tuple[tuple[int, Fields], ...] = ()
    trouble: str = ""


def read_summary(file: ByteFile, limit: int) -> SummarySection:
    """Return the summary of a file; if its checksum is wrong, an empty one that states why."""
    try:
        return _read(file, limit)
    except BadMessage as error:
        return SummarySection(trouble=str(error))


def _read(file: ByteFile, limit: int) -> SummarySection:
    if file.size < 8 + TAIL_BYTES:
        raise BadMessage("no footer")
    tail = file.read(file.size - TAIL_BYTES, TAIL_BYTES)
    if tail[29:] != MCAP_MAGIC or tail[:9] != _FOOTER_HEAD:
        raise BadMessage("no footer")
    start, crc = int.from_bytes(tail[9:17], "little"), int.from_bytes(tail[25:29], "little")
    if start == 0:
        return SummarySection()
    inside = 8 < start <= file.size - TAIL_BYTES and file.size - start <= limit
    data = file.read(start, file.size - TAIL_BYTES - start + 25) if inside else b""
    if inside and (not crc or zlib.crc32(data) == crc):
        return _walk(start, memoryview(data)[: len(data) - 25])
    moved = _moved(file, crc)
    if moved is not None:
        return replace(
            _walk(*moved),
            trouble=(
                "the offset in the footer is wrong: bytes were inserted or removed before the"
                " summary"
            ),
        )
    raise BadMessage(
        "the checksum of the summary is wrong" if inside else "the footer points outside the file"
    )


def _moved(file: ByteFile, crc: int) -> tuple[int, memoryview] | None:
    """Return the summary that follows a data-end record and matches the checksum, if the footer's
    offset is wrong.
    """
    begin = max(file.size - _SUMMARY_SEARCH_BYTES, 8)
    window = file.read(begin, file.size - begin)
    end = len(window) - TAIL_BYTES + 25
    for match in _DATA_END.finditer(window):
        start = match.start() + 13
        if crc and start <= end - 25 and zlib.crc32(window[start:end]) == crc:
            return begin + start, memoryview(window)[start : end - 25]
    return None


def _walk(start: int, view: memoryview) -> SummarySection:
    messages, definitions = None, list[tuple[int, Fields]]()
    for opcode, begin, end in records(view):
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            definitions.append((opcode, Fields(view[begin:end])))
        elif opcode == Opcode.STATISTICS:
            messages = Fields(view[begin:end]).number(8)
    return SummarySection(start, messages, tuple(definitions))
