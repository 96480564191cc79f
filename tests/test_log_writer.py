"""Written logs are read back bit for bit, by this package and by other readers."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import log_cases
import numpy as np
import pytest
from log_cases import SECOND, header, scans, write
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from true_scans import true_scans

from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.log import LogWriter, SourceOptions, open_source
from avsreplay.log.cdr import SCHEMAS, schema_text
from avsreplay.records import Label, LogHeader, Scan, ScanStatus


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
@pytest.mark.parametrize("timed", [False, True])
def test_a_log_read_back_is_the_log_written(tmp_path: Path, compression: str, timed: bool) -> None:
    head, clouds = header(np.random.Generator(np.random.PCG64(1))), scans(timed=timed)
    truth = write(tmp_path / "a.mcap", head, clouds, compression=compression)
    with open_source(tmp_path / "a.mcap") as source:
        back = list(true_scans(source))
        again = source.header
    assert [s.t_ns for s in back] == [s.t_ns for s in clouds]
    assert [s.log_ns for s in back] == [s.log_ns for s in clouds]
    assert all(s.status is ScanStatus.OK for s in back)
    assert not source.losses
    for scan, cloud, (pose, body) in zip(back, clouds, truth, strict=True):
        assert scan.points.tobytes() == cloud.points.tobytes()
        assert (scan.times_s is None) == (not timed)
        if timed:
            assert scan.times_s.tobytes() == cloud.times_s.tobytes()
        assert scan.truth is not None
        assert scan.body is not None
        np.testing.assert_allclose(scan.truth.matrix, pose.matrix, rtol=0, atol=1e-15)
        for name, constant in (
            ("sigma", head.truth),
            ("c_b", head.truth),
            ("q_bc", head.truth),
            ("w_b", body),
        ):
            np.testing.assert_array_equal(getattr(scan.body, name), getattr(constant, name))
        np.testing.assert_allclose(scan.body.v_a, body.v_a, rtol=0, atol=1e-14)
    assert_same_header(head, again)


def assert_same_header(head: LogHeader, again: LogHeader) -> None:
    assert (again.scenario, again.seed, again.notes) == (head.scenario, head.seed, head.notes)
    for one, two in zip(head.labels, again.labels, strict=True):
        assert [getattr(one, f.name) for f in fields(one)] == [
            getattr(two, f.name) for f in fields(two)
        ]
    for one, two in ((head.truth, again.truth), (head.start.x, again.start.x)):
        for f in fields(one):
            np.testing.assert_array_equal(getattr(one, f.name), getattr(two, f.name))
    np.testing.assert_array_equal(head.start.P, again.start.P)
    assert again.start.t_ns == head.start.t_ns
    np.testing.assert_array_equal(head.surface.vertices, again.surface.vertices)
    np.testing.assert_array_equal(head.surface.faces, again.surface.faces)
    assert again.surface.name == head.surface.name


def test_a_label_covers_a_half_open_window(tmp_path: Path) -> None:
    head = LogHeader(labels=(Label("clutter", 2 * SECOND, 3 * SECOND),))
    clouds = [
        Scan(i, t, np.ones((1, 3), np.float32), log_ns=t)
        for i, t in enumerate([2 * SECOND - 1, 2 * SECOND, 3 * SECOND - 1, 3 * SECOND])
    ]
    with LogWriter(tmp_path / "a.mcap", head) as writer:
        for scan in clouds:
            writer.write(scan)
    with open_source(tmp_path / "a.mcap") as source:
        assert [s.fault for s in true_scans(source)] == [None, "clutter", "clutter", None]


def test_labels_at_times_that_ros_cannot_hold_are_cut(tmp_path: Path) -> None:
    """The header record of a foreign log may state any whole number."""
    head = LogHeader(
        labels=(Label("clutter", -(10**30), 3 * SECOND), Label("empty", 2 * SECOND, 10**30))
    )
    with LogWriter(tmp_path / "a.mcap", head) as writer:
        for k in range(4):
            writer.write(Scan(k, k * SECOND, np.ones((1, 3), np.float32), log_ns=k * SECOND))
    with open_source(tmp_path / "a.mcap") as source:
        assert [s.fault for s in true_scans(source)] == ["clutter", "clutter", "empty", "empty"]


def test_the_bytes_depend_on_the_input_alone(tmp_path: Path) -> None:
    script = (
        "import sys; sys.path.insert(0, sys.argv[2])\nimport log_cases as t, numpy as np,"
        " pathlib\nt.write(pathlib.Path(sys.argv[1]),"
        " t.header(np.random.Generator(np.random.PCG64(1))), t.scans())\n"
    )
    contents = []
    for seed in ("0", "1"):
        out = tmp_path / f"{seed}.mcap"
        env = {**os.environ, "PYTHONHASHSEED": seed, "TZ": f"UTC+{seed}"}
        subprocess.run(
            [sys.executable, "-c", script, str(out), str(Path(log_cases.__file__).parent)],
            env=env,
            check=True,
        )
        contents.append(out.read_bytes())
    assert contents[0] == contents[1]
    assert b"mcap-python" not in contents[0]
    assert str(tmp_path).encode() not in contents[0]


def test_the_mcap_library_reads_it_with_every_checksum(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", header(np.random.Generator(np.random.PCG64(1))), scans())
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        counts = {
            c.topic: summary.statistics.channel_message_counts[i]
            for i, c in summary.channels.items()
        }
        assert counts == {
            "/tf_static": 1,
            "/points": 12,
            "/truth/pose": 12,
            "/truth/body": 12,
            "/faults": 6,
        }
        assert [a.name for a in reader.iter_attachments()] == ["part.ply"]
        assert [m.name for m in reader.iter_metadata()] == ["avsreplay"]
        for schema, _, message in reader.iter_messages():
            assert schema.data == schema_text(schema.name)
            assert len(message.data) > 4


def test_rosbags_reads_every_message_with_the_schemas_inside(tmp_path: Path) -> None:
    clouds = scans(timed=True)
    truth = write(tmp_path / "a.mcap", header(np.random.Generator(np.random.PCG64(1))), clouds)
    seen: dict[str, list[object]] = {}
    with AnyReader([tmp_path / "a.mcap"]) as reader:
        for connection, t_ns, raw in reader.messages():
            seen.setdefault(connection.topic, []).append(
                (t_ns, reader.deserialize(raw, connection.msgtype))
            )
    assert set(seen) == {"/tf_static", "/points", "/truth/pose", "/truth/body", "/faults"}
    for (t_ns, cloud), scan in zip(seen["/points"], clouds, strict=True):
        assert t_ns == scan.log_ns
        assert cloud.header.stamp.sec * SECOND + cloud.header.stamp.nanosec == scan.t_ns
        assert [f.name for f in cloud.fields] == ["x", "y", "z", "t"]
        table = cloud.data.view(np.float32).reshape(-1, 4)
        assert table[:, :3].tobytes() == np.ascontiguousarray(scan.points).tobytes()
        assert table[:, 3].tobytes() == scan.times_s.tobytes()
    for (_, message), (pose, body) in zip(seen["/truth/pose"], truth, strict=True):
        p, q = message.pose.position, message.pose.orientation
        assert (p.x, p.y, p.z, q.x, q.y, q.z, q.w) == (*pose.t, *pose.q)
        assert body is not None
    for (_, message), (_, body) in zip(seen["/truth/body"], truth, strict=True):
        w = message.twist.twist.angular
        assert (w.x, w.y, w.z) == tuple(body.w_b)
    levels = [(m.status[0].name, m.status[0].level) for _, m in seen["/faults"]]
    assert sorted(levels) == sorted(
        (k, v) for k in ("occlusion", "bias", "dropped") for v in (0, 1)
    )


@pytest.mark.parametrize("name", sorted(SCHEMAS))
def test_schema_texts_are_those_of_ros(name: str) -> None:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    ours = get_types_from_msg(schema_text(name).decode(), name)
    for kind, (_, members) in ours.items():
        theirs = [(m[0], m[1]) for m in store.fielddefs[kind][1]]
        assert [(m[0], m[1]) for m in members] == theirs, kind


def test_an_existing_output_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"mine")
    with pytest.raises(UsageError, match="overwrite"):
        LogWriter(path, LogHeader())
    assert path.read_bytes() == b"mine"
    write(path, LogHeader(), scans(2), overwrite=True)
    assert path.read_bytes().startswith(b"\x89MCAP")


def test_a_missing_folder_and_a_full_disk_give_one_error_line(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such folder"):
        LogWriter(tmp_path / "no" / "a.mcap", LogHeader())
    (tmp_path / "dir.mcap.partial").mkdir()
    with pytest.raises((UnreadableInput, UsageError)):
        LogWriter(tmp_path / "dir.mcap", LogHeader(), overwrite=True)


def test_an_exception_leaves_no_file(tmp_path: Path) -> None:
    writer = LogWriter(tmp_path / "a.mcap", LogHeader())
    bad = Scan(0, 2**70, scans(1)[0].points, log_ns=SECOND)
    with pytest.raises(ValueError, match="does not fit"), writer:
        writer.write(bad)
    assert list(tmp_path.iterdir()) == []


class _Full(io.BufferedWriter):
    room = 60_000

    def write(self, data: object) -> int:  # type: ignore[override]
        if self.tell() + len(data) > self.room:  # type: ignore[arg-type]
            raise OSError(28, "No space left on device")
        return super().write(data)  # type: ignore[arg-type]


def test_a_full_disk_keeps_the_complete_chunks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def opened(self: Path, mode: str = "r") -> io.BufferedWriter:
        return _Full(io.FileIO(self, mode))

    clouds = scans(40, 1000)
    monkeypatch.setattr(Path, "open", opened)
    with pytest.raises(UnreadableInput, match="No space left"):
        write(tmp_path / "a.mcap", LogHeader(), clouds, compression="none")
    monkeypatch.undo()
    assert not (tmp_path / "a.mcap").exists()
    with open_source(tmp_path / "a.mcap.partial") as source:
        back = list(true_scans(source))
        assert len(source.losses) == 1
        assert source.losses[0].bytes == 0
    assert 0 < len(back) < len(clouds)
    assert all(a.points.tobytes() == b.points.tobytes() for a, b in zip(back, clouds, strict=False))


def test_a_full_disk_leaves_no_file_without_a_complete_header(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Path, "open", lambda self, mode="r": _Full(io.FileIO(self, mode)))
    monkeypatch.setattr(_Full, "room", 10)
    with pytest.raises(UnreadableInput, match="No space left on device; nothing is kept"):
        LogWriter(tmp_path / "a.mcap", LogHeader())
    monkeypatch.undo()
    assert list(tmp_path.iterdir()) == []


def test_float64_points_are_preserved(tmp_path: Path) -> None:
    cloud = np.random.Generator(np.random.PCG64(5)).normal(size=(50, 3))
    with LogWriter(tmp_path / "a.mcap", LogHeader(), point_type="float64") as writer:
        writer.write(Scan(0, SECOND, cloud, log_ns=SECOND))
    with open_source(tmp_path / "a.mcap") as source:
        (back,) = source.scans()
    assert back.points.dtype == np.float64
    assert back.points.tobytes() == cloud.tobytes()


def test_reading_ahead_gives_the_same_scans(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", LogHeader(), scans(20))
    with open_source(tmp_path / "a.mcap") as source:
        plain = [(s.seq, s.t_ns, s.points.tobytes()) for s in source.scans()]
        ahead = [(s.seq, s.t_ns, s.points.tobytes()) for s in source.scans(prefetch=1)]
        for scan in source.scans(prefetch=2):
            assert scan.seq == 0
            break
    assert plain == ahead


def test_selection(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", LogHeader(), scans(12))  # every 0.5 s from 1 s

    def times(**options: object) -> list[float]:
        with open_source(tmp_path / "a.mcap", SourceOptions(**options)) as source:  # type: ignore[arg-type]
            found = list(source.scans())
            assert [s.seq for s in found] == list(range(len(found)))
            return [s.t_ns / SECOND - 1.0 for s in found]

    assert times(every=3) == [0.0, 1.5, 3.0, 4.5]
    assert times(start_s=1.0, end_s=2.0) == [1.0, 1.5]
    assert times(start_s=4.5) == [4.5, 5.0, 5.5]
    assert times(start_s=1.0, duration_s=2.0, every=2, n_scans=2) == [1.0, 2.0]
    assert times(n_scans=1) == [0.0]
    assert times(start_s=100.0) == []


def test_crop_keeps_the_points_inside(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", LogHeader(), scans(2, timed=True))
    box = (-1.0, -0.5, 0.0, 1.0, 0.5, 2.0)
    with open_source(tmp_path / "a.mcap", SourceOptions(crop_box=box)) as source:
        one, _ = source.scans()
    whole = scans(2, timed=True)[0]
    keep = ((whole.points >= np.array(box[:3])) & (whole.points <= np.array(box[3:]))).all(axis=1)
    assert 0 < keep.sum() < len(keep)
    assert one.points.tobytes() == whole.points[keep].tobytes()
    assert one.times_s.tobytes() == whole.times_s[keep].tobytes()
    with open_source(tmp_path / "a.mcap", SourceOptions(crop_range=(1.0, 2.0))) as source:
        two, _ = source.scans()
    distance = np.linalg.norm(whole.points.astype(np.float64), axis=1)
    assert len(two.points) == ((distance >= 1.0) & (distance <= 2.0)).sum()


def test_a_state_that_is_not_finite_is_one_line_and_leaves_no_file(tmp_path: Path) -> None:
    label = Label("occlusion", 0, 1, True, float("inf"))
    with pytest.raises(UsageError, match="not finite"):
        LogWriter(tmp_path / "a.mcap", LogHeader(labels=(label,)))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("t_ns", [-1, 2**63])
def test_a_time_that_a_log_cannot_hold_is_one_line(tmp_path, t_ns):
    scan = Scan(0, SECOND, np.zeros((1, 3), np.float32), log_ns=t_ns)
    with (
        pytest.raises(UnreadableInput, match="cannot be recorded"),
        LogWriter(tmp_path / "x.mcap", LogHeader()) as log,
    ):
        log.write(scan)
    assert not (tmp_path / "x.mcap").exists()


@pytest.mark.skipif(os.name != "posix", reason="Windows has no such lock")
@pytest.mark.parametrize("streaming", [False, True])
def test_a_second_recorder_of_a_file_is_refused_and_the_first_one_completes(tmp_path, streaming):
    path = tmp_path / "x.mcap"
    with LogWriter(path, LogHeader(seed=1), overwrite=True, streaming=streaming) as log:
        log.write(Scan(0, SECOND, np.zeros((1, 3), np.float32), log_ns=SECOND))
        with pytest.raises(UsageError, match="another process is writing it"):
            LogWriter(path, LogHeader(seed=2), overwrite=True, streaming=streaming)
    with open_source(path) as source:
        assert (source.header.seed, len(source), list(source.losses)) == (1, 1, [])
    assert [p.name for p in tmp_path.iterdir()] == ["x.mcap"]
    with LogWriter(path, LogHeader(seed=3), overwrite=True, streaming=streaming):
        pass
    with open_source(path, inspect=True) as source:
        assert source.header.seed == 3
