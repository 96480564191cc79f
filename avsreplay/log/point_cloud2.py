"""Decoding of sensor_msgs/PointCloud2 with any layout; without a copy where the layout allows
it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.geometry import MeasuredPose, Pose
from avsreplay.log.bytes_io import BadMessage
from avsreplay.log.cdr import Cursor
from avsreplay.log.options import SourceOptions

_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_MAX_FIELDS = 256
_KNOTS = 17  # instants of a scan at which the pose of a moving sensor is looked up
MAX_COORDINATE_M = (
    1e6  # a larger coordinate is a sensor error; squares and grid cells stay in range
)
_INTENSITY_NAMES = ("intensity", "intensities", "i", "reflectivity")
_TIME_NAMES = ("t", "time", "timestamp", "time_offset", "offset_time")


@value_class(eq=True)
class Field:
    """A PointField: name, byte offset, numpy type (``f4``) and count."""

    name: str
    offset: int
    kind: str
    count: int


@value_class(eq=True)
class Layout:
    """The description of a cloud and its undecoded points.

    Attributes:
        stamp_ns: header stamp [ns].
        frame: header frame.
        shape: (height, width).
        fields: the fields of a point.
        order: byte order, ``<`` or ``>``.
        point_step, row_step: distance between points and between rows [bytes].
        data: the points.
    """

    stamp_ns: int
    frame: str
    shape: tuple[int, int]
    fields: tuple[Field, ...]
    order: str
    point_step: int
    row_step: int
    data: memoryview

    def column(self, name: str) -> NDArray[Any]:
        """Return a (height, width) view of one field.

        Raises BadMessage if the cloud has no such field.
        """
        field = next((f for f in self.fields if f.name == name), None)
        if field is None:
            raise BadMessage(
                f"no field '{name}' among {', '.join(f.name for f in self.fields) or 'none'}"
            )
        strides = (self.row_step, self.point_step)
        return np.ndarray(self.shape, self.order + field.kind, self.data, field.offset, strides)


@value_class
class Cloud:
    """A decoded cloud: finite points (n, 3) [m] in ``frame``, their times [s] after the stamp and
    intensities, or None.

    ``places`` (n,) is the share of the message that stands before each point, for points without
    times. ``pose`` is set instead of the points where the source holds measured poses.
    """

    stamp_ns: int
    frame: str
    points: NDArray[Any]
    times_s: NDArray[np.float32] | None
    dropped: int
    pose: MeasuredPose | None = None
    intensities: NDArray[np.float32] | None = None
    places: NDArray[np.float32] | None = None

    def keep(self, kept: NDArray[np.bool_]) -> Cloud:
        """Return the cloud with some of its points."""
        each = (self.times_s, self.intensities, self.places)
        times, seen, places = (None if column is None else column[kept] for column in each)
        return replace(
            self, points=self.points[kept], times_s=times, intensities=seen, places=places
        )


def selected(cloud: Cloud, options: SourceOptions) -> Cloud:
    """Return a cloud after the crop, with the times of its points if their order and the duration
    of a scan give them.

    Args:
        cloud: as decoded.
        options: how the log is read.
    """
    if options.crop_box is not None:
        low, high = np.array(options.crop_box[:3]), np.array(options.crop_box[3:])
        cloud = cloud.keep(np.all((cloud.points >= low) & (cloud.points <= high), axis=1))
    if options.crop_range is not None:
        distance, (least, most) = (
            np.linalg.norm(cloud.points.astype(np.float64), axis=1),
            options.crop_range,
        )
        cloud = cloud.keep((distance >= least) & (distance <= most))
    if options.scan_duration_s is None or cloud.places is None:
        return cloud
    return replace(cloud, times_s=np.float32(options.scan_duration_s) * cloud.places, places=None)


def at_stamp(cloud: Cloud, sensor_at: Callable[[int], Pose]) -> Cloud:
    """Return a cloud in the frame that its sensor has at the stamp; each point is moved from the
    frame at its own time.

    Args:
        cloud: in the frame of the moving sensor.
        sensor_at: the pose of the sensor so many nanoseconds after the stamp.

    Raises:
        BadMessage: the time of a point is not finite.
    """
    if cloud.times_s is None or not cloud.times_s.any():
        return cloud
    times = cloud.times_s.astype(np.float64)
    if not np.isfinite(times).all():
        raise BadMessage("the time of a point is not finite")
    knots = np.linspace(min(float(times.min()), 0.0), max(float(times.max()), 0.0), _KNOTS)
    T_sa = sensor_at(0).inverse()
    steps = [T_sa @ sensor_at(round(1e9 * after)) for after in knots.tolist()]
    R, t = np.stack([step.R for step in steps]), np.stack([step.t for step in steps])
    return replace(
        cloud, points=geometry.moved_in_time(cloud.points.astype(np.float64), times, knots, R, t)
    )


def decode_cloud(payload: bytes | memoryview, encoding: str = "cdr") -> Cloud:
    """Decode a cloud without the points that are not finite or not within ``MAX_COORDINATE_M``.

    Args:
        payload: the serialised message.
        encoding: ``cdr`` or ``ros1``.

    Raises:
        BadMessage: the message is malformed; the text states why.
    """
    return decode_layout(read_layout(payload, encoding))


def decode_layout(layout: Layout) -> Cloud:
    """Return the cloud of a checked layout, as ``decode_cloud``.

    Raises BadMessage if a coordinate is missing.
    """
    if 0 in layout.shape:
        return Cloud(layout.stamp_ns, layout.frame, np.zeros((0, 3), np.float32), None, 0)
    points, times, intensities = _points(layout), _times(layout), _intensities(layout)
    places = (
        np.arange(len(points), dtype=np.float32) / np.float32(len(points))
        if times is None
        else None
    )
    cloud = Cloud(
        layout.stamp_ns, layout.frame, points, times, 0, intensities=intensities, places=places
    )
    kept = usable(points)
    dropped = 0 if kept is None else len(points) - int(np.count_nonzero(kept))
    return cloud if kept is None or not dropped else replace(cloud.keep(kept), dropped=dropped)


def usable(points: NDArray[Any]) -> NDArray[np.bool_] | None:
    """Return which of the points (n, 3) are finite and within ``MAX_COORDINATE_M``; None if
    all are.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        if (
            np.einsum("ij,ij->", points, points) < MAX_COORDINATE_M**2
        ):  # fast: no point can be outside
            return None
        kept: NDArray[np.bool_] = (np.abs(points) <= MAX_COORDINATE_M).all(axis=1)
    return kept


