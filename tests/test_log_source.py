"""Logs of other writers: ROS 1 and ROS 2 bags, split files, several topics, moving sensors,
truth in every form.
"""

from __future__ import annotations

import os
import sqlite3
import struct
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from log_cases import SECOND, header, scans, write
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation, Slerp
from true_scans import true_scans

from avsreplay import geometry
from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.geometry import Pose
from avsreplay.log import ClockChoice, LogWriter, SourceOptions, open_source
from avsreplay.log.cdr import Packer, point_cloud2, pose_stamped, schema_text
from avsreplay.log.doctor import examine
from avsreplay.log.pose_messages import PoseTrack
from avsreplay.records import Scan, ScanStatus

CLOUDS = scans(12, 150)
CLOUD, POSE, TF = (
    "sensor_msgs/msg/PointCloud2",
    "geometry_msgs/msg/PoseStamped",
    "tf2_msgs/msg/TFMessage",
)


def pose(i: int) -> Pose:
    return Pose(geometry.exp([0.1 * i, -0.2, 0.05 * i]), np.array([0.1 * i, 1.0, -0.3]))


def mcap(path: Path, messages: list[tuple[str, str, int, bytes]], encoding: str = "cdr") -> Path:
    """(topic, type, log time, payload) into an MCAP by the library's own writer."""
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start("ros2")
        channels: dict[str, int] = {}
        for topic, kind, log_ns, payload in messages:
            if topic not in channels:
                schema = writer.register_schema(kind, "ros2msg", schema_text(kind))
                channels[topic] = writer.register_channel(topic, encoding, schema)
            writer.add_message(channels[topic], log_ns, payload, log_ns)
        writer.finish()
    return path


def clouds(topic: str = "/points", frame: str = "camera") -> list[tuple[str, str, int, bytes]]:
    return [(topic, CLOUD, c.log_ns, point_cloud2(c.t_ns, frame, c.points, None)) for c in CLOUDS]


