"""The result of a run as a log that viewers open: MCAP, profile ros2, CDR only.

Frames: ``map`` over ``camera`` (identity, so that a viewer finds a root), ``target`` under ``camera`` at each estimate.
The cloud is in ``target``, carried there by the estimate: where the estimate is right it lies on the model.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import UnreadableInput
from avsreplay.geometry import Array, Pose
from avsreplay.log.cdr import point_cloud2
from avsreplay.records import Surface

CAMERA, TARGET, ROOT = "camera", "target", "map"
LIBRARY = "avsreplay"
CHUNK_BYTES = 1 << 20
_TOPICS = {
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/model": "visualization_msgs/msg/Marker",
    "/points_aligned": "sensor_msgs/msg/PointCloud2",
    "/registration/pose": "geometry_msgs/msg/PoseStamped",
    "/estimate/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/truth/pose": "geometry_msgs/msg/PoseStamped",
    "/plan": "nav_msgs/msg/Path",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}


@dataclass(frozen=True, slots=True, eq=False)
class ResultFrame:
    """What one scan leaves in the result log.

    Attributes:
        t_ns: instant.  points: (n, 3) in {A} [m].  estimate: T_ac.
        covariance: (6, 6) of (position in {A} [m], rotation vector in {A} [rad]), as ROS has it.
        registration, truth: T_ac or None.
        path: (times [s after now] (m,), positions in {A} (m, 3)) of a new plan, None where it is the one before.
        healthy: gamma.  message: the reason.  values: scalars by name.
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


