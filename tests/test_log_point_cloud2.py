"""PointCloud2 of any layout, against messages written with numpy records and struct."""

from __future__ import annotations

import struct
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from avsreplay.log.bytes_io import BadMessage
from avsreplay.log.canonical import Cloud, canonical, infer, selected
from avsreplay.log.cdr import point_cloud2
from avsreplay.log.options import SourceOptions
from avsreplay.log.point_cloud2 import raw_cloud, read_layout
from avsreplay.log.point_times import TimedCloud

CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
ROS2, ROS1 = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)


def decode_cloud(payload: bytes, encoding: str = "cdr") -> Cloud:
    """The canonical cloud of a message that is the only one of its log."""
    raw = raw_cloud(payload, encoding)
    return canonical(raw, infer([TimedCloud(raw, raw.stamp_ns)], None, SourceOptions()))


def message(  # type: ignore[no-untyped-def]
    fields,
    raw: bytes,
    width: int,
    height: int,
    step: int,
    row: int,
    big: bool = False,
    encoding: str = "cdr",
) -> bytes:
    """A message as rosbags serialises it: (name, offset, numpy kind) a field."""
    store = ROS1 if encoding == "ros1" else ROS2
    t = store.types
    header_type, time_type = t["std_msgs/msg/Header"], t["builtin_interfaces/msg/Time"]
    stamp = time_type(sec=12, nanosec=345)
    header = (
        header_type(seq=3, stamp=stamp, frame_id="lidär")
        if encoding == "ros1"
        else header_type(stamp, "lidär")
    )
    made = [
        t["sensor_msgs/msg/PointField"](name=n, offset=o, datatype=CODES[k], count=1)
        for n, o, k in fields
    ]
    cloud = t["sensor_msgs/msg/PointCloud2"](
        header=header,
        height=height,
        width=width,
        fields=made,
        is_bigendian=big,
        point_step=step,
        row_step=row,
        data=np.frombuffer(raw, np.uint8),
        is_dense=False,
    )
    if encoding == "ros1":
        return bytes(store.serialize_ros1(cloud, "sensor_msgs/msg/PointCloud2"))
    return bytes(
        store.serialize_cdr(cloud, "sensor_msgs/msg/PointCloud2", little_endian=encoding == "cdr")
    )


@settings(max_examples=60)
@given(st.data())
def test_every_layout_gives_the_original_points(data: st.DataObject) -> None:
    height, width = data.draw(st.integers(1, 4)), data.draw(st.integers(1, 9))
    kinds = {axis: data.draw(st.sampled_from(["f4", "f8"])) for axis in "xyz"}
    extra = data.draw(st.lists(st.sampled_from(sorted(CODES)), max_size=3))
    columns = [*kinds.items(), *((f"e{i}", k) for i, k in enumerate(extra))]
    columns = data.draw(st.permutations(columns))
    big = data.draw(st.booleans())
    fields, at = [], 0
    for name, kind in columns:
        at += data.draw(st.integers(0, 5))  # padding, not aligned
        fields.append((name, at, kind))
        at += int(kind[1])
    step = at + data.draw(st.integers(0, 5))
    row = step * width + (data.draw(st.integers(0, 7)) if height > 1 else 0)
    rng = np.random.Generator(np.random.PCG64(data.draw(st.integers(0, 2**32))))
    xyz = rng.normal(size=(height, width, 3))
    raw = bytearray(rng.integers(0, 256, row * height, dtype=np.uint8).tobytes())
    want = np.empty_like(xyz)
    for axis in range(3):
        name, offset, kind = next(f for f in fields if f[0] == "xyz"[axis])
        for i, j in np.ndindex(height, width):
            value = np.array(xyz[i, j, axis], dtype=kind)
            code = (">" if big else "<") + ("f" if kind == "f4" else "d")
            struct.pack_into(code, raw, i * row + j * step + offset, float(value))
            want[i, j, axis] = value
    encoding = data.draw(st.sampled_from(["cdr", "cdr big", "ros1"]))
    payload = message(fields, bytes(raw), width, height, step, row, big, encoding)
    cloud = decode_cloud(payload, "ros1" if encoding == "ros1" else "cdr")
    assert cloud.stamp_ns == 12_000_000_345
    assert cloud.frame == "lidär"
    np.testing.assert_array_equal(np.asarray(cloud.points, dtype=np.float64), want.reshape(-1, 3))


