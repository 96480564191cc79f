"""Reading of MCAP: one linear pass that verifies every checksum and resumes after damage.

The pass needs neither index nor summary: it reads intact records, lists damaged ones, counts
messages per topic, notes the position of every cloud and passes poses to their sinks. Clouds are
read later by position. An intact summary provides the channels whose first chunk is lost and the
number of messages that are missing.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from avsreplay.errors import UnreadableInput
from avsreplay.log import mcap_format as mcap
from avsreplay.log.bytes_io import BadMessage, shown
from avsreplay.log.header import MODEL_ENDINGS
from avsreplay.log.index import MAX_NS, Sink
from avsreplay.log.mcap_format import Channel, Fields, RecordSink, SummarySection, read_summary
from avsreplay.log.mcap_salvage import (
    ChannelTable,
    begins_record,
    first_chunk,
    hides_chunk,
    next_record,
)
from avsreplay.log.options import Loss
from avsreplay.log.record_pass import RecordPass

_TIME_PAIR = struct.Struct("<QQ")
_CHECKSUM_BYTES = 1 << 20  # most bytes whose checksum is taken at once
_LEAST_CHUNK_BYTES = 49
_LEAST_MESSAGE_BYTES = 22


class McapFile(RecordPass):
    """One MCAP file, indexed on construction.

    Attributes:
        closed_properly: whether the file has a data-end record.
        summary: the summary section as far as it is valid.
        data_end: (offset, checksum) of the data-end record.
        unchecked: number of chunks without a checksum.
    """

    kind = "mcap"

    def __init__(
        self,
        path: Path,
        limit: int,
        sinks: dict[str, Sink] | None = None,
        copy_to: RecordSink | None = None,
        upto: int | None = None,
    ) -> None:
        """Open and index the file.

        Args:
            path: the file.
            limit: largest message, chunk or attachment that is read [bytes].
            sinks: called with every message of a topic during the pass.
            copy_to: receives every intact record (for a repair).
            upto: number of bytes that are read of a file that still grows.

        Raises:
            UnreadableInput: the file does not exist, is empty or is not MCAP.
        """
        self._copy_to = copy_to
        super().__init__(path, limit, sinks, upto)
        self.closed_properly = False
        self.summary, self.data_end, self.unchecked = SummarySection(), (0, 0), 0
        self._channels = ChannelTable(self._table)
        self._model: tuple[str, int, int] | None = None
        self._resume: int | None = None
        self._trusted = 8  # everything before this offset is confirmed by a checksum
        self._seen, self._open_end, self._size = 0, upto is not None, self._file.size
        try:
            self._survey()
        except BaseException:
            self._file.close()
            raise

    def channels(self) -> dict[int, Channel]:
        """Return the channels by id."""
        return dict(self._channels.by_id)

    def data_checksum_holds(self) -> bool:
        """Return whether the checksum over the whole data section is correct; True if the
        file has none.
        """
        end, expected = self.data_end
        crc, at = 0, 0
        while expected and at < end:
            block = self._file.read(at, min(_CHECKSUM_BYTES, end - at))
            crc, at = zlib.crc32(block, crc), at + len(block)
        return crc == expected

    def attachment(self) -> tuple[str, bytes] | None:
        """Return name and bytes of the first attachment that is a mesh file, None if there is
        none.
        """
        if self._model is None:
            return None
        name, offset, size = self._model
        return name, self._file.read(offset, size)

    def _survey(self) -> None:
        if self._size == 0:
            raise UnreadableInput(
                "the file is empty", where=shown(self.path), hint="record it again"
            )
        if self._size < 8 or self._file.read(0, 8) != mcap.MCAP_MAGIC:
            hint = "give an MCAP, a ROS bag or a folder of scans"
            if self.path.suffix.lower() in (".csv", ".tum", ".txt"):
                hint += "; measured poses in a file need --backend poses (info: --poses)"
            raise UnreadableInput("not an MCAP file", where=shown(self.path), hint=hint)
        summary = self.summary = read_summary(self._file, self._limit)
        self._adopt(summary)
        whole = self._pass(8, self._size, lambda at: self._step(at, summary))
        if self.closed_properly:
            self._after_end(self.data_end[0] + 13)
        elif whole and not self._open_end:
            self._lose(
                Loss(
                    "the file was not closed: messages that its recorder had not yet written are"
                    " lost",
                    self._size,
                    0,
                )
            )
        self._account(summary)

    def _after_end(self, at: int) -> None:
        """List a second log behind the footer of this one, as in two files that were joined."""
        opcode: int = mcap.Opcode.DATA_END
        while opcode != mcap.Opcode.FOOTER and at + 9 <= self._size:
            head = self._file.read(at, 9)
            opcode, at = head[0], at + 9 + int.from_bytes(head[1:], "little")
        end = at + len(mcap.MCAP_MAGIC)
        if end + 8 <= self._size and self._file.read(end, 8) == mcap.MCAP_MAGIC:
            self._lose(
                Loss(
                    "another log follows the end of this one: replay each file by itself",
                    end,
                    self._size - end,
                )
            )

    def _step(self, at: int, summary: SummarySection) -> int:
        """Process one record and return the offset of the next one."""
        if at + 9 > self._size:
            self._lose(Loss("the file is cut inside a record", at, self._size - at))
            return self._size
        head = self._file.read(at, 9)
        opcode, length = head[0], int.from_bytes(head[1:], "little")
        end = at + 9 + length
        if opcode != mcap.Opcode.MESSAGE_INDEX:
            self._settle()
        try:
            if end > self._size or (summary.start and end > summary.start):
                raise BadMessage("a record ends past the file")
            if (
                length > self._limit
                and opcode != mcap.Opcode.CHUNK
                and begins_record(self._file, end)
            ):
                self._lose(Loss(self._too_large(length), at, end - at))
                return end
            self._take(opcode, at, end)
        except BadMessage as error:
            return self._resync(at, summary, str(error))
        resume, self._resume = self._resume or end, None
        return self._size if self.closed_properly else resume

    def _take(self, opcode: int, at: int, end: int) -> None:
        handler = _HANDLERS.get(opcode)
        if handler is not None:
            handler(self, at, end)
        elif opcode < 0x80:
            raise BadMessage(f"a record of unknown kind 0x{opcode:02x}")
        elif end - at > _LEAST_CHUNK_BYTES and (
            hides_chunk(self._file, at, end) or self._swallowed(at, end) is not None
        ):
            raise BadMessage("a chunk with a damaged opcode")

    def _content(self, at: int, end: int) -> Fields:
        if end - at > self._limit:
            raise BadMessage(self._too_large(end - at))
        return Fields(memoryview(self._file.read(at + 9, end - at - 9)))

    def _take_header(self, at: int, end: int) -> None:
        fields = self._content(at, end)
        self.profile, self.library = fields.text(), fields.text()

    def _take_metadata(self, at: int, end: int) -> None:
        fields = self._content(at, end)
        name, values = fields.text(), fields.mapping()
        if fields.at != len(fields.view) and not self._is_padded(at, end):
            raise BadMessage("a metadata record longer than its content")
        self.metadata.setdefault(name, values)
        if self._copy_to is not None:
            self._copy_to.metadata(name, values)

    def _is_padded(self, at: int, end: int) -> bool:
        """Return whether bytes after the content of a record are padding, which the format allows,
        and not what a damaged length takes from the next records.
        """
        return begins_record(self._file, end) and self._swallowed(at, end) is None

    def _take_message(self, at: int, end: int) -> None:
        if end - at < 31:
            raise BadMessage("a message shorter than its fixed fields")
        if len(self._chunks):  # no writer mixes the two: more likely a damaged opcode
            raise BadMessage("a message outside the chunks of a chunked file")
        payload = self._content(at, end).view
        self._message(payload, 0, len(payload), -1, at + 9)

    def _take_message_index(self, at: int, end: int) -> None:
        fields = Fields(memoryview(self._file.read_at_most(at + 9, min(6, end - at - 9))))
        fields.take(2)
        size = fields.number(4)
        if size % 16 or size != end - at - 15:
            raise BadMessage("a message index whose lengths contradict each other")
        self._count_lost(size // 16)

    def _take_attachment(self, at: int, end: int) -> None:
        fields = self._content(at, end)
        times = _TIME_PAIR.unpack(fields.take(16))
        name, media = fields.text(), fields.text()
        size = fields.number(8)
        start = at + 9 + fields.at
        data = fields.take(size)
        checked = fields.view[: fields.at]
        crc = fields.number(4)
        if crc and zlib.crc32(checked) != crc:
            if self._swallowed(at, end) is not None:
                raise BadMessage("an attachment whose length is damaged")
            self._lose(Loss(f"the checksum of attachment '{shown(name)}' is wrong", at, end - at))
            return
        if self._model is None and name.lower().endswith(MODEL_ENDINGS):
            self._model = (name, start, size)
        if self._copy_to is not None:
            self._copy_to.attachment(name, media, times, data)

    def _take_data_end(self, at: int, end: int) -> None:
        if end - at != 13:
            raise BadMessage("the data-end record is malformed")
        self.closed_properly = True
        self.data_end = (at, int.from_bytes(self._file.read(at + 9, 4), "little"))

    def _take_chunk(self, at: int, end: int) -> None:
        head = mcap.chunk_head(
            self._file.read_at_most(at, min(mcap.CHUNK_PREFIX_BYTES, end - at)), end - at
        )
        try:
            data = self._chunks.check(at, head)
            for opcode, begin, stop in mcap.records(
                memoryview(data)
            ):  # checked before any of it is used
                if opcode == mcap.Opcode.MESSAGE and stop - begin < _LEAST_MESSAGE_BYTES:
                    raise BadMessage("a message shorter than its fixed fields")
        except BadMessage as error:
            start_ns, end_ns = (min(t, MAX_NS) for t in (head.start_ns, head.end_ns))
            self._resume = self._swallowed(at, end)
            self._bad_chunk = Loss(
                str(error), at, (self._resume or end) - at, 1, None, start_ns, end_ns
            )
            return
        number, self._trusted = self._chunks.add(at, head), end
        self.unchecked += head.crc == 0
        view = memoryview(data)
        for opcode, begin, stop in mcap.records(view):
            if opcode == mcap.Opcode.MESSAGE:
                self._message(view, begin, stop, number, begin)
            elif opcode == mcap.Opcode.SCHEMA:
                self._channels.schema(Fields(view[begin:stop]))
            elif opcode == mcap.Opcode.CHANNEL:
                self._channels.channel(Fields(view[begin:stop]))

    def _swallowed(self, at: int, end: int) -> int | None:
        """Return the offset of an intact chunk inside a damaged record whose declared length is too
        large.
        """
        inner = first_chunk(self._file, at + 1, end)
        if inner is None:
            return None
        head = mcap.chunk_head(self._file.read_at_most(inner, mcap.CHUNK_PREFIX_BYTES))
        try:
            self._chunks.check(inner, head)
        except BadMessage:
            return None
        return inner

    def _message(self, view: memoryview, begin: int, end: int, container: int, offset: int) -> None:
        if end - begin < 22:
            raise BadMessage("a message shorter than its fixed fields")
        channel_id = view[begin] | view[begin + 1] << 8
        channel = self._channels.by_id.get(channel_id) or self._guessed(
            channel_id, view[begin + 22 : end]
        )
        self._seen += 1
        if channel is None:
            self._orphans += 1
            return
        times = (
            int.from_bytes(view[begin + 6 : begin + 14], "little"),
            int.from_bytes(view[begin + 14 : begin + 22], "little"),
        )
        self._table.add(channel.topic, times, view[begin + 22 : end], (container, offset + 22))
        if self._copy_to is not None:
            sequence = int.from_bytes(view[begin + 2 : begin + 6], "little")
            self._copy_to.message(channel, sequence, times, view[begin + 22 : end])

    def _guessed(self, number: int, payload: memoryview) -> Channel | None:
        channel = (
            None
            if self.summary.definitions
            else self._channels.guess(number, payload, self.library)
        )
        if channel is not None:
            self._lose(
                Loss(
                    f"the definition of a channel, recognised by its messages as {channel.type}",
                    0,
                    0,
                )
            )
        return channel

    def _resync(self, at: int, summary: SummarySection, why: str) -> int:
        """Return the next offset after ``at`` where a readable record begins."""
        inner = self._swallowed(self._trusted - 1, at)
        if inner is not None:  # the record before this one declared too many bytes
            self._lose(Loss(why, inner, 0))
            self._trusted = inner + 1
            return inner
        self._trusted = at  # this part is searched once only
        stop = summary.start - 13 if summary.start else self._size
        chunked = bool(len(self._chunks)) or not self._seen
        found = next_record(self._file, at + 1, stop, frozenset(self._channels.by_id), chunked)
        resume = found if found is not None else max(stop, at + 1)
        self._lose(Loss(why, at, resume - at))
        return resume

    def _adopt(self, summary: SummarySection) -> None:
        """Add the channels of an intact summary, in case the chunk that defines them is lost."""
        for opcode, fields in summary.definitions:
            (self._channels.schema if opcode == mcap.Opcode.SCHEMA else self._channels.channel)(
                fields
            )

    def _account(self, summary: SummarySection) -> None:
        """List the messages that the summary counts and the pass did not find."""
        self._lose_orphans()
        known = self._seen + sum(loss.messages or 0 for loss in self.losses if loss.chunks)
        blind = [loss for loss in self.losses if loss.bytes and loss.messages is None]
        missing = 0 if summary.messages is None else summary.messages - known
        if missing > 0 and len(blind) == 1:
            self.losses[self.losses.index(blind[0])] = replace(blind[0], messages=missing)
        elif missing > 0:
            self._lose(
                Loss(
                    "messages that the summary counts and the file does not contain",
                    0,
                    0,
                    messages=missing,
                )
            )


_HANDLERS: dict[int, Callable[[McapFile, int, int], None]] = {
    mcap.Opcode.HEADER: McapFile._take_header,
    mcap.Opcode.SCHEMA: lambda file, at, end: file._channels.schema(file._content(at, end)),
    mcap.Opcode.CHANNEL: lambda file, at, end: file._channels.channel(file._content(at, end)),
    mcap.Opcode.MESSAGE: McapFile._take_message,
    mcap.Opcode.CHUNK: McapFile._take_chunk,
    mcap.Opcode.MESSAGE_INDEX: McapFile._take_message_index,
    mcap.Opcode.ATTACHMENT: McapFile._take_attachment,
    mcap.Opcode.METADATA: McapFile._take_metadata,
    mcap.Opcode.DATA_END: McapFile._take_data_end,
}
