"""Measurement model and update: signs and units against finite differences, the kernel
against numpy.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tumbling
from click.testing import CliRunner
from scipy.stats import chi2, f, wishart
from state_errors import boxminus, permute_covariance

from avsreplay import geometry
from avsreplay.estimate import _motion, measurement
from avsreplay.estimate.chart import (
    AXIS_PERMUTATIONS,
    permute_axes,
    to_chart,
    to_errors,
    to_state,
)
from avsreplay.estimate.dynamics import grasp_jacobian, sigma3, sigma_join
from avsreplay.estimate.error_state import boxplus
from avsreplay.estimate.measurement import (
    BLOCKS_OF,
    chart_update,
    gain,
    in_fixture,
    innovation_of,
    innovation_vector,
    joseph,
    measured_pose,
    measurement_jacobian,
    prior_1s,
    registration_noise,
    residual,
    step_of_sets,
)
from avsreplay.estimate.pose_noise import scaled_R
from avsreplay.geometry import Pose
from avsreplay.monitor.gramian import gramian, measure, observe, weakest
from avsreplay.records import Alignment, AlignStatus, Belief, Innovation, State


@pytest.fixture(params=range(3))
def x(request: pytest.FixtureRequest) -> State:
    return tumbling.draw(request.param, mu_deg=60.0, varrho=1.0, seconds=1.0).states[0]


def test_boxplus_and_boxminus_are_inverse(x: State) -> None:
    d = np.random.Generator(np.random.PCG64(0)).normal(size=20) * 0.2
    assert np.abs(boxminus(boxplus(x, d), x) - d).max() < 1e-14


def test_the_error_is_on_the_side_that_the_paper_uses(x: State) -> None:
    d = np.zeros(20)
    d[:3], d[17:] = [0.1, 0.2, -0.1], [0.05, 0.0, 0.1]
    y = boxplus(x, d)
    dq, dmu = (np.append(v, np.sqrt(1 - v @ v)) for v in (d[:3], d[17:]))
    assert np.allclose(
        geometry.matrix(y.q_ab), geometry.matrix(x.q_ab) @ geometry.matrix(dq)
    )  # q = dq (x) q_hat
    assert np.allclose(
        geometry.matrix(y.q_bc), geometry.matrix(dmu) @ geometry.matrix(x.q_bc)
    )  # mu = mu_hat (x) dmu


def test_perfect_pose_has_no_innovation(x: State) -> None:
    assert np.abs(innovation_vector(x, x.T_ac)).max() < 1e-15


def test_sensitivity_is_the_derivative(x: State) -> None:
    H, eps = measurement_jacobian(x), 1e-6
    for k in range(20):
        d = np.zeros(20)
        d[k] = eps
        column = (
            innovation_vector(x, boxplus(x, d).T_ac) - innovation_vector(x, boxplus(x, -d).T_ac)
        ) / (2 * eps)
        assert np.abs(column - H[:, k]).max() < 1e-9, k


def test_measured_pose_inverts_the_innovation(x: State) -> None:
    pose = x.T_ac @ Pose(geometry.exp([0.5, -1.2, 0.3]), np.array([0.1, 0.2, 0.3]))
    back = measured_pose(x, innovation_vector(x, pose))
    assert np.abs(back.matrix - pose.matrix).max() < 1e-14


def test_half_angle_noise(x: State) -> None:
    one_degree = np.radians(1.0)
    C = np.diag([one_degree**2] * 3 + [0.01**2] * 3)
    R = registration_noise(
        Alignment(x.T_ac, 1, True, 9, 9, 0.0, np.linalg.inv(C), AlignStatus.ALIGNED, C),
        x,
        (1.0, 1.0),
    )
    assert np.sqrt(np.diag(R)) == pytest.approx(np.repeat([0.01, one_degree / 2], 3))


def test_noise_is_the_spread_of_innovations(x: State) -> None:
    rng = np.random.Generator(np.random.PCG64(2))
    root = np.linalg.qr(rng.normal(size=(6, 6)))[0] * np.geomspace(1e-4, 3e-3, 6)
    C = root @ root.T
    d = rng.normal(size=(4000, 6)) @ root.T
    noises = [
        innovation_vector(x, x.T_ac @ Pose(geometry.exp(-e[:3]), -e[3:])) for e in d
    ]  # T_true = T_meas Exp(d)
    R = registration_noise(
        Alignment(x.T_ac, 1, True, 9, 9, 0.0, np.linalg.inv(C), AlignStatus.ALIGNED, C),
        x,
        (1.0, 1.0),
    )
    white = np.linalg.solve(np.linalg.cholesky(R), np.transpose(noises))
    assert np.abs(white @ white.T / 4000 - np.eye(6)).max() < 0.1


def test_a_free_direction_is_not_measured(x: State) -> None:
    info = np.diag([1e6, 1e6, 1e6, 0.0, 1e6, 1e6])
    R = registration_noise(
        Alignment(x.T_ac, 1, True, 9, 9, 0.0, info, AlignStatus.DEGENERATE), x, (1.0, 4.0)
    )
    free = x.T_ac.R[:, 0]
    assert free @ R[:3, :3] @ free == pytest.approx(16.0)
    assert np.linalg.eigvalsh(R[:3, :3])[1] < 1.1e-6
    blind = Alignment(x.T_ac, 1, True, 9, 9, 0.0, np.zeros((6, 6)), AlignStatus.DEGENERATE)
    assert registration_noise(blind, x, (1.0, 4.0)) is None


def test_grasp_rows_are_the_derivative(x: State) -> None:
    J, eps = grasp_jacobian(geometry.matrix(x.q_ab)[None], x.w_b[None], x.c_b)[0], 1e-6

    def seen(y: State) -> np.ndarray:
        turn = geometry.multiply(
            geometry.multiply(geometry.conjugate(x.q_ab), y.T_ac.q), geometry.conjugate(x.q_bc)
        )
        return np.concatenate([y.T_ac.t, y.fixture_velocity, geometry.normalise(turn)[:3]])

    for k in range(20):
        d = np.zeros(20)
        d[k] = eps
        assert (
            np.abs((seen(boxplus(x, d)) - seen(boxplus(x, -d))) / (2 * eps) - J[:, k]).max() < 1e-9
        ), k


def test_residual_is_the_innovation_at_the_posterior(x: State) -> None:
    pose = x.T_ac @ Pose(geometry.exp([0.02, -0.05, 0.01]), np.array([0.1, 0.2, 0.3]))
    posterior = boxplus(x, np.linspace(-0.02, 0.03, 20))
    assert (
        np.abs(
            residual(posterior, x, innovation_vector(x, pose)) - innovation_vector(posterior, pose)
        ).max()
        < 1e-14
    )


def test_an_information_matrix_that_is_numerically_singular_gives_a_finite_covariance(monkeypatch):
    def singular(_):
        raise np.linalg.LinAlgError

    x = some_state(4)
    v = np.array([1.0, -1.0, 0.5, 2.0, 0.0, 1.0])
    info = 1e20 * np.outer(v, v)  # the a-priori deviations of 1e6 are lost in rounding
    seen = Alignment(x.T_ac, 1, True, 99, 99, 0.0, info, AlignStatus.DEGENERATE)
    monkeypatch.setattr(np.linalg, "inv", singular)
    R = registration_noise(seen, x, (1e6, 1e6))
    assert R is not None
    covariance = in_fixture(R, x.T_ac.q, x.q_bc)
    assert np.isfinite(covariance).all()
    assert v @ covariance @ v / (v @ v) == pytest.approx(1e-20 / (v @ v), rel=1e-2)
    unobservable = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    assert unobservable @ covariance @ unobservable > 1e12 * (v @ covariance @ v)


LEAST_GAP = 1e-4  # of kernel/small.hpp
WHITE = np.ones(2)


def some_state(seed: int) -> State:
    return tumbling.draw(seed, mu_deg=170.0, varrho=1.0, seconds=1.0).states[0]


def of_eigenvalues(x: State, m: tuple[float, float, float]) -> State:
    """The state with the inertia whose M has these eigenvalues."""
    return replace(x, sigma=np.tanh([0.5 * (m[2] - m[1]), 0.5 * (m[0] - m[2])]))


def retract(x: State, P: np.ndarray, d: np.ndarray) -> tuple[State, np.ndarray]:
    """The oracle: the state displaced by the error d, and P about it, by the chart as the fit
    has it.
    """
    here = to_chart(x)
    T = to_errors(here)
    there = here.moved(np.linalg.solve(T, d))
    carry = np.linalg.solve(T.T, to_errors(there).T).T
    return to_state(there), carry @ P @ carry.T


def spread_of(x: State, rng: np.random.Generator) -> np.ndarray:
    """A covariance no direction of which is alone, ratios within what they may be."""
    sizes = np.repeat([0.1, 0.02, 0.1, 0.01, 0.1, 0.1, 0.1], [3, 3, 3, 3, 2, 3, 3])
    sizes[12:14] *= 1.0 - x.sigma**2
    root = rng.normal(size=(20, 20)) * sizes[:, None]
    return root @ root.T


def aimed(
    x: State, size: float, rng: np.random.Generator, colour: np.ndarray = WHITE
) -> tuple[float, float]:
    """How far extension and oracle differ after a step of a given size: in the mean, and in P
    by its sigmas.
    """
    P, R = spread_of(x, rng), np.diag(rng.uniform(1.0, 2.0, 6)) * 1e-4
    H, S, alpha = measurement_jacobian(x), np.eye(6), np.eye(6)[0]
    H[0] = rng.normal(size=20)
    H[0] *= size / max(1e-300, np.abs(P @ H[0])[[0, 1, 2, 6, 7, 8, 14, 15, 16, 17, 18, 19]].max())
    wide = scaled_R(R, np.sqrt(colour))
    K = gain(P, H, S + (wide - R))
    want, P_want = retract(x, joseph(P, H, K, wide), K @ alpha)
    got = chart_update(Belief(0, x, P), H, Innovation(alpha, S, R, 0.0, 0.0, 0.0, 0.0), colour)
    assert np.array_equal(got.P, got.P.T)
    s = np.sqrt(np.diag(P_want))
    signs = max(np.abs(got.x.q_ab - want.q_ab).max(), np.abs(got.x.q_bc - want.q_bc).max())
    return max(signs, np.abs(boxminus(got.x, want)).max()), np.abs(
        (got.P - P_want) / np.outer(s, s)
    ).max()


@pytest.mark.parametrize("size", [0.0, 1e-6, 1e-3, 0.1, 0.5])
@pytest.mark.parametrize("seed", range(12))
def test_update_agrees_with_the_chart(seed: int, size: float) -> None:
    x, rng = some_state(seed), np.random.Generator(np.random.PCG64([seed, 1]))
    mean, covariance = aimed(x, size, rng, rng.uniform(1.0, 9.0, 2))
    assert mean < 1e-12
    assert covariance < 1e-10


@pytest.mark.parametrize(
    "gaps", [(1e-6, 1.0), (1.0, 1e-6), (1e-6, 2e-6), (0.3, 0.4), (0.3, 1e4), (1e4, 3.0)]
)
@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1), (1, 0, 2)])
def test_update_where_moments_are_nearly_equal(
    gaps: tuple[float, float], order: tuple[int, int, int]
) -> None:
    """Gaps in units of the least one, down to where rounding still tells which is the smaller."""
    m = np.cumsum([0.0, *gaps]) * LEAST_GAP
    x = of_eigenvalues(some_state(3), tuple((m - m.mean())[list(order)]))
    for k in range(8):
        mean, covariance = aimed(x, 0.02, np.random.Generator(np.random.PCG64([k, 2])))
        assert mean < 1e-12
        assert covariance < 1e-9


@pytest.mark.parametrize("m", [(0.0, 0.0, 0.0), (1.0, 1.0, -2.0), (0.1, -0.2, 0.1)])
def test_update_of_a_body_with_equal_moments_is_that_of_nearly_the_same_body(
    m: tuple[float, float, float],
) -> None:
    """Between equals rounding puts the hair on either side; the motion and M agree to the hair."""
    x, rng = of_eigenvalues(some_state(3), m), np.random.Generator(np.random.PCG64(5))
    P, R = spread_of(x, rng), np.eye(6) * 1e-3
    H = measurement_jacobian(x)
    seen = innovation_of(P, H, rng.normal(size=6) * 0.02, R)
    K = gain(P, H, seen.S)
    want, _ = retract(x, joseph(P, H, K, R), K @ seen.alpha)
    got = chart_update(Belief(0, x, P), H, seen, WHITE)
    assert np.abs(to_chart(got.x).minus(to_chart(want))).max() < 3.0 * LEAST_GAP
    assert np.all(np.linalg.eigvalsh(got.P) > 0.0)


@pytest.mark.parametrize(
    "sigma", [(0.9999, 0.3), (-0.9999, 0.3), (0.2, 0.9999), (0.2, -0.9999), (0.999, -0.9999)]
)
def test_update_of_slender_and_flat_bodies(sigma: tuple[float, float]) -> None:
    x = replace(some_state(5), sigma=np.array(sigma))
    for k in range(8):
        mean, covariance = aimed(x, 0.1, np.random.Generator(np.random.PCG64([k, 3])))
        assert mean < 1e-11
        assert covariance < 1e-9


@pytest.mark.parametrize("seed", range(12))
def test_steps_beyond_a_half_turn_and_new_names(seed: int) -> None:
    """A half angle over 1 is cut to a half turn; inertia that turns far takes the nearest of
    the 24 names.
    """
    mean, covariance = aimed(some_state(seed), 2.0, np.random.Generator(np.random.PCG64([seed, 4])))
    assert mean < 1e-11
    assert covariance < 1e-9


@pytest.mark.parametrize("naming", AXIS_PERMUTATIONS[1::3])
def test_the_order_of_axes_does_not_matter(naming) -> None:
    """The same body by other names gets the same update: no oracle."""
    x, rng = some_state(7), np.random.Generator(np.random.PCG64(8))
    P, R = spread_of(x, rng), np.eye(6) * 1e-4
    y, P_y = permute_axes(x, naming), permute_covariance(P, x, naming)
    told = []
    alpha = rng.normal(size=6) * 0.05
    renamed = np.concatenate([alpha[:3], naming.R_bn.T @ alpha[3:]])
    for state, covariance, seen_as in ((x, P, alpha), (y, P_y, renamed)):
        H = measurement_jacobian(state)
        seen = innovation_of(covariance, H, seen_as, R)
        told.append(chart_update(Belief(0, state, covariance), H, seen, WHITE))
    a, b = told
    assert np.abs(to_chart(a.x).minus(to_chart(b.x))).max() < 1e-12
    J = [np.linalg.inv(to_errors(to_chart(belief.x))) for belief in (a, b)]
    A, B = J[0] @ a.P @ J[0].T, J[1] @ b.P @ J[1].T
    assert np.abs(A - B).max() < 1e-10 * np.abs(A).max()


def test_values_that_are_not_numbers_terminate() -> None:
    x, rng = some_state(1), np.random.Generator(np.random.PCG64(0))
    P, H, S = spread_of(x, rng), measurement_jacobian(x), np.eye(6)
    bad = replace(x, w_b=np.array([np.nan, 0.0, 0.0]))
    for state, covariance, alpha in (
        (bad, P, np.ones(6)),
        (x, P * np.nan, np.ones(6)),
        (x, P, np.ones(6) * np.inf),
    ):
        got = chart_update(
            Belief(0, state, covariance), H, Innovation(alpha, S, S, 0.0, 0.0, 0.0, 0.0), WHITE
        )
        assert not np.all(np.isfinite(got.P))
    with pytest.raises(ValueError, match="an inertia ratio must be between -1 and 1"):
        chart_update(
            Belief(0, replace(x, sigma=np.array([np.nan, 1.0])), P),
            H,
            Innovation(np.ones(6), S, S, 0.0, 0.0, 0.0, 0.0),
            WHITE,
        )
    with pytest.raises(TypeError):
        _motion.correct(x.flat, P, H[:5], np.ones(6), S, S, (1.0, 1.0))


def test_an_innovation_covariance_is_definite_also_where_rounding_has_spoilt_the_prior() -> None:
    x, rng = some_state(3), np.random.default_rng(2)
    H = measurement_jacobian(x)
    R = np.diag([1e-8, 1e-8, 1e-8, 1e-10, 1e-10, 1e-10])
    root = rng.normal(size=(20, 20))
    P = root @ root.T
    spoilt = root[:, :3] @ root[:, :3].T - 1e-6 * np.eye(
        20
    )  # rounding errors of large variances exceed R
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(H @ spoilt @ H.T + R)
    found = innovation_of(spoilt, H, np.full(6, 1e-3), R)
    np.linalg.cholesky(found.S)
    assert found.nis >= 0.0
    good = innovation_of(P, H, np.full(6, 1e-3), R)
    expected = H @ P @ H.T + R
    np.testing.assert_allclose(good.S, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_array_equal(good.S, good.S.T)


def test_the_innovation_and_its_covariances_are_those_of_general_linear_algebra() -> None:
    rng = np.random.default_rng(11)
    for trial in range(20):
        x, H = some_state(trial), rng.normal(size=(6, 20))
        P, R, part = (
            a @ a.T * 10.0 ** rng.uniform(-6, 6)
            for a in (rng.normal(size=(n, n)) for n in (20, 6, 6))
        )
        e = rng.normal(size=6)
        S, definite, nis = _motion.innovation(P, H, e, R)
        expected = H @ P @ H.T + R
        np.testing.assert_allclose(S, expected, atol=1e-13 * np.abs(expected).max())
        assert definite
        assert nis == pytest.approx(float(e @ np.linalg.inv(expected) @ e), rel=1e-6)
        np.testing.assert_allclose(
            _motion.pose_covariance(P, H), H @ P @ H.T, atol=1e-13 * np.abs(H @ P @ H.T).max()
        )
        B = np.linalg.inv(R) @ part
        assert _motion.trace_of_ratio(part, R) == pytest.approx(np.trace(B), rel=1e-6)
        assert _motion.squared_traces(part, R) == pytest.approx(
            np.trace(B @ B) + np.trace(B) ** 2, rel=1e-6
        )
        squares, known = _motion.block_squares(R, e, part)
        away = np.hstack([np.eye(3), -R[:3, 3:] @ np.linalg.inv(R[3:, 3:])])  # given the attitude
        for k, block in enumerate((away, np.eye(6)[3:])):
            info = np.linalg.inv(block @ R @ block.T)
            left = block @ e
            assert squares[k] == pytest.approx(float(left @ info @ left), rel=1e-6)
            C = block @ part @ block.T
            assert known[k] == pytest.approx(float(np.trace(info @ C)), rel=1e-6)
        values, axes = np.linalg.eigh(R)
        assert _motion.definite(R)
        assert not _motion.definite(R - 1.001 * values[0] * np.outer(axes[:, 0], axes[:, 0]))
        assert not _motion.definite(np.full((6, 6), np.nan))
        H = _motion.pose_jacobian(x.flat)
        for d in np.eye(20):
            there = boxplus(x, 1e-7 * d).T_ac
            np.testing.assert_allclose(innovation_vector(x, there) / 1e-7, H @ d, atol=1e-5)


@pytest.mark.parametrize("dof", [40.0, 120.0])
def test_the_gate_on_an_estimated_noise_is_that_of_hotelling(dof: float) -> None:
    """With R drawn from Wishart's distribution and P zero, NIS is T^2, whose law is an F
    distribution.
    """
    rng, H, n = np.random.default_rng(6), np.zeros((6, 20)), 2000
    noise = wishart(dof, np.eye(6) / dof).rvs(n, random_state=rng)
    alphas = np.clip(0.01 * rng.normal(size=(n, 6)), -1.0, 1.0)
    none = np.zeros((20, 20))
    seen = [
        innovation_of(none, H, a, 1e-4 * R, True, 0.0, dof)
        for a, R in zip(alphas, noise, strict=True)
    ]
    exact = f.sf([s.nis * (dof - 5.0) / (6.0 * dof) for s in seen], 6, dof - 5.0)
    converted = np.array([s.chi2 for s in seen])
    for probability in (0.05, 0.01):
        rate = np.mean(converted > chi2.isf(probability, 6))
        assert rate == pytest.approx(np.mean(exact < probability), rel=0.05, abs=1e-9)
        assert rate == pytest.approx(probability, abs=3.0 * np.sqrt(probability / n))
        assert np.mean(
            [s.nis > chi2.isf(probability, 6) for s in seen]
        ) > probability + 3.0 * np.sqrt(probability / n)


def test_the_weight_of_a_pose_begins_at_the_gate_of_its_degrees_of_freedom() -> None:
    """A pose at twice the 99.99 % point of T^2 has half the weight; a known noise has the
    point of chi-square.
    """
    H, R = np.zeros((6, 20)), np.eye(6)
    for dof, point in ((50.0, 6.0 * 50.0 / 45.0 * f.isf(1e-4, 6, 45)), (np.inf, chi2.isf(1e-4, 6))):
        alpha = np.array([np.sqrt(2.0 * point), 0.0, 0.0, 0.0, 0.0, 0.0])
        assert innovation_of(
            np.zeros((20, 20)), H, alpha, R, True, 0.0, dof
        ).weight == pytest.approx(0.5, rel=0.01)
        assert innovation_of(np.zeros((20, 20)), H, 0.69 * alpha, R, True, 0.0, dof).weight == 1.0


def test_a_noise_that_is_a_small_part_of_the_innovation_counts_as_known() -> None:
    """The variance of z' S z, with S the sum of a known part and of a Wishart matrix, by
    simulation.
    """
    rng, dof = np.random.default_rng(7), 15.0
    R, known = np.diag([1.0, 2.0, 0.5, 1.0, 1.0, 1.0]), np.diag([9.0, 4.0, 2.0, 1.0, 0.0, 3.0])
    root = np.diag(np.diagonal(R + known) ** -0.5)
    draws = root @ (wishart(dof, R / dof).rvs(20000, random_state=rng) + known) @ root
    squared = np.mean(np.sum((draws - np.eye(6)) ** 2, axis=(1, 2)))
    assert measurement.dof_of_sum(dof, R, R + known) == pytest.approx(42.0 / squared, rel=0.05)
    assert measurement.dof_of_sum(np.inf, R, R + known) == np.inf


LOG = Path(__file__).parent.parent / "fixtures" / "tumble.mcap"


def test_three_ratios_join_to_the_two_state_step() -> None:
    x = tumbling.draw(2, seconds=1.0).states[0]
    _, sets = step_of_sets(x, 0.7)
    join = np.zeros((21, 20))
    join[:12, :12] = np.eye(12)
    join[12:15, 12:14] = sigma_join(x.sigma)
    join[15:, 14:] = np.eye(6)
    two, three = sets["two"], sets["three"]
    assert np.abs(three[0] @ join - join @ two[0]).max() < 1e-12
    assert np.abs(three[1] @ join - two[1]).max() < 1e-15


def test_each_ratio_moves_the_motion_as_its_column_says() -> None:
    """A free sigma3 is no body; its column is the derivative of Euler's equations all the same."""
    x = tumbling.draw(2, seconds=1.0).states[0]
    Phi = step_of_sets(x, 0.01)[1]["three"][0]
    w, h = x.w_b, 0.01
    want = np.diag([w[1] * w[2], w[0] * w[2], w[0] * w[1]]) * h
    assert np.abs(Phi[3:6, 12:15] - want).max() < 2e-3 * np.abs(want).max() + 1e-8
    assert abs(sigma3(x.sigma)) < 1.0


