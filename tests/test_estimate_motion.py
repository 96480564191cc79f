"""The step of the motion against the full inertia tensor, finite differences and the covariance equation."""

from __future__ import annotations

import numpy as np
import pytest
import tumbling
from scipy.integrate import solve_ivp

from avsreplay import geometry
from avsreplay.errors import UsageError
from avsreplay.estimate import horizon, motion
from avsreplay.estimate.layout import boxminus, boxplus
from avsreplay.records import Belief, State

STEPS = (0.01, 0.2, 0.5, 1.0, 12.0)


def some_state(seed: int, rate: float = 0.15) -> tuple[State, np.ndarray]:
    world = tumbling.draw(seed, rate=rate, seconds=1.0)
    return world.states[0], world.moments


def after(x: State, h: float) -> State:
    return motion.advance(x, motion.flow(x.w_b, x.sigma, h), h)


@pytest.mark.parametrize("h", STEPS)
@pytest.mark.parametrize("seed", range(4))
def test_state_follows_the_full_inertia_tensor(seed: int, h: float) -> None:
    x, moments = some_state(seed)
    truth = tumbling.follow(np.array([0.0, h]), moments, x)[-1]
    assert np.abs(boxminus(after(x, h), truth)).max() < 1e-9


@pytest.mark.parametrize("seed", range(8))
def test_energy_and_momentum_stay(seed: int) -> None:
    x, moments = some_state(seed, rate=0.4)
    y = after(x, 60.0)
    assert y.w_b @ (moments * y.w_b) == pytest.approx(x.w_b @ (moments * x.w_b), rel=1e-12)
    before, now = (geometry.matrix(s.q_ab) @ (moments * s.w_b) for s in (x, y))
    assert np.abs(now - before).max() < 1e-12
    assert abs(np.linalg.norm(y.q_ab) - 1.0) < 1e-14


@pytest.mark.parametrize("seed", range(4))
def test_steps_join_and_turn_back(seed: int) -> None:
    x, _ = some_state(seed)
    assert np.abs(boxminus(after(after(x, 0.7), 1.9), after(x, 2.6))).max() < 1e-12
    assert np.abs(boxminus(after(after(x, 3.0), -3.0), x)).max() < 1e-12


def test_a_body_at_rest_stays() -> None:
    x = State([0, 0, 0, 1.0], np.zeros(3), [1.0, 2, 3], [0.1, 0, 0], [0.2, -0.4], [0.1, 0, 0], [0, 0, 0, 1.0])
    y = after(x, 5.0)
    assert np.array_equal(y.q_ab, x.q_ab)
    assert np.allclose(y.r_a, [1.5, 2, 3])


def test_b_is_trace_over_moment() -> None:
    _, moments = some_state(3)
    assert motion.disturbance(tumbling.ratios(moments)) == pytest.approx(moments.sum() / moments)


@pytest.mark.parametrize("h", [0.2, 1.0, 12.0])
@pytest.mark.parametrize("seed", range(3))
def test_phi_is_the_derivative_of_the_step(seed: int, h: float) -> None:
    x, _ = some_state(seed)
    Phi = motion.transition(motion.flow(x.w_b, x.sigma, h), x.sigma, h)
    eps, base = 1e-5, after(x, h)
    for k in range(20):
        d = np.zeros(20)
        d[k] = eps
        column = (boxminus(after(boxplus(x, d), h), base) - boxminus(after(boxplus(x, -d), h), base)) / (2 * eps)
        assert np.abs(column - Phi[:, k]).max() < 2e-8 * max(1.0, np.abs(Phi[:, k]).max()), k


@pytest.mark.parametrize("h", STEPS)
def test_phi_and_noise_solve_their_differential_equation(h: float) -> None:
    x, moments = some_state(5)
    torque, force = 2e-4, 3e-4
    P0 = np.diag(np.linspace(0.5, 2.0, 20)) * 1e-4
    belief, Phi = motion.propagate(Belief(0, x, P0), round(h * 1e9), torque, force)
    want_Phi, want_P = by_integration(x, moments, P0, h, torque, force)
    assert np.abs(Phi - want_Phi).max() < 1e-10 * np.abs(want_Phi).max()
    assert np.abs(belief.P - want_P).max() < 1e-10 * np.abs(want_P).max()