def text1(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def header1(c: Scan, frame: str) -> bytes:
    return struct.pack("<III", c.seq, c.t_ns // SECOND, c.t_ns % SECOND) + text1(frame)


def cloud1(c: Scan) -> bytes:
    """The wire form of ROS 1, by hand."""
    fields = b"".join(
        text1(name) + struct.pack("<IBI", 4 * i, 7, 1) for i, name in enumerate("xyz")
    )
    data = np.ascontiguousarray(c.points).tobytes()
    sizes = struct.pack("<?II", False, 12, len(data)) + struct.pack("<I", len(data))
    return (
        header1(c, "camera")
        + struct.pack("<III", 1, len(c.points), 3)
        + fields
        + sizes
        + data
        + b"\x01"
    )


def bag1(
    path: Path, compression: Ros1Writer.CompressionFormat | None = None, chunk: int = 1 << 20
) -> Path:
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = Ros1Writer(path)
    if compression is not None:
        writer.set_compression(compression)
    writer.chunk_threshold = chunk
    with writer:
        cloud = writer.add_connection("/points", CLOUD, typestore=store)
        truth = writer.add_connection("/gt", POSE, typestore=store)
        for i, c in enumerate(CLOUDS):
            writer.write(cloud, c.log_ns, cloud1(c))
            writer.write(
                truth, c.log_ns, header1(c, "camera") + struct.pack("<7d", *pose(i).t, *pose(i).q)
            )
    return path


def bag2(path: Path, plugin: StoragePlugin) -> Path:
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Ros2Writer(path, version=9, storage_plugin=plugin) as writer:
        cloud = writer.add_connection("/points", CLOUD, typestore=store)
        truth = writer.add_connection("/gt", POSE, typestore=store)
        for i, c in enumerate(CLOUDS):
            writer.write(cloud, c.log_ns, point_cloud2(c.t_ns, "camera", c.points, None))
            writer.write(truth, c.log_ns, pose_stamped(c.t_ns, "camera", pose(i)))
    return path


def read(path: Path, **options: object) -> list[Scan]:
    with open_source(path, SourceOptions(**options)) as source:  # type: ignore[arg-type]
        assert not source.losses
        return list(true_scans(source))


def check(found: list[Scan], with_truth: bool = True) -> None:
    assert [s.t_ns for s in found] == [c.t_ns for c in CLOUDS]
    assert [s.log_ns for s in found] == [c.log_ns for c in CLOUDS]
    for i, (scan, c) in enumerate(zip(found, CLOUDS, strict=True)):
        assert scan.points.tobytes() == c.points.tobytes()
        if with_truth:
            np.testing.assert_allclose(scan.truth.matrix, pose(i).matrix, rtol=0, atol=1e-15)


@pytest.mark.parametrize("compression", [None, *Ros1Writer.CompressionFormat])
def test_ros1_bags(tmp_path: Path, compression: Ros1Writer.CompressionFormat | None) -> None:
    check(read(bag1(tmp_path / "a.bag", compression), truth_topic="/gt"))


@pytest.mark.parametrize("plugin", list(StoragePlugin))
@pytest.mark.parametrize("lone", [False, True])
def test_ros2_bags_as_a_folder_and_as_a_lone_file(
    tmp_path: Path, plugin: StoragePlugin, lone: bool
) -> None:
    folder = bag2(tmp_path / "bag", plugin)
    path = next(p for p in folder.iterdir() if p.suffix in (".db3", ".mcap")) if lone else folder
    check(read(path, truth_topic="/gt"))


def test_a_split_bag_is_one_log_in_the_order_of_its_numbers(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    folder.mkdir()
    parts = clouds()
    for number, start in enumerate(range(0, 12, 1)):
        mcap(folder / f"bag_{number}.mcap", parts[start : start + 1])
    check(read(folder), with_truth=False)
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  relative_file_paths:\n"
        + "".join(f"    - bag_{n}.mcap\n" for n in range(13))
    )
    with open_source(folder) as source:
        assert len(source) == 12
        assert [loss.file for loss in source.losses] == ["bag_12.mcap"]
        (topic,) = (each for each in source.info().topics if each.type.endswith("PointCloud2"))
        whole = mcap(tmp_path / "whole.mcap", parts)
        with open_source(whole) as single:
            (other,) = (e for e in single.info().topics if e.type.endswith("PointCloud2"))
    assert (topic.count, topic.first_ns, topic.last_ns) == (12, other.first_ns, other.last_ns)


def test_a_pose_between_two_lies_at_its_share_of_the_time() -> None:
    track, turn = PoseTrack(1.0), Rotation.from_rotvec([0.0, 0.6, 0.0])
    for t_ns, share in ((2_000_000_000, 1.0), (1_000_000_000, 0.0)):  # in any order
        q = (turn**share).as_quat()
        track.add(t_ns, (4.0 * share, 1.0, 0.0, *q))
    found = track.pose(1_250_000_000)
    assert found is not None
    np.testing.assert_allclose(found.t, [1.0, 1.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(found.R, (turn**0.25).as_matrix(), atol=1e-15)
    assert track.pose(999_999_999) is None
    assert track.pose(2_000_000_001) is None
    track.add(3_000_000_001, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))  # a gap of 1 s and 1 ns
    assert track.pose(2_500_000_000) is None


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9, 0.98])
def test_a_truncated_ros1_bag_gives_its_complete_chunks(tmp_path: Path, share: float) -> None:
    data = bag1(tmp_path / "a.bag", chunk=3000).read_bytes()
    (tmp_path / "x.bag").write_bytes(data[: int(share * len(data))])
    with open_source(tmp_path / "x.bag") as source:
        found = list(true_scans(source))
        assert bool(source.losses) == (share < 0.95)  # behind that only the index is cut
    assert len(found) >= int(12 * share) - 3
    assert all(
        s.points.tobytes() == c.points.tobytes() for s, c in zip(found, CLOUDS, strict=False)
    )


def test_a_damaged_chunk_of_a_ros1_bag_loses_only_that_chunk(tmp_path: Path) -> None:
    path = bag1(tmp_path / "a.bag", Ros1Writer.CompressionFormat.LZ4, 4000)
    data = bytearray(path.read_bytes())
    starts = [i for i in range(len(data)) if data.startswith(b"compression=lz4", i)]
    assert len(starts) > 3
    data[starts[1] + 60 : starts[1] + 90] = bytes(30)
    path.write_bytes(data)
    with open_source(path) as source:
        found = [s.t_ns for s in source.scans()]
        assert source.losses[0].chunks == 1
        assert source.losses[0].messages == 2 * (12 - len(found))
    assert 0 < 12 - len(found) <= 4


@pytest.mark.parametrize("leaf", [0, 2, -1])
def test_a_database_with_damaged_pages_gives_what_can_be_read(tmp_path: Path, leaf: int) -> None:
    path = next(bag2(tmp_path / "bag", StoragePlugin.SQLITE3).glob("*.db3"))
    data = bytearray(path.read_bytes())
    rows = [
        at for at in range(6 * 4096, len(data), 4096) if data[at] == 0x0D
    ]  # leaves of the table of messages
    data[rows[leaf] : rows[leaf] + 4096] = bytes(4096)
    path.write_bytes(data)
    with open_source(path) as source:
        found = list(true_scans(source))
        assert source.losses[0].what == "the database is damaged"
    known = {c.points.tobytes() for c in CLOUDS}
    assert 8 < len(found) < 12
    assert all(s.points.tobytes() in known for s in found)


def test_a_truncated_database_is_reported_with_a_hint(tmp_path: Path) -> None:
    path = next(bag2(tmp_path / "bag", StoragePlugin.SQLITE3).glob("*.db3"))
    path.write_bytes(path.read_bytes()[:20_000])
    with pytest.raises(UnreadableInput, match="recover"):
        open_source(path)


@pytest.mark.parametrize(
    "stamps", [(2**63 - 2, 2**63 - 1), (0, 2**63 - 1), (5, 2**62), (-(2**63), 2**62)]
)
def test_times_that_ros_cannot_hold_are_cut_and_can_be_recorded(
    stamps: tuple[int, int], tmp_path: Path
) -> None:
    """sqlite stores 64 bits of nanoseconds, ROS 2 and with it every log 31 bits of seconds."""
    path = tmp_path / "x.db3"
    with closing(sqlite3.connect(path)) as db:
        db.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format"
            " TEXT)"
        )
        db.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,"
            " data BLOB)"
        )
        db.execute("INSERT INTO topics VALUES(1, '/points', 'sensor_msgs/msg/PointCloud2', 'cdr')")
        for k, stamp in enumerate(stamps * 2):
            payload = point_cloud2(0, "c", np.ones((5, 3), np.float32), None)
            db.execute("INSERT INTO messages VALUES(?, 1, ?, ?)", (k, stamp, payload))
        db.commit()
    examine(path)
    with open_source(path) as source, LogWriter(tmp_path / "y.mcap", source.header) as writer:
        for scan in source.scans():
            writer.write(scan)
    with open_source(tmp_path / "y.mcap") as again:
        assert len(list(again.scans())) == 4


