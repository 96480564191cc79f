"""kiss-icp as odometry: without a model, with deskewing, for any size of the target."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("kiss_icp")

from avsreplay import geometry
from avsreplay.geometry import Array, Pose, exp
from avsreplay.log import SourceOptions, open_source
from avsreplay.register.contract import boxes, example_pose, view
from avsreplay.register.params import RegisterParams
from avsreplay.register.peers import KissBackend, KissOdometry, thinned
from avsreplay.register.registrar import Registrar

TURN = np.array([0.008, 0.02, -0.012])  # rad a scan


def tumble(scale: float, scans: int = 15) -> list[tuple[Array, Pose]]:
    """Views of a turning target that drifts by two extents, with the true T_ac."""
    surface, found = boxes(scale), []
    for k in range(scans):
        T_ac = Pose(
            np.array([0.0, 0.0, 0.0, 1.0]), scale * np.array([0.5 * k, 0.0, 0.0])
        ) @ example_pose(scale)
        T_ac = T_ac @ Pose(exp(k * TURN), np.zeros(3))
        found.append((T_ac.apply(view(surface, 12_000, T_ac.inverse().t)), T_ac))
    return found


@pytest.mark.parametrize("scale", [1.0, 0.02])
def test_odometry_follows_a_target_of_any_size(scale: float) -> None:
    scans = tumble(scale)
    odometry = KissOdometry(6.5 * scale)
    poses = [odometry.add(points)[0] for points, _ in scans]
    first = scans[0][1].inverse() @ poses[0]
    for (_, truth), pose in zip(scans, poses, strict=True):
        step = (truth @ first).inverse() @ pose
        assert np.degrees(geometry.angle(step.q)) < 2.0
        assert np.linalg.norm(step.t) < 0.02 * 6.5 * scale


def test_a_scan_of_one_instant_is_not_deskewed_and_a_swept_one_is_of_its_last_instant() -> None:
    (first, _), (second, _) = tumble(1.0, 2)
    odometry = KissOdometry(6.5)
    assert odometry.add(first, np.full(len(first), 0.3))[1] == 0.0
    assert odometry.add(second, np.linspace(0.0, 0.1, len(second)))[1] == pytest.approx(0.1)


def test_thinning_does_not_depend_on_the_order() -> None:
    points = np.random.default_rng(3).uniform(0.0, 1.0, (5000, 3))
    a, b = thinned(points, 0.1), thinned(points[::-1], 0.1)
    assert len(a) < 1000
    assert {row.tobytes() for row in a} == {row.tobytes() for row in b}


def test_the_threshold_follows_the_error_of_the_guess() -> None:
    surface, T_ca = boxes(), example_pose().inverse()
    registrar = Registrar(surface, RegisterParams(backend="kiss"))
    backend = KissBackend(registrar.target)
    errors = [
        Pose(np.array([0.0, 0.0, 0.0, 1.0]), np.array([k * registrar.limits.gate_m, 0.0, 0.0]))
        for k in (0, 3, 9)
    ]
    sigma = [backend.threshold(T_ca, error @ T_ca) / registrar.limits.gate_m for error in errors]
    assert sigma[0] == pytest.approx(2.0)
    assert sigma[1:] == pytest.approx([np.sqrt((4 + k * k) / 2) for k in (3, 9)])


def test_points_that_can_match_nothing_change_no_pose() -> None:
    """A wall behind the target, farther away than correspondences reach."""
    pytest.importorskip("small_gicp")
    surface, T_ac = boxes(), example_pose()
    scan = T_ac.apply(view(surface, 500, T_ac.inverse().t))
    wall = scan.mean(axis=0) + 4.0 * surface.extent + np.random.default_rng(5).normal(size=(400, 3))
    align = Registrar(surface, RegisterParams(backend="small_gicp")).backend.align
    alone, behind = (align(p, T_ac.inverse()) for p in (scan, np.vstack([wall, scan])))
    assert alone.converged
    assert behind.T_ca.t.tobytes() == alone.T_ca.t.tobytes()
    assert behind.T_ca.q.tobytes() == alone.T_ca.q.tobytes()


def test_the_command_writes_poses_that_a_run_reads(cli, tmp_path, fixtures_folder) -> None:
    out = tmp_path / "poses.tum"
    done = cli("odometry", fixtures_folder / "spin-raster.mcap", "-o", out)
    assert done.code == 0, done.err
    with open_source(out, SourceOptions(poses=True)) as source:
        found = list(source.scans())
    with open_source(fixtures_folder / "spin-raster.mcap", SourceOptions()) as source:
        used = [scan for scan in source.scans() if len(scan.points) >= 50]
    assert len(found) == len(used)
    assert all(scan.pose is not None for scan in found)
    again = cli("odometry", fixtures_folder / "spin-raster.mcap", "-o", out)
    assert again.code == 2
    assert "exists" in again.err
