"""The result of a run as a log for viewers: MCAP, profile ros2, CDR only.

Frames: ``map`` over ``camera`` (identity, so that a viewer finds a root) and ``target`` under
``camera`` at each estimate, ``target_true`` at each true pose. The cloud is given in ``target``: if
the estimate is right, it lies on the model; its field ``residual`` is the distance to it [m].
``/plan/cone`` holds the cones in which the planned approach stays. ``/rows`` holds the numeric
columns that no other message holds, one message per scan, with a field for each column; a column
without a value is NaN. Chunks are compressed by LZ4: clouds of points hardly become smaller, and
zstd takes three times as long.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from enum import IntEnum
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from avsreplay.errors import UnreadableInput, value_class
from avsreplay.geometry import Array, Pose
from avsreplay.log.cdr import Packer, point_cloud2, pose_stamped, transform
from avsreplay.log.mcap_format import WRITTEN_CHUNK_BYTES
from avsreplay.records import Surface

CAMERA = "camera"
TARGET = "target"
TRUE = "target_true"
ROOT = "map"
LIBRARY = "avsreplay"
RUN_RECORD = "avsreplay-run"  # not the record with which a log can be replayed
ROWS = "/rows"
ROW_TYPE = "avsreplay/msg/Row"
_TOPICS = {
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/model": "visualization_msgs/msg/Marker",
    "/points_aligned": "sensor_msgs/msg/PointCloud2",
    "/registration/pose": "geometry_msgs/msg/PoseStamped",
    "/estimate/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/truth/pose": "geometry_msgs/msg/PoseStamped",
    "/plan": "nav_msgs/msg/Path",
    "/plan/cone": "visualization_msgs/msg/Marker",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/truth/model": "visualization_msgs/msg/Marker",
    "/rosout": "rcl_interfaces/msg/Log",
    ROWS: ROW_TYPE,
}


class _Marker(IntEnum):  # visualization_msgs/msg/Marker
    LINE_LIST = 5
    POINTS = 8
    TRIANGLE_LIST = 11


class _Level(IntEnum):  # rcl_interfaces/msg/Log
    INFO = 20
    WARN = 30


@value_class
class ResultFrame:
    """The content of the result log for one scan.

    Attributes:
        t_ns: time of the scan.
        points: (n, 3) in {A} [m].
        estimate: T_ac.
        covariance: (6, 6) of (position in {A} [m], rotation vector in {A} [rad]), the order of ROS.
        registration, truth: T_ac or None.
        path: times (m,) [s from now] and positions (m, 3) in {A} [m] of a new plan; None if the
            plan is unchanged.
        healthy: gamma.
        message: the reason.
        values: scalars by name.
        residuals: (n,) distances of the points to the model at the estimate [m].
        intensities: (n,) of the points, None if the scanner gives none.
        columns: numeric columns of the row, as named to ``ResultLog``; NaN without a value.
    """

    t_ns: int
    points: NDArray[Any]
    estimate: Pose
    covariance: Array
    registration: Pose | None
    truth: Pose | None
    path: tuple[Array, Array] | None
    healthy: bool
    message: str
    values: Mapping[str, float | int | str]
    residuals: NDArray[Any] | None = None
    intensities: NDArray[Any] | None = None
    columns: Sequence[float] = ()


class ResultLog:
    """Writer of ``result.mcap``; ``close`` finishes the file.

    The bytes depend only on what is written.
    """

    def __init__(
        self,
        path: Path,
        surface: Surface,
        metadata: Mapping[str, str] | None = None,
        cone: Array | None = None,
        columns: Sequence[str] = (),
    ) -> None:
        """Create the file and write the model.

        Args:
            path: the file.
            surface: the target model, written as a marker.
            metadata: of the run, by name, for example its configuration as JSON.
            cone: (m, 3) ends of line pieces in {C} [m] that show the cones of the approach; None
                without a cone.
            columns: names of the numeric columns of a row.

        Raises:
            UnreadableInput: the file cannot be written.
        """
        from mcap.writer import CompressionType, Writer
        from rosbags.typesys import Stores, get_typestore

        self._definitions: Any = get_typestore(Stores.ROS2_HUMBLE)
        try:
            self._stream = path.open("wb")
        except OSError as error:
            what = error.strerror or "cannot be written"
            raise UnreadableInput(
                what, where=str(path), hint="check the folder and its rights"
            ) from None
        self._writer = Writer(
            self._stream, WRITTEN_CHUNK_BYTES, CompressionType.LZ4, enable_data_crcs=True
        )
        self._writer.start(profile="ros2", library=LIBRARY)
        if metadata:
            self._writer.add_metadata(RUN_RECORD, dict(metadata))
        self._surface, self._cone, self._count, self._state = surface, cone, 0, ""
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._fields = tuple(columns)
        self._row = struct.Struct(
            f"<xBxx{len(columns)}d"
        )  # encapsulation of little-endian CDR, then the values

    def close(self) -> None:
        """Finish the file; a second call does nothing."""
        if self._stream.closed:
            return
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
        finally:
            self._stream.close()

    def write(self, frame: ResultFrame) -> None:
        """Append the messages of one scan."""
        t = frame.t_ns
        if self._count == 0:
            self._append("/tf_static", t, transform(t, ROOT, CAMERA, Pose.identity()))
            self._append("/model", t, _model_marker(t, TARGET, self._surface))
            self._append("/truth/model", t, _model_marker(t, TRUE, self._surface))
            if self._cone is not None:
                width_m = 0.002 * self._surface.extent
                self._append(
                    "/plan/cone",
                    t,
                    _marker(
                        t, TARGET, _Marker.LINE_LIST, self._cone, (0.0, 0.62, 0.45, 0.9), width_m
                    ),
                )
        self._count += 1
        self._append("/tf", t, transform(t, CAMERA, TARGET, frame.estimate))
        pose = Packer().header(t, CAMERA).pose(frame.estimate).doubles(frame.covariance)
        self._append("/estimate/pose", t, pose.bytes())
        for topic, known in (
            ("/registration/pose", frame.registration),
            ("/truth/pose", frame.truth),
        ):
            if known is not None:
                self._append(topic, t, pose_stamped(t, CAMERA, known))
        if frame.truth is not None:
            self._append("/tf", t, transform(t, CAMERA, TRUE, frame.truth))
        aligned = frame.estimate.inverse().apply(frame.points)
        cloud = point_cloud2(
            t, TARGET, aligned, None, intensities=frame.intensities, residuals=frame.residuals
        )
        self._append("/points_aligned", t, cloud)
        if frame.path is not None:
            self._append("/plan", t, _path(t, *frame.path))
        self._append("/diagnostics", t, _status(frame))
        self._append(ROWS, t, self._row.pack(1, *frame.columns))
        if frame.message != self._state:
            self._append("/rosout", t, _said(frame))
        self._state = frame.message

    def copy(
        self, written: Path, state: str, changed: Mapping[int, Sequence[float]] | None = None
    ) -> None:
        """Append all messages of another log of this kind, so that this one continues it.

        Args:
            written: the other log.
            state: message of its last scan.
            changed: numeric columns of the rows that have other values than in that log, by the
                index of the scan.

        Raises:
            UnreadableInput: the other log is damaged.
        """
        self._state = state
        try:
            self._copy(written, changed or {})
        except OSError:  # this one cannot be written
            raise
        except Exception as error:  # the library has no common class of errors
            hint = "start anew with --overwrite"
            raise UnreadableInput(
                f"is damaged: {error}"[:200], where=str(written), hint=hint
            ) from None

    def _copy(self, written: Path, changed: Mapping[int, Sequence[float]]) -> None:
        from mcap.reader import NonSeekingReader

        with written.open("rb") as stream:
            for _, channel, message in NonSeekingReader(stream).iter_messages(log_time_order=False):
                columns = changed.get(message.sequence - 1) if channel.topic == ROWS else None
                self._count = message.sequence
                data = message.data if columns is None else self._row.pack(1, *columns)
                self._append(channel.topic, message.log_time, data)

    def _append(self, topic: str, t_ns: int, payload: bytes) -> None:
        self._writer.add_message(self._channel(topic), t_ns, payload, t_ns, self._count)

    def _channel(self, topic: str) -> int:
        """Return the number of a topic's channel, which is registered at the first message."""
        if topic not in self._channels:
            kind = _TOPICS[topic]
            if kind not in self._schemas:
                if kind == ROW_TYPE:
                    text = "".join(f"float64 {name}\n" for name in self._fields)
                else:
                    text, _ = self._definitions.generate_msgdef(kind, ros_version=2)
                self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", text.encode())
            qos = {"offered_qos_profiles": ""}
            self._channels[topic] = self._writer.register_channel(
                topic, "cdr", self._schemas[kind], qos
            )
        return self._channels[topic]