@pytest.mark.parametrize(
    "schema",
    [
        "CREATE VIEW messages AS WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x+1 FROM c)"
        " SELECT x AS id, 1 AS topic_id, x AS timestamp, x AS data FROM c",
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INT, timestamp INT,"
        " data BLOB GENERATED ALWAYS AS (zeroblob(id)))",
        "CREATE TABLE something_else(id INTEGER)",
    ],
)
def test_a_database_that_is_not_a_bag(tmp_path: Path, schema: str) -> None:
    with sqlite3.connect(tmp_path / "x.db3") as db:
        db.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format"
            " TEXT)"
        )
        db.execute(schema)
    with pytest.raises(UnreadableInput, match="without the table 'messages'"):
        open_source(tmp_path / "x.db3")


def test_several_cloud_topics_are_listed_and_one_can_be_chosen(tmp_path: Path) -> None:
    path = mcap(tmp_path / "a.mcap", [*clouds("/left"), *clouds("/right\x1b[31m")])
    with pytest.raises(UsageError) as caught:
        open_source(path)
    assert caught.value.exit_code == 2
    assert "/left" in str(caught.value)
    assert "\\x1b[31m" in str(caught.value)
    assert "\x1b" not in str(caught.value)
    check(read(path, topic="/left"), with_truth=False)
    with pytest.raises(UsageError, match="no cloud topic '/middle'"):
        open_source(path, SourceOptions(topic="/middle"))


def test_without_a_cloud_topic_the_topics_are_listed(tmp_path: Path) -> None:
    path = mcap(tmp_path / "a.mcap", [("/gt", POSE, 5, pose_stamped(5, "c", pose(0)))])
    with pytest.raises(UnreadableInput, match=r"/gt \(geometry_msgs/msg/PoseStamped\)") as caught:
        open_source(path)
    assert caught.value.exit_code == 3


def test_an_unknown_encoding_is_reported(tmp_path: Path) -> None:
    path = mcap(tmp_path / "a.mcap", clouds(), encoding="protobuf")
    with pytest.raises(UnreadableInput, match="unknown encoding 'protobuf'"):
        open_source(path)


