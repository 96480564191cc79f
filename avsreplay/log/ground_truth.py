"""Lookups by time for one log: true pose, true state and pose of a moving sensor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from avsreplay.errors import UsageError
from avsreplay.geometry import Pose
from avsreplay.log.bytes_io import shown
from avsreplay.log.index import Sink
from avsreplay.log.options import ClockChoice, SourceOptions, TopicInfo
from avsreplay.log.pose_files import TimedPoses, read_poses
from avsreplay.log.pose_messages import POSE_TYPES, TF_TYPE, PoseTrack, TfBuffer
from avsreplay.log.writer import BODY_TOPIC, TRUTH_TOPIC

TruthLookup = Callable[[int, int, str], Pose | None]
"""(time [ns], number of the scan, frame of the cloud) -> T_ac or None."""


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """Lookups by time for one source; None if it has no such data. ``track`` is the truth if it is a single track.

    ``moving_in`` gives the root frame in which a frame moves, where the transforms were collected.
    """

    truth: TruthLookup | None = None
    track: PoseTrack | None = None
    body: PoseTrack | None = None
    sensor: Callable[[int, str], Pose | None] | None = None
    moving_in: Callable[[str], str | None] = lambda _frame: None


@dataclass(slots=True)
class TruthCollector:
    """Collects poses, states and transforms while a log is read.

    Args:
        options: how the log is read.
    """

    options: SourceOptions
    _truth: PoseTrack = field(init=False)
    _body: PoseTrack = field(init=False)
    _sensor: PoseTrack = field(init=False)
    _tf: TfBuffer = field(init=False)

    def __post_init__(self) -> None:
        gap, by_log = self.options.truth_gap_s, self.options.clock is ClockChoice.LOG
        self._truth, self._body, self._sensor = (PoseTrack(gap, by_log) for _ in range(3))
        self._tf = TfBuffer(gap, by_log)

    def sinks(self, *, transforms: bool = False) -> dict[str, Sink]:
        """Return the sink of each topic; ``transforms``: collect those of the log also if no option names a frame."""
        out = {self.options.truth_topic or TRUTH_TOPIC: _poses_only(self._truth), BODY_TOPIC: _poses_only(self._body)}
        if self.options.sensor_topic is not None:
            out[self.options.sensor_topic] = _poses_only(self._sensor)
        if self._wants_tf or transforms:
            out.update({"/tf": self._tf.sink(static=False), "/tf_static": self._tf.sink(static=True)})
        return out

    def check(self, topics: Sequence[TopicInfo], where: str) -> None:
        """Raise UsageError if a requested topic or frame does not exist."""
        for role, name in (("truth", self.options.truth_topic), ("sensor", self.options.sensor_topic)):
            found = next((t for t in topics if t.name == name), None)
            if name is not None and (found is None or found.type not in POSE_TYPES):
                what = f"no such {role} topic" if found is None else f"{role} topic of type {shown(found.type)}"
                hint = f"pose topics here: {_poses_of(topics) or 'none'}"
                raise UsageError(f"{what}: '{shown(name)}'", where=where, hint=hint)
        for frame in (self.options.truth_frame, self.options.fixed_frame):
            if frame is not None and frame.lstrip("/") not in self._tf.frames():
                hint = f"frames of its {TF_TYPE}: {', '.join(map(shown, self._tf.frames()[:20])) or 'none'}"
                raise UsageError(f"no frame '{shown(frame)}'", where=where, hint=hint)

    def ground_truth(self) -> GroundTruth:
        """Return the lookups, after the log was read."""
        truth, track = self._truth_lookup()
        body = self._body if len(self._body) else None
        return GroundTruth(truth, track, body, self._sensor_lookup(), self._tf.moving_in)

    @property
    def _wants_tf(self) -> bool:
        return self.options.truth_frame is not None or self.options.fixed_frame is not None

    def _truth_lookup(self) -> tuple[TruthLookup | None, PoseTrack | None]:
        child, fixed = self.options.truth_frame, self.options.fixed_frame
        if self.options.truth_file is not None:
            return file_truth(read_poses(self.options.truth_file), self.options.truth_gap_s)
        if child is not None:
            return (lambda t_ns, _place, frame: self._tf.pose(fixed or frame, child, t_ns)), None
        return _by_time(self._truth) if len(self._truth) else (None, None)

    def _sensor_lookup(self) -> Callable[[int, str], Pose | None] | None:
        fixed = self.options.fixed_frame
        if self.options.sensor_topic is not None:
            return lambda t_ns, _frame: self._sensor.pose(t_ns)
        if fixed is not None:
            return lambda t_ns, frame: self._tf.pose(fixed, frame, t_ns)
        return None


def file_truth(found: TimedPoses, gap_s: float) -> tuple[TruthLookup, PoseTrack | None]:
    """Return a lookup in a pose file and its track: by time if the file has times, else by line without a track."""
    if found.t_ns is None:
        poses = found.poses
        return (lambda _t_ns, place, _frame: poses[place] if place < len(poses) else None), None
    track = PoseTrack(gap_s)
    for t_ns, pose in zip(found.t_ns, found.poses, strict=True):
        track.add(t_ns, (*pose.t.tolist(), *pose.q.tolist()))
    return _by_time(track)


def _by_time(track: PoseTrack) -> tuple[TruthLookup, PoseTrack]:
    return (lambda t_ns, _place, _frame: track.pose(t_ns)), track


def _poses_of(topics: Sequence[TopicInfo]) -> str:
    return ", ".join(f"{shown(t.name)} ({t.type})" for t in topics if t.type in POSE_TYPES)


def _poses_only(track: PoseTrack) -> Sink:
    def take(kind: str, encoding: str, log_ns: int, payload: bytes | memoryview) -> None:
        if kind in POSE_TYPES:
            track.take(kind, encoding, log_ns, payload)

    return take
