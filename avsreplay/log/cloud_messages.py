"""Messages that hold points in another form than PointCloud2, brought into its layout: PointCloud,
Livox CustomMsg, and foxglove.PointCloud as protobuf, JSON or ROS message.

Each reader gives a ``Layout``, so that what the fields mean is decided in one place for all of
them. Lengths are compared with the bytes of the message before memory is allocated.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import struct
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Pose
from avsreplay.log.bytes_io import BadMessage
from avsreplay.log.cdr import Cursor
from avsreplay.log.point_cloud2 import Field, Layout, check_layout, of_layout, read_layout
from avsreplay.log.raw_cloud import RawCloud
from avsreplay.records import NS_PER_S

FOXGLOVE = "foxglove.PointCloud"
FOXGLOVE_ROS = "foxglove_msgs/msg/PointCloud"
LayoutReader = Callable[[bytes | memoryview, str], Layout]
_MAX_CHANNELS = 256
_LIVOX = (
    ("offset_time", 0, "u4"),
    ("x", 4, "f4"),
    ("y", 8, "f4"),
    ("z", 12, "f4"),
    ("reflectivity", 16, "u1"),
    ("tag", 17, "u1"),
    ("line", 18, "u1"),
)
_LIVOX_POINT_BYTES = 19
_LIVOX_STRIDE_BYTES = 20  # from one point to the next in CDR
_FOXGLOVE_KINDS = {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "f4", 8: "f8"}


def read_point_cloud(payload: bytes | memoryview, encoding: str) -> Layout:
    """Parse a sensor_msgs/PointCloud; each channel becomes a field. Raises BadMessage."""
    cursor = Cursor(payload, encoding)
    stamp_ns, frame = cursor.header()
    columns = [("xyz", _floats(cursor, 3))]
    count, channels = len(columns[0][1]), cursor.u32()
    if channels > _MAX_CHANNELS:
        raise BadMessage(f"{channels} channels, at most {_MAX_CHANNELS} are read")
    for _ in range(channels):
        name, values = cursor.string(), _floats(cursor, 1)
        if len(values) == count:  # a channel may be empty, or describe the cloud as a whole
            columns.append((name, values))
    table = np.concatenate([values for _, values in columns], axis=1).astype("<f4")
    names = [*"xyz", *(name for name, _ in columns[1:])]
    fields = [(name, 4 * i, "f4") for i, name in enumerate(names)]
    return _layout(stamp_ns, frame, fields, "<", 4 * len(names), memoryview(table.tobytes()))


def _floats(cursor: Cursor, width: int) -> NDArray[Any]:
    """Return the next sequence of 32-bit floats, (n, width)."""
    size = cursor.u32() * 4 * width
    if size > len(cursor.data) - cursor.pos:
        raise BadMessage(
            f"a sequence of {size} bytes where {len(cursor.data) - cursor.pos} are left"
        )
    data = cursor.data[cursor.pos : cursor.pos + size]
    cursor.pos += size
    return np.frombuffer(data, cursor.order + "f4").reshape(-1, width)


def read_livox(payload: bytes | memoryview, encoding: str) -> Layout:
    """Parse a Livox CustomMsg; ``offset_time`` is in nanoseconds after the stamp. Raises
    BadMessage.
    """
    cursor = Cursor(payload, encoding)
    stamp_ns, frame = cursor.header()
    cursor.u64()  # the time base, which is the stamp in the clock of the sensor
    cursor.u32()
    for _ in range(4):  # number of the sensor, reserved octets
        cursor.u8()
    count = cursor.u32()
    step = _LIVOX_POINT_BYTES if cursor.ros1 else _LIVOX_STRIDE_BYTES
    size = (count - 1) * step + _LIVOX_POINT_BYTES if count else 0
    if size > len(cursor.data) - cursor.pos:
        raise BadMessage(f"{count} points of {step} bytes in {len(cursor.data) - cursor.pos} bytes")
    data = cursor.data[cursor.pos : cursor.pos + size]
    whole = memoryview(bytes(data) + bytes(count * step - size))  # the last one has no padding
    return _layout(stamp_ns, frame, _LIVOX, cursor.order, step, whole)


def read_foxglove(payload: bytes | memoryview, encoding: str) -> Layout:
    """Parse a foxglove.PointCloud of any encoding; its pose is applied. Raises BadMessage."""
    reader = {"protobuf": _of_protobuf, "json": _of_json}.get(encoding)
    return _of_ros(payload, encoding) if reader is None else reader(payload)


LAYOUTS: dict[str, LayoutReader] = {
    "sensor_msgs/msg/PointCloud2": read_layout,
    "sensor_msgs/msg/PointCloud": read_point_cloud,
    "livox_ros_driver/msg/CustomMsg": read_livox,
    "livox_ros_driver2/msg/CustomMsg": read_livox,
    "livox_interfaces/msg/CustomMsg": read_livox,
    FOXGLOVE: read_foxglove,
    FOXGLOVE_ROS: read_foxglove,
}
"""Reader of each type of message that holds points."""


def raw_message(kind: str, payload: bytes | memoryview, encoding: str) -> RawCloud:
    """Decode a message of ``LAYOUTS`` to the fields that it declares.

    Args:
        kind: type of the message.
        payload: the message.
        encoding: of the message.

    Raises:
        BadMessage: the message is malformed, or has no coordinates; the text states why.
    """
    return of_layout(LAYOUTS[kind](payload, encoding))


def message_stamp(kind: str, payload: bytes | memoryview, encoding: str) -> int:
    """Return the stamp of a message [ns], 0 if it cannot be read.

    Args:
        kind: type of the message.
        payload: the message, or at least its first 64 bytes.
        encoding: of the message.
    """
    try:
        if encoding == "protobuf":
            return _protobuf_stamp(dict(_protobuf(payload)).get(1, b""))
        if encoding == "json":
            return _json_stamp(_table(payload))
        cursor = Cursor(payload, encoding)
        return cursor.stamp() if kind == FOXGLOVE_ROS else cursor.header_stamp()
    except BadMessage:
        return 0


def _layout(
    stamp_ns: int,
    frame: str,
    fields: Sequence[tuple[str, int, str]],
    order: str,
    step: int,
    data: memoryview,
) -> Layout:
    """Return the checked layout of points one after the other; bytes after the last are ignored."""
    count = len(data) // step if step else 0
    found = tuple(Field(name, offset, kind, 1) for name, offset, kind in fields)
    layout = Layout(stamp_ns, frame, (1, count), found, order, step, step * count, data)
    if count:
        check_layout(layout)
    return layout


def _posed(layout: Layout, values: Sequence[float]) -> Layout:
    """Return a layout with its points moved by a pose x y z qx qy qz qw, if this is not zero or
    the identity.
    """
    length = math.hypot(*values[3:])
    if not all(math.isfinite(v) for v in values):
        raise BadMessage("a cloud whose pose is not finite")
    if tuple(values) in ((0.0,) * 7, (*(0.0,) * 6, 1.0)) or not layout.shape[1]:
        return layout
    if length < 0.5:
        raise BadMessage("a cloud whose pose has no unit quaternion")
    pose = Pose(np.array(values[3:]) / length, np.array(values[:3]))
    named = {f.name: f for f in layout.fields}
    if not {"x", "y", "z"} <= named.keys():
        raise BadMessage("a cloud without x, y and z")
    points = np.stack([layout.view(named[k])[0].astype(np.float64) for k in "xyz"], axis=1)
    step, count = layout.point_step, layout.shape[1]
    table = np.zeros((count, step + 24), np.uint8)
    table[:, :step] = np.ndarray((count, step), np.uint8, layout.data, 0, (step, 1))
    moved = np.ascontiguousarray(pose.apply(points), layout.order + "f8")
    table[:, step:] = moved.view(np.uint8).reshape(count, 24)
    fields = [
        (f.name, f.offset, f.kind) for f in layout.fields if f.name not in ("x", "y", "z")
    ] + [(axis, step + 8 * i, "f8") for i, axis in enumerate("xyz")]
    return _layout(
        layout.stamp_ns, layout.frame, fields, layout.order, step + 24, memoryview(table.tobytes())
    )


def _foxglove_kind(number: int) -> str:
    if number not in _FOXGLOVE_KINDS:
        raise BadMessage(f"a field of unknown type {number}")
    return _FOXGLOVE_KINDS[number]


def _of_ros(payload: bytes | memoryview, encoding: str) -> Layout:
    cursor = Cursor(payload, encoding)
    stamp_ns, frame, pose, step = cursor.stamp(), cursor.string(), cursor.f64s(7), cursor.u32()
    count = cursor.u32()
    if count > _MAX_CHANNELS:
        raise BadMessage(f"{count} fields, at most {_MAX_CHANNELS} are read")
    fields = [(cursor.string(), cursor.u32(), _foxglove_kind(cursor.u8())) for _ in range(count)]
    return _posed(_layout(stamp_ns, frame, fields, "<", step, cursor.octets()), pose)


def _table(payload: bytes | memoryview) -> dict[str, Any]:
    try:
        found = json.loads(bytes(payload))
    except (ValueError, RecursionError):
        raise BadMessage("not a JSON message") from None
    if not isinstance(found, dict):
        raise BadMessage("a JSON message that is no object")
    return found


def _json_stamp(table: dict[str, Any]) -> int:
    stamp = table.get("timestamp")
    try:
        return int(stamp["sec"]) * NS_PER_S + int(stamp["nsec"])  # type: ignore[index]
    except (TypeError, KeyError, ValueError, OverflowError):
        raise BadMessage("a JSON cloud without a timestamp of sec and nsec") from None


def _of_json(payload: bytes | memoryview) -> Layout:
    table = _table(payload)
    try:
        pose = table.get("pose") or {}
        values = [float((pose.get("position") or {}).get(axis, 0.0)) for axis in "xyz"]
        values += [float((pose.get("orientation") or {}).get(axis, 0.0)) for axis in "xyzw"]
        fields = [
            (str(f["name"]), int(f["offset"]), _foxglove_kind(int(f["type"])))
            for f in table["fields"]
        ]
        data = memoryview(base64.b64decode(table["data"], validate=True))
        step, frame = int(table["point_stride"]), str(table.get("frame_id", ""))
    except (
        TypeError,
        KeyError,
        AttributeError,
        binascii.Error,
        ValueError,
        OverflowError,
    ) as error:
        raise BadMessage(f"a JSON cloud with a missing or malformed field: {error}") from None
    if step < 0 or any(offset < 0 for _, offset, _ in fields):
        raise BadMessage("a JSON cloud with a negative offset")
    return _posed(_layout(_json_stamp(table), frame, fields, "<", step, data), values)


def _protobuf(payload: bytes | memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Yield (number, value) of the fields of a protobuf message: an integer, or the bytes of a
    text, message or number of fixed length.
    """
    view, at = memoryview(payload).cast("B"), 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            if at >= len(view) or shift > 63:
                raise BadMessage("a protobuf message that ends inside a number")
            octet, at = view[at], at + 1
            value |= (octet & 0x7F) << shift
            shift += 7
            if octet < 0x80:
                return value

    while at < len(view):
        key = varint()
        kind = key & 7
        if kind == 0:
            yield key >> 3, varint()
            continue
        size = {1: 8, 5: 4}.get(kind) or (varint() if kind == 2 else None)
        if size is None or size > len(view) - at:
            raise BadMessage("a protobuf field that ends past its message, or of an unknown kind")
        at += size
        yield key >> 3, view[at - size : at]


