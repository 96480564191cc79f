"""The clouds or measured poses of a source in order; decoded ahead on a second thread if asked."""

from __future__ import annotations

import threading
from collections.abc import Generator, Iterator, Sequence
from pathlib import Path
from queue import Empty, Full, Queue
from typing import TypeVar

import numpy as np

from avsreplay.files import BadFile
from avsreplay.log.bytes_io import BadMessage, shown
from avsreplay.log.index import Recording
from avsreplay.log.options import Loss, TopicInfo
from avsreplay.log.point_cloud2 import Cloud, decode_cloud, usable
from avsreplay.log.pose_files import read_measured
from avsreplay.log.pose_messages import decode_measured
from avsreplay.log.scan_files import read_points

T = TypeVar("T")
_WAIT_S = 0.1
_NO_POINTS = np.zeros((0, 3), np.float32)
EPOCH_NS = 1_000_000_000  # stamp of the first scan of a folder: a stamp of zero means "unset"


class MessageClouds:
    """The clouds of one topic of a recording, ordered by log time, then by file order.

    Attributes:
        kind: the format in words.
        topic: the cloud topic, None if there is none to read.
        log_ns, publish_ns, header_ns: time of reception, of sending, and in the message header [ns], one per cloud.
    """

    def __init__(self, recording: Recording, topic: str | None) -> None:
        self.kind, self.topic, self._recording = recording.kind, topic, recording
        index = recording.clouds(topic or "")
        self._places = index.order()
        self._encoding = next((t.encoding for t in recording.topics() if t.name == topic), "cdr")
        self.log_ns = [index.log_ns[i] for i in self._places]
        self.publish_ns = [index.publish_ns[i] for i in self._places]
        self.header_ns = [index.header_ns[i] for i in self._places]

    @property
    def losses(self) -> Sequence[Loss]:
        """Parts of the log that could not be read."""
        return self._recording.losses

    def load(self, place: int) -> Cloud:
        """Return the decoded cloud. Raises BadMessage if it cannot be decoded."""
        return decode_cloud(*self.payload(place))

    def payload(self, place: int) -> tuple[bytes | memoryview, str]:
        """Return the serialised message and its encoding. Raises BadMessage if it cannot be read."""
        return self._recording.read(self.topic or "", self._places[place]), self._encoding

    def topics(self) -> list[TopicInfo]:
        """Return all topics of the recording, sorted by name."""
        return self._recording.topics()

    def close(self) -> None:
        """Close the recording."""
        self._recording.close()


class PoseMessages(MessageClouds):
    """The measured poses of one topic; same interface as MessageClouds, with poses in place of points.

    Attributes:
        type: message type of the topic.
    """

    def __init__(self, recording: Recording, topic: str | None) -> None:
        super().__init__(recording, topic)
        self.type = next((t.type for t in recording.topics() if t.name == topic), "")

    def load(self, place: int) -> Cloud:
        """Return the decoded pose. Raises BadMessage if it cannot be decoded or is not valid."""
        stamp_ns, frame, pose = decode_measured(self.type, *self.payload(place))
        return Cloud(stamp_ns, frame, _NO_POINTS, None, 0, pose)


class PoseFile:
    """The measured poses of a file; same interface as MessageClouds.

    Args:
        path: the file.
        rate_hz: poses per second, used if the file has no times.
    """

    kind = "pose file"
    topic: str | None = None
    losses: Sequence[Loss] = ()

    def __init__(self, path: Path, rate_hz: float) -> None:
        found = read_measured(path)
        self._poses = found.poses
        steady = [EPOCH_NS + round(i * 1e9 / rate_hz) for i in range(len(found.poses))]
        self.log_ns = self.publish_ns = self.header_ns = steady if found.t_ns is None else list(found.t_ns)

    def load(self, place: int) -> Cloud:
        """Return one pose. Raises BadMessage if its line has no valid pose."""
        pose = self._poses[place]
        if isinstance(pose, str):
            raise BadMessage(pose)
        return Cloud(self.header_ns[place], "", _NO_POINTS, None, 0, pose)

    def payload(self, place: int) -> None:
        """Return None: the file has lines, not messages."""

    def topics(self) -> list[TopicInfo]:
        """Return no topics: it is a single file."""
        return []

    def close(self) -> None:
        """Do nothing: the file is not held open."""


class FolderClouds:
    """The scan files of a folder as clouds; same interface as MessageClouds.

    Args:
        files: the files, in order.
        rate_hz: scans per second, used if ``times_ns`` is not given.
        limit: largest file that is read [bytes].
        times_ns: time of each file [ns].
    """

    kind = "folder"
    topic: str | None = None
    losses: Sequence[Loss] = ()

    def __init__(self, files: list[Path], rate_hz: float, limit: int, times_ns: list[int] | None = None) -> None:
        self._files, self._limit = files, limit
        steady = [EPOCH_NS + round(i * 1e9 / rate_hz) for i in range(len(files))]
        self.log_ns = self.publish_ns = self.header_ns = times_ns or steady

    def load(self, place: int) -> Cloud:
        """Read one file. Raises BadMessage if it cannot be decoded."""
        path = self._files[place]
        try:
            size = path.stat().st_size
            if size > self._limit:
                raise BadFile(f"{size} bytes are over the limit of {self._limit}")
            points = read_points(path, self._limit)
        except OSError as error:
            raise BadMessage(f"{shown(path.name)}: {error.strerror}") from None
        except ValueError as error:
            raise BadMessage(f"{shown(path.name)}: {error}") from None
        chosen = usable(points)
        kept = points if chosen is None else points[chosen]
        return Cloud(self.header_ns[place], "", kept, None, len(points) - len(kept))

    def payload(self, place: int) -> None:
        """Return None: a folder has files, not messages."""

    def topics(self) -> list[TopicInfo]:
        """Return no topics: a folder has files."""
        return []

    def close(self) -> None:
        """Do nothing: no file is held open."""


CloudStream = MessageClouds | FolderClouds | PoseFile


def ahead(items: Iterator[T], count: int) -> Generator[T]:
    """Yield the same items in the same order, at most ``count`` of them computed ahead on a second thread.

    An exception of ``items`` is raised in the calling thread.
    """
    queue: Queue[tuple[bool, T | BaseException | None]] = Queue(max(count, 1))
    stop = threading.Event()

    def put(entry: tuple[bool, T | BaseException | None]) -> None:
        while not stop.is_set():
            try:
                queue.put(entry, timeout=_WAIT_S)
                return
            except Full:
                continue

    def produce() -> None:
        try:
            for item in items:
                put((True, item))
                if stop.is_set():
                    return
            put((False, None))
        except BaseException as error:  # raised again in the consumer's thread
            put((False, error))
        finally:
            if isinstance(items, Generator):
                items.close()

    thread = threading.Thread(target=produce, name="avsreplay-read-ahead", daemon=True)
    thread.start()
    try:
        yield from _drained(queue, thread)
    finally:
        stop.set()
        thread.join()


def _drained(queue: Queue[tuple[bool, T | BaseException | None]], thread: threading.Thread) -> Iterator[T]:
    while True:
        try:
            more, item = queue.get(timeout=_WAIT_S)
        except Empty:
            if thread.is_alive():
                continue
            more, item = queue.get_nowait()
        if more:
            yield item  # type: ignore[misc]
        elif isinstance(item, BaseException):
            raise item
        else:
            return
