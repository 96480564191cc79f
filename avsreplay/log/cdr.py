"""Reading and writing of serialised ROS messages: CDR (ROS 2, both byte orders) and the ROS 1 wire
format.

One reader serves both: they differ in alignment, in the closing NUL of a string and in the ``seq``
of a header. Every read is checked against the end of the buffer, so that a wrong length raises
``BadMessage``.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.geometry import Pose
from avsreplay.log.bytes_io import BadMessage
from avsreplay.records import NS_PER_S, Label, State

_U32 = struct.Struct("<I")
_STAMP = struct.Struct("<iI")
_CDR_LITTLE = {
    0x0001: "<",
    0x0000: ">",
}  # plain CDR; parameter lists (0x0002, 0x0003) do not occur in ROS


class Cursor:
    """A reader of one message; each method raises BadMessage at the end of the buffer.

    Attributes:
        data: the bytes of the message, without the four-byte encapsulation of CDR.
        pos: offset of the next byte.
        order: ``<`` or ``>``.
        ros1: whether the message is in the ROS 1 wire format.
    """

    __slots__ = ("data", "order", "pos", "ros1")

    def __init__(self, payload: bytes | memoryview, encoding: str = "cdr") -> None:
        """Start at the first field of a message.

        Args:
            payload: the bytes of the message.
            encoding: ``cdr`` (the payload begins with the four-byte encapsulation) or ``ros1``.

        Raises:
            BadMessage: the CDR encapsulation is missing or unknown.
        """
        view = memoryview(payload).cast("B")
        self.pos = 0
        self.ros1 = encoding == "ros1"
        self.order = "<"
        if not self.ros1:
            if len(view) < 4:
                raise BadMessage("shorter than the CDR encapsulation")
            kind = (view[0] << 8) | view[1]
            if kind not in _CDR_LITTLE:
                raise BadMessage(f"unknown CDR encapsulation 0x{kind:04x}")
            self.order = _CDR_LITTLE[kind]
            view = view[4:]
        self.data = view

    def _take(self, fmt: str, size: int) -> int | float:
        start = self.pos if self.ros1 else (self.pos + size - 1) & -size
        try:
            value: int | float = struct.unpack_from(self.order + fmt, self.data, start)[0]
        except struct.error:
            raise BadMessage(f"ends at byte {len(self.data)}, {start + size} needed") from None
        self.pos = start + size
        return value

    def u8(self) -> int:
        """Return the next octet."""
        return int(self._take("B", 1))

    def u32(self) -> int:
        """Return the next unsigned 32-bit number."""
        return int(self._take("I", 4))

    def i32(self) -> int:
        """Return the next signed 32-bit number."""
        return int(self._take("i", 4))

    def u64(self) -> int:
        """Return the next unsigned 64-bit number."""
        return int(self._take("Q", 8))

    def f64s(self, count: int) -> tuple[float, ...]:
        """Return the next ``count`` doubles of an array of fixed length.

        Raises:
            BadMessage: the message ends before them.
        """
        start = self.pos if self.ros1 else (self.pos + 7) & -8
        try:
            values = struct.unpack_from(f"{self.order}{count}d", self.data, start)
        except struct.error:
            raise BadMessage(f"ends at byte {len(self.data)}, {start + 8 * count} needed") from None
        self.pos = start + 8 * count
        return values

    def octets(self) -> memoryview:
        """Return the next sequence of octets as a view.

        Raises:
            BadMessage: the message ends inside the sequence.
        """
        size = self.u32()
        start = self.pos
        if start + size > len(self.data):
            raise BadMessage(f"a sequence of {size} bytes where {len(self.data) - start} are left")
        self.pos = start + size
        return self.data[start : self.pos]

    def string(self) -> str:
        r"""Return the next string; bytes that are not UTF-8 become ``\xNN``."""
        raw = bytes(self.octets())
        return (raw if self.ros1 else raw.rstrip(b"\x00")).decode("utf-8", "backslashreplace")

    def stamp(self) -> int:
        """Return the next time [ns]."""
        seconds = self.u32() if self.ros1 else self.i32()
        return seconds * NS_PER_S + self.u32()

    def header(self) -> tuple[int, str]:
        """Return stamp [ns] and frame of the next std_msgs Header."""
        return self.header_stamp(), self.string()

    def header_stamp(self) -> int:
        """Return the stamp [ns] of the next std_msgs Header, without its frame."""
        if self.ros1:
            self.u32()
        return self.stamp()


class Packer:
    """A writer of little-endian CDR; each method appends one value."""

    __slots__ = ("out",)

    def __init__(self) -> None:
        self.out = bytearray(b"\x00\x01\x00\x00")

    def _align(self, size: int) -> None:
        if missing := (4 - len(self.out)) % size:
            self.out += bytes(missing)

    def u8(self, value: int) -> Packer:
        """Append an octet."""
        self.out.append(value)
        return self

    def u32(self, value: int) -> Packer:
        """Append an unsigned 32-bit number."""
        self._align(4)
        self.out += _U32.pack(value)
        return self

    def i32(self, value: int) -> Packer:
        """Append a signed 32-bit number."""
        self._align(4)
        self.out += struct.pack("<i", value)
        return self

    def f64s(self, *values: float) -> Packer:
        """Append doubles as an array of fixed length."""
        self._align(8)
        self.out += struct.pack(f"<{len(values)}d", *values)
        return self

    def doubles(self, values: NDArray[np.float64]) -> Packer:
        """Append the numbers of an array of any shape as doubles."""
        self._align(8)
        self.out += values.astype("<f8").tobytes()
        return self

    def f32s(self, *values: float) -> Packer:
        """Append floats as an array of fixed length."""
        self._align(4)
        self.out += struct.pack(f"<{len(values)}f", *values)
        return self

    def pose(self, pose: Pose) -> Packer:
        """Append a geometry_msgs Pose."""
        return self.f64s(*pose.t.tolist(), *pose.q.tolist())

    def string(self, text: str) -> Packer:
        """Append a string with its closing NUL."""
        raw, out = text.encode("utf-8"), self.out
        if missing := (4 - len(out)) % 4:
            out += bytes(missing)
        out += _U32.pack(len(raw) + 1) + raw + b"\x00"
        return self

    def octets(self, raw: bytes) -> Packer:
        """Append a sequence of octets."""
        self.u32(len(raw))
        self.out += raw
        return self

    def header(self, t_ns: int, frame: str) -> Packer:
        """Append a std_msgs Header. Raises ValueError if ``t_ns`` does not fit a ROS 2 time."""
        seconds, nanoseconds = divmod(t_ns, NS_PER_S)
        if not -(2**31) <= seconds < 2**31:
            raise ValueError(f"stamp {t_ns} ns does not fit a ROS 2 time")
        self._align(4)
        self.out += _STAMP.pack(seconds, nanoseconds)
        return self.string(frame)

    def bytes(self) -> bytes:
        """Return the bytes written so far."""
        return bytes(self.out)


_DATATYPE = {"float32": 7, "float64": 8}


def point_cloud2(
    t_ns: int,
    frame: str,
    points: NDArray[Any],
    times_s: NDArray[Any] | None,
    point_type: str = "float32",
    intensities: NDArray[Any] | None = None,
    residuals: NDArray[Any] | None = None,
) -> bytes:
    """Return a PointCloud2 of points.

    Args:
        t_ns: stamp [ns].
        frame: its frame.
        points: (n, 3) [m].
        times_s: (n,) [s after the stamp], the field ``t``; None: no such field.
        point_type: of the coordinates, ``float32`` or ``float64``.
        intensities: (n,), the field ``intensity``; None: no such field.
        residuals: (n,) [m], the field ``residual``; None: no such field.
    """
    fields = (("t", times_s), ("intensity", intensities), ("residual", residuals))
    besides = [(name, values) for name, values in fields if values is not None]
    names, size = (
        ["x", "y", "z", *(name for name, _ in besides)],
        4 if point_type == "float32" else 8,
    )
    step = 3 * size + 4 * len(besides)
    table = np.empty((len(points), step // 4), "<f4")
    table[:, : 3 * size // 4].view(f"<f{size}")[:] = points
    for k, (_, values) in enumerate(besides):
        table[:, 3 * size // 4 + k] = values
    packer = Packer().header(t_ns, frame).u32(1).u32(len(points)).u32(len(names))
    for k, name in enumerate(names):
        kind = 7 if k > 2 else _DATATYPE[point_type]
        packer.string(name).u32(min(k, 3) * size + 4 * max(k - 3, 0)).u8(kind).u32(1)
    return packer.u8(0).u32(step).u32(step * len(points)).octets(table.tobytes()).u8(1).bytes()


def pose_stamped(t_ns: int, frame: str, pose: Pose) -> bytes:
    """Return a geometry_msgs PoseStamped."""
    return Packer().header(t_ns, frame).pose(pose).bytes()


def odometry(t_ns: int, frame: str, child: str, body: State) -> bytes:
    """Return a nav_msgs Odometry: the pose of {B} in {A} and the twist in {B}."""
    v_b = geometry.rotate(geometry.matrix(body.q_ab).T, body.v_a)
    zeros = (0.0,) * 36
    packer = Packer().header(t_ns, frame).string(child).f64s(*body.r_a, *body.q_ab, *zeros)
    return packer.f64s(*v_b, *body.w_b, *zeros).bytes()


def transform(t_ns: int, parent: str, child: str, pose: Pose) -> bytes:
    """Return a tf2_msgs TFMessage with one transform T_parent_child."""
    return Packer().u32(1).header(t_ns, parent).string(child).pose(pose).bytes()


def diagnostic(t_ns: int, label: Label, begins: bool) -> bytes:
    """Return a diagnostic_msgs DiagnosticArray: an injected fault begins (WARN) or ends (OK)."""
    message = "injected fault begins" if begins else "injected fault ends"
    values = {
        "start_ns": label.start_ns,
        "end_ns": label.end_ns,
        "harmful": label.harmful,
        "strength": label.strength,
    }
    packer = Packer().header(t_ns, "").u32(1).u8(1 if begins else 0)
    packer.string(label.kind).string(message).string("").u32(len(values))
    for key, value in values.items():
        packer.string(key).string(str(value))
    return packer.bytes()


_TIME_DEFINITION = ("builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n")
_HEADER_DEFINITION = ("std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id\n")
_POINT = ("geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z\n")
_VECTOR3 = ("geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z\n")
_QUATERNION_DEFINITION = (
    "geometry_msgs/Quaternion",
    "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n",
)
_POSE_DEFINITION = ("geometry_msgs/Pose", "Point position\nQuaternion orientation\n")
_TWIST = ("geometry_msgs/Twist", "Vector3 linear\nVector3 angular\n")
_FIELD = (
    "sensor_msgs/PointField",
    (
        "uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\nuint8"
        " UINT32=6\nuint8 FLOAT32=7\nuint8 FLOAT64=8\nstring name\nuint32 offset\nuint8"
        " datatype\nuint32 count\n"
    ),
)
_TRANSFORM = ("geometry_msgs/Transform", "Vector3 translation\nQuaternion rotation\n")
_TRANSFORM_DEFINITION = (
    "geometry_msgs/TransformStamped",
    "std_msgs/Header header\nstring child_frame_id\nTransform transform\n",
)
_POSE_COV = ("geometry_msgs/PoseWithCovariance", "Pose pose\nfloat64[36] covariance\n")
_TWIST_COV = ("geometry_msgs/TwistWithCovariance", "Twist twist\nfloat64[36] covariance\n")
_KEY_VALUE = ("diagnostic_msgs/KeyValue", "string key\nstring value\n")
_DIAGNOSTIC = (
    "diagnostic_msgs/DiagnosticStatus",
    (
        "byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\nbyte level\nstring name\nstring"
        " message\nstring hardware_id\nKeyValue[] values\n"
    ),
)

SCHEMAS: dict[str, tuple[str, tuple[tuple[str, str], ...]]] = {
    "sensor_msgs/msg/PointCloud2": (
        (
            "std_msgs/Header header\nuint32 height\nuint32 width\nPointField[] fields\nbool"
            " is_bigendian\nuint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n"
        ),
        (_HEADER_DEFINITION, _TIME_DEFINITION, _FIELD),
    ),
    "geometry_msgs/msg/PoseStamped": (
        "std_msgs/Header header\nPose pose\n",
        (_HEADER_DEFINITION, _TIME_DEFINITION, _POSE_DEFINITION, _POINT, _QUATERNION_DEFINITION),
    ),
    "nav_msgs/msg/Odometry": (
        (
            "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
            "geometry_msgs/TwistWithCovariance twist\n"
        ),
        (
            _HEADER_DEFINITION,
            _TIME_DEFINITION,
            _POSE_COV,
            _POSE_DEFINITION,
            _POINT,
            _QUATERNION_DEFINITION,
            _TWIST_COV,
            _TWIST,
            _VECTOR3,
        ),
    ),
    "tf2_msgs/msg/TFMessage": (
        "geometry_msgs/TransformStamped[] transforms\n",
        (
            _TRANSFORM_DEFINITION,
            _HEADER_DEFINITION,
            _TIME_DEFINITION,
            _TRANSFORM,
            _VECTOR3,
            _QUATERNION_DEFINITION,
        ),
    ),
    "diagnostic_msgs/msg/DiagnosticArray": (
        "std_msgs/Header header\nDiagnosticStatus[] status\n",
        (_HEADER_DEFINITION, _TIME_DEFINITION, _DIAGNOSTIC, _KEY_VALUE),
    ),
}


def schema_text(name: str) -> bytes:
    """Return the definition of a message type of ``SCHEMAS`` with its dependencies, in the
    ``ros2msg`` format.
    """
    body, dependencies = SCHEMAS[name]
    parts = [body, *(f"MSG: {dep}\n{text}" for dep, text in dependencies)]
    return ("\n" + "=" * 80 + "\n").join(p.rstrip("\n") for p in parts).encode() + b"\n"