def read_layout(payload: bytes | memoryview, encoding: str = "cdr") -> Layout:
    """Parse and check a message without decoding its points.

    Raises BadMessage if it is malformed.
    """
    cursor = Cursor(payload, encoding)
    stamp_ns, frame = cursor.header()
    height, width = cursor.u32(), cursor.u32()
    fields = _fields(cursor)
    order = ">" if cursor.u8() else "<"
    point_step, row_step = cursor.u32(), cursor.u32()
    data = cursor.octets()
    if height == 1 or row_step == 0:  # some writers leave row_step unset if there is one row
        row_step = width * point_step
    layout = Layout(stamp_ns, frame, (height, width), fields, order, point_step, row_step, data)
    if height and width:
        check_layout(layout)
    return layout


def _fields(cursor: Cursor) -> tuple[Field, ...]:
    count = cursor.u32()
    if count > _MAX_FIELDS:
        raise BadMessage(f"{count} fields, at most {_MAX_FIELDS} are read")
    fields = []
    for _ in range(count):
        name, offset, datatype, many = cursor.string(), cursor.u32(), cursor.u8(), cursor.u32()
        if datatype not in _DATATYPES:
            raise BadMessage(f"field '{name}' is of unknown datatype {datatype}")
        fields.append(Field(name, offset, _DATATYPES[datatype], many))
    return tuple(fields)


