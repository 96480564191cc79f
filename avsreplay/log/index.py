"""The index of a log: its topics, chunks and the places of its messages; base class of the
log readers; its clouds.
"""

from __future__ import annotations

import zlib
from array import array
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from avsreplay.log.bytes_io import BadMessage, ByteFile, inflate, unpacked
from avsreplay.log.camera import CAMERA_INFO
from avsreplay.log.cloud_messages import LAYOUTS, message_stamp, raw_message
from avsreplay.log.depth_image import IMAGE_TYPES
from avsreplay.log.mcap_format import ChunkHead
from avsreplay.log.options import Loss, TopicInfo
from avsreplay.log.point_cloud2 import Layout
from avsreplay.log.raw_cloud import RawCloud
from avsreplay.read_budget import OverBudget, ReadBudget
from avsreplay.records import MAX_STAMP_S, NS_PER_S

MAX_NS = MAX_STAMP_S * NS_PER_S  # a later time is cut to this
CLOUD_TYPES = tuple(LAYOUTS)
POSE_NAMES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/TransformStamped",
)
"""Types that hold one stamped pose."""
_MCAP_COMPRESSIONS = ("", "zstd", "lz4", "bz2")
_CACHED_CHUNKS = 2  # decompressed chunks held in memory
_MOST_EXPANSION = 1000  # decompressed bytes of all chunks per byte of a file; clouds take 1 to 20
_INDEXED = (*CLOUD_TYPES, *POSE_NAMES, *IMAGE_TYPES, CAMERA_INFO)
Sink = Callable[[str, str, int, bytes | memoryview], None]
"""Receives (type, encoding, log time [ns], payload) of each message of a topic, in file order."""


def _column() -> array[int]:
    return array("q")


@dataclass(slots=True)
class CloudIndex:
    """The messages of one cloud, image or pose topic in file order; each array has one entry for
    each message.

    Attributes:
        log_ns, publish_ns, header_ns: time of reception, of sending, and in the message header
            [ns].
        container, offset, size: where the reader finds the message again.
    """

    log_ns: array[int] = field(default_factory=_column)
    publish_ns: array[int] = field(default_factory=_column)
    header_ns: array[int] = field(default_factory=_column)
    container: array[int] = field(default_factory=_column)
    offset: array[int] = field(default_factory=_column)
    size: array[int] = field(default_factory=_column)

    def add(self, clocks: tuple[int, int, int], container: int, offset: int, size: int) -> None:
        """Append a message with its (log, publish, header) times [ns]."""
        for column, value in zip(
            (self.log_ns, self.publish_ns, self.header_ns), clocks, strict=True
        ):
            column.append(max(-MAX_NS, min(value, MAX_NS)))
        self.container.append(container)
        self.offset.append(offset)
        self.size.append(size)

    def order(self) -> list[int]:
        """Return the entries ordered by log time, then by file order."""
        return sorted(range(len(self.log_ns)), key=self.log_ns.__getitem__)


@dataclass(slots=True)
class _TopicCount:
    name: str
    type: str
    encoding: str
    count: int = 0
    first_ns: int | None = None
    last_ns: int | None = None

    def add(self, log_ns: int) -> None:
        self.count += 1
        if self.first_ns is None or self.last_ns is None:
            self.first_ns = self.last_ns = log_ns
        elif log_ns < self.first_ns:
            self.first_ns = log_ns
        elif log_ns > self.last_ns:
            self.last_ns = log_ns


class MessageTable:
    """Topics with their message counts and the index of every cloud and pose topic, filled by one
    pass over the log.

    Args:
        sinks: called with every message of a topic during the pass; the sink of ``*/tf`` also for
            every other topic with this last part, as those of a namespace.
        limit: largest message that is decompressed [bytes].
    """

    def __init__(self, sinks: dict[str, Sink] | None = None, limit: int = 1 << 27) -> None:
        self._sinks, self._limit = dict(sinks or {}), limit
        self._topics: dict[str, _TopicCount] = {}
        self._clouds: dict[str, CloudIndex] = {}

    def declare(self, topic: str, kind: str, encoding: str) -> None:
        """Declare a topic; the first declared type is kept."""
        shared = self._sinks.get(f"*/{topic.rsplit('/', 1)[-1]}")
        if shared is not None:
            self._sinks.setdefault(topic, shared)
        self._topics.setdefault(topic, _TopicCount(topic, kind, encoding))

    def add(
        self, topic: str, times: tuple[int, int], payload: memoryview, place: tuple[int, int]
    ) -> None:
        """Add a message of a declared topic: (log, publish) times [ns], payload and
        (container, offset).
        """
        known = self._topics[topic]
        stored = len(payload)
        if topic in self._sinks or known.type in _INDEXED:
            try:
                payload = memoryview(unpacked(payload, known.encoding, self._limit))
            except BadMessage:  # it is indexed, and reported when it is read
                payload = memoryview(b"")
        log_ns = max(-MAX_NS, min(times[0], MAX_NS))
        known.add(log_ns)
        if known.type in _INDEXED:
            clocks = (log_ns, times[1], message_stamp(known.type, payload, known.encoding))
            self._clouds.setdefault(topic, CloudIndex()).add(clocks, *place, stored)
        if topic in self._sinks:
            self._sinks[topic](known.type, known.encoding, log_ns, payload)

    def topics(self) -> list[TopicInfo]:
        """Return all topics, sorted by name."""
        infos = (
            TopicInfo(t.name, t.type, t.encoding, t.count, t.first_ns, t.last_ns)
            for t in self._topics.values()
        )
        return sorted(infos, key=lambda t: t.name)

    def encoding(self, topic: str) -> str:
        """Return the encoding of a declared topic."""
        return self._topics[topic].encoding

    def wants(self, topic: str) -> bool:
        """Return whether a sink takes the messages of a topic."""
        return topic in self._sinks

    def clouds(self, topic: str) -> CloudIndex:
        """Return the index of a cloud topic."""
        return self._clouds.get(topic) or CloudIndex()


