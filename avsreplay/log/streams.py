"""Clouds or measured poses of a source in order, and its true poses, states and sensor poses by
time.

The clouds are decoded ahead on a second thread if requested.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from queue import Empty, Full, Queue
from typing import TypeVar

from avsreplay import geometry
from avsreplay.errors import UsageError, value_class
from avsreplay.geometry import Array, MeasuredPose, Pose
from avsreplay.log.bytes_io import BadMessage, shown
from avsreplay.log.camera import Camera
from avsreplay.log.depth_image import DepthImage, depth_cloud, read_png
from avsreplay.log.header import with_vertices
from avsreplay.log.index import MessageClouds, Sink
from avsreplay.log.options import ClockChoice, Loss, SourceOptions, TopicInfo
from avsreplay.log.pose_files import TimedPoses, read_poses
from avsreplay.log.pose_messages import POSE_TYPES, TF_TYPE, PoseTrack, TfBuffer, decode_measured
from avsreplay.log.raw_cloud import RawCloud, of_points
from avsreplay.log.scan_files import read_points
from avsreplay.log.writer import BODY_TOPIC, TRUTH_TOPIC
from avsreplay.read_budget import BadFile
from avsreplay.records import LogHeader

T = TypeVar("T")
_QUEUE_WAIT_S = 0.1
# stamp of the first scan of a folder: a stamp of zero means "unset"
FOLDER_EPOCH_NS = 1_000_000_000


class PoseMessages(MessageClouds):
    """The measured poses of one topic; same interface as MessageClouds, with poses in place of
    points.
    """

    def load(self, place: int) -> RawCloud:
        """Return the decoded pose. Raises BadMessage if it cannot be decoded or is not valid."""
        stamp_ns, frame, pose = decode_measured(self.type, *self.payload(place))
        return RawCloud(stamp_ns, frame, {}, (1, 0), pose=pose)


class _Files:
    """What clouds and poses from files have in common; same interface as MessageClouds."""

    topic: str | None = None
    losses: Sequence[Loss] = ()

    def layout(self, place: int) -> None:
        """Return None: files hold no messages."""

    def topics(self) -> list[TopicInfo]:
        """Return no topics."""
        return []

    def close(self) -> None:
        """Do nothing: no file is held open."""


class PoseFile(_Files):
    """The measured poses of a file.

    Args:
        path: the file.
        rate_hz: poses per second, used if the file has no times.
    """

    kind = "pose file"

    def __init__(self, path: Path, rate_hz: float) -> None:
        found = read_poses(path)
        self._poses = found.poses
        self.timed = found.t_ns is not None
        steady = [FOLDER_EPOCH_NS + round(i * 1e9 / rate_hz) for i in range(len(found.poses))]
        self.log_ns = self.publish_ns = self.header_ns = (
            steady if found.t_ns is None else found.t_ns
        )

    def load(self, place: int) -> RawCloud:
        """Return one pose. Raises BadMessage if its line has no valid pose."""
        pose = self._poses[place]
        if isinstance(pose, str):
            raise BadMessage(pose)
        return RawCloud(self.header_ns[place], "", {}, (1, 0), pose=pose)


class FolderClouds(_Files):
    """The scan files of a folder as clouds.

    Args:
        files: the files, in order.
        rate_hz: scans per second, used if ``times_ns`` is not given.
        limit: largest file that is read [bytes].
        times_ns: time of each file [ns].
        camera: of the files, if they are depth images.
    """

    kind = "folder"

    def __init__(
        self,
        files: list[Path],
        rate_hz: float,
        limit: int,
        times_ns: list[int] | None = None,
        camera: Camera | None = None,
    ) -> None:
        self._files, self._limit, self._camera = files, limit, camera
        steady = [FOLDER_EPOCH_NS + round(i * 1e9 / rate_hz) for i in range(len(files))]
        self.log_ns = self.publish_ns = self.header_ns = times_ns or steady

    def load(self, place: int) -> RawCloud:
        """Read one file. Raises BadMessage if it cannot be decoded."""
        path = self._files[place]
        try:
            size = path.stat().st_size
            if size > self._limit:
                raise BadFile(f"{size} bytes are over the limit of {self._limit}")
            if self._camera is not None:
                values = read_png(path.read_bytes(), self._limit)
                return depth_cloud(DepthImage(self.header_ns[place], "", values), self._camera)
            points = read_points(path, self._limit)
        except OSError as error:
            raise BadMessage(f"{shown(path.name)}: {error.strerror}") from None
        except ValueError as error:
            raise BadMessage(f"{shown(path.name)}: {error}") from None
        return of_points(points, self.header_ns[place])


CloudStream = MessageClouds | FolderClouds | PoseFile


def ahead(items: Iterator[T], count: int) -> Generator[T]:
    """Yield the same items in the same order, at most ``count`` of them computed ahead on a second
    thread.

    An exception of ``items`` is raised in the calling thread.
    """
    queue: Queue[tuple[bool, T | BaseException | None]] = Queue(max(count, 1))
    stop = threading.Event()

    def put(entry: tuple[bool, T | BaseException | None]) -> None:
        while not stop.is_set():
            try:
                queue.put(entry, timeout=_QUEUE_WAIT_S)
                return
            except Full:
                continue

    def produce() -> None:
        try:
            for item in items:
                put((True, item))
                if stop.is_set():
                    return
            put((False, None))
        except BaseException as error:  # raised again in the consumer's thread
            put((False, error))
        finally:
            if isinstance(items, Generator):
                items.close()

    thread = threading.Thread(target=produce, name="avsreplay-read-ahead", daemon=True)
    thread.start()
    try:
        yield from _drained(queue, thread)
    finally:
        stop.set()
        thread.join()


def _drained(
    queue: Queue[tuple[bool, T | BaseException | None]], thread: threading.Thread
) -> Iterator[T]:
    while True:
        try:
            more, item = queue.get(timeout=_QUEUE_WAIT_S)
        except Empty:
            if thread.is_alive():
                continue
            more, item = queue.get_nowait()
        if more:
            yield item  # type: ignore[misc]
        elif isinstance(item, BaseException):
            raise item
        else:
            return


TruthLookup = Callable[[int, int, str], Pose | None]
"""(time [ns], number of the scan, frame of the cloud) -> T_ac or None."""


@value_class(eq=True)
class GroundTruth:
    """Lookups by time for one source; None if it has no such data. ``track`` is the truth if it is
    a single track.

    Where the transforms were collected, ``moving_in`` gives the root in which a frame moves,
    ``moving_beside`` the frames that move and do not carry it, ``connected`` whether two are in one
    tree, and ``frames`` all names.
    """

    truth: TruthLookup | None = None
    track: PoseTrack | None = None
    body: PoseTrack | None = None
    sensor: Callable[[int, str], Pose | None] | None = None
    moving_in: Callable[[str], str | None] = lambda _frame: None
    moving_beside: Callable[[str], list[str]] = lambda _frame: []
    connected: Callable[[str, str], bool] = lambda _one, _two: True
    frames: Sequence[str] = ()


def about_grasp(
    grasp: Array, header: LogHeader, known: GroundTruth
) -> tuple[LogHeader, GroundTruth]:
    """Return model and truth with the origin of {C} at a grasp point; the start of the log is about
    the old origin.

    Args:
        grasp: (3,) in the frame of the model, or of the measured poses [m].
        header: of the log.
        known: its ground truth.
    """
    surface, body, lookup = header.surface, header.truth, known.truth
    if (
        surface is not None and surface.sha256
    ):  # not the octahedron that stands for a target without a model
        surface = with_vertices(surface, surface.vertices - grasp)
    if body is not None:
        body = replace(body, c_b=body.c_b + geometry.matrix(body.q_bc) @ grasp)
    header = replace(header, surface=surface, truth=body, start=None)
    if lookup is None:
        return header, known

    def moved(t_ns: int, place: int, frame: str) -> Pose | None:
        pose = lookup(t_ns, place, frame)
        return pose and pose @ Pose(geometry.IDENTITY_QUAT, grasp)

    return header, replace(known, truth=moved)


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
        """Return the sink of each topic; ``transforms``: collect those of the log also if no
        option names a frame.
        """
        out = {
            self.options.truth_topic or TRUTH_TOPIC: _poses_only(self._truth),
            BODY_TOPIC: _poses_only(self._body),
        }
        if self.options.sensor_topic is not None:
            out[self.options.sensor_topic] = _poses_only(self._sensor)
        if self._wants_tf or transforms:
            out.update(
                {"*/tf": self._tf.sink(static=False), "*/tf_static": self._tf.sink(static=True)}
            )
        return out

    def check(self, topics: Sequence[TopicInfo], where: str, stated: str = "") -> None:
        """Raise UsageError if a requested topic or frame does not exist. ``stated``: the
        frame that the log names.
        """
        for role, name in (
            ("truth", self.options.truth_topic),
            ("sensor", self.options.sensor_topic),
        ):
            found = next((t for t in topics if t.name == name), None)
            if name is not None and (found is None or found.type not in POSE_TYPES):
                what = (
                    f"no such {role} topic"
                    if found is None
                    else f"{role} topic of type {shown(found.type)}"
                )
                hint = f"pose topics here: {_poses_of(topics) or 'none'}"
                raise UsageError(f"{what}: '{shown(name)}'", where=where, hint=hint)
        for frame in (self.options.truth_frame, self.options.fixed_frame):
            if frame is not None and frame != stated and frame.lstrip("/") not in self._tf.frames():
                hint = (
                    f"frames of its {TF_TYPE}:"
                    f" {', '.join(map(shown, self._tf.frames()[:20])) or 'none'}"
                )
                raise UsageError(f"no frame '{shown(frame)}'", where=where, hint=hint)

    def ground_truth(self) -> GroundTruth:
        """Return the lookups, after the log was read."""
        truth, track = self._truth_lookup()
        body = self._body if len(self._body) else None
        return GroundTruth(
            truth,
            track,
            body,
            self._sensor_lookup(),
            self._tf.moving_in,
            self._tf.moving_beside,
            self._tf.connected,
            self._tf.frames(),
        )

    @property
    def damaged(self) -> int:
        """Return the number of poses and transforms that could not be used."""
        return sum(each.damaged for each in (self._truth, self._body, self._sensor, self._tf))

    @property
    def _wants_tf(self) -> bool:
        return self.options.truth_frame is not None or self.options.fixed_frame is not None

    def _truth_lookup(self) -> tuple[TruthLookup | None, PoseTrack | None]:
        child, fixed = self.options.truth_frame, self.options.fixed_frame
        if self.options.truth_file is not None:
            return file_truth(read_poses(self.options.truth_file), self.options.truth_gap_s)
        if child is not None:
            return (lambda t_ns, _place, frame: self._tf.pose(fixed or frame, child, t_ns)), None
        return (self._truth.at_scan, self._truth) if len(self._truth) else (None, None)

    def _sensor_lookup(self) -> Callable[[int, str], Pose | None] | None:
        fixed = self.options.fixed_frame
        if self.options.sensor_topic is not None:
            return lambda t_ns, _frame: self._sensor.pose(t_ns)
        if fixed is not None:
            return lambda t_ns, frame: self._tf.pose(fixed, frame, t_ns)
        return None


def file_truth(found: TimedPoses, gap_s: float) -> tuple[TruthLookup, PoseTrack | None]:
    """Return a lookup in a pose file and its track: by time if the file has times, else by
    line without a track.
    """
    if found.t_ns is None:
        poses = [pose.T_ac if isinstance(pose, MeasuredPose) else None for pose in found.poses]
        return (lambda _t_ns, place, _frame: poses[place] if place < len(poses) else None), None
    track = PoseTrack(gap_s)
    for t_ns, pose in zip(found.t_ns, found.poses, strict=True):
        if isinstance(pose, MeasuredPose):  # not a line that a tracker wrote without a pose
            track.add(t_ns, (*pose.T_ac.t.tolist(), *pose.T_ac.q.tolist()))
    return track.at_scan, track


def _poses_of(topics: Sequence[TopicInfo]) -> str:
    return ", ".join(f"{shown(t.name)} ({t.type})" for t in topics if t.type in POSE_TYPES)


def _poses_only(track: PoseTrack) -> Sink:
    def take(kind: str, encoding: str, log_ns: int, payload: bytes | memoryview) -> None:
        if kind in POSE_TYPES:
            track.take(kind, encoding, log_ns, payload)

    return take
