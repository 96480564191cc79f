"""Finding the way again in a damaged MCAP file: the next place where a chunk, or a message outside one, may begin."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable

from avsreplay.log import mcap_records as mcap
from avsreplay.log.byte_file import ByteFile
from avsreplay.log.cursor import BadMessage

__all__ = ["begins_record", "first_chunk", "hides_chunk", "is_chunk", "next_record"]

_WINDOW = 1 << 20
_MARGIN = 64  # a candidate is told by so many bytes behind its first
_MAX_CANDIDATES = 1_000_000
_MESSAGE = re.compile(rb"(?=\x05[\s\S]{4}\x00{4}[\s\S]{2})")


def is_chunk(file: ByteFile, at: int, stop: int) -> bool:
    """Could a chunk record stand at ``at`` and end by ``stop``?"""
    try:
        mcap.chunk_head(file.upto(at, mcap.CHUNK_PREFIX), stop - at)
    except BadMessage:
        return False
    return True


def begins_record(file: ByteFile, at: int) -> bool:
    """Could a record of a known kind begin at ``at`` and end inside the file?"""
    head = file.upto(at, 9)
    return len(head) == 9 and 0 < head[0] < 16 and at + 9 + int.from_bytes(head[1:], "little") <= file.size


def hides_chunk(file: ByteFile, at: int, end: int) -> bool:
    """Is a record of a private kind a chunk but for its first byte?"""
    try:
        mcap.chunk_head(b"\x06" + file.upto(at + 1, mcap.CHUNK_PREFIX - 1), end - at)
    except BadMessage:
        return False
    return True


def first_chunk(file: ByteFile, at: int, last: int) -> int | None:
    """The first place in [at, last) where a chunk may begin, wherever it ends."""
    return _search(file, at, last, mcap.chunk_candidates, lambda place: is_chunk(file, place, file.size))


def next_record(file: ByteFile, at: int, stop: int, channels: frozenset[int], chunked: bool) -> int | None:
    """The next chunk in [at, stop); in a file without chunks the next message of a known channel."""
    if chunked:
        return _search(file, at, stop, mcap.chunk_candidates, lambda place: is_chunk(file, place, stop))
    return _search(file, at, stop, _messages, lambda place: _is_message(file, place, stop, channels))


def _messages(window: bytes) -> list[int]:
    return [match.start() for match in _MESSAGE.finditer(window)]


def _is_message(file: ByteFile, at: int, stop: int, channels: frozenset[int]) -> bool:
    """A message of a known channel behind which another record begins."""
    head = file.upto(at, 11)
    end = at + 9 + int.from_bytes(head[1:9], "little")
    if end > stop or end < at + 31 or int.from_bytes(head[9:11], "little") not in channels:
        return False
    return end == stop or begins_record(file, end)


def _search(
    file: ByteFile,
    at: int,
    stop: int,
    candidates: Callable[[bytes], Iterable[int]],
    accept: Callable[[int], bool],
) -> int | None:
    tried = 0
    while at < stop:
        window = file.upto(at, min(_WINDOW, stop - at) + _MARGIN)
        for place in candidates(window):
            tried += 1
            if tried > _MAX_CANDIDATES:  # bytes made to look like records everywhere
                return None
            if at + place < stop and accept(at + place):
                return at + place
        at += _WINDOW
    return None
