"""A log that grows: an MCAP file that another program still writes, or a stream that is copied to a
file meanwhile.

Times of scans and true poses may depend on what is recorded later: a permanent step of a clock is
found at its third scan, and a pose is interpolated between two. ``outdated`` compares what was used
with the finished log.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.log.bytes_io import shown
from avsreplay.log.mcap_format import MCAP_MAGIC, Opcode
from avsreplay.log.opening import open_source
from avsreplay.log.options import Loss, SourceOptions
from avsreplay.log.source import Source
from avsreplay.records import Scan, Truth

_POLL_S = 0.05
_OPENING_DURATIONS = 2.0  # seconds between two openings, per second that an opening takes
_COPIED_BYTES = 1 << 16  # most bytes of a stream that are read at once
_NO_POINTS = np.zeros((0, 3), np.float32)


class GrowingLog:
    """An MCAP file that grows; only its complete records are read.

    Attributes:
        path: the file.
        finished: whether nothing more is read: the file was closed by its recorder, the stream has
            ended, or ``stop``.
        source: the log as it was opened last.
    """

    source: Source

    def __init__(self, path: Path, feed: BinaryIO | None = None) -> None:
        """Begin.

        Args:
            path: the file; with ``feed`` it is created.
            feed: a stream that is copied to the file on a thread of its own.

        Raises:
            UnreadableInput: the file cannot be read.
            UsageError: it is not an MCAP file.
        """
        self.path, self.finished = path, False
        self._at, self._fed, self._pause_s = 0, feed is not None, _POLL_S
        self._stop, self._opened = threading.Event(), False
        self._used: list[tuple[Scan, Truth]] = []
        self._meanings = set[object]()  # of the numbers of the clouds, at each opening
        self._clock = (
            0,
            0.0,
        )  # first time and period at the first opening, from which the stages are made
        self._broken: OSError | None = None  # the error that ended the stream before its end
        if feed is not None:
            copy = path.open(
                "wb", buffering=0
            )  # here, because the folder may be gone before the thread starts
            threading.Thread(
                target=self._copy, args=(feed, copy), name="avsreplay-feed", daemon=True
            ).start()
        elif not path.is_file() or (path.stat().st_size >= len(MCAP_MAGIC) and not self._is_mcap()):
            what = "not an MCAP file" if path.exists() else "no such file"
            hint = "leave out --follow; only one MCAP file can be followed"
            raise UsageError(what, where=f"--follow {shown(path)}", hint=hint)

    def scans(self) -> Iterator[Scan]:
        """Yield the selected scans, one when the next one is there, the last one when the log is
        finished.
        """
        seq = 0
        while True:
            last = self.finished
            while seq < len(self.source) - (not last):
                yield self.source.scan_at(seq)
                seq += 1
            if last:
                return
            before = self.source
            self.open(before.options)
            before.close()

    def take(self, scan: Scan, truth: Truth) -> None:
        """Store the values of a scan and its truth that were used.

        Args:
            scan: the scan; its points are not kept.
            truth: its ground truth.
        """
        self._used.append((replace(scan, points=_NO_POINTS, times_s=None, places=None), truth))

    def outdated(self) -> bool:
        """Return whether the finished log gives another meaning, time, note or truth for a scan
        than was used.
        """
        if len(self._used) != len(self.source):
            return True
        if len(self._meanings) > 1:
            return True
        if self._clock != (self.source.first_ns, self.source.clock.period_s):
            return True
        return any(self._differs(scan, truth) for scan, truth in self._used)

    def _differs(self, scan: Scan, truth: Truth) -> bool:
        now, true = self.source.scan_at(scan.seq), self.source.truth_of(scan)
        if (now.t_ns, now.note, now.status) != (
            scan.t_ns,
            scan.note,
            scan.status,
        ) or true.fault != truth.fault:
            return True
        if (truth.pose is None, truth.state is None) != (true.pose is None, true.state is None):
            return True
        return _bytes(truth) != _bytes(true)

    def open(self, options: SourceOptions) -> Source:
        """Open the log as far as it is complete; waits until it has a scan that was not there at
        the last opening.

        Args:
            options: how to read it.

        Raises:
            UnreadableInput: the log or stream is finished and cannot be read.
            UsageError: an option does not fit to the log.
        """
        before = self._at
        while True:
            grown = self.advance()
            if self.finished or (grown and self._at > before):
                begun = time.monotonic()
                try:
                    upto = self._at if self._stop.is_set() and not self._fed else None
                    self.source = open_source(
                        self.path, options, upto=upto if self.finished else self._at
                    )
                    if self.finished and self._broken is not None:
                        self.source.add_loss(
                            Loss(f"the stream broke off: {self._broken.strerror}", self._at, 0)
                        )
                    self._meanings.add(self.source.meaning.decided)
                    if not self._opened:
                        self._opened = True
                        self._clock = self.source.first_ns, self.source.clock.period_s
                    return self.source
                except UnreadableInput as error:  # it has no scan yet
                    if self.finished and self._broken is not None:
                        error.what = f"the stream broke off: {self._broken.strerror}"
                    if self.finished:
                        raise
                finally:
                    self._pause_s = max(_POLL_S, _OPENING_DURATIONS * (time.monotonic() - begun))
            self._stop.wait(self._pause_s)

    def stop(self) -> None:
        """Wait for no more data; what is complete is still read."""
        self._stop.set()

    def advance(self) -> bool:
        """Step over the records that are complete by now; return whether there were any."""
        ending, start = self._stop.is_set(), self._at
        size = self.path.stat().st_size
        with self.path.open("rb") as file:
            if not self._at and size >= len(MCAP_MAGIC):
                self._at = len(MCAP_MAGIC) if self._is_mcap() else 0
            while self._at and self._at + 9 <= size:
                file.seek(self._at)
                head = file.read(9)
                end = self._at + 9 + int.from_bytes(head[1:], "little")
                if head[0] == Opcode.DATA_END:  # the summary follows; a stream is read to its end
                    ending = ending or (not self._fed and self._closed(size))
                    break
                if end > size:
                    break
                self._at = end
        self.finished = ending
        return self._at > start

    def _closed(self, size: int) -> bool:
        with self.path.open("rb") as file:
            file.seek(size - len(MCAP_MAGIC))
            return file.read() == MCAP_MAGIC

    def _is_mcap(self) -> bool:
        with self.path.open("rb") as file:
            return file.read(len(MCAP_MAGIC)) == MCAP_MAGIC

    def _copy(self, feed: BinaryIO, copy: BinaryIO) -> None:
        read = getattr(feed, "read1", feed.read)
        try:
            with copy:
                while block := read(_COPIED_BYTES):
                    copy.write(block)
        except OSError as error:  # the stream cannot be read, or the disk is full
            self._broken = error
        finally:
            self._stop.set()


def _bytes(truth: Truth) -> bytes:
    """Pose and state at a scan as bytes."""
    pose = b"" if truth.pose is None else truth.pose.matrix.tobytes()
    state = (
        b""
        if truth.state is None
        else truth.state.T_ac.matrix.tobytes() + truth.state.w_b.tobytes()
    )
    return pose + state
