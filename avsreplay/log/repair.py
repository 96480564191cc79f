"""Repair of an MCAP file: every intact record is copied to a new file that all readers open."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.files import check_output, output_path
from avsreplay.log.bytes_io import BadMessage, shown
from avsreplay.log.header import HEADER_RECORD, decode_header
from avsreplay.log.index import CLOUD_TYPES, MAX_NS
from avsreplay.log.mcap_file import McapFile
from avsreplay.log.mcap_format import Channel, is_mcap
from avsreplay.log.point_cloud2 import decode_cloud
from avsreplay.log.surface import MODEL_ENDINGS, parse_surface
from avsreplay.log.writer import LIBRARY

_CHUNK_BYTES = 1 << 20


@dataclass(slots=True)
class Repaired:
    """Number of records that a repair copied, and the ones that it left out."""

    messages: int = 0
    attachments: int = 0
    records: int = 0
    dropped: list[str] = field(default_factory=list)


class _Copier:
    """A RecordSink that writes the records to a new file."""

    def __init__(self, stream: BinaryIO, profile: str) -> None:
        from mcap.writer import Writer

        self.done = Repaired()
        self._writer: Any = Writer(stream, _CHUNK_BYTES, enable_data_crcs=True)
        self._writer.start(profile=profile, library=LIBRARY)
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[int, int] = {}

    def message(self, channel: Channel, sequence: int, times: tuple[int, int], payload: memoryview) -> None:
        """Copy a message, unless it is a cloud that cannot be decoded or its time is beyond 2^63 ns."""
        if channel.type in CLOUD_TYPES:
            try:
                decode_cloud(payload, channel.encoding)
            except BadMessage as error:
                self.done.dropped.append(f"a cloud on {shown(channel.topic)}: {shown(error)}")
                return
        if times[0] > MAX_NS:
            self.done.dropped.append(f"a message on {shown(channel.topic)} of an impossible time")
            return
        number = self._channel(channel)
        self._writer.add_message(number, times[0], bytes(payload), min(times[1], MAX_NS), sequence)
        self.done.messages += 1

    def attachment(self, name: str, media: str, times: tuple[int, int], data: memoryview) -> None:
        """Copy an attachment, unless it is a model file that cannot be read."""
        if name.lower().endswith(MODEL_ENDINGS):
            try:
                parse_surface(bytes(data), name)
            except UnreadableInput as error:
                self.done.dropped.append(f"the model inside: {shown(error)}")
                return
        self._writer.add_attachment(times[1], times[0], name, media, bytes(data))
        self.done.attachments += 1

    def metadata(self, name: str, values: dict[str, str]) -> None:
        """Copy a metadata record, unless it is the avsreplay header with a wrong checksum."""
        if name == HEADER_RECORD:
            try:
                decode_header(values)
            except ValueError as error:
                self.done.dropped.append(f"the header record: {shown(error)}")
                return
        self._writer.add_metadata(name, values)
        self.done.records += 1

    def finish(self) -> None:
        """Write the index and the footer."""
        self._writer.finish()

    def _channel(self, channel: Channel) -> int:
        if channel.id not in self._channels:
            key = (channel.type, channel.schema_encoding, channel.schema)
            if key not in self._schemas:
                self._schemas[key] = self._writer.register_schema(*key)
            new = self._writer.register_channel(channel.topic, channel.encoding, self._schemas[key], channel.metadata)
            self._channels[channel.id] = new
        return self._channels[channel.id]


def repair(path: Path, output: Path, *, overwrite: bool = False, max_message_mib: int = 128) -> Repaired:
    """Write every intact record of an MCAP file to a new file.

    Args:
        path: the damaged file.
        output: the new file.
        overwrite: replace an existing output.
        max_message_mib: largest message, chunk or attachment that is copied [MiB].

    Returns:
        The number of records copied and a list of those left out.

    Raises:
        UsageError: the output exists or is the input, or the input is not an MCAP file.
        UnreadableInput: the input cannot be opened, or the output cannot be written.
    """
    _check(path, output, overwrite)
    probe = McapFile(path, max_message_mib << 20)
    probe.close()
    with output_path(output, overwrite=overwrite) as part, part.open("wb") as stream:
        copier = _Copier(stream, probe.profile)
        McapFile(path, max_message_mib << 20, copy_to=copier).close()
        copier.finish()
    return copier.done


def _check(path: Path, output: Path, overwrite: bool) -> None:
    if not path.exists():
        raise UnreadableInput("no such file", where=shown(path), hint="check the path")
    if output.exists() and output.samefile(path):
        raise UsageError("is the input", where=shown(output), hint="name another output")
    check_output(output, overwrite=overwrite)
    if not is_mcap(path):
        hint = "convert it with 'avsreplay record' instead"
        raise UsageError("only MCAP files are repaired", where=shown(path), hint=hint)
