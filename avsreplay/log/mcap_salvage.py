"""Recovery of a damaged MCAP file: the next readable record, and channels whose definition is lost.

A channel is defined in the first chunk and again in the summary; a recording that was killed and
then damaged at its begin has lost both. A cloud is recognised by its fields. A pose is recognised
only in a log written by this package, by a message length that no other type has.
"""

from __future__ import annotations

import re

from avsreplay.log import mcap_format as mcap
from avsreplay.log.bytes_io import BadMessage, ByteFile
from avsreplay.log.cdr import Cursor
from avsreplay.log.index import MessageTable, canonical_type
from avsreplay.log.mcap_format import Channel, Fields
from avsreplay.log.point_cloud2 import read_layout
from avsreplay.log.pose_messages import read_pose
from avsreplay.log.record_pass import search
from avsreplay.log.writer import BODY_TOPIC, LIBRARY, TRUTH_TOPIC


class ChannelTable:
    """Channels by id; the first definition of an id is used.

    Args:
        table: the table in which the topics are declared.
    """

    def __init__(self, table: MessageTable) -> None:
        self._table = table
        self._schemas: dict[int, tuple[str, str, bytes]] = {}
        self.by_id: dict[int, Channel] = {}

    def schema(self, fields: Fields) -> None:
        """Add a schema record. Raises BadMessage if it is malformed."""
        number, name, encoding = fields.number(2), fields.text(), fields.text()
        self._schemas.setdefault(number, (name, encoding, bytes(fields.take(fields.number(4)))))

    def channel(self, fields: Fields) -> None:
        """Add a channel record. Raises BadMessage if it is malformed."""
        number, schema = fields.number(2), fields.number(2)
        topic, encoding = fields.text(), fields.text()
        name, form, text = self._schemas.get(schema, ("", "", b""))
        self._take(
            Channel(number, topic, canonical_type(name), encoding, form, text, fields.mapping())
        )

    def guess(self, number: int, payload: memoryview, library: str) -> Channel | None:
        """Add the channel that a message without a definition seems to belong to; return None
        if it is unknown.
        """
        channel = guess_channel(number, payload, library)
        if channel is not None:
            self._take(channel)
        return channel

    def _take(self, channel: Channel) -> None:
        if channel.id not in self.by_id:
            self.by_id[channel.id] = channel
            self._table.declare(channel.topic, channel.type, channel.encoding)


_POSE_TYPE = "geometry_msgs/msg/PoseStamped"
_ODOMETRY_TYPE = "nav_msgs/msg/Odometry"


def guess_channel(number: int, payload: memoryview, library: str) -> Channel | None:
    """Return the channel that a message seems to belong to, None if it is unknown."""
    if _is_cloud(payload):
        return Channel(number, f"/lost/channel_{number}", "sensor_msgs/msg/PointCloud2", "cdr")
    if library == LIBRARY and _is_whole(_POSE_TYPE, payload, 7):
        return Channel(number, TRUTH_TOPIC, _POSE_TYPE, "cdr")
    if library == LIBRARY and _is_whole(_ODOMETRY_TYPE, payload, 7 + 36 + 6 + 36):
        return Channel(number, BODY_TOPIC, _ODOMETRY_TYPE, "cdr")
    return None


def _is_cloud(payload: memoryview) -> bool:
    try:
        layout = read_layout(payload)
    except BadMessage:
        return False
    return {"x", "y", "z"} <= {field.name for field in layout.fields}


def _is_whole(kind: str, payload: memoryview, doubles: int) -> bool:
    """Return whether the message is valid as ``kind`` and has exactly the length of that type."""
    try:
        read_pose(kind, payload)
        cursor = Cursor(payload)
        cursor.header()
        if kind == _ODOMETRY_TYPE:
            cursor.string()
        cursor.f64s(doubles)
    except BadMessage:
        return False
    return cursor.pos == len(cursor.data)


_MESSAGE = re.compile(rb"(?=\x05[\s\S]{4}\x00{4}[\s\S]{2})")


def is_chunk(file: ByteFile, at: int, stop: int) -> bool:
    """Return whether a plausible chunk record begins at ``at`` and ends before ``stop``."""
    try:
        mcap.chunk_head(file.read_at_most(at, mcap.CHUNK_PREFIX_BYTES), stop - at)
    except BadMessage:
        return False
    return True


def begins_record(file: ByteFile, at: int) -> bool:
    """Return whether a record with a known opcode begins at ``at`` and ends inside the file."""
    head = file.read_at_most(at, 9)
    return (
        len(head) == 9
        and 0 < head[0] < 16
        and at + 9 + int.from_bytes(head[1:], "little") <= file.size
    )


def hides_chunk(file: ByteFile, at: int, end: int) -> bool:
    """Return whether a record with a private opcode is a chunk except for its first byte."""
    try:
        mcap.chunk_head(b"\x06" + file.read_at_most(at + 1, mcap.CHUNK_PREFIX_BYTES - 1), end - at)
    except BadMessage:
        return False
    return True


def first_chunk(file: ByteFile, at: int, last: int) -> int | None:
    """Return the first offset in [at, last) where a chunk may begin, wherever it ends."""
    return search(
        file, at, last, mcap.chunk_candidates, lambda place: is_chunk(file, place, file.size)
    )


def next_record(
    file: ByteFile, at: int, stop: int, channels: frozenset[int], chunked: bool
) -> int | None:
    """Return the offset of the next chunk in [at, stop); without chunks, of the next message
    of a known channel.
    """
    if chunked:
        return search(
            file, at, stop, mcap.chunk_candidates, lambda place: is_chunk(file, place, stop)
        )
    return search(file, at, stop, _messages, lambda place: _is_message(file, place, stop, channels))


def _messages(window: bytes) -> list[int]:
    return [match.start() for match in _MESSAGE.finditer(window)]


def _is_message(file: ByteFile, at: int, stop: int, channels: frozenset[int]) -> bool:
    """Return whether a message of a known channel is followed by another record."""
    head = file.read_at_most(at, 11)
    end = at + 9 + int.from_bytes(head[1:9], "little")
    if end > stop or end < at + 31 or int.from_bytes(head[9:11], "little") not in channels:
        return False
    return end == stop or begins_record(file, end)