class ChunkStore:
    """The readable chunks of a file by number, in file order; the last two decompressed ones are
    kept in memory.

    Args:
        file: the file.
        limit: largest chunk that is read, compressed or not [bytes].
    """

    def __init__(self, file: ByteFile, limit: int) -> None:
        self._file, self._limit = file, limit
        self._budget = ReadBudget(file.size, per_byte=_MOST_EXPANSION)
        self._offset, self._packed, self._compression, self._size = (array("q") for _ in range(4))
        self._cache: dict[int, bytes] = {}

    def __len__(self) -> int:
        return len(self._offset)

    def compressions(self) -> Counter[str]:
        """Return the number of chunks of each compression."""
        return Counter(_MCAP_COMPRESSIONS[k] or "uncompressed" for k in self._compression)

    def check(self, at: int, head: ChunkHead) -> bytes:
        """Return the decompressed chunk at offset ``at``.

        Raises BadMessage if it is damaged or over the limit, or if the chunks of the file declare
        more than its bytes can hold.
        """
        if max(head.size, head.data_size) > self._limit:
            raise BadMessage(f"a chunk of {head.size} bytes is over the limit of {self._limit}")
        try:
            self._budget.take_bytes(head.size if head.compression else 0, "chunks")
        except OverBudget as error:
            raise BadMessage(str(error)) from None
        data = inflate(
            self._file.read(at + head.data_at, head.data_size), head.compression, head.size
        )
        if head.crc and zlib.crc32(data) != head.crc:
            raise BadMessage("the checksum of a chunk is wrong")
        return data

    def add(self, at: int, head: ChunkHead) -> int:
        """Add a checked chunk and return its number."""
        values = (
            at + head.data_at,
            head.data_size,
            _MCAP_COMPRESSIONS.index(head.compression),
            head.size,
        )
        for column, value in zip(
            (self._offset, self._packed, self._compression, self._size), values, strict=True
        ):
            column.append(value)
        return len(self._offset) - 1

    def __getitem__(self, number: int) -> bytes:
        """Return the decompressed chunk.

        Raises BadMessage if the file has changed since it was indexed.
        """
        if number not in self._cache:
            if len(self._cache) >= _CACHED_CHUNKS:
                self._cache.pop(next(iter(self._cache)))
            packed = self._file.read(self._offset[number], self._packed[number])
            self._cache[number] = inflate(
                packed, _MCAP_COMPRESSIONS[self._compression[number]], self._size[number]
            )
        return self._cache[number]


