"""What is done, one line a run, appended as it comes: the campaign's memory.

A line is ``checksum id status outcome``. A process that is killed leaves at most one torn line, which is cut off when
the campaign is taken up again. Lines stand in the order of completion; results are sorted elsewhere.
"""

from __future__ import annotations

import json
import sys
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, TypeVar

from avsreplay.errors import UnreadableInput
from avsreplay.sweep.worker import Outcome

__all__ = ["Journal"]

T = TypeVar("T")


class Journal:
    """The file of outcomes; a context manager while it is appended to.

    Attributes:
        status: of every run that is done, by its id.

    Raises:
        UnreadableInput: the file cannot be read or written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._stream: BinaryIO | None = None
        self._places: dict[str, tuple[int, int]] = {}
        self.status: dict[str, str] = {}
        self._end = 0
        if path.exists():
            self._guarded(self._index)

    def __enter__(self) -> Journal:
        def begin() -> BinaryIO:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            stream = self._path.open("ab")
            stream.truncate(self._end)  # a torn line of a run that was cut short
            return stream

        self._stream = self._guarded(begin)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def __contains__(self, run_id: str) -> bool:
        return run_id in self.status

    def add(self, outcome: Outcome) -> None:
        """Append an outcome and hand it to the system at once; one that is there already is left out."""
        stream = self._stream
        if stream is None:
            raise RuntimeError("the journal is not open")
        if outcome.id in self.status:
            return
        line = _line(outcome)

        def append() -> None:
            stream.write(line)
            stream.flush()

        self._guarded(append)
        self._note(outcome.id, outcome.status, len(line))

    def outcome(self, run_id: str) -> Outcome:
        """What the run came to. Raises KeyError for one that is not done."""
        start, size = self._places[run_id]

        def read() -> bytes:
            with self._path.open("rb") as stream:
                stream.seek(start)
                return stream.read(size)

        return _outcome(self._guarded(read))

    def outcomes(self) -> Iterator[Outcome]:
        """What is done, in the order it was finished."""
        if not self._path.exists():
            return
        with self._guarded(lambda: self._path.open("rb")) as stream:
            for _, size in self._places.values():
                yield _outcome(stream.read(size))

    def forget(self, statuses: tuple[str, ...]) -> None:
        """Drop the runs that ended so, to have them run again."""
        kept = [self.outcome(run_id) for run_id, status in self.status.items() if status not in statuses]
        partial = self._path.with_suffix(".partial")

        def rewrite() -> None:
            partial.write_bytes(b"".join(_line(outcome) for outcome in kept))
            partial.replace(self._path)

        self._guarded(rewrite)
        self._places, self.status, self._end = {}, {}, 0
        self._guarded(self._index)

    def _index(self) -> None:
        """Place and status of every whole line; stops at the first that is torn."""
        with self._path.open("rb") as stream:
            for line in stream:
                if not line.endswith(b"\n") or line[:9] != b"%08x " % zlib.crc32(line[9:-1]):
                    return
                run_id, status, _ = line[9:].split(b" ", 2)
                self._note(run_id.decode(), status.decode(), len(line))

    def _note(self, run_id: str, status: str, size: int) -> None:
        self._places[run_id] = (self._end, size)
        self.status[run_id] = status
        self._end += size

    def _guarded(self, act: Callable[[], T]) -> T:
        try:
            return act()
        except OSError as error:
            what = error.strerror or "cannot be used"
            raise UnreadableInput(what, where=str(self._path), hint="check the folder, then run it again") from None


def _line(outcome: Outcome) -> bytes:
    values = {"error": outcome.error, "metrics": outcome.metrics, "episodes": outcome.episodes}
    values["scans"] = outcome.scans
    rest = f"{outcome.id} {outcome.status} {json.dumps(values, separators=(',', ':'))}".encode()
    return b"%08x %s\n" % (zlib.crc32(rest), rest)


def _outcome(line: bytes) -> Outcome:
    run_id, status, body = line[9:-1].split(b" ", 2)
    values: dict[str, Any] = json.loads(body)
    metrics = values["metrics"] and {sys.intern(name): value for name, value in values["metrics"].items()}
    scans, episodes = (tuple(map(tuple, values.get(name, ()))) for name in ("scans", "episodes"))
    return Outcome(run_id.decode(), status.decode(), values["error"], metrics, scans, episodes)
