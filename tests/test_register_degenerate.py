"""Views that do not determine all directions of a pose: which, their covariance, and a run
that begins with one.
"""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from oracles.residuals import summed
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from avsreplay.estimate import Estimator, EstimatorParams
from avsreplay.estimate.track import common_motions
from avsreplay.geometry import Array, Pose
from avsreplay.monitor.convergence import block_1s
from avsreplay.monitor.fault_detection import FaultDetector, FaultParams
from avsreplay.records import AlignStatus, ScanStatus, Surface
from avsreplay.register.contract import view
from avsreplay.register.covariance import sandwich_covariance
from avsreplay.register.degenerate import Directions
from avsreplay.register.registrar import Registrar

HEIGHT_M, RADIUS_M = 3.0, 0.6


def stage() -> Surface:
    """A body of revolution about z whose ends differ: cylinder and nozzle."""
    tube = trimesh.creation.cylinder(RADIUS_M, HEIGHT_M, sections=96)
    nozzle = trimesh.creation.cone(0.5, 0.8, sections=96)
    nozzle.apply_translation((0.0, 0.0, 0.48 * HEIGHT_M))
    mesh = trimesh.util.concatenate([tube, nozzle])
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32), "stage", "")


def scan_of(surface: Surface, T_ac: Pose, seed: int) -> Array:
    """Points of the faces towards the camera, with 2 mm noise along the ray."""
    points = T_ac.apply(view(surface, 3000, T_ac.inverse().t))
    noise = np.random.default_rng(seed).normal(0.0, 0.002, (len(points), 1))
    return points * (1.0 + noise / np.linalg.norm(points, axis=1, keepdims=True))


def twist(d: Array) -> Array:
    """The 4x4 generator of a motion d = [theta; v]."""
    x, y, z = d[:3]
    return np.block(
        [[np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), d[3:, None]], [np.zeros((1, 4))]]
    )


