"""The topic of a recording whose messages are the scans: clouds, depth images or measured poses."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from avsreplay.errors import UnreadableInput, UsageError, counted
from avsreplay.log.bytes_io import shown
from avsreplay.log.cloud_messages import FOXGLOVE
from avsreplay.log.depth_stream import depth_topics
from avsreplay.log.index import CLOUD_TYPES, POSE_NAMES, Recording
from avsreplay.log.options import SourceOptions, TopicInfo

_LISTED_TOPICS = 12  # topics that a message names
_CONVERTED = (
    (
        re.compile(r"CompressedPointCloud", re.IGNORECASE),
        "these are compressed clouds (Draco): decompress them first, with"
        " 'ros2 run point_cloud_transport republish' or a Foxglove converter; ",
    ),
    (
        re.compile(r"packet|velodynescan|rslidarscan|hesaiscan|pandarscan|udpframe", re.IGNORECASE),
        "these are raw sensor packets: convert them with the sensor's own driver first; ",
    ),
    (
        re.compile(r"LaserScan"),
        "a LaserScan is one line of points: collect several into clouds first, with"
        " laser_assembler for instance; ",
    ),
)
"""Types of messages that hold points and are not read, with how to convert them."""


def scan_topics(recording: Recording, options: SourceOptions) -> list[TopicInfo]:
    """Return the topics of scans with a message: of measured poses if the options say so, else
    those of clouds and, where there is none, those of depth images.
    """
    kinds = POSE_NAMES if options.poses else CLOUD_TYPES
    found = [t for t in recording.topics() if t.type in kinds and t.count]
    return found if found or options.poses else depth_topics(recording)


def optional_topic(recording: Recording, options: SourceOptions, path: Path) -> str | None:
    """Return the topic of scans, None if there are several or none and none is named.

    Raises UsageError or UnreadableInput as ``chosen_topic``.
    """
    named = options.topic is not None or len(scan_topics(recording, options)) == 1
    return chosen_topic(recording, options, path) if named else None


def chosen_topic(recording: Recording, options: SourceOptions, path: Path) -> str:
    """Return the topic of scans.

    Args:
        recording: the log.
        options: how it is read; they may name the topic.
        path: of the log, for messages.

    Raises:
        UsageError: there are several topics and none is named, or the named one has no scans.
        UnreadableInput: there is none, or its encoding is not read.
    """
    wanted, topics = options.topic, recording.topics()
    what = "pose" if options.poses else "cloud"
    if wanted is None:
        found = scan_topics(recording, options)
    else:
        kinds = POSE_NAMES if options.poses else CLOUD_TYPES
        images = [] if options.poses else depth_topics(recording)
        found = [t for t in topics if t.type in kinds or t in images]
        found = [t for t in found if t.name == wanted]
        if not found:
            hint = f"topics here: {_named(topics) or 'none'}"
            raise UsageError(f"no {what} topic '{shown(wanted)}'", where=shown(path), hint=hint)
    if not found:
        raise _without_scans(recording, path, what)
    if len(found) > 1:
        hint = f"choose a --topic: {_named(found)}"
        raise UsageError(f"{len(found)} {what} topics", where=shown(path), hint=hint)
    chosen = found[0]
    if chosen.encoding not in ("cdr", "ros1") and chosen.type != FOXGLOVE:
        what = f"topic '{shown(chosen.name)}' has the unknown encoding '{shown(chosen.encoding)}'"
        raise UnreadableInput(what, where=shown(path), hint="cdr and ros1 are read")
    return chosen.name


def _named(topics: Sequence[TopicInfo]) -> str:
    more = ", ..." if len(topics) > _LISTED_TOPICS else ""
    return ", ".join(f"{shown(t.name)} ({shown(t.type)})" for t in topics[:_LISTED_TOPICS]) + more


def _without_scans(recording: Recording, path: Path, what: str) -> UnreadableInput:
    topics, advice = recording.topics(), ""
    filled = [t for t in topics if t.count]
    converted = [text for kind, text in _CONVERTED if any(kind.search(t.type) for t in filled)]
    if what != "pose" and any(t.type in POSE_NAMES for t in filled):
        advice = "to use its poses as the measurement add --backend poses; "
    elif what != "pose" and converted:
        advice = converted[0]
    elif recording.losses:
        parts = counted(len(recording.losses), "part")
        advice = f"{parts} of it could not be read, 'avsreplay doctor' lists them; "
    hint = f"{advice}topics here: {_named(topics) or 'none'}"
    return UnreadableInput(f"no {what} topic with a message", where=shown(path), hint=hint)