def test_a_truth_topic_that_is_missing_or_not_a_pose(tmp_path: Path) -> None:
    path = mcap(tmp_path / "a.mcap", clouds())
    with pytest.raises(UsageError, match="no such truth topic"):
        open_source(path, SourceOptions(truth_topic="/gt"))
    with pytest.raises(UsageError, match="truth topic of type"):
        open_source(path, SourceOptions(truth_topic="/points"))


def test_truth_is_interpolated_between_stamps_but_not_across_a_gap(tmp_path: Path) -> None:
    start, half = CLOUDS[0].t_ns, SECOND // 4
    a, b = pose(0), pose(3)
    messages = [
        *clouds(),
        ("/gt", POSE, 1, pose_stamped(start - half, "c", a)),
        ("/gt", POSE, 2, pose_stamped(start + half, "c", b)),
        ("/gt", POSE, 3, pose_stamped(start + 9 * SECOND, "c", b)),
    ]
    found = read(mcap(tmp_path / "a.mcap", messages), truth_topic="/gt", truth_gap_s=0.6)
    middle = Pose(Slerp([0, 1], Rotation.from_quat([a.q, b.q]))(0.5).as_quat(), 0.5 * (a.t + b.t))
    np.testing.assert_allclose(found[0].truth.matrix, middle.matrix, atol=1e-15)
    assert all(s.truth is None for s in found[1:])


def covariance(i: int, c: Scan) -> bytes:
    p = pose(i)
    return Packer().header(c.t_ns, "c").f64s(*p.t, *p.q, *([0.0] * 36)).bytes()


def odometry(i: int, c: Scan) -> bytes:
    p = pose(i)
    return (
        Packer()
        .header(c.t_ns, "c")
        .string("t")
        .f64s(*p.t, *p.q, *([0.0] * 36), *([0.0] * 42))
        .bytes()
    )


def stamped(i: int, c: Scan) -> bytes:
    p = pose(i)
    return Packer().header(c.t_ns, "c").string("target").f64s(*p.t, *p.q).bytes()


@pytest.mark.parametrize(
    ("kind", "make"),
    [
        ("geometry_msgs/msg/PoseWithCovarianceStamped", covariance),
        ("nav_msgs/msg/Odometry", odometry),
        ("geometry_msgs/msg/TransformStamped", stamped),
    ],
)
def test_truth_of_every_message_type(tmp_path: Path, kind: str, make) -> None:  # type: ignore[no-untyped-def]
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = McapWriter(file)
        writer.start("ros2")
        one = writer.register_channel(
            "/points", "cdr", writer.register_schema(CLOUD, "ros2msg", schema_text(CLOUD))
        )
        two = writer.register_channel("/gt", "cdr", writer.register_schema(kind, "ros2msg", b""))
        for i, (c, (_, _, log_ns, payload)) in enumerate(zip(CLOUDS, clouds(), strict=True)):
            writer.add_message(one, log_ns, payload, log_ns)
            writer.add_message(two, log_ns, make(i, c), log_ns)
        writer.finish()
    check(read(tmp_path / "a.mcap", truth_topic="/gt"))


def transforms(*links: tuple[str, str, Pose], t_ns: int) -> bytes:
    packer = Packer().u32(len(links))
    for parent, child, p in links:
        packer.header(t_ns, parent).string(child).f64s(*p.t, *p.q)
    return packer.bytes()


def moving_sensor() -> list[tuple[str, str, int, bytes]]:
    mount = pose(2)
    out = [("/tf_static", TF, 1, transforms(("base", "lidar", mount), t_ns=0))]
    for i, c in enumerate(CLOUDS):
        links = (("map", "base", pose(i)), ("map", "target", pose(20 - i)))
        out.append(("/tf", TF, c.log_ns, transforms(*links, t_ns=c.t_ns)))
    return [*clouds(frame="/lidar"), *out]


def test_clouds_of_a_moving_sensor_are_transformed_to_a_fixed_frame(tmp_path: Path) -> None:
    found = read(
        mcap(tmp_path / "a.mcap", moving_sensor()), fixed_frame="map", truth_frame="target"
    )
    for i, (scan, c) in enumerate(zip(found, CLOUDS, strict=True)):
        T_map_lidar = pose(i).matrix @ pose(2).matrix
        want = c.points.astype(np.float64) @ T_map_lidar[:3, :3].T + T_map_lidar[:3, 3]
        np.testing.assert_allclose(scan.points, want, atol=1e-12)
        np.testing.assert_allclose(scan.truth.matrix, pose(20 - i).matrix, atol=1e-14)