def cylinder_rows(seed: int) -> tuple[Array, Array]:
    """J (n, 6) of points on the near half of a cylinder about a random axis, and that axis as a
    motion d.
    """
    rng = np.random.default_rng(seed)
    R, c = Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3)
    a, z = rng.uniform(0, np.pi, 400), rng.uniform(-1, 1, 400)
    n = np.column_stack([np.cos(a), np.sin(a), 0 * a]) @ R.T
    p = c + 0.5 * n + z[:, None] * R[:, 2]
    return np.hstack([np.cross(p, n), n]), np.concatenate([R[:, 2], np.cross(c, R[:, 2])])


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("angle", [0.3, 2.0, -3.0])
def test_a_rotation_by_any_angle_about_the_axis_is_a_motion_along_the_unobservable_directions(
    seed, angle
):
    J, axis = cylinder_rows(seed)
    centre = J[:, 3:].mean(axis=0)
    view_of = Directions.of(J.T @ J, len(J), centre)
    assert view_of.free.shape == (6, 2)  # it also slides along the axis
    T_ca = Pose(Rotation.random(random_state=seed + 9).as_quat(), np.array([0.3, -1.0, 2.0]))
    turned = Pose.from_matrix(expm(twist(angle * axis))) @ T_ca
    np.testing.assert_allclose(view_of.nearest(T_ca, turned).matrix, turned.matrix, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_a_refined_pose_has_no_residuals_left_and_does_not_move_along_the_unobservable_directions(
    seed,
):
    J, _ = cylinder_rows(seed)
    view_of = Directions.of(J.T @ J, len(J), J[:, 3:].mean(axis=0))
    error = 1e-5 * np.random.default_rng(seed).normal(size=6)
    T_ca = Pose(Rotation.random(random_state=seed).as_quat(), np.array([0.3, -1.0, 2.0]))
    step = view_of.refined(T_ca, J.T @ J, J.T @ J @ error) @ T_ca.inverse()
    d = np.concatenate([2.0 * step.q[:3], step.t])
    np.testing.assert_allclose(J @ d, J @ error, atol=1e-9)
    np.testing.assert_allclose(view_of.free.T @ view_of.to_x @ d, 0.0, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_the_information_is_that_of_the_observable_directions_alone(seed):
    """Oracle: least squares in the observable directions only, with the covariance of
    independent noise.
    """
    J, axis = cylinder_rows(seed)
    rng = np.random.default_rng(seed)
    found = summed(J, rng.normal(0.0, 0.01, len(J)), np.arange(len(J)) // 4)
    view_of = Directions.of(J.T @ J, len(J), found.centre)
    P, _ = sandwich_covariance(view_of.held(found).normals, found.gradients)
    info = view_of.observable_information(P)
    along = view_of.motions
    np.testing.assert_allclose(along.T @ info @ along, 0.0, atol=1e-9 * np.trace(info))
    assert axis @ info @ axis < 1e-9 * np.trace(info)
    U = np.linalg.svd(J, full_matrices=False)[2][:4]
    ratio = np.linalg.eigvals(np.linalg.solve(U @ J.T @ J @ U.T / 1e-4, U @ info @ U.T)).real
    assert np.all((ratio > 0.5) & (ratio < 2.0))


def test_common_motions_are_those_of_both_sets():
    x, y, z = np.eye(6)[:, :3].T
    both = common_motions(np.column_stack([x, z]), np.column_stack([y, 2.0 * z]), 1.0)
    assert both.shape == (6, 1)
    np.testing.assert_allclose(np.abs(both[:, 0]), 2.0 * z)
    assert common_motions(np.eye(6), None, 1.0).size == 0
    assert common_motions(np.column_stack([x]), np.column_stack([y]), 1.0).size == 0


@pytest.mark.parametrize("height_m", [0.02, 0.04, 0.06])
def test_points_that_noise_moves_over_an_edge_do_not_determine_a_direction(height_m):
    """Two sides of a plate, and the bottom 1 deg from the line of sight, without returns: nothing
    tells the height, although points inside of the plate are nearest the bottom.
    """
    mesh = trimesh.creation.box((2.0, 1.2, 0.1))
    plate = Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32), "plate", "")
    registrar = Registrar(plate)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        y, x, z = rng.uniform(-0.6, 0.6, 400), rng.uniform(-1, 1, 240), rng.uniform(-1, 1, 640)
        sides = [np.column_stack([np.ones(400), y]), np.column_stack([x, np.full(240, 0.6)])]
        points = np.column_stack([np.vstack(sides), 0.05 * z])
        eye = np.array([3.8, 1.15, -0.05 - height_m])
        rays = points - eye
        far = np.linalg.norm(rays, axis=1, keepdims=True)
        T_ac = Pose(Pose.identity().q, -eye)
        noisy = rays * (1.0 + 0.002 * rng.standard_normal((640, 1)) / far)
        found = registrar.register(noisy, T_ac)
        assert found.status is AlignStatus.DEGENERATE


def test_a_body_of_revolution_is_found_up_to_its_rotation_and_not_called_ambiguous():
    surface, registrar = stage(), Registrar(stage())
    for seed in range(4):
        T_ac = Pose(Rotation.random(random_state=seed).as_quat(), np.array([0.1, -0.2, 8.0]))
        found = registrar.acquire(scan_of(surface, T_ac, seed))
        assert found.status is AlignStatus.DEGENERATE
        assert "turns about z" in found.free_directions
        step = T_ac.inverse() @ found.T_ac
        assert np.degrees(np.arccos(min(1.0, step.R[2, 2]))) < 0.3
        assert np.linalg.norm(step.t) < 0.01


def test_the_estimate_of_a_body_of_revolution_states_that_its_rotation_is_not_determined():
    """It turns about an axis across its own; the position is tracked, and the attitude never
    claimed.
    """
    surface, registrar = stage(), Registrar(stage())
    estimator = Estimator(EstimatorParams(), None, surface.extent)
    judge = FaultDetector(FaultParams(), surface.extent)
    poses = [
        Pose(
            (
                Rotation.from_rotvec([0.0, 0.05 * k, 0.02 * k])
                * Rotation.from_rotvec([1.2, 0.4, 0.0])
            ).as_quat(),
            np.array([0.002 * k, 0.0, 8.0]),
        )
        for k in range(30)
    ]
    first = registrar.acquire(scan_of(surface, poses[0], 0))
    track, used = estimator.initial(0, first.T_ac, acquired=True), 0
    for k, T_ac in enumerate(poses):
        prior = estimator.predict(track, 500_000_000 * k)
        points = scan_of(surface, T_ac, k)
        found = first if k == 0 else registrar.register(points, prior.belief.x.T_ac, k)
        innovation = estimator.innovate(prior, found)
        examined = judge.examine(ScanStatus.OK, found, innovation, prior.belief)
        track, finding = estimator.step(track, prior, innovation, examined.admission, False)
        used += finding.used
    belief = estimator.published(track)
    assert used >= 28
    assert np.linalg.norm((poses[-1].inverse() @ belief.x.T_ac).t) < 0.002
    assert track.undetermined.shape == (6, 1)
    assert abs(track.undetermined[2, 0]) > 0.99 * np.linalg.norm(track.undetermined[:3, 0])
    assert np.degrees(2.0 * block_1s(belief.P)["mu"]) > 60.0
    assert np.all(estimator.track_forecast(track, np.array([0.0, 30.0])).rot_1s_rad > 1.0)