def _path(t_ns: int, times_s: Array, positions: Array) -> bytes:
    """Return a nav_msgs Path of the planned positions."""
    packer = Packer().header(t_ns, CAMERA).u32(len(times_s))
    for after, (x, y, z) in zip(times_s, positions, strict=True):
        packer.header(t_ns + round(float(after) * 1e9), CAMERA).f64s(x, y, z, 0.0, 0.0, 0.0, 1.0)
    return packer.bytes()


def _status(frame: ResultFrame) -> bytes:
    """Return a diagnostic_msgs DiagnosticArray with gamma and the scalars of a scan."""
    packer = Packer().header(frame.t_ns, "").u32(1).u8(0 if frame.healthy else 1)
    packer.string("gamma").string(frame.message).string("").u32(len(frame.values))
    for name, value in frame.values.items():
        packer.string(name).string(str(value))
    return packer.bytes()


def _said(frame: ResultFrame) -> bytes:
    """Return a rcl_interfaces Log: whether the scan is used, or why not."""
    level = _Level.INFO if frame.healthy else _Level.WARN
    packer = Packer().i32(frame.t_ns // 10**9).u32(frame.t_ns % 10**9).u8(level).string("avsreplay")
    return packer.string(frame.message).string("").string("").u32(0).bytes()


def _model_marker(t_ns: int, frame: str, surface: Surface) -> bytes:
    """Return a visualization_msgs Marker: the triangles of the model, or its points, in a frame."""
    faces = surface.faces
    corners = surface.vertices[faces.reshape(-1)] if len(faces) else surface.vertices
    colour = (0.6, 0.65, 0.7, 0.5) if frame == TARGET else (0.2, 0.7, 0.6, 0.25)
    return _marker(
        t_ns, frame, _Marker.TRIANGLE_LIST if len(faces) else _Marker.POINTS, corners, colour, 1.0
    )


def _marker(
    t_ns: int,
    frame: str,
    kind: int,
    points: Array,
    colour: tuple[float, float, float, float],
    scale: float,
) -> bytes:
    """Return a visualization_msgs Marker of points (m, 3) in a frame."""
    name = "cone" if kind == _Marker.LINE_LIST else "model"
    packer = Packer().header(t_ns, frame).string(name).i32(0).i32(kind)
    packer.i32(0).pose(Pose.identity()).f64s(scale, scale, scale).f32s(
        *colour
    )  # action, pose, scale, colour
    packer.i32(0).u32(0).u8(1)  # lifetime (none), locked to its frame
    packer.u32(len(points)).doubles(points).u32(0)  # points, no colours per point
    packer.string("").header(t_ns, "").string("").octets(b"").u32(0)  # no texture
    return (
        packer.string("").string("").string("").octets(b"").u8(0).bytes()
    )  # text, mesh resource, mesh file
