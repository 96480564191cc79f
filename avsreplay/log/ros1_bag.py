"""Reading of ROS 1 bags (format 2.0) by one linear pass, so that a bag without an index or cut
short is read as well.

The rosbags library is not used because it requires an intact index and allocates the lengths that
the file declares. The format has no checksums: damage shows as inconsistent lengths or as a chunk
that cannot be decompressed.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from enum import IntEnum
from pathlib import Path

from avsreplay.errors import value_class
from avsreplay.log.bytes_io import ROS1_MAGIC, BadMessage
from avsreplay.log.index import Sink, canonical_type
from avsreplay.log.mcap_format import MAX_FOREIGN_RECORDS, ChunkHead, Fields
from avsreplay.log.options import Loss
from avsreplay.log.record_pass import RecordPass, search
from avsreplay.records import NS_PER_S


class _Op(IntEnum):
    MESSAGE = 2
    BAG = 3
    INDEX = 4
    CHUNK = 5
    CHUNK_INFO = 6
    CONNECTION = 7


# the length of a record's header, and the first of its fields, of which a chunk has three
_RECORD_HEADER = re.compile(
    rb"(?=[\x08-\x80]\x00{3}[\x04-\x40]\x00{3}(?:op=\x05|compression=|size=))"
)
_MAX_HEADER_BYTES = 1 << 16  # of the header of one record
_BAG_COMPRESSIONS = {"none": "", "bz2": "bz2", "lz4": "lz4"}


@value_class(eq=True)
class _Record:
    """The header fields of a record and the position of its data."""

    op: int
    fields: dict[str, bytes]
    data_at: int
    data_size: int

    @property
    def end(self) -> int:
        return self.data_at + self.data_size

    def number(self, name: str) -> int:
        """Return a little-endian field. Raises BadMessage if it is missing or too long."""
        if name not in self.fields or len(self.fields[name]) > 8:
            raise BadMessage(f"a record without a valid '{name}'")
        return int.from_bytes(self.fields[name], "little")


class Ros1Bag(RecordPass):
    """One ROS 1 bag, indexed on construction."""

    kind = "ros1 bag"
    profile = "ros1"

    def __init__(self, path: Path, limit: int, sinks: dict[str, Sink] | None = None) -> None:
        """Open and index the bag.

        Args:
            path: the file.
            limit: largest message or chunk that is read [bytes].
            sinks: called with every message of a topic during the pass.

        Raises:
            UnreadableInput: the file does not exist or cannot be read.
        """
        super().__init__(path, limit, sinks)
        self._topics: dict[int, str] = {}
        try:
            self._survey()
        except BaseException:
            self._file.close()
            raise

    def _survey(self) -> None:
        stop = self._index_at()
        self._adopt(stop)
        end = stop or self._file.size
        self._pass(len(ROS1_MAGIC), end, lambda at: self._step(at, end))
        if stop is None:
            self._lose(
                Loss(
                    "the bag was not closed: messages that its recorder had not yet written are"
                    " lost",
                    self._file.size,
                    0,
                )
            )
        self._lose_orphans()

    def _index_at(self) -> int | None:
        """Return the offset of the index, None if the bag was not closed or its header is
        damaged.
        """
        try:
            head = self._record(len(ROS1_MAGIC))
            place = head.number("index_pos") if head.op == _Op.BAG else 0
        except BadMessage:
            return None
        return place if head.end <= place < self._file.size else None

    def _adopt(self, at: int | None) -> None:
        """Add the connections of the index, in case the chunk that defines them is lost."""
        while at is not None and at < self._file.size:
            try:
                record = self._record(at)
                if record.op == _Op.CONNECTION:
                    self._connection(record, self._data(record))
            except BadMessage:
                return
            at = record.end

    def _step(self, at: int, end: int) -> int:
        try:
            record = self._record(at)
            if record.end > end:
                raise BadMessage("a record ends past the file")
            if record.op != _Op.INDEX:
                self._settle()
            self._take(at, record)
        except BadMessage as error:
            return self._resync(at, end, str(error))
        return record.end

    def _take(self, at: int, record: _Record) -> None:
        if record.op == _Op.CHUNK:
            self._take_chunk(at, record)
        elif record.op == _Op.MESSAGE:
            data = self._data(record)
            self._message(record, data, -1, record.data_at)
        elif record.op == _Op.CONNECTION:
            self._connection(record, self._data(record))
        elif record.op == _Op.INDEX:
            self._count_lost(record.number("count") if self._bad_chunk else 0)
        elif record.op not in (_Op.BAG, _Op.CHUNK_INFO):
            raise BadMessage(f"a record of unknown kind {record.op}")

    def _take_chunk(self, at: int, record: _Record) -> None:
        name = record.fields.get("compression", b"").decode("ascii", "replace")
        if name not in _BAG_COMPRESSIONS:
            raise BadMessage("a chunk with an unknown compression")
        head = ChunkHead(
            0,
            0,
            record.number("size"),
            0,
            _BAG_COMPRESSIONS[name],
            record.data_at - at,
            record.data_size,
        )
        try:
            data = memoryview(self._chunks.check(at, head))
            for _ in _records(data):  # checked before any of it is used
                pass
        except BadMessage as error:
            self._bad_chunk = Loss(str(error), at, record.end - at, 1)
            return
        number = self._chunks.add(at, head)
        for found in _records(data):
            body = data[found.data_at : found.end]
            if found.op == _Op.CONNECTION:
                self._connection(found, body)
            elif found.op == _Op.MESSAGE:
                self._message(found, body, number, found.data_at)

    def _connection(self, record: _Record, data: memoryview) -> None:
        number, topic = record.number("conn"), _text(record.fields.get("topic", b""))
        kind = canonical_type(_text(_fields(data).get("type", b"")))
        self._topics.setdefault(number, topic)
        self._table.declare(topic, kind, "ros1")

    def _message(self, record: _Record, payload: memoryview, container: int, offset: int) -> None:
        topic = self._topics.get(record.number("conn"))
        if topic is None:
            self._orphans += 1
            return
        time = record.number("time")
        log_ns = (time & 0xFFFFFFFF) * NS_PER_S + (time >> 32)
        self._table.add(topic, (log_ns, log_ns), payload, (container, offset))

    def _data(self, record: _Record) -> memoryview:
        if record.data_size > self._limit:
            raise BadMessage(self._too_large(record.data_size))
        return memoryview(self._file.read(record.data_at, record.data_size))

    def _record(self, at: int) -> _Record:
        size = int.from_bytes(self._file.read(at, 4), "little")
        if size > _MAX_HEADER_BYTES:
            raise BadMessage("a record header that is too long")
        raw = self._file.read(at + 4, size + 4)
        return _parsed(memoryview(raw)[:size], at + 8 + size, int.from_bytes(raw[size:], "little"))

    def _resync(self, at: int, end: int, why: str) -> int:
        found = search(
            self._file,
            at + 1,
            end,
            lambda window: (match.start() for match in _RECORD_HEADER.finditer(window)),
            lambda place: self._is_chunk(place, end),
        )
        resume = end if found is None else found
        self._lose(Loss(why, at, resume - at))
        return resume

    def _is_chunk(self, at: int, end: int) -> bool:
        try:
            record = self._record(at)
        except BadMessage:
            return False
        return record.op == _Op.CHUNK and record.end <= end


def _records(view: memoryview) -> Iterator[_Record]:
    """Yield the records of a chunk. Raises BadMessage if the last one is cut."""
    walk, foreign = Fields(view), 0
    while walk.at < len(view):
        head = walk.take(walk.number(4))
        size = walk.number(4)
        record = _parsed(head, walk.at, size)
        foreign += record.op not in (_Op.MESSAGE, _Op.CONNECTION)
        if foreign > MAX_FOREIGN_RECORDS:
            raise BadMessage("records of unknown kinds")
        yield record
        walk.take(size)


def _parsed(head: memoryview, data_at: int, data_size: int) -> _Record:
    fields = _fields(head)
    if len(fields.get("op", b"")) != 1:
        raise BadMessage("a record without an opcode")
    return _Record(fields["op"][0], fields, data_at, data_size)


def _fields(view: memoryview) -> dict[str, bytes]:
    """Return the ``name=value`` fields. Raises BadMessage if they are malformed."""
    walk, out = Fields(view), dict[str, bytes]()
    while walk.at < len(view):
        name, equals, value = bytes(walk.take(walk.number(4))).partition(b"=")
        if not equals:
            raise BadMessage("a field without a value")
        out[_text(name)] = value
    return out


def _text(raw: bytes) -> str:
    return raw.decode("utf-8", "backslashreplace")
