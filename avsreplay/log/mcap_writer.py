"""Writing of the MCAP format: messages in compressed chunks with checksums and indexes, and a complete summary section.

A message costs one ``struct.pack``, which matters for logs of many small messages. The bytes depend only on the calls.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from typing import Any, BinaryIO

from avsreplay.log import mcap_format as mcap
from avsreplay.log.mcap_format import MAGIC

_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_MESSAGE_FIELDS = 22  # bytes between the length and the payload


def _text(value: str | bytes) -> bytes:
    raw = value.encode() if isinstance(value, str) else value
    return struct.pack("<I", len(raw)) + raw


def _map(values: Mapping[str, str]) -> bytes:
    return _text(b"".join(_text(part) for item in values.items() for part in item))


def _record(opcode: int, *parts: bytes) -> bytes:
    return b"".join((struct.pack("<BQ", opcode, sum(map(len, parts))), *parts))


def _compressed(data: bytes, compression: str) -> bytes:
    if compression == "zstd":
        import zstandard

        return zstandard.compress(data)
    if compression == "lz4":
        import lz4.frame

        frame: Any = lz4.frame
        return bytes(frame.compress(data))
    return data


class McapWriter:
    """Writer of one MCAP file to an open stream, which it does not close."""

    def __init__(
        self, stream: BinaryIO, profile: str, library: str, chunk_bytes: int, compression: str = "zstd"
    ) -> None:
        """Write the magic number and the header.

        Args:
            stream: the output; ``tell`` is called, ``seek`` is not.
            profile: of the messages, for example ``ros2``.
            library: name of the program that writes.
            chunk_bytes: a chunk ends when it exceeds this size before compression.
            compression: ``zstd``, ``lz4`` or an empty string.
        """
        self._stream, self._chunk_bytes, self._compression = stream, chunk_bytes, compression
        self._crc = self._chunks = self._attachments = self._records = 0
        self._parts: list[bytes] = []
        self._entries: dict[int, list[int]] = {}  # by channel: log time and offset in the chunk of each message
        self._size = self._begin_ns = self._end_ns = 0
        self._counts: dict[int, int] = {}
        self._span_ns: tuple[int, int] | None = None
        self._schemas: list[bytes] = []
        self._channels: list[bytes] = []
        self._indexes: dict[int, list[bytes]] = {
            mcap.CHUNK_INDEX: [],
            mcap.ATTACHMENT_INDEX: [],
            mcap.METADATA_INDEX: [],
        }
        self._write(MAGIC)
        self._write(_record(mcap.HEADER, _text(profile), _text(library)))

    def add_attachment(self, log_ns: int, create_ns: int, name: str, media_type: str, data: bytes) -> None:
        """Write an attachment.

        Args:
            log_ns: time at which it was recorded [ns].
            create_ns: time at which it was created [ns], 0 if unknown.
            name: of the file.
            media_type: for example ``application/octet-stream``.
            data: the content.
        """
        at, times = self._stream.tell(), struct.pack("<QQ", log_ns, create_ns)
        size, names = struct.pack("<Q", len(data)), _text(name) + _text(media_type)
        crc = zlib.crc32(data, zlib.crc32(times + names + size))
        record = _record(mcap.ATTACHMENT, times, names, size, data, struct.pack("<I", crc))
        self._write(record)
        self._attachments += 1
        place = struct.pack("<QQ", at, len(record))
        self._indexes[mcap.ATTACHMENT_INDEX].append(_record(mcap.ATTACHMENT_INDEX, place, times, size, names))

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record.

        Args:
            name: of the record.
            values: its content.
        """
        at, record = self._stream.tell(), _record(mcap.METADATA, _text(name), _map(values))
        self._write(record)
        self._records += 1
        place = struct.pack("<QQ", at, len(record))
        self._indexes[mcap.METADATA_INDEX].append(_record(mcap.METADATA_INDEX, place, _text(name)))

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema and return its number.

        Args:
            name: of the message type.
            encoding: of the definition, for example ``ros2msg``.
            data: the definition.
        """
        number = struct.pack("<H", len(self._schemas) + 1)
        self._schemas.append(_record(mcap.SCHEMA, number, _text(name), _text(encoding), _text(data)))
        self._add(self._schemas[-1])
        return len(self._schemas)

    def register_channel(self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str]) -> int:
        """Add a channel and return its number.

        Args:
            topic: of the messages.
            encoding: of the messages, for example ``cdr``.
            schema: number of their schema, 0 for none.
            metadata: of the channel.
        """
        numbers = struct.pack("<HH", len(self._channels) + 1, schema)
        self._channels.append(_record(mcap.CHANNEL, numbers, _text(topic), _text(encoding), _map(metadata)))
        self._add(self._channels[-1])
        return len(self._channels)

    def add_message(self, channel: int, log_ns: int, payload: bytes, publish_ns: int, sequence: int) -> None:
        """Add a message to the chunk, and write the chunk if it is full.

        Args:
            channel: number of the channel.
            log_ns: time of recording [ns].
            payload: the encoded message.
            publish_ns: time of sending [ns].
            sequence: number of the message.
        """
        entries = self._entries.get(channel)
        if entries is None:
            if not self._entries:
                self._begin_ns = self._end_ns = log_ns
            entries = self._entries[channel] = []
        entries += (log_ns, self._size)
        if log_ns > self._end_ns:
            self._end_ns = log_ns
        elif log_ns < self._begin_ns:
            self._begin_ns = log_ns
        head = _MESSAGE.pack(mcap.MESSAGE, _MESSAGE_FIELDS + len(payload), channel, sequence, log_ns, publish_ns)
        self._parts += (head, payload)
        self._size += len(head) + len(payload)
        if self._size > self._chunk_bytes:
            self.end_chunk()

    def end_chunk(self) -> None:
        """Write the chunk, if it holds a message."""
        if not self._entries:
            return
        data = b"".join(self._parts)
        packed, compression = _compressed(data, self._compression), _text(self._compression)
        times = struct.pack("<QQ", self._begin_ns, self._end_ns)
        head = struct.pack("<QI", len(data), zlib.crc32(data))
        at, size = self._stream.tell(), struct.pack("<Q", len(packed))
        record = _record(mcap.CHUNK, times, head, compression, size, packed)
        self._write(record)
        index_at, offsets, length, indexes = self._stream.tell(), [], 0, []
        for channel, entries in self._entries.items():
            offsets.append(struct.pack("<HQ", channel, index_at + length))
            number = struct.pack("<H", channel)
            indexes.append(_record(mcap.MESSAGE_INDEX, number, _text(struct.pack(f"<{len(entries)}Q", *entries))))
            length += len(indexes[-1])
            self._counts[channel] = self._counts.get(channel, 0) + len(entries) // 2
        self._write(b"".join(indexes))
        place, sizes = struct.pack("<QQ", at, len(record)), struct.pack("<QQ", len(packed), len(data))
        tail = (_text(b"".join(offsets)), struct.pack("<Q", length), compression, sizes)
        self._indexes[mcap.CHUNK_INDEX].append(_record(mcap.CHUNK_INDEX, times, place, *tail))
        self._chunks += 1
        first, last = self._span_ns or (self._begin_ns, self._end_ns)
        self._span_ns = min(first, self._begin_ns), max(last, self._end_ns)
        self._parts, self._entries, self._size = [], {}, 0

    def finish(self) -> None:
        """Write the last chunk, the summary section and the footer."""
        self.end_chunk()
        self._write(_record(mcap.DATA_END, struct.pack("<I", self._crc)))
        start, summary, offsets = self._stream.tell(), b"", b""
        groups = {mcap.SCHEMA: self._schemas, mcap.CHANNEL: self._channels, mcap.STATISTICS: [self._statistics()]}
        for opcode, records in (groups | self._indexes).items():
            group = b"".join(records)
            place = struct.pack("<BQQ", opcode, start + len(summary), len(group))
            offsets += _record(mcap.SUMMARY_OFFSET, place)
            summary += group
        footer = struct.pack("<BQQQ", mcap.FOOTER, 20, start, start + len(summary))
        crc = zlib.crc32(footer, zlib.crc32(offsets, zlib.crc32(summary)))
        self._stream.write(summary + offsets + footer + struct.pack("<I", crc) + MAGIC)

    def _add(self, record: bytes) -> None:
        self._parts.append(record)
        self._size += len(record)
        if self._size > self._chunk_bytes:
            self.end_chunk()

    def _statistics(self) -> bytes:
        counts = b"".join(struct.pack("<HQ", *item) for item in self._counts.items())
        numbers = (len(self._schemas), len(self._channels), self._attachments, self._records, self._chunks)
        head = struct.pack("<QHIIII", sum(self._counts.values()), *numbers)
        return _record(mcap.STATISTICS, head, struct.pack("<QQ", *(self._span_ns or (0, 0))), _text(counts))

    def _write(self, data: bytes) -> None:
        self._crc = zlib.crc32(data, self._crc)
        self._stream.write(data)
