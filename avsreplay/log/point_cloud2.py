"""Decoding of sensor_msgs/PointCloud2 with any layout; fields are views of the message."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.log.bytes_io import BadMessage
from avsreplay.log.cdr import Cursor
from avsreplay.log.raw_cloud import RawCloud

_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_MAX_CLOUD_FIELDS = 256


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

    def view(self, field: Field) -> NDArray[Any]:
        """Return a (height, width) view of one field."""
        strides = (self.row_step, self.point_step)
        return np.ndarray(self.shape, self.order + field.kind, self.data, field.offset, strides)


def raw_cloud(payload: bytes | memoryview, encoding: str = "cdr") -> RawCloud:
    """Decode a cloud to the fields that it declares, as views of the message.

    Args:
        payload: the serialised message.
        encoding: ``cdr`` or ``ros1``.

    Raises:
        BadMessage: the message is malformed, or has no coordinates; the text states why.
    """
    return of_layout(read_layout(payload, encoding))


def of_layout(layout: Layout) -> RawCloud:
    """Return the cloud of a checked layout. Raises BadMessage if it has no coordinates."""
    if 0 in layout.shape:
        none = np.zeros(0, np.float32)
        fields = {name: none for name in (*"xyz", *(f.name for f in layout.fields))}
        return RawCloud(layout.stamp_ns, layout.frame, fields, (1, 0))
    fields = {field.name: layout.view(field) for field in reversed(layout.fields)}
    fields = {field.name: fields[field.name] for field in layout.fields}
    for axis in "xyz":
        if axis not in fields:
            known = ", ".join(fields) or "none"
            raise BadMessage(f"no field '{axis}' among {known}")
    return RawCloud(layout.stamp_ns, layout.frame, fields, layout.shape)


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
    if count > _MAX_CLOUD_FIELDS:
        raise BadMessage(f"{count} fields, at most {_MAX_CLOUD_FIELDS} are read")
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