class ResultLog:
    """Writes ``result.mcap``; ``close`` finishes it. The bytes depend on what is written alone.

    Raises:
        UnreadableInput: the file cannot be written.
    """

    def __init__(self, path: Path, surface: Surface) -> None:
        from mcap.writer import CompressionType, Writer
        from rosbags.typesys import Stores, get_typestore

        self._store: Any = get_typestore(Stores.ROS2_HUMBLE)
        try:
            self._stream = path.open("wb")
        except OSError as error:
            what = error.strerror or "cannot be written"
            raise UnreadableInput(what, where=str(path), hint="check the folder and its rights") from None
        self._writer = Writer(self._stream, CHUNK_BYTES, CompressionType.ZSTD, enable_data_crcs=True)
        self._writer.start(profile="ros2", library=LIBRARY)
        self._surface, self._count = surface, 0
        self._channels: dict[str, int] = {}

    def close(self) -> None:
        """Finish the file."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.close()

    def write(self, frame: ResultFrame) -> None:
        """Append everything of one scan."""
        t = frame.t_ns
        if self._count == 0:
            self._put("/tf_static", t, transforms=[self._transform(t, ROOT, CAMERA, Pose.identity())])
            self._put("/model", t, **self._marker(t))
        self._count += 1
        self._put("/tf", t, transforms=[self._transform(t, CAMERA, TARGET, frame.estimate)])
        covariance = self._make(
            "geometry_msgs/msg/PoseWithCovariance", pose=self._pose(frame.estimate), covariance=frame.covariance.ravel()
        )
        self._put("/estimate/pose", t, header=self._header(t, CAMERA), pose=covariance)
        for topic, pose in (("/registration/pose", frame.registration), ("/truth/pose", frame.truth)):
            if pose is not None:
                self._put(topic, t, header=self._header(t, CAMERA), pose=self._pose(pose))
        aligned = frame.estimate.inverse().apply(frame.points)
        self._append("/points_aligned", t, point_cloud2(t, TARGET, aligned, None))
        if frame.path is not None:
            self._put("/plan", t, header=self._header(t, CAMERA), poses=list(self._path(t, *frame.path)))
        self._put("/diagnostics", t, header=self._header(t, ""), status=[self._status(frame)])

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._store.types[kind](**fields)

    def _put(self, topic: str, t_ns: int, **fields: Any) -> None:
        kind = _TOPICS[topic]
        self._append(topic, t_ns, bytes(self._store.serialize_cdr(self._make(kind, **fields), kind)))

    def _append(self, topic: str, t_ns: int, payload: bytes) -> None:
        if topic not in self._channels:
            kind = _TOPICS[topic]
            text, _ = self._store.generate_msgdef(kind, ros_version=2)
            schema = self._writer.register_schema(kind, "ros2msg", text.encode())
            self._channels[topic] = self._writer.register_channel(topic, "cdr", schema, {"offered_qos_profiles": ""})
        self._writer.add_message(self._channels[topic], t_ns, payload, t_ns, self._count)

    def _time(self, t_ns: int) -> Any:
        return self._make("builtin_interfaces/msg/Time", sec=t_ns // 10**9, nanosec=t_ns % 10**9)

    def _header(self, t_ns: int, frame: str) -> Any:
        return self._make("std_msgs/msg/Header", stamp=self._time(t_ns), frame_id=frame)

    def _point(self, p: Iterable[float]) -> Any:
        x, y, z = (float(v) for v in p)
        return self._make("geometry_msgs/msg/Point", x=x, y=y, z=z)

    def _quaternion(self, q: Iterable[float]) -> Any:
        x, y, z, w = (float(v) for v in q)
        return self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _pose(self, pose: Pose) -> Any:
        place, turn = self._point(pose.t), self._quaternion(pose.q)
        return self._make("geometry_msgs/msg/Pose", position=place, orientation=turn)

    def _transform(self, t_ns: int, parent: str, child: str, pose: Pose) -> Any:
        x, y, z = (float(v) for v in pose.t)
        shift = self._make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
        both = self._make("geometry_msgs/msg/Transform", translation=shift, rotation=self._quaternion(pose.q))
        header = self._header(t_ns, parent)
        return self._make("geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=both)

    def _path(self, t_ns: int, times_s: Array, positions: Array) -> Iterable[Any]:
        still = self._quaternion((0.0, 0.0, 0.0, 1.0))
        for after, position in zip(times_s, positions, strict=True):
            pose = self._make("geometry_msgs/msg/Pose", position=self._point(position), orientation=still)
            header = self._header(t_ns + round(float(after) * 1e9), CAMERA)
            yield self._make("geometry_msgs/msg/PoseStamped", header=header, pose=pose)

    def _status(self, frame: ResultFrame) -> Any:
        pairs = [
            self._make("diagnostic_msgs/msg/KeyValue", key=name, value=str(value))
            for name, value in frame.values.items()
        ]
        return self._make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=0 if frame.healthy else 1,
            name="gamma",
            message=frame.message,
            hardware_id="",
            values=pairs,
        )

    def _marker(self, t_ns: int) -> dict[str, Any]:
        """The model as a list of triangles in ``target`` (of points, where it has no faces)."""
        mesh, faces = self._surface.vertices, self._surface.faces
        corners = mesh[faces.reshape(-1)] if len(faces) else mesh
        colour = self._make("std_msgs/msg/ColorRGBA", r=0.6, g=0.65, b=0.7, a=0.5)
        one = self._make("geometry_msgs/msg/Vector3", x=1.0, y=1.0, z=1.0)
        return {
            "header": self._header(t_ns, TARGET),
            "ns": "model",
            "id": 0,
            "type": 11 if len(faces) else 8,  # TRIANGLE_LIST, POINTS
            "action": 0,
            "pose": self._pose(Pose.identity()),
            "scale": one,
            "color": colour,
            "lifetime": self._make("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
            "frame_locked": True,
            "points": [self._point(p) for p in corners],
            "colors": [],
            "texture_resource": "",
            "texture": self._make(
                "sensor_msgs/msg/CompressedImage",
                header=self._header(t_ns, ""),
                format="",
                data=np.zeros(0, np.uint8),
            ),
            "uv_coordinates": [],
            "text": "",
            "mesh_resource": "",
            "mesh_file": self._make("visualization_msgs/msg/MeshFile", filename="", data=np.zeros(0, np.uint8)),
            "mesh_use_embedded_materials": False,
        }
