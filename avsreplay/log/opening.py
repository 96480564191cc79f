"""Opening of a source: which kind of bytes it is, which topic, which truth, which model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.log.bags import is_bag_folder, open_recording
from avsreplay.log.cursor import BadMessage
from avsreplay.log.feed import MessageFeed
from avsreplay.log.guides import MessageGuides
from avsreplay.log.header import HEADER_RECORD, decode_header
from avsreplay.log.open_folder import open_folder
from avsreplay.log.options import Loss, SourceOptions, TopicInfo
from avsreplay.log.recording import CLOUD_TYPES, Recording
from avsreplay.log.source import Source, refuse_losses
from avsreplay.log.surface import parse_surface, read_surface
from avsreplay.log.text import shown
from avsreplay.records import LogHeader, Surface

__all__ = ["open_source"]


def open_source(path: str | Path, options: SourceOptions | None = None, *, look: bool = False) -> Source:
    """Open an MCAP file, a ROS 1 or 2 bag or a folder of scans.

    Args:
        path: the file or folder.
        options: how it is read.
        look: open it also where there is no cloud topic, or several and none is asked for: it then has no scans.

    Raises:
        UnreadableInput: not there, empty, none of these, no cloud topic, or (``strict``) anything lost.
        UsageError: several cloud topics and none asked for, or a topic asked for that is not there.
    """
    path, options = Path(path), options or SourceOptions()
    try:
        source = _opened(path, options, look)
    except OSError as error:
        raise UnreadableInput(error.strerror or "cannot be read", where=shown(path), hint="check the path") from None
    try:
        if options.strict:
            refuse_losses(source)
    except UnreadableInput:
        source.close()
        raise
    return source


def _opened(path: Path, options: SourceOptions, look: bool) -> Source:
    if not path.exists():
        raise UnreadableInput("no such file", where=shown(path), hint="check the path")
    if path.is_dir() and not is_bag_folder(path):
        return open_folder(path, options)
    if not path.is_dir() and not path.is_file():
        raise UnreadableInput("neither a file nor a folder", where=shown(path), hint="give a log or a folder of scans")
    return _messages(path, options, look)


def _messages(path: Path, options: SourceOptions, look: bool) -> Source:
    collected = MessageGuides(options)
    recording = open_recording(path, options.max_message_mib << 20, collected.sinks())
    try:
        topics = recording.topics()
        collected.check(topics, shown(path))
        topic = _looked(recording, options, path) if look else _cloud_topic(recording, options, path)
        header, lost = _header(recording, options)
        guides = collected.guides()
        feed = MessageFeed(recording, topic)
    except BaseException:
        recording.close()
        raise
    extra = {"profile": recording.profile, "library": recording.library}
    files = sorted(p for p in path.iterdir() if p.is_file()) if path.is_dir() else [path]
    return Source(path, feed, header, options, guides, files=files, extra=extra, losses=lost)


def _named(topics: Sequence[TopicInfo], types: Sequence[str] = ()) -> str:
    chosen = [t for t in topics if not types or t.type in types]
    return ", ".join(f"{shown(t.name)} ({shown(t.type)})" for t in chosen[:12]) + (", ..." if len(chosen) > 12 else "")


def _looked(recording: Recording, options: SourceOptions, path: Path) -> str | None:
    clouds = [t for t in recording.topics() if t.type in CLOUD_TYPES and t.count]
    return _cloud_topic(recording, options, path) if options.topic is not None or len(clouds) == 1 else None


def _cloud_topic(recording: Recording, options: SourceOptions, path: Path) -> str:
    wanted, topics = options.topic, recording.topics()
    clouds = [t for t in topics if t.type in CLOUD_TYPES and (t.count or t.name == wanted)]
    if wanted is not None and not any(t.name == wanted for t in clouds):
        hint = f"topics here: {_named(topics) or 'none'}"
        raise UsageError(f"no PointCloud2 topic '{shown(wanted)}'", where=shown(path), hint=hint)
    if not clouds:
        raise _no_clouds(recording, path)
    if wanted is None and len(clouds) > 1:
        hint = f"choose one with --topic: {_named(clouds)}"
        raise UsageError(f"{len(clouds)} PointCloud2 topics", where=shown(path), hint=hint)
    chosen = next(t for t in clouds if wanted in (None, t.name))
    if chosen.encoding not in ("cdr", "ros1"):
        what = f"topic '{shown(chosen.name)}' has the unknown encoding '{shown(chosen.encoding)}'"
        raise UnreadableInput(what, where=shown(path), hint="cdr and ros1 are read")
    return chosen.name


def _no_clouds(recording: Recording, path: Path) -> UnreadableInput:
    topics, advice = recording.topics(), ""
    if any("packet" in t.type.lower() for t in topics):
        advice = "these are raw sensor packets: convert them with the sensor's own driver first; "
    elif recording.losses:
        advice = f"{len(recording.losses)} part(s) of it could not be read, 'avsreplay doctor' says which; "
    hint = f"{advice}topics here: {_named(topics) or 'none'}"
    return UnreadableInput("no PointCloud2 topic with a message", where=shown(path), hint=hint)


def _header(recording: Recording, options: SourceOptions) -> tuple[LogHeader, tuple[Loss, ...]]:
    lost = list[Loss]()
    header = LogHeader()
    if HEADER_RECORD in recording.metadata:
        try:
            header = decode_header(recording.metadata[HEADER_RECORD])
        except ValueError as error:
            lost.append(Loss(shown(error), 0, 0))
    surface = read_surface(options.model, options.cloud_model) if options.model is not None else None
    if surface is None:
        surface, trouble = _carried(recording)
        lost += trouble
    return replace(header, surface=surface), tuple(lost)


def _carried(recording: Recording) -> tuple[Surface | None, list[Loss]]:
    """The log's own model; one that is no model is a loss, and the log can still be run with another."""
    try:
        found = recording.attachment()
        return (None if found is None else parse_surface(found[1], found[0])), []
    except (UnreadableInput, BadMessage) as error:
        return None, [Loss(f"the model inside cannot be used: {shown(error)}", 0, 0)]
