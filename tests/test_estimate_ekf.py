"""The extension's update through the chart and its pass over many rows, against the same in the chart's own words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tumbling

from avsreplay.estimate import _motion, ekf
from avsreplay.estimate.chart import (
    AXIS_PERMUTATIONS,
    permute_axes,
    permute_covariance,
    to_chart,
    to_errors,
    to_state,
)
from avsreplay.estimate.error_state import boxminus
from avsreplay.estimate.measurement import measurement_jacobian
from avsreplay.records import Belief, Innovation, State

LEAST_GAP = 1e-4  # of kernel/small.hpp
WHITE = np.ones(2)


def some_state(seed: int) -> State:
    return tumbling.draw(seed, mu_deg=170.0, varrho=1.0, seconds=1.0).states[0]


def of_eigenvalues(x: State, m: tuple[float, float, float]) -> State:
    """The state with the inertia whose M has these eigenvalues."""
    return replace(x, sigma=np.tanh([0.5 * (m[2] - m[1]), 0.5 * (m[0] - m[2])]))


def retract(x: State, P: np.ndarray, d: np.ndarray) -> tuple[State, np.ndarray]:
    """The oracle: the state displaced by the error d, and P about it, by the chart as the fit has it."""
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


def aimed(x: State, size: float, rng: np.random.Generator, colour: np.ndarray = WHITE) -> tuple[float, float]:
    """How far extension and oracle differ after a step of a given size: in the mean, and in P by its sigmas."""
    P, R = spread_of(x, rng), np.diag(rng.uniform(1.0, 2.0, 6)) * 1e-4
    H, S, alpha = measurement_jacobian(x), np.eye(6), np.eye(6)[0]
    H[0] = rng.normal(size=20)
    H[0] *= size / max(1e-300, np.abs(P @ H[0])[[0, 1, 2, 6, 7, 8, 14, 15, 16, 17, 18, 19]].max())
    wide = ekf.inflated(R, colour)
    K = ekf.gain(P, H, S + (wide - R))
    want, P_want = retract(x, ekf.joseph(P, H, K, wide), K @ alpha)
    got = ekf.chart_update(Belief(0, x, P), H, Innovation(alpha, S, R, 0.0, 0.0, 0.0), colour)
    assert np.array_equal(got.P, got.P.T)
    s = np.sqrt(np.diag(P_want))
    signs = max(np.abs(got.x.q_ab - want.q_ab).max(), np.abs(got.x.q_bc - want.q_bc).max())
    return max(signs, np.abs(boxminus(got.x, want)).max()), np.abs((got.P - P_want) / np.outer(s, s)).max()


@pytest.mark.parametrize("size", [0.0, 1e-6, 1e-3, 0.1, 0.5])
@pytest.mark.parametrize("seed", range(12))
def test_update_agrees_with_the_chart(seed: int, size: float) -> None:
    x, rng = some_state(seed), np.random.Generator(np.random.PCG64([seed, 1]))
    mean, covariance = aimed(x, size, rng, rng.uniform(1.0, 9.0, 2))
    assert mean < 1e-12
    assert covariance < 1e-10


@pytest.mark.parametrize("gaps", [(1e-6, 1.0), (1.0, 1e-6), (1e-6, 2e-6), (0.3, 0.4), (0.3, 1e4), (1e4, 3.0)])
@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1), (1, 0, 2)])
def test_update_where_moments_are_nearly_equal(gaps: tuple[float, float], order: tuple[int, int, int]) -> None:
    """Gaps in units of the least one, down to where rounding still tells which is the smaller."""
    m = np.cumsum([0.0, *gaps]) * LEAST_GAP
    x = of_eigenvalues(some_state(3), tuple((m - m.mean())[list(order)]))
    for k in range(8):
        mean, covariance = aimed(x, 0.02, np.random.Generator(np.random.PCG64([k, 2])))
        assert mean < 1e-12
        assert covariance < 1e-9


@pytest.mark.parametrize("m", [(0.0, 0.0, 0.0), (1.0, 1.0, -2.0), (0.1, -0.2, 0.1)])
def test_update_of_a_body_with_equal_moments_is_that_of_nearly_the_same_body(m: tuple[float, float, float]) -> None:
    """Between equals rounding puts the hair on either side; the motion and M agree to the hair."""
    x, rng = of_eigenvalues(some_state(3), m), np.random.Generator(np.random.PCG64(5))
    P, R = spread_of(x, rng), np.eye(6) * 1e-3
    H = measurement_jacobian(x)
    seen = ekf.innovation_of(P, H, rng.normal(size=6) * 0.02, R)
    K = ekf.gain(P, H, seen.S)
    want, _ = retract(x, ekf.joseph(P, H, K, R), K @ seen.alpha)
    got = ekf.chart_update(Belief(0, x, P), H, seen, WHITE)
    assert np.abs(to_chart(got.x).minus(to_chart(want))).max() < 3.0 * LEAST_GAP
    assert np.all(np.linalg.eigvalsh(got.P) > 0.0)


@pytest.mark.parametrize("sigma", [(0.9999, 0.3), (-0.9999, 0.3), (0.2, 0.9999), (0.2, -0.9999), (0.999, -0.9999)])
def test_update_of_slender_and_flat_bodies(sigma: tuple[float, float]) -> None:
    x = replace(some_state(5), sigma=np.array(sigma))
    for k in range(8):
        mean, covariance = aimed(x, 0.1, np.random.Generator(np.random.PCG64([k, 3])))
        assert mean < 1e-11
        assert covariance < 1e-9


@pytest.mark.parametrize("seed", range(12))
def test_steps_beyond_a_half_turn_and_new_names(seed: int) -> None:
    """A half angle over 1 is cut to a half turn; inertia that turns far takes the nearest of the 24 names."""
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
        seen = ekf.innovation_of(covariance, H, seen_as, R)
        told.append(ekf.chart_update(Belief(0, state, covariance), H, seen, WHITE))
    a, b = told
    assert np.abs(to_chart(a.x).minus(to_chart(b.x))).max() < 1e-12
    J = [np.linalg.inv(to_errors(to_chart(belief.x))) for belief in (a, b)]
    A, B = J[0] @ a.P @ J[0].T, J[1] @ b.P @ J[1].T
    assert np.abs(A - B).max() < 1e-10 * np.abs(A).max()


def test_values_that_are_not_numbers_terminate() -> None:
    x, rng = some_state(1), np.random.Generator(np.random.PCG64(0))
    P, H, S = spread_of(x, rng), measurement_jacobian(x), np.eye(6)
    bad = replace(x, w_b=np.array([np.nan, 0.0, 0.0]), sigma=np.array([np.nan, 1.0]))
    for state, covariance, alpha in ((bad, P, np.ones(6)), (x, P * np.nan, np.ones(6)), (x, P, np.ones(6) * np.inf)):
        got = ekf.chart_update(Belief(0, state, covariance), H, Innovation(alpha, S, S, 0.0, 0.0, 0.0), WHITE)
        assert not np.all(np.isfinite(got.P))
    with pytest.raises(TypeError):
        _motion.correct(x.q_ab, x.w_b, x.r_a, x.v_a, x.sigma, x.c_b, x.q_bc, P, H[:5], np.ones(6), S, S, (1.0, 1.0))


def test_an_innovation_covariance_is_definite_also_where_rounding_has_spoilt_the_prior() -> None:
    x, rng = some_state(3), np.random.default_rng(2)
    H = measurement_jacobian(x)
    R = np.diag([1e-8, 1e-8, 1e-8, 1e-10, 1e-10, 1e-10])
    root = rng.normal(size=(20, 20))
    P = root @ root.T
    spoilt = root[:, :3] @ root[:, :3].T - 1e-6 * np.eye(20)  # rounding errors of large variances exceed R
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(H @ spoilt @ H.T + R)
    found = ekf.innovation_of(spoilt, H, np.full(6, 1e-3), R)
    np.linalg.cholesky(found.S)
    assert found.nis >= 0.0
    good = ekf.innovation_of(P, H, np.full(6, 1e-3), R)
    expected = H @ P @ H.T + R
    np.testing.assert_array_equal(good.S, 0.5 * (expected + expected.T))
