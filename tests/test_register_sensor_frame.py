"""Scans in a fixed frame are registered as in the frame of their sensor, wherever the fixed frame
has its origin.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avsreplay import geometry
from avsreplay.errors import UsageError
from avsreplay.geometry import Pose
from avsreplay.log import LogWriter, SourceOptions, open_source
from avsreplay.record import RecordOptions, record_source
from avsreplay.records import LogHeader, Scan
from avsreplay.register.params import RegisterParams
from avsreplay.register.registrar import Registrar
from avsreplay.register.sensor_frame import SensorFrame
from avsreplay.run import Job, Run

FIXTURE = Path(__file__).parents[1] / "fixtures" / "tumble.mcap"
RASTER = FIXTURE.with_name("spin-raster.mcap")
SENSOR = Pose(geometry.exp([0.4, -1.1, 2.0]), np.array([80.0, -45.0, 10.0]))


@pytest.fixture(scope="module")
def scene():
    with open_source(FIXTURE) as source:
        scan = source.scan_at(3)
        return (
            Registrar(source.header.surface, RegisterParams()),
            scan.points.copy(),
            source.truth_of(scan).pose,
        )


def test_pose_and_quality_are_those_in_the_frame_of_the_sensor(scene):
    registrar, points, truth = scene
    guess = truth @ Pose(geometry.exp([0.02, -0.01, 0.02]), np.array([0.02, 0.01, -0.02]))
    plain, moved = registrar.register(points, guess), SENSOR.apply(points)
    found = SensorFrame(registrar, SENSOR).register(moved, SENSOR @ guess)
    np.testing.assert_allclose(found.T_ac.matrix, (SENSOR @ plain.T_ac).matrix, atol=1e-6)
    assert (found.status, found.inliers) == (plain.status, plain.inliers)
    np.testing.assert_allclose(found.covariance, plain.covariance, rtol=1e-3, atol=1e-12)
    acquired = SensorFrame(registrar, SENSOR).acquire(moved)
    np.testing.assert_allclose(
        acquired.T_ac.matrix, (SENSOR @ registrar.acquire(points).T_ac).matrix, atol=1e-5
    )
    times = np.linspace(0.0, 0.1, len(points))
    expected = registrar.instants(points, times, plain.T_ac)
    instants = SensorFrame(registrar, SENSOR).instants(moved, times, SENSOR @ plain.T_ac)
    np.testing.assert_allclose(instants, expected, atol=1e-6)


def test_without_a_sensor_pose_the_registrar_is_used_as_it_is(scene):
    registrar, points, truth = scene
    plain, found = (
        registrar.register(points, truth),
        SensorFrame(registrar, None).register(points, truth),
    )
    assert found.T_ac.t.tobytes() == plain.T_ac.t.tobytes()


def _far_log(log: Path, fixed_frame: str = "map", raw: Path = FIXTURE) -> Path:
    """The fixture, seen by a camera 90 m from the origin of the fixed frame that the header
    names.
    """
    with open_source(raw) as source:
        header = replace(source.header, start=None, truth=None, scenario="", labels=())
        with LogWriter(log, replace(header, fixed_frame=fixed_frame)) as writer:
            for scan in source.scans():
                writer.write_camera(scan.log_ns, scan.t_ns, SENSOR)
                writer.write(scan)
                writer.write_truth(scan.log_ns, scan.t_ns, SENSOR @ source.truth_of(scan).pose)
    return log


def test_a_log_that_is_recorded_from_a_fixed_frame_holds_the_pose_of_the_sensor(tmp_path):
    far, copy = _far_log(tmp_path / "far.mcap", "world"), tmp_path / "copy.mcap"
    done = record_source(far, copy, SourceOptions(sensor_topic="/camera/pose"), RecordOptions())
    assert "moves in 'map'" in done.note
    with open_source(FIXTURE) as plain, open_source(copy) as again:
        assert (again.header.fixed_frame, again.options.fixed_frame) == ("map", "map")
        assert len(again) == len(plain)
        for seq in (0, 5, len(plain) - 1):
            scan, other = plain.scan_at(seq), again.scan_at(seq)
            np.testing.assert_allclose(other.sensor.matrix, SENSOR.matrix, atol=1e-9)
            np.testing.assert_allclose(other.points, SENSOR.apply(scan.points), atol=1e-5)
            truth = SENSOR @ plain.truth_of(scan).pose
            np.testing.assert_allclose(again.truth_of(other).pose.matrix, truth.matrix, atol=1e-6)


def test_without_transforms_no_scan_of_a_log_that_names_a_fixed_frame_can_be_used(tmp_path):
    with LogWriter(tmp_path / "x.mcap", LogHeader(fixed_frame="map")) as writer:
        writer.write(Scan(0, 1_000_000_000, np.ones((3, 3), np.float32), log_ns=1_000_000_000))
    with open_source(tmp_path / "x.mcap") as source:
        assert "the pose of the sensor is unknown" in source.scan_at(0).note
    with pytest.raises(UsageError, match="no frame 'map'"):
        open_source(tmp_path / "x.mcap", SourceOptions(fixed_frame="map"))


def test_a_run_in_a_far_fixed_frame_is_that_in_the_frame_of_the_sensor(tmp_path):
    """The camera stands 90 m from the origin of the fixed frame; the target is behind it as
    seen from there.
    """
    log = _far_log(tmp_path / "far.mcap")
    with Run(Job(source=log)) as run:
        rows = list(run.rows())
    with Run(Job(source=FIXTURE, assignments=("init=auto", "estimator.start=cold"))) as run:
        plain = list(run.rows())
    assert [row.gamma for row in rows] == [row.gamma for row in plain]
    assert sum(row.gamma for row in rows) > 0.8 * len(rows)
    for row, other in zip(rows, plain, strict=True):
        if row.gamma:
            assert row.reg_pos_err_m == pytest.approx(other.reg_pos_err_m, abs=1e-4)
            assert row.inliers == pytest.approx(other.inliers, abs=2)


def _turning(after_s: float) -> Pose:
    """Pose of a sensor that turns and moves; between two instants the position is
    interpolated by the reader.
    """
    return Pose(
        geometry.multiply(SENSOR.q, geometry.exp(after_s * np.array([0.1, -0.2, 0.15]))),
        SENSOR.t + 0.3 * after_s,
    )


def _turning_log(log: Path, raw: Path = RASTER) -> float:
    """A log with points at their own times, measured by that sensor; returns the duration of
    a scan [s].
    """
    with open_source(raw) as source:
        header = replace(
            source.header, start=None, truth=None, scenario="", labels=(), fixed_frame="map"
        )
        first = source.scan_at(0).t_ns
        with LogWriter(log, header) as writer:
            for scan in source.scans():
                t_s, times = (scan.t_ns - first) * 1e-9, scan.times_s.astype(np.float64)
                poses = [_turning(t_s + after) for after in times]
                seen = [
                    T.inverse().apply(p)
                    for T, p in zip(poses, SENSOR.apply(scan.points), strict=True)
                ]
                last = float(times.max())
                for after in np.linspace(0.0, last, 9):
                    ns = round(after * 1e9)
                    writer.write_camera(
                        scan.log_ns + ns, scan.t_ns + ns, _turning(t_s + float(after))
                    )
                writer.write(replace(scan, points=np.array(seen)))
                writer.write_truth(scan.log_ns, scan.t_ns, SENSOR @ source.truth_of(scan).pose)
    return last


def test_each_point_is_moved_from_the_frame_that_its_sensor_has_at_the_time_of_the_point(tmp_path):
    log, copy = tmp_path / "turning.mcap", tmp_path / "copy.mcap"
    assert _turning_log(log) > 0.05
    record_source(log, copy, SourceOptions(), RecordOptions())
    with open_source(RASTER) as plain, open_source(log) as turning, open_source(copy) as again:
        for seq in (0, 2):
            expected = SENSOR.apply(plain.scan_at(seq).points)
            np.testing.assert_allclose(turning.scan_at(seq).points, expected, atol=2e-5)
            np.testing.assert_allclose(again.scan_at(seq).points, expected, atol=3e-5)
            np.testing.assert_array_equal(again.scan_at(seq).times_s, plain.scan_at(seq).times_s)
        assert again.header.sensor_at_stamp
        assert not turning.header.sensor_at_stamp


def test_a_scan_without_the_pose_of_its_sensor_at_the_last_point_is_damaged(tmp_path):
    log = _far_log(tmp_path / "far.mcap", raw=RASTER)
    with open_source(log) as source:
        found = list(source.scans())
    assert [scan.status.value for scan in found[:-1]] == ["ok"] * (len(found) - 1)
    assert found[-1].status.value == "damaged"
    assert "pose of the sensor is unknown" in found[-1].note
