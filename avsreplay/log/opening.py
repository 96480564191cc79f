"""Opening of a source: which kind of bytes it is, which topic, which truth, which model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.log.conf import read_conf
from avsreplay.log.feed import MessageFeed
from avsreplay.log.folder import FolderFeed, scan_files
from avsreplay.log.header import HEADER_RECORD, decode_header
from avsreplay.log.mcap_file import McapFile
from avsreplay.log.options import ClockChoice, Loss, SourceOptions, TopicInfo
from avsreplay.log.poses import POSE_TYPES
from avsreplay.log.recording import CLOUD_TYPES, Recording, Sink
from avsreplay.log.source import Source, refuse_losses
from avsreplay.log.surface import parse_surface, read_surface
from avsreplay.log.text import shown
from avsreplay.log.truth import PoseTrack
from avsreplay.log.writer import BODY_TOPIC, TRUTH_TOPIC
from avsreplay.records import LogHeader, Surface

__all__ = ["open_source"]


def open_source(path: str | Path, options: SourceOptions | None = None) -> Source:
    """Open an MCAP file, a ROS 1 or 2 bag or a folder of scans.

    Raises:
        UnreadableInput: not there, empty, none of these, no cloud topic, or (``strict``) anything lost.
        UsageError: several cloud topics and none asked for, or a topic asked for that is not there.
    """
    path, options = Path(path), options or SourceOptions()
    if not path.exists():
        raise UnreadableInput("no such file", where=shown(path), hint="check the path")
    source = _folder(path, options) if path.is_dir() else _messages(path, options)
    try:
        if options.strict:
            refuse_losses(source)
    except UnreadableInput:
        source.close()
        raise
    return source


def _messages(path: Path, options: SourceOptions) -> Source:
    by_log = options.clock is ClockChoice.LOG
    truth, body = PoseTrack(options.truth_gap_s, by_log), PoseTrack(options.truth_gap_s, by_log)
    truth_topic = options.truth_topic or TRUTH_TOPIC
    sinks: dict[str, Sink] = {truth_topic: _poses_only(truth), BODY_TOPIC: _poses_only(body)}
    recording: Recording = McapFile(path, options.max_message_mib << 20, sinks)
    try:
        _check_truth(recording.topics(), options, path)
        topic = _cloud_topic(recording.topics(), options.topic, path)
        header, lost = _header(recording, options)
    except BaseException:
        recording.close()
        raise
    extra = {"profile": recording.profile, "library": recording.library}
    feed = MessageFeed(recording, topic)
    return Source(
        path, feed, header, options, truth=truth if len(truth) else None, body=body if len(body) else None,
        extra=extra, losses=lost,
    )  # fmt: skip


def _poses_only(track: PoseTrack) -> Sink:
    def take(kind: str, encoding: str, log_ns: int, payload: bytes | memoryview) -> None:
        if kind in POSE_TYPES:
            track.take(kind, encoding, log_ns, payload)

    return take


def _check_truth(topics: Sequence[TopicInfo], options: SourceOptions, path: Path) -> None:
    if options.truth_topic is None:
        return
    found = next((t for t in topics if t.name == options.truth_topic), None)
    if found is None or found.type not in POSE_TYPES:
        what = "no such truth topic" if found is None else f"truth topic of type {shown(found.type)}"
        hint = f"pose topics here: {_named(topics, tuple(POSE_TYPES)) or 'none'}"
        raise UsageError(f"{what}: '{shown(options.truth_topic)}'", where=shown(path), hint=hint)


def _named(topics: Sequence[TopicInfo], types: Sequence[str] = ()) -> str:
    chosen = [t for t in topics if not types or t.type in types]
    return ", ".join(f"{shown(t.name)} ({shown(t.type)})" for t in chosen[:12]) + (", ..." if len(chosen) > 12 else "")


def _cloud_topic(topics: Sequence[TopicInfo], wanted: str | None, path: Path) -> str:
    clouds = [t for t in topics if t.type in CLOUD_TYPES and (t.count or t.name == wanted)]
    if wanted is not None:
        if not any(t.name == wanted for t in clouds):
            hint = f"topics here: {_named(topics) or 'none'}"
            raise UsageError(f"no PointCloud2 topic '{shown(wanted)}'", where=shown(path), hint=hint)
        chosen = wanted
    elif not clouds:
        hint = f"topics here: {_named(topics) or 'none'}"
        raise UnreadableInput("no PointCloud2 topic with a message", where=shown(path), hint=hint)
    elif len(clouds) > 1:
        hint = f"choose one with --topic: {_named(clouds)}"
        raise UsageError(f"{len(clouds)} PointCloud2 topics", where=shown(path), hint=hint)
    else:
        chosen = clouds[0].name
    encoding = next(t.encoding for t in clouds if t.name == chosen)
    if encoding not in ("cdr", "ros1"):
        what = f"topic '{shown(chosen)}' has the unknown encoding '{shown(encoding)}'"
        raise UnreadableInput(what, where=shown(path), hint="cdr and ros1 are read")
    return chosen


def _header(recording: Recording, options: SourceOptions) -> tuple[LogHeader, tuple[Loss, ...]]:
    lost: tuple[Loss, ...] = ()
    header = LogHeader()
    if HEADER_RECORD in recording.metadata:
        try:
            header = decode_header(recording.metadata[HEADER_RECORD])
        except ValueError as error:
            lost = (Loss(shown(error), 0, 0),)
    return replace(header, surface=_surface(recording, options)), lost


def _surface(recording: Recording, options: SourceOptions) -> Surface | None:
    if options.model is not None:
        return read_surface(options.model, options.cloud_model)
    carried = recording.attachment()
    return None if carried is None else parse_surface(carried[1], carried[0])


def _folder(path: Path, options: SourceOptions) -> Source:
    confs = sorted(path.glob("*.conf"))
    truth = PoseTrack(options.truth_gap_s)
    pose_file = options.truth_file or (confs[0] if len(confs) == 1 else None)
    poses = read_conf(pose_file) if pose_file is not None and pose_file.suffix == ".conf" else {}
    files = scan_files(path, tuple(poses))
    feed = FolderFeed(files, options.rate_hz, options.max_message_mib << 20)
    for file, t_ns in zip(files, feed.header_ns, strict=True):
        if file.name in poses:
            pose = poses[file.name]
            truth.add(t_ns, (*pose.t.tolist(), *pose.q.tolist()))
    surface = None if options.model is None else read_surface(options.model, options.cloud_model)
    notes = {"source": "folder", "rate_hz": repr(options.rate_hz)}
    return Source(path, feed, LogHeader(surface=surface, notes=notes), options, truth=truth if len(truth) else None)
