"""A constant torque and force as part of a belief's motion, against a motion with many small
impulses.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tumbling
from state_errors import boxminus

from avsreplay import geometry
from avsreplay.estimate import Estimator, EstimatorParams
from avsreplay.estimate.chart import to_chart, to_errors
from avsreplay.estimate.disturbance_schedule import no_worse_than_pose
from avsreplay.estimate.driven import DrivenBelief, driven_forecast, driven_moments, propagated
from avsreplay.estimate.dynamics import grasp_forecast, propagate, propagate_state
from avsreplay.estimate.error_state import boxplus
from avsreplay.estimate.initialise import PoseFix
from avsreplay.estimate.measurement import (
    chart_update,
    in_camera,
    innovation_of,
    innovation_vector,
    measurement_jacobian,
)
from avsreplay.geometry import Array
from avsreplay.records import Belief, State

U = np.array([1.2e-3, -0.8e-3, 0.5e-3, 2e-3, 1e-3, -1e-3])


def pushed(x: State, u: Array, seconds: float, parts: int = 1000) -> State:
    """The motion under u (6,): rad/s2 in {C}, m/s2 in {A}, as impulses in the middle of many
    free steps.
    """
    h = seconds / parts
    for _ in range(parts):
        x, _ = propagate_state(x, 0.5 * h)
        x = replace(x, w_b=x.w_b + h * geometry.matrix(x.q_bc) @ u[:3], v_a=x.v_a + h * u[3:])
        x, _ = propagate_state(x, 0.5 * h)
    return x


def belief_of(seed: int, u: Array = U) -> DrivenBelief:
    rng = np.random.default_rng(seed)
    L = rng.normal(size=(26, 26)) * np.repeat([1e-2, 1e-4], [20, 6])[:, None]
    C = L @ L.T
    x = tumbling.draw(seed, seconds=1.0).states[0]
    return DrivenBelief(0, x, C[:20, :20], u, C[20:, 20:], C[:20, 20:])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("seconds", [0.5, 20.0])
def test_the_prediction_is_the_motion_under_the_torque_and_the_force(
    seed: int, seconds: float
) -> None:
    belief = belief_of(seed)
    there, _ = propagated(belief, round(seconds * 1e9), 0.0, 0.0)
    truth = pushed(belief.x, U, seconds)
    assert boxminus(there.x, truth) == pytest.approx(np.zeros(20), abs=1e-6)
    back, _ = propagated(there, 0, 0.0, 0.0)
    assert boxminus(back.x, belief.x) == pytest.approx(np.zeros(20), abs=1e-9)
    free, _ = propagate(belief, round(seconds * 1e9), 0.0, 0.0)
    assert np.linalg.norm(boxminus(free.x, truth)) > 100.0 * np.linalg.norm(
        boxminus(there.x, truth)
    )


@pytest.mark.parametrize("seed", range(3))
def test_the_covariance_is_that_of_differences_of_the_motion(seed: int) -> None:
    """Phi and the derivative by u, by central differences of the motion itself."""
    belief, seconds = belief_of(seed), 15.0
    there, Phi = propagated(belief, round(seconds * 1e9), 0.0, 0.0)

    def end(d: Array) -> State:
        moved = replace(belief, x=boxplus(belief.x, d[:20]), u=U + d[20:])
        return propagated(moved, round(seconds * 1e9), 0.0, 0.0)[0].x

    step = 1e-6
    J = np.empty((20, 26))
    for k in range(26):
        d = np.zeros(26)
        d[k] = step
        J[:, k] = (boxminus(end(d), there.x) - boxminus(end(-d), there.x)) / (2.0 * step)
    assert Phi == pytest.approx(J[:, :20], rel=1e-3, abs=1e-4)
    joint = np.block([[belief.P, belief.cross], [belief.cross.T, belief.P_u]])
    scale = np.sqrt(np.diagonal(there.P))
    assert there.P / np.outer(scale, scale) == pytest.approx(
        (J @ joint @ J.T) / np.outer(scale, scale), abs=1e-3
    )
    assert isinstance(there, DrivenBelief)
    expected = J @ joint[:, 20:]
    assert there.cross == pytest.approx(expected, rel=1e-2, abs=1e-3 * np.abs(expected).max())


def test_a_pose_corrects_the_acceleration_as_in_the_joint_filter() -> None:
    belief = belief_of(4)
    H = measurement_jacobian(belief.x)
    R = np.diag(np.repeat([1e-6, 1e-7], 3))
    seen = boxplus(belief.x, np.full(20, 1e-5))
    alpha = innovation_vector(belief.x, seen.T_ac)
    innovation = innovation_of(belief.P, H, alpha, R)
    after = chart_update(belief, H, innovation, np.ones(2))
    joint = np.block([[belief.P, belief.cross], [belief.cross.T, belief.P_u]])
    wide = np.hstack([H, np.zeros((6, 6))])
    K = np.linalg.solve(wide @ joint @ wide.T + R, wide @ joint).T
    expected = joint - K @ wide @ joint
    assert isinstance(after, DrivenBelief)
    assert after.u - U == pytest.approx(K[20:] @ alpha, rel=1e-6)
    assert after.P_u == pytest.approx(expected[20:, 20:], rel=1e-6)
    T, T0 = to_errors(to_chart(after.x)), to_errors(to_chart(belief.x))
    assert after.cross == pytest.approx(
        T @ np.linalg.solve(T0, expected[:20, 20:]), rel=1e-6, abs=1e-12
    )


def test_without_an_acceleration_it_is_free_motion() -> None:
    driven = belief_of(1, np.zeros(6))
    known = replace(driven, P_u=np.zeros((6, 6)), cross=np.zeros((20, 6)))
    plain, times = Belief(0, driven.x, driven.P), np.array([0.0, 1.0, 10.0, 30.0])
    there, Phi = propagated(known, 10**10, 1e-4, 1e-4)
    free, Phi_free = propagate(plain, 10**10, 1e-4, 1e-4)
    assert Phi == pytest.approx(Phi_free, abs=1e-12)
    assert pytest.approx(free.P, rel=1e-9, abs=1e-15) == there.P
    found, expected = (
        f(b, times, 1e-4, 1e-4) for f, b in ((driven_forecast, known), (grasp_forecast, plain))
    )
    for name in ("pos_1s_m", "vel_1s_mps", "rot_1s_rad"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-9)


def test_forecast_and_path_are_those_of_the_prediction() -> None:
    belief = belief_of(2)
    estimator, times = Estimator(EstimatorParams(), None, 4.0), np.array([5.0, 20.0])
    position, velocity = estimator.motion(belief)(times)
    attitude, forecast = estimator.attitude(belief)(times), driven_forecast(belief, times, 0.0, 0.0)
    for k, t in enumerate(times.tolist()):
        there, _ = propagated(belief, round(t * 1e9), 0.0, 0.0)
        assert position[k] == pytest.approx(there.x.T_ac.t, abs=1e-9)
        assert velocity[k] == pytest.approx(there.x.fixture_velocity, abs=1e-9)
        assert abs(float(attitude[k] @ there.x.T_ac.q)) == pytest.approx(1.0, abs=1e-12)
        S = measurement_jacobian(there.x) @ there.P @ measurement_jacobian(there.x).T
        assert forecast.pos_1s_m[k] == pytest.approx(float(np.sqrt(np.trace(S[:3, :3]))), rel=1e-6)


def test_a_mixture_has_the_moments_of_its_parts() -> None:
    first = belief_of(3)
    other = replace(first, x=boxplus(first.x, np.full(20, 1e-4)), u=U * 1.1)
    found = driven_moments([(0.7, first), (0.3, other)])
    assert found.u == pytest.approx(0.7 * U + 0.3 * 1.1 * U)
    d = boxminus(other.x, first.x)
    assert boxminus(found.x, first.x) == pytest.approx(0.3 * d, rel=1e-2, abs=1e-8)
    assert np.diagonal(found.P) == pytest.approx(
        np.diagonal(first.P + 0.21 * np.outer(d, d)), rel=1e-2
    )
    assert driven_moments([(1.0, first)]) is first


def test_a_belief_with_a_torque_is_no_less_precise_than_the_last_pose() -> None:
    """In the directions in which its pose is less precise, the pose is used as far as is missing,
    and no further.
    """
    belief, C = belief_of(3), np.diag(np.repeat([2e-2, 6e-2], 3) ** 2)
    pose = belief.x.T_ac @ geometry.Pose(
        geometry.exp(np.array([0.01, -0.02, 0.01])), np.array([0.03, 0.0, -0.02])
    )
    H = measurement_jacobian(belief.x)
    before = np.linalg.eigvals(
        np.linalg.solve(in_camera(C, pose.q, belief.x.q_bc), H @ belief.P @ H.T)
    ).real
    assert before.min() < 1.0 < before.max()
    after = no_worse_than_pose(belief, PoseFix(0, pose, C), np.ones(2))
    T, U = to_errors(to_chart(belief.x)), to_errors(to_chart(after.x))
    P = T @ np.linalg.solve(U, np.linalg.solve(U, after.P).T) @ T.T
    found = np.linalg.eigvals(
        np.linalg.solve(in_camera(C, pose.q, belief.x.q_bc), H @ P @ H.T)
    ).real
    assert np.sort(found) == pytest.approx(np.sort(np.minimum(before, 1.0)), rel=1e-4)
    assert np.trace(after.P_u) < np.trace(belief.P_u)
