"""The step of the motion against the full inertia tensor, finite differences and the covariance
equation.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
import tumbling
from scipy.integrate import solve_ivp
from state_errors import boxminus

from avsreplay import geometry
from avsreplay.errors import UsageError
from avsreplay.estimate import _motion, dynamics
from avsreplay.estimate.dynamics import rotation_history, rotation_path
from avsreplay.estimate.error_state import boxplus
from avsreplay.records import Belief, State

CALM = (0.0, 0.0, 0.0)
STEPS = (0.01, 0.2, 0.5, 1.0, 12.0)


def some_state(seed: int, rate: float = 0.15) -> tuple[State, np.ndarray]:
    world = tumbling.draw(seed, rate=rate, seconds=1.0)
    return world.states[0], world.moments


def after(x: State, h: float) -> State:
    return dynamics.advance(x, dynamics.flow(x.w_b, x.sigma, h), h)


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
    x = State(
        [0, 0, 0, 1.0],
        np.zeros(3),
        [1.0, 2, 3],
        [0.1, 0, 0],
        [0.2, -0.4],
        [0.1, 0, 0],
        [0, 0, 0, 1.0],
    )
    y = after(x, 5.0)
    assert np.array_equal(y.q_ab, x.q_ab)
    assert np.allclose(y.r_a, [1.5, 2, 3])


def test_b_is_trace_over_moment() -> None:
    _, moments = some_state(3)
    assert dynamics.disturbance(tumbling.ratios(moments)) == pytest.approx(moments.sum() / moments)


@pytest.mark.parametrize("h", [0.2, 1.0, 12.0])
@pytest.mark.parametrize("seed", range(3))
def test_phi_is_the_derivative_of_the_step(seed: int, h: float) -> None:
    x, _ = some_state(seed)
    Phi = dynamics.transition(dynamics.flow(x.w_b, x.sigma, h), x.sigma, h)
    eps, base = 1e-5, after(x, h)
    for k in range(20):
        d = np.zeros(20)
        d[k] = eps
        column = (
            boxminus(after(boxplus(x, d), h), base) - boxminus(after(boxplus(x, -d), h), base)
        ) / (2 * eps)
        assert np.abs(column - Phi[:, k]).max() < 2e-8 * max(1.0, np.abs(Phi[:, k]).max()), k


@pytest.mark.parametrize("h", STEPS)
def test_phi_and_noise_solve_their_differential_equation(h: float) -> None:
    x, moments = some_state(5)
    torque, force = 2e-4, 3e-4
    P0 = np.diag(np.linspace(0.5, 2.0, 20)) * 1e-4
    belief, Phi = dynamics.propagate(Belief(0, x, P0), round(h * 1e9), torque, force)
    want_Phi, want_P = by_integration(x, moments, P0, h, torque, force)
    assert np.abs(Phi - want_Phi).max() < 1e-10 * np.abs(want_Phi).max()
    assert np.abs(belief.P - want_P).max() < 1e-10 * np.abs(want_P).max()


def by_integration(
    x: State, moments: np.ndarray, P0: np.ndarray, h: float, torque: float, force: float
):
    """Phi and P by DOP853 from F and G as printed, F's derivatives taken by finite differences of
    phi.
    """
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
        M[3:6, 3:6] = [
            [0, s1 * w[2], s1 * w[1]],
            [s2 * w[2], 0, s2 * w[0]],
            [s3 * w[1], s3 * w[0], 0],
        ]
        M[3:6, 12:14] = [
            [w[1] * w[2], 0],
            [0, w[0] * w[2]],
            np.array([s2**2 - 1, s1**2 - 1]) / d * w[0] * w[1],
        ]
        return M

    def rates(_: float, y: np.ndarray) -> np.ndarray:
        w, Phi, P = y[:3], y[3:403].reshape(20, 20), y[403:].reshape(20, 20)
        A = F(w)
        return np.concatenate(
            [phi(w, x.sigma), (A @ Phi).ravel(), (A @ P + P @ A.T + G @ G.T).ravel()]
        )

    y0 = np.concatenate([x.w_b, np.eye(20).ravel(), P0.ravel()])
    y = solve_ivp(rates, (0.0, h), y0, method="DOP853", rtol=1e-12, atol=1e-18).y[:, -1]
    return y[3:403].reshape(20, 20), y[403:].reshape(20, 20)


def test_three_ratios_join_to_two() -> None:
    sigma, eps = np.array([0.3, -0.6]), 1e-6
    for k in range(2):
        d = np.eye(2)[k] * eps
        slope = (dynamics.sigma3(sigma + d) - dynamics.sigma3(sigma - d)) / (2 * eps)
        assert dynamics.sigma_join(sigma)[2, k] == pytest.approx(slope, rel=1e-9)


def test_trajectory_is_the_motion_and_its_velocity_the_slope() -> None:
    x, moments = some_state(2, rate=0.3)
    times = np.array([0.0, 0.31, 4.0, 17.3, 60.0])
    position, velocity = dynamics.grasp_trajectory(x)(times)
    truth = tumbling.follow(times, moments, x)
    assert np.abs(position - [s.T_ac.t for s in truth]).max() < 1e-9
    assert np.abs(velocity - [s.fixture_velocity for s in truth]).max() < 1e-9
    with pytest.raises(ValueError, match="before now"):
        dynamics.grasp_trajectory(x)(np.array([-1.0]))


def test_forecast_is_the_spread_of_displaced_motions() -> None:
    x, _ = some_state(7)
    rng = np.random.Generator(np.random.PCG64(1))
    root = np.linalg.qr(rng.normal(size=(20, 20)))[0] * np.geomspace(1e-5, 1e-3, 20)
    belief, times = Belief(0, x, root @ root.T), np.array([0.0, 3.0, 20.0])
    seen = dynamics.grasp_forecast(belief, times, 0.0, 0.0)
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
    for values, claimed in (
        (poses, seen.pos_1s_m),
        (speeds, seen.vel_1s_mps),
        (turns, seen.rot_1s_rad),
    ):
        assert np.sqrt(np.var(values, axis=0).sum(axis=1)) == pytest.approx(claimed, rel=0.09)


def test_forecast_adds_the_disturbance_of_every_step() -> None:
    """Over many instants against one step to each."""
    x, _ = some_state(7)
    torque, force, P0 = 1e-3, 2e-3, np.eye(20) * 1e-12
    times = np.array([5.0, 30.0])
    seen = dynamics.grasp_forecast(Belief(0, x, P0), times, torque, force)
    for i, t in enumerate(times):
        then, _ = dynamics.propagate(Belief(0, x, P0), round(t * 1e9), torque, force)
        J = dynamics.grasp_jacobian(geometry.matrix(then.x.q_ab)[None], then.x.w_b[None], x.c_b)[0]
        want = np.sqrt(np.diag(J @ then.P @ J.T).reshape(3, 3).sum(axis=1)) * [1, 1, 2]
        assert (seen.pos_1s_m[i], seen.vel_1s_mps[i], seen.rot_1s_rad[i]) == pytest.approx(
            tuple(want), rel=1e-11
        )


def test_a_gap_of_years_is_refused_in_one_line() -> None:
    x, _ = some_state(1)
    with pytest.raises(
        UsageError, match=r"the target turns .* rad: too far to predict; check the stamps"
    ):
        dynamics.propagate(Belief(0, x, np.eye(20)), 10**18, 0.0, 0.0)


def noise_by_quadrature(x: State, moments: np.ndarray, h: float, torque: float) -> np.ndarray:
    """Q (6, 6) as an integral: what a push at each instant has become by the end, on a motion
    from there on.
    """
    G = np.zeros((6, 3))
    G[3:] = np.diag(moments.sum() / moments) * torque
    cells = max(4, int(4 * abs(h) * np.linalg.norm(x.w_b)))
    nodes, weights = np.polynomial.legendre.leggauss(8)
    Q, edges = np.zeros((6, 6)), np.linspace(0.0, h, cells + 1)
    for low, high in itertools.pairwise(edges):
        for node, weight in zip(nodes, weights, strict=True):
            t = 0.5 * (low + high) + 0.5 * (high - low) * node
            pushed = dynamics.flow(after(x, t).w_b, x.sigma, h - t).S[:, :6] @ G
            Q += 0.5 * weight * abs(high - low) * pushed @ pushed.T
    return Q


@pytest.mark.parametrize("h", [0.05, 0.2, 12.0, 40.0, -0.2, -12.0])
@pytest.mark.parametrize("seed", range(3))
def test_noise_is_the_sum_of_propagated_disturbances(seed: int, h: float) -> None:
    x, moments = some_state(seed)
    want = noise_by_quadrature(x, moments, h, 2e-3)
    scale = np.sqrt(np.outer(np.diag(want), np.diag(want)))
    assert np.abs((dynamics.flow(x.w_b, x.sigma, h, 2e-3).Q - want) / scale).max() < 1e-10


def test_noise_of_a_body_at_rest_is_the_textbook_one() -> None:
    sigma, torque, h = np.array([0.2, -0.4]), 3e-4, 0.7
    Q = dynamics.flow(np.zeros(3), sigma, h, torque).Q
    push = np.diag((np.array(dynamics.disturbance(sigma)) * torque) ** 2)
    want = np.block(
        [[push * h**3 / 12.0, push * h**2 / 4.0], [push * h**2 / 4.0, push * h]]
    )  # dq' = w / 2
    assert np.abs(Q - want).max() < 1e-15 * np.abs(want).max()


@pytest.mark.parametrize("h", [60.0, -0.3, -30.0])
def test_sensitivity_is_the_derivative_by_three_ratios_either_way(h: float) -> None:
    """Each of sigma1..3 apart, as the extension takes them, and a start of any attitude error and
    rate.
    """
    x, _ = some_state(9, rate=0.3)
    q, ratios = np.array([0.0, 0.0, 0.0, 1.0]), np.array(dynamics.ratios(x.sigma))

    def moved(w: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        q1, w1, _, _ = _motion.follow(q, w, tuple(s), CALM, np.array([h]))
        return q1[0], w1[0]

    end, S = moved(x.w_b, ratios)[0], dynamics.flow(x.w_b, x.sigma, h).S
    assert np.abs(S[:3, :3] - geometry.matrix(end).T).max() < 1e-13
    assert not S[3:, :3].any()
    for k in range(6):
        d = 1e-6 * np.eye(6)[k]
        (qa, wa), (qb, wb) = (moved(x.w_b + s * d[:3], ratios + s * d[3:]) for s in (1.0, -1.0))
        turn = geometry.multiply(geometry.conjugate(end), np.array([qa, qb]))
        column = np.concatenate([turn[0, :3] - turn[1, :3], wa - wb]) / 2e-6
        assert np.abs(column - S[:, 3 + k]).max() < 1e-7 * max(1.0, np.abs(S[:, 3 + k]).max()), k


@pytest.mark.parametrize("rate", [3.0, 200.0])
def test_fast_bodies_follow_the_full_inertia_tensor(rate: float) -> None:
    x, moments = some_state(6)
    x, h = replace(x, w_b=x.w_b * rate / np.linalg.norm(x.w_b)), 20.0 / rate
    for span in (h, -h):
        truth = tumbling.follow(
            np.array([0.0, abs(span)]), moments, x if span > 0 else after(x, span)
        )[-1]
        d = boxminus(after(x, span) if span > 0 else x, truth)
        assert np.abs(d / np.maximum(1.0, rate)).max() < 1e-9


@pytest.mark.parametrize("sigma", [(0.97, -0.9), (-0.98, 0.3), (0.99, -0.99), (0.5, 0.98)])
def test_slender_and_flat_bodies(sigma: tuple[float, float]) -> None:
    """The rate may grow manifold between two cuts of a long step."""
    w, s = np.array([0.05, 0.4, -0.3]), np.array(sigma)
    s1, s2, s3 = dynamics.ratios(s)
    rates = lambda _, u: [s1 * u[1] * u[2], s2 * u[0] * u[2], s3 * u[0] * u[1]]  # noqa: E731
    truth = solve_ivp(rates, (0.0, 60.0), w, method="DOP853", rtol=1e-13, atol=1e-15).y[:, -1]
    assert np.abs(dynamics.flow(w, s, 60.0).w - truth).max() < 1e-9


def test_many_instants_are_the_steps_between_them() -> None:
    x, _ = some_state(4, rate=0.3)
    times = np.array([0.0, 0.4, 0.4, 7.0, 3.0, 31.0, -5.0])
    seen = rotation_history(x, times)
    for k, t in enumerate(times):
        step = dynamics.flow(x.w_b, x.sigma, t)
        Phi = dynamics.transition(step, x.sigma, t)
        assert np.abs(seen.w[k] - step.w).max() < 1e-12
        assert (
            np.abs(
                geometry.matrix(seen.q[k]) - geometry.matrix(dynamics.advance(x, step, t).q_ab)
            ).max()
            < 1e-12
        )
        assert np.abs(seen.S[k] - Phi[:6, [0, 1, 2, 3, 4, 5, 12, 13]]).max() < 1e-10


def test_a_path_is_the_same_motion_in_any_order() -> None:
    x, _ = some_state(4, rate=0.3)
    times = np.array([80.0, 0.0, -3.0, 12.3, 79.9, 1e-9, 200.0, 12.3])
    q, w = rotation_path(x).at(times)
    for k, t in enumerate(times):
        there = after(x, t)
        assert np.abs(w[k] - there.w_b).max() < 1e-11
        assert np.abs(geometry.matrix(q[k]) - geometry.matrix(there.q_ab)).max() < 1e-11
    path = rotation_path(x)
    again = [path.at(np.array([t])) for t in times[::-1]][::-1]
    assert np.array_equal(q, [one[0] for one, _ in again])
    assert np.array_equal(w, [one[0] for _, one in again])


def test_a_path_of_a_body_at_rest_stays_in_one_place() -> None:
    x = State(
        [0, 0, 0, 1.0],
        np.zeros(3),
        np.zeros(3),
        np.zeros(3),
        [0.2, -0.4],
        np.zeros(3),
        [0, 0, 0, 1.0],
    )
    q, w = rotation_path(x).at(np.array([0.0, 1e9, -5.0]))
    assert np.array_equal(q, np.tile(x.q_ab, (3, 1)))
    assert not w.any()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e12])
def test_a_rate_that_is_not_finite_or_too_large_is_refused(bad: float) -> None:
    x, _ = some_state(1)
    with pytest.raises(ValueError, match="finite"):
        dynamics.flow(x.w_b, x.sigma, bad)
    with pytest.raises(ValueError, match="finite"):
        rotation_path(x).at(np.array([0.0, bad]))
    with pytest.raises(ValueError, match="finite"):
        dynamics.flow(np.array([0.1, bad, 0.0]), x.sigma, 1.0)
    with pytest.raises(ValueError, match="finite"):
        rotation_history(x, np.array([0.0, 1.0, bad]))


@pytest.mark.parametrize("ratio", [1.0001, -1e4, np.nan, np.inf])
def test_an_inertia_ratio_that_no_body_has_is_refused(ratio: float) -> None:
    """Beyond -1 to 1 the principal moments break the triangle inequality, and the rate grows
    without bound.
    """
    x, _ = some_state(1)
    sigma = np.array([0.1, ratio])
    impossible = replace(x, sigma=sigma)
    for call in (
        lambda: dynamics.flow(x.w_b, sigma, 0.1),
        lambda: rotation_path(impossible).at(np.array([0.1])),
        lambda: rotation_history(impossible, np.array([0.1])),
    ):
        with pytest.raises(ValueError, match="an inertia ratio must be between -1 and 1"):
            call()


def test_a_forecast_of_a_rate_that_is_too_large_is_infinite() -> None:
    x = replace(some_state(1)[0], w_b=np.array([1e6, 0.0, 1.0]))
    seen = dynamics.grasp_forecast(Belief(0, x, np.eye(20)), np.array([1.0, 30.0]), 1e-4, 1e-4)
    assert np.all(np.isinf([seen.pos_1s_m, seen.vel_1s_mps, seen.rot_1s_rad]))
    with pytest.raises(ValueError, match="ascend"):
        dynamics.grasp_forecast(Belief(0, x, np.eye(20)), np.array([3.0, 1.0]), 0.0, 0.0)


def test_process_noise_does_not_change_the_mean_motion() -> None:
    x, _ = some_state(8)
    ratios, times = dynamics.ratios(x.sigma), np.array([0.3, 9.0, 30.0])
    noisy = _motion.follow(x.q_ab, x.w_b, ratios, dynamics.torque_density(x.sigma, 1e-3), times)
    calm = _motion.follow(x.q_ab, x.w_b, ratios, CALM, times)
    assert all(np.abs(a - b).max() < 1e-10 for a, b in zip(noisy[:3], calm[:3], strict=True))
    assert not calm[3].any()
    assert np.linalg.eigvalsh(noisy[3]).min() > 0.0