@pytest.mark.parametrize("kinds", list(product(("f4", "f8"), repeat=3)))
@pytest.mark.parametrize("order", ["xyz", "zyx", "xzy"])
def test_adjacent_coordinates_of_any_kinds_give_the_original_points(
    kinds: tuple[str, str, str], order: str
) -> None:
    """Also where the distance of two coordinates in memory is the size of another one."""
    fields, at = [], 0
    for name in order:
        fields.append((name, at, kinds["xyz".index(name)]))
        at += int(fields[-1][2][1])
    want = np.random.Generator(np.random.PCG64(3)).normal(size=(5, 3))
    table = np.empty(5, {k: [f[i] for f in fields] for i, k in enumerate(("names", "offsets"))} | {
        "formats": [f"<{kind}" for _, _, kind in fields]
    })  # fmt: skip
    for axis, kind, column in zip("xyz", kinds, want.T, strict=True):
        column[:] = column.astype(kind)
        table[axis] = column
    found = decode_cloud(message(fields, table.tobytes(), 5, 1, at, 5 * at))
    np.testing.assert_array_equal(np.asarray(found.points, dtype=np.float64), want)


def test_the_common_layout_is_a_view_and_not_a_copy() -> None:
    payload = point_cloud2(5, "camera", np.ones((100, 3), np.float32), np.zeros(100, np.float32))
    cloud = decode_cloud(payload)
    assert not cloud.points.flags.owndata
    assert not cloud.points.flags.writeable
    assert cloud.points.strides == (16, 4)


def test_points_that_are_not_finite_are_left_out_and_counted() -> None:
    points = np.arange(30, dtype=np.float32).reshape(10, 3)
    points[3, 1], points[5, 2], points[7, 0] = np.nan, np.inf, -np.inf
    cloud = decode_cloud(point_cloud2(5, "c", points, np.arange(10, dtype=np.float32)))
    kept = [0, 1, 2, 4, 6, 8, 9]
    assert cloud.dropped == 3
    np.testing.assert_array_equal(cloud.points, points[kept])
    np.testing.assert_array_equal(cloud.times_s, kept)


def test_the_order_of_points_without_times_counts_those_that_are_left_out() -> None:
    points = np.arange(30, dtype=np.float32).reshape(10, 3)
    points[3, 1], points[5, 2] = np.nan, np.inf
    cloud = decode_cloud(point_cloud2(5, "c", points, None))
    assert cloud.places is not None
    np.testing.assert_allclose(cloud.places, [0.0, 0.1, 0.2, 0.4, 0.6, 0.7, 0.8, 0.9], atol=1e-7)
    assert (
        decode_cloud(point_cloud2(5, "c", points, np.arange(10, dtype=np.float32))).places is None
    )


@pytest.mark.parametrize("duration_s", [0.5, -0.5])
def test_the_duration_of_a_scan_gives_times_by_the_order_of_the_points(duration_s: float) -> None:
    points = np.arange(30, dtype=np.float32).reshape(10, 3)
    points[3, 1] = np.nan
    options = SourceOptions(scan_duration_s=duration_s, crop_range=(8.0, 1e3))
    found = selected(decode_cloud(point_cloud2(5, "c", points, None)), options)
    np.testing.assert_array_equal(found.points, points[[2, 4, 5, 6, 7, 8, 9]])
    np.testing.assert_allclose(
        found.times_s, duration_s * np.array([0.2, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9]), atol=1e-7
    )
    assert found.places is None
    given = np.arange(10, dtype=np.float32)
    own = selected(decode_cloud(point_cloud2(5, "c", points, given)), options)
    np.testing.assert_array_equal(
        own.times_s, given[[2, 4, 5, 6, 7, 8, 9]]
    )  # times of the message are kept


@pytest.mark.parametrize("kind", ["float32", "float64"])
def test_points_that_are_too_far_away_are_left_out_and_counted(kind: str) -> None:
    points = np.arange(30, dtype=kind).reshape(10, 3)
    points[3, 1], points[5, 2], points[7, 0] = 1.1e6, -1e20, 1e38
    points[8] = 9.9e5
    cloud = decode_cloud(point_cloud2(5, "c", points, None, kind))
    assert cloud.dropped == 3
    np.testing.assert_array_equal(cloud.points, np.delete(points, [3, 5, 7], axis=0))


