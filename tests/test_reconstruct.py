"""Reconstruction of an unknown target: properties of the result against simulated and real shapes."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial import ConvexHull, cKDTree

from avsreplay import geometry
from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.geometry import Pose
from avsreplay.log import SourceOptions, open_source
from avsreplay.reconstruct import at_grasp, reconstruct
from avsreplay.records import Scan

CORNERS = np.random.default_rng(11).normal(size=(14, 3)) * [0.5, 0.35, 0.25]
HULL = ConvexHull(CORNERS)


def hull_scan(rng, T_ac: Pose, noise_m: float = 0.0) -> np.ndarray:
    """Points on the faces of an irregular convex body that face the camera at the origin of {A}: exact visibility."""
    parts = []
    for corners, plane in zip(CORNERS[HULL.simplices], HULL.equations, strict=True):
        a, b, c = corners
        count = int(6000 * np.linalg.norm(np.cross(b - a, c - a)))
        u, v = rng.uniform(size=(2, count, 1))
        u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
        points = T_ac.apply(a + u * (b - a) + v * (c - a))
        parts.append(points[(points @ (T_ac.R @ plane[:3])) < 0.0])
    points = np.vstack(parts)
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    return points + noise_m * rng.normal(size=(len(points), 1)) * rays


def turning(count: int, step_deg: float, noise_m: float = 0.0, seed: int = 1):
    """Scans of the body while it turns about a tilted axis, and their true poses."""
    rng = np.random.default_rng(seed)
    axis = np.array([0.3, 0.9, 0.2]) / np.linalg.norm([0.3, 0.9, 0.2])
    poses = [Pose(geometry.exp(np.radians(step_deg * k) * axis), np.array([0.02 * k, 0.0, 4.0])) for k in range(count)]
    scans = [Scan(seq=k, t_ns=k * 500_000_000, points=hull_scan(rng, T, noise_m)) for k, T in enumerate(poses)]
    return scans, poses


def errors(made, truth):
    """Pose errors (turn [deg], shift [m]) relative to the first scan."""
    by_ns = {k * 500_000_000: T for k, T in enumerate(truth)}
    first_ns, first = made.poses[0]
    out = []
    for t_ns, T in made.poses:
        got, want = T @ first.inverse(), by_ns[t_ns] @ by_ns[first_ns].inverse()
        turn = geometry.angle(geometry.multiply(geometry.conjugate(want.q), got.q))
        centre = by_ns[first_ns].t
        out.append((np.degrees(float(turn)), float(np.linalg.norm(got.apply(centre) - want.apply(centre)))))
    return np.array(out)


@pytest.fixture(scope="module")
def full_turn():
    scans, truth = turning(25, 15.0, noise_m=0.003)
    return scans, truth, reconstruct(lambda: scans)


@pytest.mark.slow
def test_every_scan_of_a_full_turn_is_used_and_the_turn_closes(full_turn):
    _, truth, made = full_turn
    assert made.used == 25
    turn_deg, shift_m = errors(made, truth).max(axis=0)
    assert turn_deg < 1.0
    assert shift_m < 0.015
    assert abs(errors(made, truth)[-1, 0]) < 0.5  # one full turn: the last pose is the first again


@pytest.mark.slow
def test_points_lie_on_the_body_and_normals_point_outward(full_turn):
    _, truth, made = full_turn
    _, first = made.poses[0]
    T_true_c = truth[0].inverse() @ first  # reconstruction {C} to the body's own frame
    points, normals = T_true_c.apply(made.points), made.normals @ T_true_c.R.T
    height = points @ HULL.equations[:, :3].T + HULL.equations[:, 3]  # of each point above each plane
    nearest = height.argmax(axis=1)
    distance = np.abs(height.max(axis=1))
    assert np.median(distance) < 0.003
    assert np.quantile(distance, 0.95) < 0.012
    agreement = np.einsum("ni,ni->n", normals, HULL.equations[nearest, :3])
    assert np.median(agreement) > 0.98
    assert (agreement < 0.0).mean() < 0.01


def test_the_result_is_the_same_for_the_same_scans():
    scans, _ = turning(6, 15.0, noise_m=0.003)
    made, again = reconstruct(lambda: scans), reconstruct(lambda: scans)
    np.testing.assert_array_equal(made.points, again.points)
    np.testing.assert_array_equal(made.one_sigma_m, again.one_sigma_m)


@pytest.mark.slow
def test_a_moving_occluder_is_left_out(full_turn):
    """A plate that passes in front of the body in a third of the scans is not part of the model."""
    scans, _, made = full_turn
    rng = np.random.default_rng(3)
    mixed = []
    for scan in scans:
        plate = np.column_stack([rng.uniform(-0.1, 0.1, (200, 2)) + 0.03 * (scan.seq % 12) - 0.2, np.full(200, 2.9)])
        points = np.vstack([scan.points, plate]) if scan.seq % 3 == 1 else scan.points
        mixed.append(Scan(seq=scan.seq, t_ns=scan.t_ns, points=points))
    again = reconstruct(lambda: mixed)
    far, _ = cKDTree(made.points).query(again.points)
    assert (far > 0.1).mean() < 0.03


def test_a_target_at_rest_is_refused():
    rng = np.random.default_rng(2)
    pose = Pose(geometry.exp(np.array([0.4, 0.2, 0.1])), np.array([0.0, 0.0, 4.0]))
    scans = [Scan(seq=k, t_ns=k * 500_000_000, points=hull_scan(rng, pose)) for k in range(6)]
    with pytest.raises(UnreadableInput, match=r"a turn of 0\.\d deg only: the target is at rest"):
        reconstruct(lambda: scans)


def test_a_sphere_is_refused():
    rng = np.random.default_rng(2)
    scans = []
    for k in range(6):
        p = rng.normal(size=(3000, 3))
        p = 0.5 * p / np.linalg.norm(p, axis=1, keepdims=True) + [0.01 * k, 0.0, 4.0]
        scans.append(Scan(seq=k, t_ns=k * 500_000_000, points=p[p[:, 2] < 3.9]))
    with pytest.raises(UnreadableInput, match="does not determine its attitude"):
        reconstruct(lambda: scans)


def test_too_few_scans_are_refused():
    scans, _ = turning(2, 10.0)
    with pytest.raises(UnreadableInput, match="only 2 scans"):
        reconstruct(lambda: scans)


@pytest.mark.slow
def test_the_command_writes_a_model_that_run_accepts(cli, fixtures_folder, tmp_path):
    done = cli("model", fixtures_folder / "tumble.mcap", "-o", tmp_path / "m.ply", "--json")
    assert done.code == 0, done.err
    said = json.loads(done.out)
    assert said["scans_used"] >= 25
    assert said["points"] > 1000
    again = cli("model", fixtures_folder / "tumble.mcap", "-o", tmp_path / "m.ply")
    assert again.code == 2
    assert "already exists" in again.err


@pytest.mark.slow
def test_the_dragon_is_rebuilt_from_fifteen_scans(shared_data):
    folder = shared_data / "stanford-dragon"
    with open_source(folder, SourceOptions(model=folder / "dragon_vrip_res3.ply")) as source:
        made = reconstruct(source.scans)
    assert made.used == 15
    assert made.rms_m < 0.4e-3


@pytest.mark.slow
def test_run_replays_a_log_against_the_model_that_it_builds_itself(cli, fixtures_folder):
    done = cli("run", fixtures_folder / "tumble.mcap", "--model", "auto", "--json")
    assert done.code == 0, done.err
    rows = json.loads(done.out)["rows"]
    healthy = [r for r in rows if r["gamma"] == 1]
    assert len(healthy) >= 25
    assert all(r["gamma"] == 0 for r in rows if r["fault"] == "occlusion")
    assert np.sqrt(np.mean([r["pos_err_m"] ** 2 for r in healthy])) < 0.02  # relative to the first scan, 5 m target
    assert all(r["nees"] is None for r in rows)  # the true state refers to another frame


@pytest.mark.slow
def test_the_frame_is_moved_to_a_grasp_point_with_x_along_the_normal(full_turn):
    _, _, made = full_turn
    at = at_grasp(made)
    near = np.linalg.norm(at.points, axis=1) < 0.03
    assert near.sum() > 3
    assert at.normals[near].mean(axis=0)[0] > 0.97
    (_, before), (_, after) = made.poses[7], at.poses[7]
    moved = before.inverse() @ after
    np.testing.assert_allclose(moved.apply(at.points), made.points, atol=1e-9)
    with pytest.raises(UsageError, match="from the surface"):
        at_grasp(made, np.array([9.0, 0.0, 0.0]))