def test_truth_from_a_chain_in_the_sensors_own_frame(tmp_path: Path) -> None:
    found = read(mcap(tmp_path / "a.mcap", moving_sensor()), truth_frame="target")
    for i, scan in enumerate(found):
        want = np.linalg.inv(pose(i).matrix @ pose(2).matrix) @ pose(20 - i).matrix
        np.testing.assert_allclose(scan.truth.matrix, want, atol=1e-14)


def test_clouds_are_transformed_by_a_sensor_topic(tmp_path: Path) -> None:
    poses = [
        ("/cam", POSE, c.log_ns, pose_stamped(c.t_ns, "map", pose(i)))
        for i, c in enumerate(CLOUDS[:-1])
    ]
    found = read(mcap(tmp_path / "a.mcap", [*clouds(), *poses]), sensor_topic="/cam")
    np.testing.assert_allclose(found[4].points, pose(4).apply(CLOUDS[4].points), atol=1e-12)
    assert found[-1].status is ScanStatus.DAMAGED
    assert "the pose of the sensor is unknown" in found[-1].note


def test_the_position_of_the_sensor_is_one_in_the_frame_of_the_clouds(tmp_path: Path) -> None:
    """Alone it moves no point; with the pose of that frame it moves with it."""
    poses = [
        ("/cam", POSE, c.log_ns, pose_stamped(c.t_ns, "map", pose(i))) for i, c in enumerate(CLOUDS)
    ]
    path, at = mcap(tmp_path / "a.mcap", [*clouds(), *poses]), (0.5, -1.0, 2.0)
    for topic in (None, "/cam"):
        with open_source(path, SourceOptions(sensor_m=at, sensor_topic=topic)) as source:
            scan = source.scan_at(4)
            frame = pose(4) if topic else Pose.identity()
            np.testing.assert_allclose(scan.sensor.t, frame.apply(np.array([at]))[0], atol=1e-12)
            np.testing.assert_allclose(scan.points, frame.apply(CLOUDS[4].points), atol=1e-6)
            np.testing.assert_allclose(source.in_own_frame(scan), CLOUDS[4].points, atol=1e-6)


def test_a_loop_of_transforms_ends(tmp_path: Path) -> None:
    loop = transforms(
        ("a", "b", pose(1)),
        ("b", "a", pose(2)),
        ("b", "camera", pose(0)),
        ("x", "map", pose(0)),
        t_ns=0,
    )
    path = mcap(tmp_path / "a.mcap", [*clouds(), ("/tf_static", TF, 1, loop)])
    assert all(s.status is ScanStatus.DAMAGED for s in read(path, fixed_frame="map"))
    with pytest.raises(UsageError, match="no frame 'mars'"):
        open_source(path, SourceOptions(fixed_frame="mars"))


def test_pose_files_beside_a_log(tmp_path: Path) -> None:
    path = mcap(tmp_path / "a.mcap", clouds())
    tum, kitti, euroc = tmp_path / "t.tum", tmp_path / "k.txt", tmp_path / "e.csv"
    rows = [(c.t_ns, pose(i)) for i, c in enumerate(CLOUDS)]
    lines = [
        f"{t // SECOND}.{t % SECOND:09d} {' '.join(repr(float(v)) for v in (*p.t, *p.q))}\n"
        for t, p in rows
    ]
    tum.write_text("# t x y z qx qy qz qw\n" + "".join(lines))
    kitti.write_text(
        "".join(" ".join(repr(float(v)) for v in p.matrix[:3].reshape(-1)) + "\n" for _, p in rows)
    )
    euroc.write_text(
        "#timestamp [ns],p,q\n"
        + "".join(
            f"{t},{','.join(repr(float(v)) for v in (*p.t, p.q[3], *p.q[:3]))},0,0,0\n"
            for t, p in rows
        )
    )
    for file in (tum, kitti, euroc):
        for i, scan in enumerate(read(path, truth_file=file)):
            np.testing.assert_allclose(scan.truth.matrix, pose(i).matrix, atol=1e-14)


