"""Reconstruction of an unknown target: properties of the result against simulated and real shapes."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial import cKDTree

from avsreplay import geometry
from avsreplay.errors import UnreadableInput
from avsreplay.geometry import Pose
from avsreplay.log import SourceOptions, open_source
from avsreplay.reconstruct import reconstruct
from avsreplay.records import Scan


def box_scan(rng, T_ac: Pose, noise_m: float = 0.0) -> np.ndarray:
    """Points on the sides of an irregular body (two boxes) that face the camera at the origin of {A}."""
    parts = []
    for centre, half in (((0.0, 0.0, 0.0), (0.5, 0.3, 0.2)), ((0.35, 0.2, 0.3), (0.12, 0.08, 0.15))):
        for axis in range(3):
            for sign in (-1.0, 1.0):
                p = rng.uniform(-1.0, 1.0, (700, 3)) * half
                p[:, axis] = sign * half[axis]
                normal = np.zeros(3)
                normal[axis] = sign
                a = T_ac.apply(p + centre)
                parts.append(a[(a @ (T_ac.R @ normal)) < 0.0])
    points = np.vstack(parts)
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    return points + noise_m * rng.normal(size=(len(points), 1)) * rays


def turning(count: int, step_deg: float, noise_m: float = 0.0, seed: int = 1):
    """Scans of the body while it turns about a tilted axis, and their true poses."""
    rng = np.random.default_rng(seed)
    axis = np.array([0.3, 0.9, 0.2]) / np.linalg.norm([0.3, 0.9, 0.2])
    poses = [Pose(geometry.exp(np.radians(step_deg * k) * axis), np.array([0.02 * k, 0.0, 4.0])) for k in range(count)]
    scans = [Scan(seq=k, t_ns=k * 500_000_000, points=box_scan(rng, T, noise_m)) for k, T in enumerate(poses)]
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
    scans, truth = turning(37, 10.0, noise_m=0.003)
    return scans, truth, reconstruct(scans)


def test_every_scan_of_a_full_turn_is_used_and_the_turn_closes(full_turn):
    _, truth, made = full_turn
    assert made.used == 37
    turn_deg, shift_m = errors(made, truth).max(axis=0)
    assert turn_deg < 1.0
    assert shift_m < 0.015
    assert abs(errors(made, truth)[-1, 0]) < 0.5  # one full turn: the last pose is the first again


def test_points_lie_on_the_body_and_normals_point_outward(full_turn):
    _, truth, made = full_turn
    _, first = made.poses[0]
    T_true_c = truth[0].inverse() @ first  # reconstruction {C} to the body's own frame
    points, normals = T_true_c.apply(made.points), made.normals @ T_true_c.R.T
    rng = np.random.default_rng(5)
    surface = np.vstack([T.inverse().apply(box_scan(rng, T)) for T in truth])
    far, _ = cKDTree(surface).query(points)
    assert np.median(far) < 0.012  # the samples of the oracle are about 15 mm apart
    assert np.quantile(far, 0.95) < 0.03
    outward = np.einsum("ni,ni->n", normals, points) > 0.0
    assert outward.mean() > 0.8


def test_the_result_is_the_same_for_the_same_scans(full_turn):
    scans, _, made = full_turn
    again = reconstruct(scans)
    np.testing.assert_array_equal(made.points, again.points)
    np.testing.assert_array_equal(made.one_sigma_m, again.one_sigma_m)


def test_a_moving_occluder_is_left_out(full_turn):
    """A plate that passes in front of the body in a third of the scans is not part of the model."""
    scans, _, made = full_turn
    rng = np.random.default_rng(3)
    mixed = []
    for scan in scans:
        plate = np.column_stack([rng.uniform(-0.1, 0.1, (200, 2)) + 0.03 * (scan.seq % 12) - 0.2, np.full(200, 2.9)])
        points = np.vstack([scan.points, plate]) if scan.seq % 3 == 1 else scan.points
        mixed.append(Scan(seq=scan.seq, t_ns=scan.t_ns, points=points))
    again = reconstruct(mixed)
    far, _ = cKDTree(made.points).query(again.points)
    assert (far > 0.1).mean() < 0.03


def test_a_target_at_rest_is_refused():
    rng = np.random.default_rng(2)
    pose = Pose(geometry.exp(np.array([0.4, 0.2, 0.1])), np.array([0.0, 0.0, 4.0]))
    scans = [Scan(seq=k, t_ns=k * 500_000_000, points=box_scan(rng, pose)) for k in range(6)]
    with pytest.raises(UnreadableInput, match=r"turned by 0\.\d deg only"):
        reconstruct(scans)


def test_a_sphere_is_refused():
    rng = np.random.default_rng(2)
    scans = []
    for k in range(6):
        p = rng.normal(size=(3000, 3))
        p = 0.5 * p / np.linalg.norm(p, axis=1, keepdims=True) + [0.01 * k, 0.0, 4.0]
        scans.append(Scan(seq=k, t_ns=k * 500_000_000, points=p[p[:, 2] < 3.9]))
    with pytest.raises(UnreadableInput, match="does not determine the attitude"):
        reconstruct(scans)


def test_too_few_scans_are_refused():
    scans, _ = turning(2, 10.0)
    with pytest.raises(UnreadableInput, match="only 2 scans"):
        reconstruct(scans)


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
        made = reconstruct(source.scans())
    assert made.used == 15
    assert made.rms_m < 0.4e-3