def test_time_fields_in_all_their_forms() -> None:
    stamp = 1_600_000_000_500_000_000
    base = np.zeros(
        4, dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u8")]
    )  # room for any

    def times(name: str, kind: str, values: object) -> np.ndarray:  # type: ignore[type-arg]
        table = np.zeros(4, dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), (name, "<" + kind)])
        table[name], table["x"] = values, np.arange(1.0, 5.0)
        fields = [("x", 0, "f4"), ("y", 4, "f4"), ("z", 8, "f4"), (name, 12, kind)]
        raw = bytearray(message(fields, table.tobytes(), 4, 1, table.itemsize, table.nbytes))
        struct.pack_into("<iI", raw, 4, 1_600_000_000, 500_000_000)
        found = decode_cloud(bytes(raw)).times_s
        assert found is not None
        return found

    want = np.array([0.0, 0.025, 0.05, 0.075])
    np.testing.assert_allclose(times("time", "f4", want), want, atol=1e-8)
    np.testing.assert_allclose(times("t", "u4", (want * 1e9).astype(np.uint32)), want, atol=1e-8)
    np.testing.assert_allclose(times("timestamp", "f8", stamp * 1e-9 + want), want, atol=1e-6)
    assert base.dtype.itemsize == 20


def _good() -> bytes:
    return point_cloud2(5, "c", np.ones((10, 3), np.float32), None)


def test_every_prefix_of_a_message_is_rejected() -> None:
    whole = _good()
    for size in range(len(whole) - 1):
        with pytest.raises(BadMessage):
            decode_cloud(whole[:size])


@pytest.mark.parametrize(
    ("what", "fields", "width", "height", "step", "row"),
    [
        ("in 120 bytes", [("x", 0, "f4"), ("y", 4, "f4"), ("z", 8, "f4")], 2**32 - 1, 1, 12, 12),
        (
            "in 120 bytes",
            [("x", 0, "f4"), ("y", 4, "f4"), ("z", 8, "f4")],
            2**28,
            2**31,
            12,
            2**32 - 1,
        ),
        ("row_step", [("x", 0, "f4"), ("y", 4, "f4"), ("z", 8, "f4")], 5, 2, 12, 12),
        ("past point_step", [("x", 0, "f4"), ("y", 4, "f4"), ("z", 10, "f4")], 10, 1, 12, 120),
        (
            "past point_step",
            [("x", 0, "f4"), ("y", 4, "f4"), ("z", 2**32 - 4, "f4")],
            10,
            1,
            12,
            120,
        ),
        ("past point_step", [("x", 0, "f4"), ("y", 4, "f4"), ("z", 8, "f4")], 10, 1, 0, 0),
        ("overlap", [("x", 0, "f4"), ("y", 2, "f4"), ("z", 8, "f4")], 10, 1, 12, 120),
        ("no field 'z'", [("x", 0, "f4"), ("y", 4, "f4")], 10, 1, 12, 120),
    ],
)
def test_wrong_sizes_are_rejected(what, fields, width, height, step, row) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(BadMessage, match=what):
        decode_cloud(message(fields, bytes(120), width, height, step, row))


def test_unknown_datatypes_encodings_and_counts_are_rejected() -> None:
    whole = bytearray(_good())
    at = whole.index(b"x\x00") + 2
    at += -(at - 4) % 4
    whole[at + 4] = 99
    with pytest.raises(BadMessage, match="datatype 99"):
        decode_cloud(bytes(whole))
    with pytest.raises(BadMessage, match="encapsulation"):
        decode_cloud(b"\x00\x07\x00\x00" + _good()[4:])
    whole = bytearray(_good())
    count = whole.index(b"x\x00") - 8
    struct.pack_into("<I", whole, count, 2**32 - 1)
    with pytest.raises(BadMessage, match="fields"):
        decode_cloud(bytes(whole))


def test_names_that_are_not_utf8_are_escaped() -> None:
    whole = bytearray(point_cloud2(5, "abcd", np.ones((1, 3), np.float32), None))
    at = whole.index(b"abcd")
    whole[at : at + 2] = b"\xff\x1b"
    assert read_layout(bytes(whole)).frame == "\\xff\x1bcd"