def check_layout(layout: Layout) -> None:
    """Raise BadMessage if a layout with points contradicts itself or its data."""
    height, width = layout.shape
    if layout.row_step < width * layout.point_step:
        raise BadMessage(
            f"row_step {layout.row_step} is shorter than {width} points of {layout.point_step}"
        )
    needed = (height - 1) * layout.row_step + width * layout.point_step
    if needed > len(layout.data):
        raise BadMessage(
            f"{height} x {width} points of {layout.point_step} bytes in {len(layout.data)} bytes"
        )
    for field in layout.fields:
        size = int(field.kind[1]) * max(field.count, 1)
        if field.offset + size > layout.point_step:
            raise BadMessage(f"field '{field.name}' ends past point_step {layout.point_step}")
    spans = sorted(
        (f.offset, f.offset + int(f.kind[1])) for f in layout.fields if f.name in ("x", "y", "z")
    )
    if any(before[1] > after[0] for before, after in pairwise(spans)):
        raise BadMessage("the fields x, y and z overlap")


def _points(layout: Layout) -> NDArray[Any]:
    """Return the points (n, 3), float32 or float64; a view if x, y and z are adjacent and in
    native byte order.
    """
    x, y, z = (layout.column(axis) for axis in "xyz")
    size = x.dtype.itemsize
    bases = [next(f.offset for f in layout.fields if f.name == axis) for axis in "xyz"]
    native = x.dtype.isnative and x.dtype.kind == "f" and x.dtype == y.dtype == z.dtype
    rows_meet = layout.row_step == layout.shape[1] * layout.point_step
    if native and rows_meet and bases == [bases[0], bases[0] + size, bases[0] + 2 * size]:
        count = layout.shape[0] * layout.shape[1]
        return np.ndarray((count, 3), x.dtype, layout.data, bases[0], (layout.point_step, size))
    kind = (
        np.float32
        if all(c.dtype.kind == "f" and c.dtype.itemsize == 4 for c in (x, y, z))
        else np.float64
    )
    return np.stack([c.reshape(-1) for c in (x, y, z)], axis=1).astype(kind)


def _times(layout: Layout) -> NDArray[np.float32] | None:
    """Return times [s] after the stamp: floats are seconds, integers nanoseconds, large
    doubles absolute seconds.
    """
    names = {f.name for f in layout.fields}
    if {"time_sec", "time_nsec"} <= names:
        seconds = layout.column("time_sec").reshape(-1).astype(np.int64) * 1_000_000_000
        return _relative(
            seconds + layout.column("time_nsec").reshape(-1).astype(np.int64), layout.stamp_ns
        )
    name = next((n for n in _TIME_NAMES if n in names), None)
    if name is None:
        return None
    column = layout.column(name).reshape(-1)
    if column.dtype.kind in "iu":
        return _relative(column.astype(np.int64), layout.stamp_ns)
    if column.dtype.itemsize == 8 and len(column) and np.nanmax(np.abs(column)) > 1e6:
        return (column.astype(np.float64) - layout.stamp_ns * 1e-9).astype(np.float32)
    return column.astype(np.float32)


def _intensities(layout: Layout) -> NDArray[np.float32] | None:
    """Return the intensity (n,) of each point in the sensor's own unit."""
    name = next((f.name for f in layout.fields if f.name in _INTENSITY_NAMES), None)
    return None if name is None else layout.column(name).reshape(-1).astype(np.float32)


def _relative(times_ns: NDArray[np.int64], stamp_ns: int) -> NDArray[np.float32]:
    """Convert nanoseconds to seconds after the stamp; large values are absolute times."""
    absolute = len(times_ns) > 0 and abs(int(times_ns[0])) > 10**15
    return ((times_ns - (stamp_ns if absolute else 0)) * 1e-9).astype(np.float32)
