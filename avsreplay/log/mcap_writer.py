"""Writing of the MCAP format: chunks with message indexes and checksums, and the summary section.

The bytes are those of the library ``mcap``, which takes three times as long for many small messages.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, BinaryIO

import numpy as np

from avsreplay.geometry import Array
from avsreplay.log import mcap_format as mcap

_ATTACHMENT_INDEX, _CHUNK_INDEX, _METADATA_INDEX, _SUMMARY_OFFSET = 10, 8, 13, 14
_MESSAGE = struct.Struct("<BQHIQQ")
_SCALAR = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8"), ("publish", "<u8"),
     ("head", "<u4"), ("value", "<f8")]
)  # fmt: skip
_CDR_HEAD = 0x100  # encapsulation of little-endian CDR as a number


def _record(opcode: int, *parts: bytes) -> bytes:
    content = b"".join(parts)
    return struct.pack("<BQ", opcode, len(content)) + content


def _text(value: str) -> bytes:
    data = value.encode()
    return struct.pack("<I", len(data)) + data


def _map(values: Mapping[str, str]) -> bytes:
    data = b"".join(_text(text) for pair in values.items() for text in pair)
    return struct.pack("<I", len(data)) + data


class McapWriter:
    """Writer of one MCAP file into a stream; ``finish`` completes it and leaves the stream open."""

    def __init__(
        self,
        stream: BinaryIO,
        library: str,
        compression: str = "zstd",
        chunk_bytes: int = 1 << 62,
        profile: str = "ros2",
    ) -> None:
        """Write the header.

        Args:
            stream: a binary stream with ``write``, ``flush`` and ``tell``.
            library: name of the writing program, stored in the header.
            compression: of the chunks: zstd, lz4 or "" for none.
            chunk_bytes: a chunk ends with the message with which it exceeds this size; ``flush`` ends it as well.
            profile: of the header.
        """
        self._stream, self._compression, self._chunk_bytes = stream, compression, chunk_bytes
        self._crc = self._messages = self._chunks = 0
        self._schemas, self._channels = list[bytes](), list[bytes]()
        self._chunk_index, self._attachments, self._metadata = list[bytes](), list[bytes](), list[bytes]()
        self._span: tuple[int, int] | None = None
        self._counts: dict[int, int] = {}
        self._begin_chunk()
        self._write(mcap.MAGIC)
        self._write(_record(mcap.HEADER, _text(profile), _text(library)))

    def schema(self, name: str, encoding: str, data: bytes) -> int:
        """Define a schema and return its number."""
        number = len(self._schemas) + 1
        content = struct.pack("<H", number), _text(name), _text(encoding), struct.pack("<I", len(data)), data
        self._define(self._schemas, _record(mcap.SCHEMA, *content))
        return number

    def channel(self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str]) -> int:
        """Define the channel of a topic and return its number."""
        number = len(self._channels) + 1
        content = struct.pack("<HH", number, schema), _text(topic), _text(encoding), _map(metadata)
        self._define(self._channels, _record(mcap.CHANNEL, *content))
        return number

    def message(self, channel: int, t_ns: int, data: bytes, sequence: int, sent_ns: int | None = None) -> None:
        """Append a message.

        Args:
            channel: its number.
            t_ns: time of reception [ns].
            data: encoded message.
            sequence: its number.
            sent_ns: time of sending, if it is another one [ns].
        """
        sent_ns = t_ns if sent_ns is None else sent_ns
        self._indexed(channel, t_ns, len(self._chunk))
        self._chunk += _MESSAGE.pack(mcap.MESSAGE, 22 + len(data), channel, sequence, t_ns, sent_ns)
        self._chunk += data
        self._end_message(t_ns, 1)

    def scalars(self, channels: Sequence[int], t_ns: int, values: Array, sequence: int) -> None:
        """Append one message with a 64-bit number to each of several channels.

        Args:
            channels: their numbers, each once.
            t_ns: time of reception and of sending [ns].
            values: (n,) the numbers.
            sequence: number of the messages.
        """
        at = len(self._chunk)
        block = np.empty(len(channels), _SCALAR)
        block["opcode"], block["length"], block["head"] = mcap.MESSAGE, _SCALAR.itemsize - 9, _CDR_HEAD
        block["channel"], block["sequence"], block["value"] = channels, sequence, values
        block["log"] = block["publish"] = t_ns
        for number in channels:
            self._indexed(number, t_ns, at)
            at += _SCALAR.itemsize
        self._chunk += block.tobytes()
        self._end_message(t_ns, len(channels))

    def attachment(self, name: str, media: str, data: bytes, times: tuple[int, int] = (0, 0)) -> None:
        """Write an attachment between the chunks; ``times`` are those of reception and of creation [ns]."""
        begin = struct.pack("<QQ", *times) + _text(name) + _text(media) + struct.pack("<Q", len(data))
        crc = zlib.crc32(data, zlib.crc32(begin))
        record = _record(mcap.ATTACHMENT, begin, data, struct.pack("<I", crc))
        place = struct.pack("<QQQQQ", self._stream.tell(), len(record), *times, len(data))
        self._attachments.append(_record(_ATTACHMENT_INDEX, place, _text(name), _text(media)))
        self._write(record)

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record between the chunks."""
        record = _record(mcap.METADATA, _text(name), _map(values))
        place = struct.pack("<QQ", self._stream.tell(), len(record))
        self._metadata.append(_record(_METADATA_INDEX, place, _text(name)))
        self._write(record)

    def flush(self) -> None:
        """End the chunk and write it."""
        self._end_chunk()
        self._stream.flush()

    def finish(self) -> None:
        """Write the last chunk and the summary."""
        self._end_chunk()
        self._write(_record(mcap.DATA_END, struct.pack("<I", self._crc)))
        start = self._stream.tell()
        groups = {
            mcap.SCHEMA: b"".join(self._schemas),
            mcap.CHANNEL: b"".join(self._channels),
            mcap.STATISTICS: self._statistics(),
            _CHUNK_INDEX: b"".join(self._chunk_index),
            _ATTACHMENT_INDEX: b"".join(self._attachments),
            _METADATA_INDEX: b"".join(self._metadata),
        }
        summary, offsets = b"", b""
        for opcode, group in groups.items():
            offsets += _record(_SUMMARY_OFFSET, struct.pack("<BQQ", opcode, start + len(summary), len(group)))
            summary += group
        footer = struct.pack("<BQQQ", mcap.FOOTER, 20, start, start + len(summary))
        crc = zlib.crc32(footer, zlib.crc32(summary + offsets))
        self._stream.write(summary + offsets + footer + struct.pack("<I", crc) + mcap.MAGIC)

    def _begin_chunk(self) -> None:
        self._chunk, self._index = bytearray(), dict[int, list[int]]()
        self._chunk_span: tuple[int, int] | None = None

    def _define(self, known: list[bytes], record: bytes) -> None:
        known.append(record)
        self._chunk += record
        self._end_if_full()

    def _indexed(self, channel: int, t_ns: int, at: int) -> None:
        places = self._index.get(channel)
        if places is None:
            places = self._index[channel] = []
        places += (t_ns, at)

    def _end_message(self, t_ns: int, count: int) -> None:
        low, high = self._chunk_span or (t_ns, t_ns)
        self._chunk_span = min(low, t_ns), max(high, t_ns)
        self._messages += count
        self._end_if_full()

    def _end_if_full(self) -> None:
        if len(self._chunk) > self._chunk_bytes:
            self._end_chunk()

    def _end_chunk(self) -> None:
        if self._chunk_span is None:
            return
        data, (first, last) = self._chunk, self._chunk_span
        low, high = self._span or (first, last)
        self._span, self._chunks = (min(low, first), max(high, last)), self._chunks + 1
        packed, name = _compressed(data, self._compression), _text(self._compression)
        head = struct.pack("<QQQI", first, last, len(data), zlib.crc32(data))
        record = _record(mcap.CHUNK, head, name, struct.pack("<Q", len(packed)), packed)
        start, index, offsets = self._stream.tell(), b"", b""
        for channel, places in self._index.items():
            self._counts[channel] = self._counts.get(channel, 0) + len(places) // 2
            offsets += struct.pack("<HQ", channel, start + len(record) + len(index))
            entries = struct.pack(f"<HI{len(places)}Q", channel, 8 * len(places), *places)
            index += _record(mcap.MESSAGE_INDEX, entries)
        sizes = struct.pack("<QQQQI", first, last, start, len(record), len(offsets)), offsets
        packed_sizes = struct.pack("<QQ", len(packed), len(data))
        self._chunk_index.append(_record(_CHUNK_INDEX, *sizes, struct.pack("<Q", len(index)), name, packed_sizes))
        self._write(record)
        self._write(index)
        self._begin_chunk()

    def _statistics(self) -> bytes:
        counts = b"".join(struct.pack("<HQ", *pair) for pair in self._counts.items())
        kinds = len(self._schemas), len(self._channels), len(self._attachments), len(self._metadata), self._chunks
        first, last = self._span or (0, 0)
        head = struct.pack("<QHIIIIQQI", self._messages, *kinds, first, last, len(counts))
        return _record(mcap.STATISTICS, head, counts)

    def _write(self, data: bytes) -> None:
        self._crc = zlib.crc32(data, self._crc)
        self._stream.write(data)


def _compressed(data: bytearray, compression: str) -> bytes:
    if compression == "zstd":
        import zstandard

        return zstandard.compress(data)
    if compression == "lz4":
        import lz4.frame

        frame: Any = lz4.frame
        return bytes(frame.compress(data))
    return bytes(data)
