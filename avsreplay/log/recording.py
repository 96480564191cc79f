"""What every log of messages offers: topics, an index of its clouds, messages by place."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from avsreplay.log.cursor import BadMessage, Cursor
from avsreplay.log.options import Loss, TopicInfo

__all__ = ["CLOUD_TYPES", "MAX_NS", "CloudIndex", "MessageTable", "Recording", "Sink", "TopicCount", "canonical_type"]

MAX_NS = 2**63 - 1
CLOUD_TYPES = ("sensor_msgs/msg/PointCloud2",)
Sink = Callable[[str, str, int, bytes | memoryview], None]
"""Takes (type, encoding, log time [ns], payload) of each message of a topic, in file order."""


@dataclass(slots=True)
class CloudIndex:
    """Where the messages of one cloud topic are, in recorder's order once sorted.

    Attributes:
        log_ns, publish_ns, header_ns: the three clocks.  place: what the recording needs to find a message again.
    """

    log_ns: array[int] = field(default_factory=lambda: array("q"))
    publish_ns: array[int] = field(default_factory=lambda: array("q"))
    header_ns: array[int] = field(default_factory=lambda: array("q"))
    container: array[int] = field(default_factory=lambda: array("q"))
    offset: array[int] = field(default_factory=lambda: array("q"))
    size: array[int] = field(default_factory=lambda: array("q"))

    def add(self, clocks: tuple[int, int, int], container: int, offset: int, size: int) -> None:
        """Append a message: its (log, publish, header) times and its place."""
        for column, value in zip((self.log_ns, self.publish_ns, self.header_ns), clocks, strict=True):
            column.append(max(-(2**63), min(value, 2**63 - 1)))
        self.container.append(container)
        self.offset.append(offset)
        self.size.append(size)

    def order(self) -> list[int]:
        """Places by log time, then file order."""
        return sorted(range(len(self.log_ns)), key=self.log_ns.__getitem__)


@dataclass(slots=True)
class TopicCount:
    """A topic while it is counted."""

    name: str
    type: str
    encoding: str
    count: int = 0
    first_ns: int | None = None
    last_ns: int | None = None

    def saw(self, log_ns: int) -> None:
        """One more message."""
        self.count += 1
        if self.first_ns is None or self.last_ns is None:
            self.first_ns = self.last_ns = log_ns
        elif log_ns < self.first_ns:
            self.first_ns = log_ns
        elif log_ns > self.last_ns:
            self.last_ns = log_ns

    def info(self) -> TopicInfo:
        """What was counted."""
        return TopicInfo(self.name, self.type, self.encoding, self.count, self.first_ns, self.last_ns)


class MessageTable:
    """What a survey learns: topics with their counts, where the clouds are; truth goes to its sinks at once.

    Args:
        sinks: who takes the messages of a topic.
    """

    def __init__(self, sinks: Mapping[str, Sink] | None = None) -> None:
        self._sinks = dict(sinks or {})
        self._topics: dict[str, TopicCount] = {}
        self._clouds: dict[str, CloudIndex] = {}

    def declare(self, topic: str, kind: str, encoding: str) -> None:
        """A topic that may have messages; the first type it is declared with holds."""
        self._topics.setdefault(topic, TopicCount(topic, kind, encoding))

    def add(self, topic: str, times: tuple[int, int], payload: memoryview, place: tuple[int, int]) -> None:
        """A message of a declared topic: its (log, publish) times [ns], bytes and (container, offset)."""
        known = self._topics[topic]
        log_ns = min(times[0], MAX_NS)
        known.saw(log_ns)
        if known.type in CLOUD_TYPES:
            clocks = (log_ns, times[1], _stamp(payload, known.encoding))
            self._clouds.setdefault(topic, CloudIndex()).add(clocks, *place, len(payload))
        if topic in self._sinks:
            self._sinks[topic](known.type, known.encoding, log_ns, payload)

    def topics(self) -> list[TopicInfo]:
        """Every topic, by name."""
        return sorted((count.info() for count in self._topics.values()), key=lambda t: t.name)

    def clouds(self, topic: str) -> CloudIndex:
        """The index of a cloud topic."""
        return self._clouds.get(topic, CloudIndex())

    def encoding(self, topic: str) -> str:
        """The message encoding of a topic."""
        return self._topics[topic].encoding


def _stamp(payload: memoryview, encoding: str) -> int:
    """The header stamp of a message, 0 where it is too short to have one."""
    try:
        cursor = Cursor(payload, encoding)
        if cursor.ros1:
            cursor.u32()
        return cursor.stamp()
    except BadMessage:
        return 0


class Recording(Protocol):
    """A log of messages that was read through once."""

    losses: list[Loss]

    @property
    def kind(self) -> str:
        """What it is, in words."""

    @property
    def profile(self) -> str:
        """What the file says of its use."""

    @property
    def library(self) -> str:
        """What the file says of its writer."""

    @property
    def metadata(self) -> Mapping[str, dict[str, str]]:
        """Metadata records by name."""

    def topics(self) -> list[TopicInfo]:
        """Every topic, by name."""

    def clouds(self, topic: str) -> CloudIndex:
        """The index of a cloud topic."""

    def encoding(self, topic: str) -> str:
        """``cdr`` or ``ros1``."""

    def read(self, topic: str, place: int) -> bytes | memoryview:
        """The payload of a cloud. Raises BadMessage where it cannot be had."""

    def attachment(self) -> tuple[str, bytes] | None:
        """The name and bytes of the model, where the log carries one."""

    def close(self) -> None:
        """Let go of the files."""


def canonical_type(name: str) -> str:
    """``pkg/Type`` of ROS 1 and of old bags as ``pkg/msg/Type``."""
    package, _, rest = name.partition("/")
    return name if rest.startswith("msg/") or not rest else f"{package}/msg/{rest}"
