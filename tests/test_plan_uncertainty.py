"""Plans over a belief: moments known in closed form, quantiles and probabilities."""

import math

import numpy as np
import pytest

from avsreplay.geometry import exp, multiply
from avsreplay.plan.limits import Scene
from avsreplay.plan.path import path_of
from avsreplay.plan.rendezvous import PlanParams, rendezvous
from avsreplay.plan.uncertainty import Tolerance, draws, spread

ORIGIN = np.zeros(3)
PARAMS = PlanParams()


def fixed(point):
    return lambda t: (np.tile(point, (len(t), 1)), np.zeros((len(t), 3)))


def scene(point, q=None):
    return Scene(fixed(point), (q is not None and (lambda t: np.tile(q, (len(t), 1)))) or None)


def planner(params):
    return lambda scene: rendezvous(scene.goal, ORIGIN, ORIGIN, params).t_go_s


def plan():
    return path_of(rendezvous(fixed([4.0, 0, 0]), ORIGIN, ORIGIN, PARAMS), ORIGIN, ORIGIN)


def covariance(rng, n=20):
    A = rng.normal(size=(n, n))
    scale = 10.0 ** rng.uniform(-6, 0, n)
    return scale[:, None] * (A @ A.T + 0.1 * np.eye(n)) * scale


def test_draws_have_the_covariance_asked_for():
    rng = np.random.default_rng(2)
    P = covariance(rng, 6)
    got = draws(P, 20_000, rng)
    scale = np.sqrt(np.diag(P))
    difference = ((got.T @ got) / len(got) - P) / np.outer(scale, scale)
    assert np.abs(difference).max() < 5.0 * math.sqrt(2.0 / 20_000)


def test_a_singular_covariance_is_accepted_and_a_negative_one_refused():
    rng = np.random.default_rng(0)
    flat = np.diag([1.0, 0.0, 2.0])
    assert np.all(draws(flat, 10, rng)[:, 1] == 0.0)
    with pytest.raises(ValueError, match="covariance is not positive"):
        draws(np.array([[1.0, 2.0], [2.0, 1.0]]), 1, rng)
    with pytest.raises(ValueError, match="finite square"):
        draws(np.full((2, 2), math.nan), 1, rng)
    with pytest.raises(ValueError, match="count is 0"):
        draws(flat, 0, rng)


def test_a_certain_future_gives_no_spread():
    found = spread(plan(), [scene([4.0, 0, 0])] * 5, planner(PARAMS), Tolerance())
    assert found.probability == 1.0
    assert found.miss_m.p95 < 1e-9
    assert found.t_go_s.std == pytest.approx(0.0, abs=1e-12)
    assert found.t_go_s.mean == pytest.approx(2 * math.sqrt(4 / 0.05))
    assert math.isnan(found.angle_deg.mean)


def test_miss_and_probability_follow_the_rayleigh_distribution():
    rng = np.random.default_rng(3)
    sigma, count = 0.01, 1000
    futures = [scene([4.0, *(sigma * z)]) for z in rng.standard_normal((count, 2))]
    quick = PlanParams(grid_s=5.0)
    found = spread(plan(), futures, planner(quick), Tolerance(position_m=0.02))
    expected = 1.0 - math.exp(-0.5 * 2.0**2)  # Rayleigh
    assert found.probability == pytest.approx(
        expected, abs=4 * math.sqrt(expected * (1 - expected) / count)
    )
    assert found.miss_m.mean == pytest.approx(sigma * math.sqrt(math.pi / 2), rel=0.05)
    assert found.miss_m.p95 == pytest.approx(sigma * math.sqrt(-2 * math.log(0.05)), rel=0.06)


def test_end_time_spreads_as_its_slope_says():
    base, slope = 4.0, 1.0 / math.sqrt(4.0 * 0.05)  # t = 2 sqrt(x/a), dt/dx
    futures = [scene([base + d, 0, 0]) for d in (-0.05, 0.05)]
    found = spread(plan(), futures, planner(PARAMS), Tolerance())
    assert found.t_go_s.std == pytest.approx(0.05 * slope, rel=1e-3)
    assert found.probability == 0.0


def test_the_attitude_error_counts():
    q = exp([0.1, 0.2, 0.3])
    off = multiply(q, exp([0.0, math.radians(3.0), 0.0]))
    futures = [scene([4.0, 0, 0], q), scene([4.0, 0, 0], off)]
    found = spread(plan(), futures, planner(PARAMS), Tolerance(angle_deg=2.0), q)
    assert found.probability == 0.5
    assert found.angle_deg.mean == pytest.approx(1.5, abs=1e-6)


def test_a_future_out_of_reach_is_counted():
    away = scene([900.0, 0, 0])
    found = spread(plan(), [away, scene([4.0, 0, 0])], planner(PARAMS), Tolerance())
    assert found.infeasible == 1
    assert found.probability == 0.5
    with pytest.raises(ValueError, match="no future"):
        spread(plan(), [], planner(PARAMS), Tolerance())
