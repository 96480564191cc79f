"""The laws of rotations and poses, against scipy's Rotation as the oracle."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from avsreplay import geometry
from avsreplay.geometry import Pose

finite = st.floats(-10.0, 10.0, allow_nan=False)
vectors = arrays(np.float64, 3, elements=finite)
quaternions = arrays(np.float64, 4, elements=st.floats(-1.0, 1.0)).filter(
    lambda q: np.linalg.norm(q) > 1e-3
)


def batch(n=200, seed=3):
    return geometry.normalise(np.random.default_rng(seed).normal(size=(n, 4)))


def test_matrix_is_the_active_rotation():
    q = batch()
    np.testing.assert_allclose(geometry.matrix(q), Rotation.from_quat(q).as_matrix(), atol=1e-15)


def test_product_multiplies_the_matrices_in_the_same_order():
    a, b = batch(seed=1), batch(seed=2)
    np.testing.assert_allclose(
        geometry.matrix(geometry.multiply(a, b)),
        geometry.matrix(a) @ geometry.matrix(b),
        atol=1e-14,
    )


def test_papers_product_is_hamiltons_with_its_factors_exchanged():
    a, b = batch(1, seed=4)[0], batch(1, seed=5)[0]
    av, aw, bv, bw = a[:3], a[3], b[:3], b[3]
    printed = np.append(aw * bv + bw * av - np.cross(av, bv), aw * bw - av @ bv)
    np.testing.assert_allclose(printed, geometry.multiply(b, a), atol=1e-15)


@given(quaternions)
def test_quaternion_inverts_matrix(q):
    unit = geometry.normalise(q)
    back = geometry.quaternion(geometry.matrix(unit))
    np.testing.assert_allclose(geometry.matrix(back), geometry.matrix(unit), atol=1e-12)
    assert back[3] >= 0.0


def test_quaternion_near_half_turns():
    axes = np.random.default_rng(0).normal(size=(100, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    for angle in (np.pi, np.pi - 1e-9, np.pi - 1e-4):
        R = Rotation.from_rotvec(angle * axes).as_matrix()
        np.testing.assert_allclose(geometry.matrix(geometry.quaternion(R)), R, atol=1e-9)


@given(vectors)
def test_log_inverts_exp_within_half_a_turn(v):
    v = v * min(1.0, 3.14 / max(np.linalg.norm(v), 1e-12))
    np.testing.assert_allclose(geometry.log(geometry.exp(v)), v, atol=1e-9)


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e-12, 1e-8, 1e-4, 1.0, 3.0])
def test_exp_agrees_with_rotvec_at_every_size(size):
    v = size * np.array([0.6, -0.0, 0.8])
    np.testing.assert_allclose(
        geometry.matrix(geometry.exp(v)), Rotation.from_rotvec(v).as_matrix(), atol=1e-15
    )


@given(quaternions)
def test_normalise_gives_one_of_the_two_signs(q):
    np.testing.assert_array_equal(geometry.normalise(q), geometry.normalise(-q))


def test_skew_is_the_cross_product():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 50, 3))
    np.testing.assert_allclose(
        np.einsum("nij,nj->ni", geometry.skew(a), b), np.cross(a, b), atol=1e-15
    )


def test_pose_inverse_and_composition():
    q, t = batch(3), np.random.default_rng(1).normal(size=(3, 3))
    a, b, c = (Pose(*pair) for pair in zip(q, t, strict=True))
    np.testing.assert_allclose((a @ a.inverse()).matrix, np.eye(4), atol=1e-14)
    np.testing.assert_allclose(((a @ b) @ c).matrix, a.matrix @ b.matrix @ c.matrix, atol=1e-14)
    points = np.random.default_rng(2).normal(size=(7, 3))
    np.testing.assert_allclose((a @ b).apply(points), a.apply(b.apply(points)), atol=1e-14)


def test_pose_from_matrix_restores_orthonormality():
    q = batch(1)[0]
    T = Pose(q, [1.0, 2.0, 3.0]).matrix
    T[:3, :3] *= 1.0 + 1e-9
    pose = Pose.from_matrix(T)
    np.testing.assert_allclose(pose.R.T @ pose.R, np.eye(3), atol=1e-15)


def test_points_are_moved_by_the_motion_at_their_own_times():
    turns, shifts, rng = batch(3, seed=7), np.arange(9.0).reshape(3, 3), np.random.default_rng(1)
    points, knots = rng.normal(size=(50, 3)), np.array([-1.0, 0.0, 1.0])
    times = np.repeat([-1.0, -0.25, 0.0, 0.5, 1.0], 10)
    R = geometry.matrix(turns)
    found = geometry.moved_in_time(points, times, knots, R, shifts)
    for low, part, k in ((0, 0.0, 0), (0, 0.75, 10), (1, 0.0, 20), (1, 0.5, 30), (1, 1.0, 40)):
        a, b = (points[k : k + 10] @ R[i].T + shifts[i] for i in (low, low + 1))
        np.testing.assert_allclose(found[k : k + 10], (1 - part) * a + part * b, atol=1e-14)


def test_frozen_cannot_be_written_and_checks_its_shape():
    array = geometry.frozen([1, 2, 3], 3)
    with pytest.raises(ValueError, match="read-only"):
        array[0] = 5.0
    with pytest.raises(ValueError, match="shape"):
        geometry.frozen([1, 2, 3], 4)


@pytest.mark.parametrize("function", [geometry.normalise, geometry.matrix])
def test_a_single_value_equals_the_row_of_the_batch_bit_for_bit(function):
    q = batch(300) * 3.0
    q[:4], q[4:8] = np.eye(4), -np.eye(4)
    q[8:60, 3], q[8:20, 2], q[12:15, 1] = 0.0, 0.0, 0.0
    assert np.array_equal([function(one) for one in q], function(q))


def test_a_single_product_equals_the_row_of_the_batch_bit_for_bit():
    a, b = batch(300, seed=6), batch(300, seed=7)
    assert np.array_equal(
        [geometry.multiply(p, q) for p, q in zip(a, b, strict=True)], geometry.multiply(a, b)
    )


def test_a_single_skew_matrix_equals_the_row_of_the_batch_bit_for_bit():
    v = batch(50)[:, :3]
    assert np.array_equal([geometry.skew(one) for one in v], geometry.skew(v))


@pytest.mark.parametrize(
    "axis", [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.6, 0.0, 0.8], [2 / 3, -1 / 3, 2 / 3]]
)
def test_the_vector_across_an_axis_has_unit_length_and_a_right_angle(axis):
    side = geometry.across(np.array(axis))
    assert np.linalg.norm(side) == pytest.approx(1.0, abs=1e-15)
    assert side @ axis == pytest.approx(0.0, abs=1e-15)
