"""What the end of an MCAP file tells, taken only where its checksum holds."""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass, replace

from avsreplay.log import mcap_records as mcap
from avsreplay.log.byte_file import ByteFile
from avsreplay.log.cursor import BadMessage
from avsreplay.log.mcap_records import Fields

__all__ = ["TAIL", "Summary", "read_summary"]

TAIL = 37  # footer record (29 bytes) and closing magic
_DATA_END = re.compile(rb"\x0f\x04\x00{7}")
_SEARCHED = 4 << 20
_FOOTER_HEAD = b"\x02\x14\x00\x00\x00\x00\x00\x00\x00"


@dataclass(frozen=True, slots=True)
class Summary:
    """The summary section.

    Attributes:
        start: where it begins, 0 where there is none to trust.  messages: how many the file holds, None: not said.
        definitions: its schema and channel records.  trouble: what is wrong with it, "" where nothing is.
    """

    start: int = 0
    messages: int | None = None
    definitions: tuple[tuple[int, Fields], ...] = ()
    trouble: str = ""


def read_summary(file: ByteFile, limit: int) -> Summary:
    """The summary of a file, an empty one that says why where it cannot be trusted."""
    try:
        return _read(file, limit)
    except BadMessage as error:
        return Summary(trouble=str(error))


def _read(file: ByteFile, limit: int) -> Summary:
    if file.size < 8 + TAIL:
        raise BadMessage("no footer")
    tail = file.read(file.size - TAIL, TAIL)
    if tail[29:] != mcap.MAGIC or tail[:9] != _FOOTER_HEAD:
        raise BadMessage("no footer")
    start, crc = int.from_bytes(tail[9:17], "little"), int.from_bytes(tail[25:29], "little")
    if start == 0:
        return Summary()
    inside = 8 < start <= file.size - TAIL and file.size - start <= limit
    data = file.read(start, file.size - TAIL - start + 25) if inside else b""
    if inside and (not crc or zlib.crc32(data) == crc):
        return _walk(start, memoryview(data)[: len(data) - 25])
    moved = _moved(file, crc)
    if moved is not None:
        return replace(_walk(*moved), trouble="the footer points elsewhere: bytes were put in or taken out before it")
    raise BadMessage("the checksum of the summary does not hold" if inside else "the footer points outside the file")


def _moved(file: ByteFile, crc: int) -> tuple[int, memoryview] | None:
    """Where the summary is after all, when bytes before it came or went: behind an end of data, and its sum holds."""
    begin = max(file.size - _SEARCHED, 8)
    window = file.read(begin, file.size - begin)
    end = len(window) - TAIL + 25
    for match in _DATA_END.finditer(window):
        start = match.start() + 13
        if crc and start <= end - 25 and zlib.crc32(window[start:end]) == crc:
            return begin + start, memoryview(window)[start : end - 25]
    return None


def _walk(start: int, view: memoryview) -> Summary:
    messages, definitions = None, list[tuple[int, Fields]]()
    for opcode, begin, end in mcap.records(view):
        if opcode in (mcap.SCHEMA, mcap.CHANNEL):
            definitions.append((opcode, Fields(view[begin:end])))
        elif opcode == mcap.STATISTICS:
            messages = Fields(view[begin:end]).number(8)
    return Summary(start, messages, tuple(definitions))
