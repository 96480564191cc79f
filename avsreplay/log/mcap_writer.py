"""Writing of MCAP files in chunks, with indexes, a summary and checksums, for logs, results and repaired files.

The records and their order are those of the Python library ``mcap``, so that both write the same bytes. That library
spends 2 us on a message. Most messages of a result hold one number each; here they are appended as one array.
"""

from __future__ import annotations

import struct
import zlib
from collections import defaultdict
from collections.abc import Mapping
from functools import cache
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from avsreplay.log import mcap_format as mcap

_HEAD, _MESSAGE = struct.Struct("<BQ"), struct.Struct("<BQHIQQ")
_FIXED = _MESSAGE.size - _HEAD.size  # fields of a message before its payload
_NAMES = ("opcode", "length", "channel", "sequence", "log_ns", "published_ns", "payload")


class McapWriter:
    """Writer of one MCAP file; ``finish`` completes it. The bytes depend only on what is written.

    Args:
        stream: receives the bytes; it must tell its position.
        profile: of the messages, for example ``ros2``.
        library: name of the program that writes.
        compression: of the chunks: ``zstd``, ``lz4`` or ``none``.
        chunk_bytes: a chunk is written when it exceeds this size.
    """

    def __init__(
        self, stream: BinaryIO, profile: str, library: str, compression: str = "zstd", chunk_bytes: int = 1 << 20
    ) -> None:
        self._stream, self._compression, self._most = stream, "" if compression == "none" else compression, chunk_bytes
        self._chunk = bytearray()
        self._index = defaultdict[int, list[int]](list)  # channel -> time and offset of each message in the chunk
        self._start_ns: int | None = None  # of the messages in the chunk
        self._first_ns: int | None = None  # of all messages
        self._end_ns = self._last_ns = self._data_crc = 0
        self._schemas, self._channels, self._counts = list[bytes](), list[bytes](), dict[int, int]()
        kinds = (mcap.CHUNK_INDEX, mcap.ATTACHMENT_INDEX, mcap.METADATA_INDEX)
        self._indexes: dict[int, list[bytes]] = {kind: [] for kind in kinds}
        self._write(mcap.MAGIC)
        self._write(_record(mcap.HEADER, _text(profile), _text(library)))

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Append a metadata record.

        Args:
            name: of the record.
            values: its texts by name.
        """
        record = _record(mcap.METADATA, _text(name), _mapping(values))
        place = struct.pack("<QQ", self._stream.tell(), len(record))
        self._indexes[mcap.METADATA_INDEX].append(_record(mcap.METADATA_INDEX, place, _text(name)))
        self._write(record)

    def add_attachment(self, created_ns: int, log_ns: int, name: str, media: str, data: bytes) -> None:
        """Append an attachment.

        Args:
            created_ns: time of its creation [ns].
            log_ns: time of its recording [ns].
            name: its name.
            media: its media type.
            data: its content.
        """
        times, size = struct.pack("<QQ", log_ns, created_ns), struct.pack("<Q", len(data))
        body = b"".join((times, _text(name), _text(media), size, data))
        record = _record(mcap.ATTACHMENT, body, struct.pack("<I", zlib.crc32(body)))
        place = struct.pack("<QQ", self._stream.tell(), len(record))
        index = _record(mcap.ATTACHMENT_INDEX, place, times, size, _text(name), _text(media))
        self._indexes[mcap.ATTACHMENT_INDEX].append(index)
        self._write(record)

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Define a message type and return its number.

        Args:
            name: of the type.
            encoding: of its definition.
            data: its definition.
        """
        number = len(self._schemas) + 1
        body = struct.pack("<H", number), _text(name), _text(encoding), struct.pack("<I", len(data)), data
        self._define(self._schemas, _record(mcap.SCHEMA, *body))
        return number

    def register_channel(self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str]) -> int:
        """Define a channel and return its number.

        Args:
            topic: its topic.
            encoding: of its messages.
            schema: number of their type.
            metadata: texts by name.
        """
        number = len(self._channels) + 1
        body = struct.pack("<HH", number, schema), _text(topic), _text(encoding), _mapping(metadata)
        self._define(self._channels, _record(mcap.CHANNEL, *body))
        return number

    def add_message(
        self, channel: int, log_ns: int, payload: bytes | memoryview, published_ns: int, sequence: int
    ) -> None:
        """Append a message.

        Args:
            channel: number of its channel.
            log_ns: time of its recording [ns].
            payload: its content.
            published_ns: time of its publication [ns].
            sequence: its number.
        """
        head = _MESSAGE.pack(mcap.MESSAGE, _FIXED + len(payload), channel, sequence, log_ns, published_ns)
        self._index[channel].extend((log_ns, len(self._chunk)))
        self._chunk += head
        self._chunk += payload
        self._took(log_ns)

    def add_messages(self, channels: tuple[int, ...], t_ns: int, payloads: NDArray[Any], sequence: int) -> None:
        """Append messages of equal size that are recorded and published at the same time.

        Args:
            channels: n numbers of channels.
            t_ns: time of all messages [ns].
            payloads: (n,) their contents, of any type without padding.
            sequence: number of all messages.
        """
        size, begin = payloads.dtype.itemsize, len(self._chunk)
        step, index = _MESSAGE.size + size, self._index
        if not channels or begin + step * len(channels) > self._most:  # a chunk may end between two of them
            for channel, payload in zip(channels, payloads, strict=True):
                self.add_message(channel, t_ns, payload.tobytes(), t_ns, sequence)
            return
        table = np.empty(len(channels), _table_of(payloads.dtype))
        fields = (mcap.MESSAGE, _FIXED + size, channels, sequence, t_ns, t_ns, payloads)
        for name, values in zip(_NAMES, fields, strict=True):
            table[name] = values
        for channel, at in zip(channels, range(begin, begin + step * len(channels), step), strict=True):
            index[channel].extend((t_ns, at))
        self._chunk += table.tobytes()
        self._took(t_ns)

    def flush(self) -> None:
        """Write the messages so far as a chunk, and flush the stream."""
        self._end_chunk()
        self._stream.flush()

    def finish(self) -> None:
        """Write the last chunk, the summary and the footer. The stream stays open."""
        self._end_chunk()
        self._write(_record(mcap.DATA_END, struct.pack("<I", self._data_crc)))
        begin, summary, offsets = self._stream.tell(), bytearray(), []
        groups = {mcap.SCHEMA: self._schemas, mcap.CHANNEL: self._channels, mcap.STATISTICS: [self._statistics()]}
        for kind, records in (groups | self._indexes).items():
            group = b"".join(records)
            place = struct.pack("<BQQ", kind, begin + len(summary), len(group))
            offsets.append(_record(mcap.SUMMARY_OFFSET, place))
            summary += group
        footer = _HEAD.pack(mcap.FOOTER, 20) + struct.pack("<QQ", begin, begin + len(summary))
        summary += b"".join([*offsets, footer])
        self._stream.write(summary + struct.pack("<I", zlib.crc32(summary)) + mcap.MAGIC)

    def _define(self, known: list[bytes], record: bytes) -> None:
        known.append(record)
        self._chunk += record
        if len(self._chunk) > self._most:
            self._end_chunk()

    def _took(self, t_ns: int) -> None:
        """Note the time of what was added to the chunk, and write the chunk where it is full."""
        self._start_ns = t_ns if self._start_ns is None else min(self._start_ns, t_ns)
        self._end_ns = max(self._end_ns, t_ns)
        if len(self._chunk) > self._most:
            self._end_chunk()

    def _end_chunk(self) -> None:
        """Write the chunk and the index of its messages; without a message there is none."""
        if self._start_ns is None:
            return
        span, size = struct.pack("<QQ", self._start_ns, self._end_ns), len(self._chunk)
        data, compression = _compressed(self._chunk, self._compression), _text(self._compression)
        sizes = struct.pack("<QI", size, zlib.crc32(self._chunk))
        place = self._stream.tell()
        self._write(record := _record(mcap.CHUNK, span, sizes, compression, struct.pack("<Q", len(data)), data))
        at, indexes, offsets = place + len(record), bytearray(), bytearray()
        for channel, entries in self._index.items():
            offsets += struct.pack("<HQ", channel, at + len(indexes))
            listed = struct.pack(f"<HI{len(entries)}Q", channel, 8 * len(entries), *entries)
            indexes += _record(mcap.MESSAGE_INDEX, listed)
            self._counts[channel] = self._counts.get(channel, 0) + len(entries) // 2
        self._write(indexes)
        lengths = struct.pack("<QQI", place, len(record), len(offsets)), offsets, struct.pack("<Q", len(indexes))
        known = _record(mcap.CHUNK_INDEX, span, *lengths, compression, struct.pack("<QQ", len(data), size))
        self._indexes[mcap.CHUNK_INDEX].append(known)
        first = self._start_ns if self._first_ns is None else self._first_ns
        self._first_ns, self._last_ns = min(first, self._start_ns), max(self._last_ns, self._end_ns)
        self._chunk, self._start_ns, self._end_ns = bytearray(), None, 0
        self._index.clear()

    def _statistics(self) -> bytes:
        counts = b"".join(struct.pack("<HQ", channel, count) for channel, count in self._counts.items())
        attachments, metadata, chunks = (
            len(self._indexes[kind]) for kind in (mcap.ATTACHMENT_INDEX, mcap.METADATA_INDEX, mcap.CHUNK_INDEX)
        )
        numbers = sum(self._counts.values()), len(self._schemas), len(self._channels), attachments, metadata, chunks
        times = self._first_ns or 0, self._last_ns
        return _record(mcap.STATISTICS, struct.pack("<QHIIIIQQI", *numbers, *times, len(counts)), counts)

    def _write(self, data: bytes | bytearray) -> None:
        """Write a part of the data section."""
        self._data_crc = zlib.crc32(data, self._data_crc)
        self._stream.write(data)


@cache
def _table_of(payload: np.dtype[Any]) -> np.dtype[Any]:
    formats = ("u1", "<u8", "<u2", "<u4", "<u8", "<u8", payload)
    return np.dtype(list(zip(_NAMES, formats, strict=True)))


def _compressed(data: bytearray, compression: str) -> bytes | bytearray:
    if compression == "lz4":
        import lz4.frame

        frame: Any = lz4.frame
        return bytes(frame.compress(data))
    if compression == "zstd":
        import zstandard

        return zstandard.compress(data)
    return data


def _record(opcode: int, *parts: bytes | bytearray) -> bytes:
    body = b"".join(parts)
    return _HEAD.pack(opcode, len(body)) + body


def _text(value: str) -> bytes:
    raw = value.encode()
    return struct.pack("<I", len(raw)) + raw


def _mapping(values: Mapping[str, str]) -> bytes:
    body = b"".join(_text(name) + _text(value) for name, value in values.items())
    return struct.pack("<I", len(body)) + body