@pytest.mark.parametrize(
    "line",
    [
        "1 2 3",
        "a b c d e f g h",
        "1 0 0 0 0 0 0 1 9",
        "1 0 0 0 2 0 0 0 0 1 0 0",
        "1,2",
        "",
    ],
)
def test_a_file_that_is_not_a_pose_file(tmp_path: Path, line: str) -> None:
    path = mcap(tmp_path / "a.mcap", clouds())
    (tmp_path / "p.txt").write_text("0 0 0 0 0 0 0 1\n" * bool(line) + line + "\n")
    with pytest.raises(UnreadableInput) as caught:
        open_source(path, SourceOptions(truth_file=tmp_path / "p.txt"))
    assert ("p.txt:2" in str(caught.value)) == bool(line)


def test_a_cloud_that_cannot_be_decoded_is_a_damaged_scan(tmp_path: Path) -> None:
    messages = clouds()
    messages[4] = (*messages[4][:3], messages[4][3][:200])
    messages[5] = (*messages[5][:3], b"")
    found = read(mcap(tmp_path / "a.mcap", messages))
    assert [s.status for s in found][3:7] == [
        ScanStatus.OK,
        ScanStatus.DAMAGED,
        ScanStatus.DAMAGED,
        ScanStatus.OK,
    ]
    assert len(found) == 12


def test_an_empty_cloud_is_an_empty_scan(tmp_path: Path) -> None:
    empty = np.zeros((0, 3), np.float32)
    nothing = np.full((7, 3), np.nan, np.float32)
    messages = [
        ("/p", CLOUD, SECOND + i, point_cloud2(SECOND + i, "c", p, None))
        for i, p in enumerate((empty, nothing))
    ]
    found = read(mcap(tmp_path / "a.mcap", messages))
    assert [(s.status, s.dropped_points) for s in found] == [
        (ScanStatus.EMPTY, 0),
        (ScanStatus.EMPTY, 7),
    ]