def by_integration(x: State, moments: np.ndarray, P0: np.ndarray, h: float, torque: float, force: float):
    """Phi and P by DOP853 from F and G as printed, F's derivatives taken by finite differences of phi."""
    G = np.zeros((20, 6))
    G[3:6, :3], G[9:12, 3:] = np.diag(moments.sum() / moments) * torque, np.eye(3) * force

    def phi(w: np.ndarray, s: np.ndarray) -> np.ndarray:
        s3 = -(s[0] + s[1]) / (1 + s[0] * s[1])
        return np.array([s[0] * w[1] * w[2], s[1] * w[0] * w[2], s3 * w[0] * w[1]])

    def F(w: np.ndarray) -> np.ndarray:
        s1, s2 = x.sigma
        s3, d = -(s1 + s2) / (1 + s1 * s2), (1 + s1 * s2) ** 2
        M = np.zeros((20, 20))
        M[:3, :3], M[:3, 3:6], M[6:9, 9:12] = -geometry.skew(w), 0.5 * np.eye(3), np.eye(3)
        M[3:6, 3:6] = [[0, s1 * w[2], s1 * w[1]], [s2 * w[2], 0, s2 * w[0]], [s3 * w[1], s3 * w[0], 0]]
        M[3:6, 12:14] = [[w[1] * w[2], 0], [0, w[0] * w[2]], np.array([s2**2 - 1, s1**2 - 1]) / d * w[0] * w[1]]
        return M

    def rates(_: float, y: np.ndarray) -> np.ndarray:
        w, Phi, P = y[:3], y[3:403].reshape(20, 20), y[403:].reshape(20, 20)
        A = F(w)
        return np.concatenate([phi(w, x.sigma), (A @ Phi).ravel(), (A @ P + P @ A.T + G @ G.T).ravel()])

    y0 = np.concatenate([x.w_b, np.eye(20).ravel(), P0.ravel()])
    y = solve_ivp(rates, (0.0, h), y0, method="DOP853", rtol=1e-12, atol=1e-18).y[:, -1]
    return y[3:403].reshape(20, 20), y[403:].reshape(20, 20)


def test_three_ratios_join_to_two() -> None:
    sigma, eps = np.array([0.3, -0.6]), 1e-6
    for k in range(2):
        d = np.eye(2)[k] * eps
        slope = (motion.sigma3(sigma + d) - motion.sigma3(sigma - d)) / (2 * eps)
        assert motion.sigma_join(sigma)[2, k] == pytest.approx(slope, rel=1e-9)


def test_trajectory_is_the_motion_and_its_velocity_the_slope() -> None:
    x, moments = some_state(2, rate=0.3)
    times = np.array([0.0, 0.31, 4.0, 17.3, 60.0])
    position, velocity = horizon.trajectory(x)(times)
    truth = tumbling.follow(times, moments, x)
    assert np.abs(position - [s.T_ac.t for s in truth]).max() < 1e-9
    assert np.abs(velocity - [s.fixture_velocity for s in truth]).max() < 1e-9
    with pytest.raises(ValueError, match="before now"):
        horizon.trajectory(x)(np.array([-1.0]))


def test_forecast_is_the_spread_of_displaced_motions() -> None:
    x, _ = some_state(7)
    rng = np.random.Generator(np.random.PCG64(1))
    root = np.linalg.qr(rng.normal(size=(20, 20)))[0] * np.geomspace(1e-5, 1e-3, 20)
    belief, times = Belief(0, x, root @ root.T), np.array([0.0, 3.0, 20.0])
    seen = horizon.forecast(belief, times, 0.0, 0.0)
    poses, speeds, turns = [], [], []
    for _ in range(600):
        far = [after(boxplus(x, root @ rng.normal(size=20)), t) for t in times]
        poses.append([s.T_ac.t for s in far])
        speeds.append([s.fixture_velocity for s in far])
        turns.append(
            [
                geometry.log(geometry.multiply(geometry.conjugate(after(x, t).T_ac.q), s.T_ac.q))
                for s, t in zip(far, times, strict=True)
            ]
        )
    for values, claimed in ((poses, seen.pos_1s_m), (speeds, seen.vel_1s_mps), (turns, seen.rot_1s_rad)):
        assert np.sqrt(np.var(values, axis=0).sum(axis=1)) == pytest.approx(claimed, rel=0.09)


def test_forecast_adds_the_disturbance_of_every_step() -> None:
    """Quadrature over the horizon against the covariance stepped through it."""
    x, _ = some_state(7)
    torque, force, P0 = 1e-3, 2e-3, np.eye(20) * 1e-12
    times = np.array([5.0, 30.0])
    seen = horizon.forecast(Belief(0, x, P0), times, torque, force)
    for i, t in enumerate(times):
        then, _ = motion.propagate(Belief(0, x, P0), round(t * 1e9), torque, force)
        J = motion.grasp_rows(geometry.matrix(then.x.q_ab)[None], then.x.w_b[None], x.c_b)[0]
        want = np.sqrt(np.diag(J @ then.P @ J.T).reshape(3, 3).sum(axis=1)) * [1, 1, 2]
        assert (seen.pos_1s_m[i], seen.vel_1s_mps[i], seen.rot_1s_rad[i]) == pytest.approx(tuple(want), rel=1e-5)


def test_a_gap_of_years_is_refused_in_one_line() -> None:
    x, _ = some_state(1)
    with pytest.raises(UsageError, match="too far to predict"):
        motion.propagate(Belief(0, x, np.eye(20)), 10**18, 0.0, 0.0)