def test_knowing_more_never_makes_it_worse() -> None:
    world = tumbling.draw(4, seconds=60.0)
    x = world.states[0]
    scales = prior_1s(np.full(20, 0.1), x.sigma)
    folds = {name: gramian(scale) for name, scale in scales.items()}
    for h in np.diff(world.times, prepend=0.0):
        x, steps = step_of_sets(x, float(h))
        folds = {name: observe(folds[name], *steps[name], 1e-24 * np.eye(6)) for name in folds}
    found = {name: measure(fold) for name, fold in folds.items()}
    assert {name: (f.rank, f.size) for name, f in found.items()} == {
        "two": (20, 20),
        "three": (21, 21),
        "known": (12, 12),
    }
    raw = {name: f.log10_cond for name, f in found.items()}
    assert raw["known"] < raw["two"] <= raw["three"] + 1e-9
    for name, fold in folds.items():
        assert len(weakest(fold, 2, BLOCKS_OF[name])) == 2


@pytest.mark.slow
@pytest.mark.skipif(not LOG.exists(), reason="fixtures/tumble.mcap is not here")
def test_the_command_prints_one_document() -> None:
    from avsreplay.cli.observability import observability_command

    done = CliRunner().invoke(observability_command, [str(LOG), "--json", "--marks", "3"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert len(found["lines"]) == 3
    assert found["lines"][-1]["two"]["of"] == 20
    assert set(found["weakest"]) == {"two", "three", "known"}
    keys = set(
        found["lines"][-1]["two"]
    )  # the Gramian of the rows is another one, which has other names
    assert keys == {
        "rank_fitted_motion",
        "of",
        "log10_cond_fitted_motion",
        "log10_cond_scaled_fitted_motion",
    }
