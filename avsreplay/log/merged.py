"""A log split over several files, read as one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from avsreplay.log.options import Loss, TopicInfo
from avsreplay.log.recording import CloudIndex, Recording

__all__ = ["Merged"]


class Merged:
    """Several recordings in order; a Recording.

    Args:
        parts: the recordings.  kind: what they are together.  losses: those of the whole, files that are missing.
    """

    def __init__(self, parts: Sequence[Recording], kind: str, losses: Sequence[Loss] = ()) -> None:
        self.kind, self._parts = kind, list(parts)
        self.losses = [*losses, *(loss for part in parts for loss in part.losses)]

    @property
    def profile(self) -> str:
        """The first part's."""
        return self._parts[0].profile if self._parts else ""

    @property
    def library(self) -> str:
        """The first part's."""
        return self._parts[0].library if self._parts else ""

    @property
    def metadata(self) -> Mapping[str, dict[str, str]]:
        """Records by name, the first part that has one."""
        out: dict[str, dict[str, str]] = {}
        for part in reversed(self._parts):
            out.update(part.metadata)
        return out

    def topics(self) -> list[TopicInfo]:
        """Every topic of any part, counts added up."""
        out: dict[str, TopicInfo] = {}
        for topic in (t for part in self._parts for t in part.topics()):
            out[topic.name] = _joined(out[topic.name], topic) if topic.name in out else topic
        return sorted(out.values(), key=lambda t: t.name)

    def clouds(self, topic: str) -> CloudIndex:
        """The index of a cloud topic over all parts."""
        out = CloudIndex()
        for number, part in enumerate(self._parts):
            index = part.clouds(topic)
            for place, clocks in enumerate(zip(index.log_ns, index.publish_ns, index.header_ns, strict=True)):
                out.add(clocks, number, place, index.size[place])
        return out

    def encoding(self, topic: str) -> str:
        """The encoding of a topic where it first stands."""
        return next(t.encoding for t in self.topics() if t.name == topic)

    def read(self, topic: str, place: int) -> bytes | memoryview:
        """The payload of a cloud. Raises BadMessage where it cannot be had."""
        for part in self._parts:
            count = len(part.clouds(topic).log_ns)
            if place < count:
                return part.read(topic, place)
            place -= count
        raise IndexError(place)

    def attachment(self) -> tuple[str, bytes] | None:
        """The first model a part carries."""
        return next(filter(None, (part.attachment() for part in self._parts)), None)

    def close(self) -> None:
        """Let go of the files."""
        for part in self._parts:
            part.close()


def _joined(one: TopicInfo, two: TopicInfo) -> TopicInfo:
    firsts = [t for t in (one.first_ns, two.first_ns) if t is not None]
    lasts = [t for t in (one.last_ns, two.last_ns) if t is not None]
    first, last = min(firsts, default=None), max(lasts, default=None)
    return TopicInfo(one.name, one.type, one.encoding, one.count + two.count, first, last)