def test_the_log_clock_can_be_chosen(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", header(np.random.Generator(np.random.PCG64(1))), CLOUDS)
    assert [s.t_ns for s in read(tmp_path / "a.mcap", clock=ClockChoice.LOG)] == [
        c.log_ns for c in CLOUDS
    ]


def test_model_and_truth_move_with_the_grasp_point() -> None:
    log, grasp = Path(__file__).parents[1] / "fixtures" / "tumble.mcap", (0.3, -0.2, 0.5)
    by = Pose(geometry.IDENTITY_QUAT, np.array(grasp))
    with open_source(log) as plain, open_source(log, SourceOptions(grasp=grasp)) as moved:
        assert plain.header.surface is not None
        assert moved.header.surface is not None
        np.testing.assert_allclose(
            moved.header.surface.vertices, plain.header.surface.vertices - grasp, atol=1e-12
        )
        assert moved.header.start is None
        for seq in (0, len(plain) - 1):
            scan = plain.scan_at(seq)
            before, after = plain.truth_of(scan), moved.truth_of(scan)
            assert before.pose is not None
            assert after.pose is not None
            assert after.state is not None
            np.testing.assert_allclose(after.pose.matrix, (before.pose @ by).matrix, atol=1e-12)
            np.testing.assert_allclose(after.state.T_ac.matrix, after.pose.matrix, atol=1e-6)


# ---- containers and transforms of other recorders ----


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_messages_that_are_compressed_one_by_one(tmp_path: Path, plugin: StoragePlugin) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    writer = Ros2Writer(tmp_path / "bag", version=9, storage_plugin=plugin)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        cloud = writer.add_connection("/points", CLOUD, typestore=store)
        truth = writer.add_connection("/gt", POSE, typestore=store)
        for i, c in enumerate(CLOUDS):
            writer.write(cloud, c.log_ns, point_cloud2(c.t_ns, "camera", c.points, None))
            writer.write(truth, c.log_ns, pose_stamped(c.t_ns, "camera", pose(i)))
    check(read(tmp_path / "bag", truth_topic="/gt"))


def test_a_compressed_message_over_the_limit_is_a_damaged_scan(tmp_path: Path) -> None:
    import zstandard

    bomb = zstandard.compress(bytes(8 << 20))
    messages = [*clouds()[:1], ("/points", CLOUD, CLOUDS[1].log_ns, bomb)]
    options = SourceOptions(max_message_mib=1)
    with open_source(mcap(tmp_path / "a.mcap", messages), options) as source:
        found = list(source.scans())
    assert sorted(scan.status.value for scan in found) == ["damaged", "ok"]
    assert any("over the limit" in str(scan.note) for scan in found)


def test_the_metadata_of_a_bag_stands_for_its_folder(tmp_path: Path) -> None:
    bag2(tmp_path / "bag", StoragePlugin.MCAP)
    check(read(tmp_path / "bag" / "metadata.yaml", truth_topic="/gt"))


def test_an_invalid_transform_does_not_drop_the_others_of_its_message(tmp_path: Path) -> None:
    nothing = Packer().header(CLOUDS[0].t_ns, "odom").string("wheel").f64s(*[0.0] * 7).bytes()[4:]
    messages = []
    for topic, kind, log_ns, payload in moving_sensor():
        if topic == "/tf":
            whole = bytearray(payload)
            whole[4:8] = struct.pack("<I", 3)
            whole += bytes(-(len(whole) - 4) % 4) + nothing
            payload = bytes(whole)
        messages.append((topic, kind, log_ns, payload))
    path = mcap(tmp_path / "a.mcap", messages)
    found = read(path, fixed_frame="map", truth_frame="target")
    for i, scan in enumerate(found):
        np.testing.assert_allclose(scan.truth.matrix, pose(20 - i).matrix, atol=1e-14)
    with open_source(path, SourceOptions(fixed_frame="map")) as source:
        assert str(len(CLOUDS)) in source.info().notes["poses or transforms"]


def test_transforms_of_a_namespace_are_found(tmp_path: Path) -> None:
    named = {"/tf": "/robot1/tf", "/tf_static": "/robot1/tf_static"}
    messages = [(named.get(topic, topic), *rest) for topic, *rest in moving_sensor()]
    found = read(mcap(tmp_path / "a.mcap", messages), fixed_frame="map", truth_frame="target")
    np.testing.assert_allclose(found[3].truth.matrix, pose(17).matrix, atol=1e-14)


def test_a_fixed_frame_that_no_transform_reaches_is_named(tmp_path: Path) -> None:
    messages = [m for m in moving_sensor() if m[0] != "/tf_static"]
    path = mcap(tmp_path / "a.mcap", messages)
    with open_source(path, SourceOptions(fixed_frame="map")) as source:
        scan = source.scan_at(0)
    assert scan.status is ScanStatus.DAMAGED
    assert "no transform connects '/lidar' to 'map'" in str(scan.note)
    gt = [("/gt", POSE, c.log_ns, pose_stamped(c.t_ns, "map", pose(0))) for c in CLOUDS]
    path = mcap(tmp_path / "b.mcap", [*messages, *gt])
    with open_source(path, SourceOptions(truth_topic="/gt"), inspect=True) as source:
        problem = source.truth_problem([source.scan_at(0)])
    assert problem is not None
    assert "no transform of the log connects them" in problem[0]
    assert problem[1] == ""


def test_a_target_in_the_transforms_is_advised_as_truth(tmp_path: Path, cli) -> None:  # type: ignore[no-untyped-def]
    path = mcap(tmp_path / "a.mcap", moving_sensor())
    with open_source(path, inspect=True) as source:
        assert source.moving_beside("/lidar") == ["target"]
        assert source.moving_beside("target") == ["base"]


POSE_FILES = {
    "header": ("t_s,x,y,z,qx,qy,qz,qw\n", "{t},{x},{y},{z},{qx},{qy},{qz},{qw}\n", "utf-8"),
    "mark": ("t_s,x,y,z,qx,qy,qz,qw\n", "{t},{x},{y},{z},{qx},{qy},{qz},{qw}\n", "utf-8-sig"),
    "wide": ("t_s,x,y,z,qx,qy,qz,qw\n", "{t},{x},{y},{z},{qx},{qy},{qz},{qw}\n", "utf-16"),
    "tum": ("", "{t} {x} {y} {z} {qx} {qy} {qz} {qw}\n", "utf-16"),
}


@pytest.mark.parametrize("name", POSE_FILES)
def test_true_and_measured_poses_have_one_reader(tmp_path: Path, name: str) -> None:
    """A header, a byte-order mark, UTF-16 and lines without a pose are read as both."""
    head, line, code = POSE_FILES[name]
    text = head
    for i, c in enumerate(CLOUDS):
        values = [*pose(i).t, *pose(i).q] if i != 4 else [float("nan")] * 7
        keys = ("x", "y", "z", "qx", "qy", "qz", "qw")
        named = dict(zip(keys, map(repr, map(float, values)), strict=True))
        text += line.format(t=f"{c.t_ns * 1e-9:.9f}", **named)
    path = tmp_path / "poses.csv"
    path.write_bytes(text.encode(code))
    log = mcap(tmp_path / "a.mcap", clouds())
    scans_ = read(log, truth_file=path, truth_gap_s=0.1)
    with open_source(path, SourceOptions(poses=True)) as source:
        measured = list(source.scans())
    for i, (scan, one) in enumerate(zip(scans_, measured, strict=True)):
        if i == 4:
            assert scan.truth is None
            assert one.status is ScanStatus.DAMAGED
        else:
            np.testing.assert_allclose(scan.truth.matrix, pose(i).matrix, atol=1e-12)
            np.testing.assert_allclose(one.pose.T_ac.matrix, pose(i).matrix, atol=1e-12)


POINTER = (
    b"version https://git-lfs.github.com/spec/v1\n"
    b"oid sha256:4d7a214614ab2935c943f9e0ff69d22eadbb8f32b1258daaa5e2ca24d17e2393\nsize 12345\n"
)


@pytest.mark.parametrize("name", ["a.stl", "a.ply", "a.mcap", "a.bag", "rows.jsonl"])
def test_a_pointer_of_git_lfs_is_named(tmp_path: Path, name: str) -> None:
    from avsreplay.log.header import read_surface
    from avsreplay.report.jsonl import read_rows

    path = tmp_path / name
    path.write_bytes(POINTER)
    reader = {".stl": read_surface, ".ply": read_surface, ".jsonl": read_rows}
    with pytest.raises(UnreadableInput, match="git-LFS pointer"):
        reader.get(path.suffix, open_source)(path)


@pytest.mark.parametrize("opcode", [0x0C, 0x09])
def test_a_padded_record_is_kept(tmp_path: Path, opcode: int) -> None:
    path = tmp_path / "a.mcap"
    write(path, header(np.random.Generator(np.random.PCG64(1))), CLOUDS[:3])
    data = path.read_bytes()
    at = 8
    while data[at] != opcode:
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    size = int.from_bytes(data[at + 1 : at + 9], "little")
    end = at + 9 + size
    padded = data[: at + 1] + (size + 5).to_bytes(8, "little") + data[at + 9 : end] + bytes(5)
    footer = len(data) - 37
    start = int.from_bytes(data[footer + 9 : footer + 17], "little")
    rest = bytearray(data[end:])
    rest[footer - end + 9 : footer - end + 17] = bytes(8)  # the summary has moved: none is named
    rest[footer - end + 25 : footer - end + 29] = bytes(4)
    del rest[start - end : footer - end]
    rest[start - end - 4 : start - end] = bytes(4)  # no checksum over the data
    path.write_bytes(padded + bytes(rest))
    with open_source(path) as source:
        assert not source.losses
        assert len(source) == 3
        assert source.header.seed == 7
        assert source.header.surface is not None


@pytest.mark.parametrize("change", ["shorter", "longer", "other", "gone", ""])
@pytest.mark.parametrize("kind", ["mcap", "bag", "poses", "folder"])
def test_a_file_that_changes_while_it_is_read_is_a_loss(
    tmp_path: Path, kind: str, change: str
) -> None:
    """Its scans may be those of either state, and its checksum is that of the second one."""
    path = tmp_path / f"a.{kind}"
    if kind == "folder":
        path.mkdir()
        for k in range(3):
            np.save(path / f"{k}.npy", CLOUDS[k].points)
    elif kind == "poses":
        path.write_text("".join(f"{k} 0 0 5 0 0 0 1\n" for k in range(1, 4)))
    elif kind == "bag":
        bag1(path)
    else:
        mcap(path, clouds())
    file = path / "1.npy" if kind == "folder" else path
    os.utime(file, (1, 1))
    data = file.read_bytes()
    with open_source(path, SourceOptions(poses=kind == "poses")) as source:
        next(source.scans())
        if change == "gone":
            file.unlink()
        elif change:
            new = {"shorter": data[:-1], "longer": data + b"\n", "other": bytes(len(data))}
            file.write_bytes(new[change])
        found = [loss.file for loss in source.losses]
    assert found == ([file.name] if change else [])
