"""Examination of a log (structure, checksums, clocks, gaps, duplicates, points, truth) and repair
of an MCAP file.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from avsreplay.errors import UnreadableInput, UsageError, value_class
from avsreplay.files import check_output, output_path
from avsreplay.geometry import Array
from avsreplay.log.bytes_io import BadMessage, shown
from avsreplay.log.cloud_messages import raw_message
from avsreplay.log.header import HEADER_RECORD, MODEL_ENDINGS, decode_header, parse_surface
from avsreplay.log.index import CLOUD_TYPES, MAX_NS
from avsreplay.log.mcap_file import McapFile
from avsreplay.log.mcap_format import WRITTEN_CHUNK_BYTES, Channel, is_mcap
from avsreplay.log.opening import open_source
from avsreplay.log.options import ClockSummary, LogInfo, Loss, SourceOptions
from avsreplay.log.source import Source
from avsreplay.log.writer import LIBRARY
from avsreplay.records import Scan, ScanStatus

_GAP_PERIODS = 3.0  # least gap between two scans, in periods
_LEAST_GAP_S = 0.5
_EXAMPLES = 5  # scans, or layouts of points, that a finding names
_CLOCK_OFFSET_S = 1.0  # offset of header stamps and log clock that is reported


class Severity(Enum):
    """Severity of a finding."""

    OK = "ok"  # checked without a finding
    NOTE = "note"  # information
    WARNING = "warning"  # the log can be used, but its results may be affected
    ERROR = "error"  # part of the log cannot be read


@value_class(eq=True)
class Finding:
    """A finding: severity, subject, text, and the file offsets or scan numbers it concerns."""

    severity: Severity
    about: str
    text: str
    places: tuple[int, ...] = ()


@dataclass(slots=True)
class _Tally:
    """Counts of one pass over the scans."""

    scans: int = 0
    points: int = 0
    dropped: int = 0
    with_truth: int = 0
    damaged: list[tuple[int, str]] = field(default_factory=list)
    empty: list[int] = field(default_factory=list)
    repeated: list[int] = field(default_factory=list)


def examine(path: Path, options: SourceOptions | None = None) -> tuple[LogInfo, list[Finding]]:
    """Check a log completely.

    Args:
        path: the log or folder.
        options: how it is read.

    Returns:
        The description of the source, and the findings.

    Raises:
        UnreadableInput: it cannot be opened.
        UsageError: the requested topic does not exist.
    """
    options = options or SourceOptions()
    with open_source(path, options, inspect=True) as source:
        info = source.info()
        findings = [*_losses(info.losses), *_structure(path, options), *_content(info)]
        if info.scans:
            tally, times = _pass(source)
            findings += [*_clocks(source.clock), *_gaps(times), *_scans(tally)]
            findings += [*_meaning(source), *_layout(source)]
    return info, findings


def _losses(losses: tuple[Loss, ...]) -> Iterator[Finding]:
    if not losses:
        yield Finding(Severity.OK, "damage", "no part is lost")
    for loss in losses:
        span = ""
        if loss.start_ns is not None and loss.end_ns is not None:
            span = f", {(loss.end_ns - loss.start_ns) * 1e-9:.3f} s"
        messages = "" if loss.messages is None else f", {loss.messages} messages"
        where = f"{shown(loss.file)}: " if loss.file else ""
        text = f"{where}{shown(loss.what)}: {loss.bytes} bytes{messages}{span} lost"
        yield Finding(Severity.ERROR, "damage", text, (loss.offset,))


def _structure(path: Path, options: SourceOptions) -> Iterator[Finding]:
    if not is_mcap(path):
        yield Finding(
            Severity.NOTE,
            "checksums",
            "this format has none: damage inside a message cannot be detected",
        )
        return
    file = McapFile(path, options.max_message_mib << 20)
    try:
        if file.closed_properly and file.summary.trouble:
            text = f"invalid: {file.summary.trouble}; other readers may reject the file"
            yield Finding(Severity.ERROR, "summary", text)
        elif file.closed_properly and not file.summary.start:
            yield Finding(
                Severity.WARNING, "summary", "missing: other readers are slow or reject the file"
            )
        if file.unchecked:
            yield Finding(Severity.WARNING, "checksums", f"{file.unchecked} chunks have none")
        if file.closed_properly and not file.data_checksum_holds():
            text = "the checksum over the data section is wrong"
            yield Finding(Severity.ERROR, "checksums", text)
        elif not file.unchecked and not file.losses:
            yield Finding(Severity.OK, "checksums", "all are correct")
        if file.profile != "ros2":
            yield Finding(
                Severity.NOTE,
                "profile",
                f"'{shown(file.profile)}', not ros2: some readers do not open it",
            )
        yield from _schemas(file)
    finally:
        file.close()


def _schemas(file: McapFile) -> Iterator[Finding]:
    for channel in file.channels().values():
        if channel.encoding not in ("cdr", "ros1"):
            text = (
                f"{shown(channel.topic)} is encoded as '{shown(channel.encoding)}', which is not"
                " read"
            )
            yield Finding(Severity.NOTE, "encoding", text)
        elif not channel.schema:
            yield Finding(
                Severity.NOTE, "schema", f"{shown(channel.topic)} has no message definition"
            )


def _content(info: LogInfo) -> Iterator[Finding]:
    if not info.scans:
        yield Finding(
            Severity.WARNING,
            "scans",
            "no cloud topic with a message, or several of which none was chosen",
        )
    if info.model is None:
        yield Finding(Severity.NOTE, "model", "the log has none: give --model to run it")
    elif not info.model_faces:
        yield Finding(
            Severity.NOTE, "model", f"{shown(info.model)} has no faces: it is used as a point cloud"
        )


def _pass(source: Source) -> tuple[_Tally, list[int]]:
    tally, times, last = _Tally(), list[int](), b""
    for scan in source.scans(prefetch=1):
        times.append(scan.t_ns)
        last = _count(tally, scan, last)
        tally.with_truth += source.truth_of(scan).pose is not None
    return tally, times


def _count(tally: _Tally, scan: Scan, last: bytes) -> bytes:
    tally.scans += 1
    tally.points += len(scan.points)
    tally.dropped += scan.dropped_points
    if scan.status is ScanStatus.DAMAGED:
        tally.damaged.append((scan.seq, scan.note or ""))
    elif not len(scan.points):
        tally.empty.append(scan.seq)
    data = np.ascontiguousarray(scan.points).tobytes()
    mark = zlib.crc32(data).to_bytes(4, "little") + len(data).to_bytes(8, "little") if data else b""
    if data and mark == last:
        tally.repeated.append(scan.seq)
    return mark


def _clocks(clock: ClockSummary) -> Iterator[Finding]:
    if clock.note:
        yield Finding(Severity.WARNING, "clock", clock.note)
    elif abs(clock.offset_s) > _CLOCK_OFFSET_S:
        text = (
            f"header and log clock are {clock.offset_s:+.3f} s apart; scan times are taken from the"
            f" {clock.clock} clock"
        )
        yield Finding(Severity.NOTE, "clock", text)
    for name, words in (
        ("unset", "stamps are unset"),
        ("jumps", "stamps jump"),
        ("equal", "stamps are equal to the previous one"),
        ("back", "stamps are before the previous one"),
        ("header_steps", "permanent steps of the header clock"),
        ("log_steps", "permanent steps of the log clock"),
    ):
        if count := getattr(clock, name):
            yield Finding(Severity.WARNING, "clock", f"{count} {words}")
    if not clock.placed and not clock.note:
        yield Finding(
            Severity.OK, "clock", f"every stamp is plausible; median period {clock.period_s:.4f} s"
        )


def _gaps(times: list[int]) -> Iterator[Finding]:
    steps: Array = np.diff(np.array(times, dtype=np.int64)).astype(np.float64) * 1e-9
    if not len(steps):
        return
    limit = max(_GAP_PERIODS * float(np.median(steps)), _LEAST_GAP_S)
    wide = [int(i) for i in np.flatnonzero(steps > limit)]
    if wide:
        longest = max(float(steps[i]) for i in wide)
        text = f"{len(wide)} wider than {limit:.3f} s, the widest {longest:.3f} s"
        yield Finding(Severity.WARNING, "gaps", text, tuple(wide[:_EXAMPLES]))
    else:
        yield Finding(Severity.OK, "gaps", f"none wider than {limit:.3f} s")


def _scans(tally: _Tally) -> Iterator[Finding]:
    if tally.damaged:
        seqs, first = tuple(seq for seq, _ in tally.damaged[:_EXAMPLES]), tally.damaged[0][1]
        text = f"{len(tally.damaged)} of {tally.scans} cannot be decoded, the first: {first}"
        yield Finding(Severity.ERROR, "scans", text, seqs)
    if tally.empty:
        text = f"{len(tally.empty)} of {tally.scans} have no finite point"
        yield Finding(Severity.WARNING, "scans", text, tuple(tally.empty[:_EXAMPLES]))
    if tally.repeated:
        text = f"{len(tally.repeated)} are identical to the previous scan"
        yield Finding(Severity.WARNING, "duplicates", text, tuple(tally.repeated[:_EXAMPLES]))
    total = tally.points + tally.dropped
    share = tally.dropped / total if total else 0.0
    text = f"{total} in {tally.scans} scans, {100 * share:.2f} % no returns"
    yield Finding(Severity.NOTE if tally.dropped else Severity.OK, "points", text)
    if 0 < tally.with_truth < tally.scans:
        text = f"{tally.scans - tally.with_truth} of {tally.scans} scans have none"
        yield Finding(Severity.NOTE, "truth", text)


_SEVERITIES = {"ok": Severity.OK, "check": Severity.NOTE, "fail": Severity.WARNING}


def _meaning(source: Source) -> Iterator[Finding]:
    """Report what the numbers of the clouds mean, and what is to be stated."""
    for each in source.meaning.inferences:
        advice = f"; {each.option}" if each.grade != "ok" else ""
        yield Finding(_SEVERITIES[each.grade], each.about, f"{each.sentence}{advice}")


def _layout(source: Source) -> Iterator[Finding]:
    """Report the fields of the clouds and whether they change."""
    layouts: Counter[str] = Counter()
    for layout in source.layouts():
        fields = " ".join(f"{shown(f.name)}:{f.kind}@{f.offset}" for f in layout.fields)
        order = "little" if layout.order == "<" else "big"
        layouts[
            f"{fields}, {layout.point_step} bytes a point, {order} endian, frame"
            f" '{shown(layout.frame)}'"
        ] += 1
    for text, count in layouts.most_common(_EXAMPLES):
        severity = Severity.OK if len(layouts) == 1 else Severity.WARNING
        yield Finding(severity, "layout", text if len(layouts) == 1 else f"{count} scans: {text}")


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
        self._writer: Any = Writer(stream, WRITTEN_CHUNK_BYTES, enable_data_crcs=True)
        self._writer.start(profile=profile, library=LIBRARY)
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[int, int] = {}

    def message(
        self, channel: Channel, sequence: int, times: tuple[int, int], payload: memoryview
    ) -> None:
        """Copy a message, unless it is a cloud that cannot be decoded or its time is beyond 2^63
        ns.
        """
        if channel.type in CLOUD_TYPES:
            try:
                raw_message(channel.type, payload, channel.encoding)
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
            new = self._writer.register_channel(
                channel.topic, channel.encoding, self._schemas[key], channel.metadata
            )
            self._channels[channel.id] = new
        return self._channels[channel.id]


def repair(
    path: Path, output: Path, *, overwrite: bool = False, max_message_mib: int = 128
) -> Repaired:
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