class Recording:
    """Base class of the log readers: a log of messages that was read once from begin to end.

    Attributes:
        path: the file.
        losses: parts that could not be read.
        metadata: MCAP metadata records by name.
        kind: the format in words.
        profile, library: what the file states about its use and its writer.
    """

    kind = ""
    profile = library = ""
    _file: ByteFile
    _chunks: ChunkStore

    def __init__(self, path: Path, limit: int, sinks: dict[str, Sink] | None = None) -> None:
        self.path, self.losses = path, list[Loss]()
        self.metadata: dict[str, dict[str, str]] = {}
        self._limit, self._table = limit, MessageTable(sinks, limit)

    def chunks(self) -> Counter[str]:
        """Return the number of chunks of each compression; a database has none."""
        return Counter()

    def topics(self) -> list[TopicInfo]:
        """Return every topic that was declared, sorted by name."""
        return self._table.topics()

    def clouds(self, topic: str) -> CloudIndex:
        """Return the index of a cloud topic."""
        return self._table.clouds(topic)

    def read(self, topic: str, place: int) -> bytes | memoryview:
        """Return the payload of the message with this index entry.

        Raises BadMessage if it cannot be read or decompressed.
        """
        return unpacked(self._stored(topic, place), self._table.encoding(topic), self._limit)

    def _stored(self, topic: str, place: int) -> bytes | memoryview:
        """Return a message as it is stored. Raises BadMessage if it cannot be read."""
        index = self._table.clouds(topic)
        chunk, offset, size = index.container[place], index.offset[place], index.size[place]
        if chunk < 0:  # the message is not inside a chunk
            return self._file.read(offset, size)
        return memoryview(self._chunks[chunk])[offset : offset + size]

    def attachment(self) -> tuple[str, bytes] | None:
        """Return name and bytes of the model file attached to the log, None if there is none."""
        return None

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class MessageClouds:
    """The clouds of one topic of a recording, ordered by log time, then by file order.

    Attributes:
        kind: the format in words.
        topic: the cloud topic, None if there is none to read.
        type: message type of the topic.
        log_ns, publish_ns, header_ns: time of reception, of sending, and in the message header
            [ns], one per cloud.
    """

    def __init__(self, recording: Recording, topic: str | None) -> None:
        self.kind, self.topic, self._recording = recording.kind, topic, recording
        index = recording.clouds(topic or "")
        self._places = index.order()
        self.type, self._encoding = next(
            ((t.type, t.encoding) for t in recording.topics() if t.name == topic), ("", "cdr")
        )
        self.log_ns = [index.log_ns[i] for i in self._places]
        self.publish_ns = [index.publish_ns[i] for i in self._places]
        self.header_ns = [index.header_ns[i] for i in self._places]

    @property
    def losses(self) -> Sequence[Loss]:
        """Parts of the log that could not be read."""
        return self._recording.losses

    def load(self, place: int) -> RawCloud:
        """Return the decoded cloud. Raises BadMessage if it cannot be decoded."""
        return raw_message(self.type, *self.payload(place))

    def layout(self, place: int) -> Layout | None:
        """Return the layout of a message of points, None if the topic has other messages.

        Raises BadMessage if it is malformed.
        """
        reader = LAYOUTS.get(self.type)
        return None if reader is None else reader(*self.payload(place))

    def payload(self, place: int) -> tuple[bytes | memoryview, str]:
        """Return the serialised message and its encoding.

        Raises BadMessage if it cannot be read.
        """
        return self._recording.read(self.topic or "", self._places[place]), self._encoding

    def topics(self) -> list[TopicInfo]:
        """Return all topics of the recording, sorted by name."""
        return self._recording.topics()

    def close(self) -> None:
        """Close the recording."""
        self._recording.close()


class Merged(Recording):
    """Several recordings in order, read as one log.

    Args:
        parts: the recordings, at least one.
        kind: the format in words.
        losses: losses of the whole, for instance missing files.
    """

    def __init__(self, parts: Sequence[Recording], kind: str, losses: Sequence[Loss] = ()) -> None:
        self.kind, self._parts = kind, list(parts)
        self.losses = [*losses, *(loss for part in parts for loss in part.losses)]
        self.profile, self.library = parts[0].profile, parts[0].library
        self.metadata = {}
        for part in reversed(self._parts):  # the first part with a record of that name counts
            self.metadata.update(part.metadata)

    def chunks(self) -> Counter[str]:
        """Return the number of chunks of each compression in all parts."""
        return sum((part.chunks() for part in self._parts), Counter[str]())

    def topics(self) -> list[TopicInfo]:
        """Return every topic of any part with the sum of its counts, sorted by name."""
        out: dict[str, TopicInfo] = {}
        for topic in (t for part in self._parts for t in part.topics()):
            out[topic.name] = _joined(out[topic.name], topic) if topic.name in out else topic
        return sorted(out.values(), key=lambda t: t.name)

    def clouds(self, topic: str) -> CloudIndex:
        """Return the index of a cloud topic over all parts."""
        out = CloudIndex()
        for number, part in enumerate(self._parts):
            index = part.clouds(topic)
            for place, clocks in enumerate(
                zip(index.log_ns, index.publish_ns, index.header_ns, strict=True)
            ):
                out.add(clocks, number, place, index.size[place])
        return out

    def read(self, topic: str, place: int) -> bytes | memoryview:
        """Return the payload of the cloud message with this index entry.

        Raises BadMessage if it cannot be read.
        """
        for part in self._parts:
            count = len(part.clouds(topic).log_ns)
            if place < count:
                return part.read(topic, place)
            place -= count
        raise IndexError(place)

    def attachment(self) -> tuple[str, bytes] | None:
        """Return the first model that a part carries."""
        return next(filter(None, (part.attachment() for part in self._parts)), None)

    def close(self) -> None:
        """Close all files."""
        for part in self._parts:
            part.close()


def _joined(one: TopicInfo, two: TopicInfo) -> TopicInfo:
    firsts = [t for t in (one.first_ns, two.first_ns) if t is not None]
    lasts = [t for t in (one.last_ns, two.last_ns) if t is not None]
    first, last = min(firsts, default=None), max(lasts, default=None)
    return TopicInfo(one.name, one.type, one.encoding, one.count + two.count, first, last)


def canonical_type(name: str) -> str:
    """Return ``pkg/msg/Type`` for ``pkg/Type``, the form of ROS 1 and of old bags."""
    package, _, rest = name.partition("/")
    return name if rest.startswith("msg/") or not rest else f"{package}/msg/{rest}"