def _integer(value: int | memoryview) -> int:
    return value if isinstance(value, int) else int.from_bytes(value, "little")


def _octets(value: int | memoryview) -> memoryview:
    if isinstance(value, int):
        raise BadMessage("a protobuf field of another kind than its message has")
    return value


def _protobuf_stamp(value: int | memoryview | bytes) -> int:
    parts = dict(_protobuf(value)) if not isinstance(value, int) else {}
    return _integer(parts.get(1, 0)) * NS_PER_S + _integer(parts.get(2, 0))


def _doubles(value: int | memoryview, count: int) -> list[float]:
    out = [0.0] * count
    for number, raw in _protobuf(_octets(value)):
        if 1 <= number <= count and not isinstance(raw, int) and len(raw) == 8:
            out[number - 1] = struct.unpack("<d", raw)[0]
    return out


def _of_protobuf(payload: bytes | memoryview) -> Layout:
    stamp_ns = step = 0
    frame, data, pose = "", memoryview(b""), [0.0] * 7
    fields = list[tuple[str, int, str]]()
    for number, value in _protobuf(payload):
        if number == 1:
            stamp_ns = _protobuf_stamp(value)
        elif number == 2:
            frame = bytes(_octets(value)).decode("utf-8", "backslashreplace")
        elif number == 3:
            parts = dict(_protobuf(_octets(value)))
            pose = _doubles(parts.get(1, memoryview(b"")), 3)
            pose += _doubles(parts.get(2, memoryview(b"")), 4)
        elif number == 4:
            step = _integer(value)
        elif number == 5:
            fields.append(_protobuf_field(_octets(value)))
        elif number == 6:
            data = _octets(value)
    if len(fields) > _MAX_CHANNELS:
        raise BadMessage(f"{len(fields)} fields, at most {_MAX_CHANNELS} are read")
    return _posed(_layout(stamp_ns, frame, fields, "<", step, data), pose)


def _protobuf_field(value: memoryview) -> tuple[str, int, str]:
    parts = dict(_protobuf(value))
    name = bytes(_octets(parts.get(1, memoryview(b"")))).decode("utf-8", "backslashreplace")
    return name, _integer(parts.get(2, 0)), _foxglove_kind(_integer(parts.get(3, 0)))
