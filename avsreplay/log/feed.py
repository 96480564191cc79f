"""Where clouds come from: a log of messages or a folder of files, as one kind of thing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from avsreplay.log.options import Loss, TopicInfo
from avsreplay.log.point_cloud2 import Cloud, decode_cloud
from avsreplay.log.recording import Recording

__all__ = ["Feed", "MessageFeed"]


class Feed(Protocol):
    """Clouds in recorder's order, with their three clocks [ns], one entry a cloud."""

    @property
    def kind(self) -> str:
        """What it is, in words."""

    @property
    def topic(self) -> str | None:
        """The cloud topic, None where there are none."""

    @property
    def log_ns(self) -> Sequence[int]:
        """When the recorder received each cloud."""

    @property
    def publish_ns(self) -> Sequence[int]:
        """When it was sent."""

    @property
    def header_ns(self) -> Sequence[int]:
        """The stamp in its header."""

    @property
    def losses(self) -> Sequence[Loss]:
        """What could not be read of the container."""

    def load(self, place: int) -> Cloud:
        """The cloud at a place. Raises BadMessage where it cannot be decoded."""

    def payload(self, place: int) -> tuple[bytes | memoryview, str] | None:
        """The message as it stands in the log and its encoding; None where it is a file."""

    def topics(self) -> list[TopicInfo]:
        """Every topic, by name."""

    def close(self) -> None:
        """Let go of the files."""


@dataclass(slots=True)
class MessageFeed:
    """The clouds of one topic of a recording."""

    recording: Recording
    topic: str | None
    kind: str = ""
    log_ns: list[int] = field(default_factory=list)
    publish_ns: list[int] = field(default_factory=list)
    header_ns: list[int] = field(default_factory=list)
    _places: list[int] = field(default_factory=list)
    _encoding: str = "cdr"

    def __post_init__(self) -> None:
        self.kind = self.recording.kind
        if self.topic is None:
            return
        index = self.recording.clouds(self.topic)
        self._places, self._encoding = index.order(), self.recording.encoding(self.topic)
        self.log_ns = [index.log_ns[i] for i in self._places]
        self.publish_ns = [index.publish_ns[i] for i in self._places]
        self.header_ns = [index.header_ns[i] for i in self._places]

    @property
    def losses(self) -> Sequence[Loss]:
        """What could not be read of the file."""
        return self.recording.losses

    def load(self, place: int) -> Cloud:
        """The cloud at a place. Raises BadMessage where it cannot be decoded."""
        return decode_cloud(*self.payload(place))

    def payload(self, place: int) -> tuple[bytes | memoryview, str]:
        """The message as it stands in the log, and its encoding. Raises BadMessage."""
        return self.recording.read(self.topic or "", self._places[place]), self._encoding

    def topics(self) -> list[TopicInfo]:
        """Every topic, by name."""
        return self.recording.topics()

    def close(self) -> None:
        """Let go of the file."""
        self.recording.close()
