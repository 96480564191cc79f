"""What the readers of files of records have in common: one pass from begin to end, which lists what
is damaged and resumes at the next record that is intact.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

from avsreplay.log.bytes_io import ByteFile
from avsreplay.log.index import ChunkStore, Recording, Sink
from avsreplay.log.options import Loss

_MAX_LOSSES = 10_000
_FIRST_WINDOW_BYTES = 1 << 12  # in which the next record is searched at first: it is usually near
_MAX_WINDOW_BYTES = 1 << 20  # to which the window grows
_CANDIDATE_BYTES = 64  # by which a candidate is recognised at most
_MAX_CANDIDATES = 1_000_000


def search(
    file: ByteFile,
    at: int,
    stop: int,
    candidates: Callable[[bytes], Iterable[int]],
    accept: Callable[[int], bool],
) -> int | None:
    """Return the first offset in [at, stop) where a record begins, None if there is none.

    Args:
        file: the file.
        at: first offset.
        stop: end of the search.
        candidates: gives the places in some bytes where a record may begin.
        accept: whether one begins at an offset.
    """
    tried, width = 0, _FIRST_WINDOW_BYTES
    while at < stop:
        window = file.read_at_most(at, min(width, stop - at) + _CANDIDATE_BYTES)
        for place in candidates(window):
            tried += 1
            if tried > _MAX_CANDIDATES:  # a file made to look like records everywhere
                return None
            if at + place < stop and accept(at + place):
                return at + place
        at, width = at + width, min(2 * width, _MAX_WINDOW_BYTES)
    return None


class RecordPass(Recording):
    """Base class of the readers of files of records."""

    def __init__(
        self, path: Path, limit: int, sinks: dict[str, Sink] | None, upto: int | None = None
    ) -> None:
        super().__init__(path, limit, sinks)
        self._bad_chunk: Loss | None = None
        self._orphans = 0  # messages whose channel is not defined
        self._file = ByteFile(path, upto)
        self._chunks = ChunkStore(self._file, limit)

    def chunks(self) -> Counter[str]:
        """Return the number of chunks of each compression."""
        return self._chunks.compressions()

    def _pass(self, at: int, end: int, step: Callable[[int], int]) -> bool:
        """Take the records from ``at`` to ``end``; return whether all could be taken.

        ``step`` takes the record at an offset and returns the offset of the next one.
        """
        while at < end and len(self.losses) < _MAX_LOSSES:
            at = step(at)
        self._settle()
        if len(self.losses) >= _MAX_LOSSES:
            self._lose(Loss("damaged at too many places: the rest is not read", at, end - at))
            return False
        return True

    def _lose(self, loss: Loss) -> None:
        self.losses.append(replace(loss, file=self.path.name))

    def _lose_orphans(self) -> None:
        if self._orphans:
            what = "messages of a channel whose definition is lost"
            self._lose(Loss(what, 0, 0, messages=self._orphans))

    def _count_lost(self, messages: int) -> None:
        """Add what an index behind the last damaged chunk says about it."""
        if self._bad_chunk is not None:
            known = self._bad_chunk.messages or 0
            self._bad_chunk = replace(self._bad_chunk, messages=known + messages)

    def _settle(self) -> None:
        """List the last damaged chunk, after the indexes behind it have given its message count."""
        if self._bad_chunk is not None:
            self._lose(self._bad_chunk)
            self._bad_chunk = None

    def _too_large(self, size: int) -> str:
        return f"a record of {size} bytes is over the limit of {self._limit}"
