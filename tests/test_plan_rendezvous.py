"""The minimum-time rendezvous: its properties, and solutions computed by other methods."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from avsreplay.estimate.estimator import Estimator
from avsreplay.estimate.params import EstimatorParams
from avsreplay.outcome import PlanStatus
from avsreplay.plan.path import CostatePath, sample_goal
from avsreplay.plan.reachable_set import (
    SMALL_TURN,
    Gauge,
    gauge,
    integrals,
    newton_step,
    support,
)
from avsreplay.plan.rendezvous import Margin, PlanParams, rendezvous
from avsreplay.records import Belief, State

ORIGIN = np.zeros(3)
GAUSS = np.polynomial.legendre.leggauss(200)


def fixed(point, rate=(0.0, 0.0, 0.0)):
    point, rate = np.asarray(point, float), np.asarray(rate, float)
    return lambda t: (point + rate * t[:, None], np.tile(rate, (len(t), 1)))


def tumbling(rng, rate=(0.1, 0.35), arm=1.5):
    """Grasp point of a torque-free body by DOP853: an oracle that shares nothing with the
    package.
    """
    J, w, c = np.sort(rng.uniform(1, 3, 3)), rng.normal(size=3), rng.normal(size=3)
    w *= rng.uniform(*rate) / np.linalg.norm(w)
    c *= arm / np.linalg.norm(c)
    centre, drift = (
        rng.uniform(2, 8) * (d := rng.normal(size=3)) / np.linalg.norm(d),
        0.02 * rng.normal(size=3),
    )

    def flow(_, y):
        q, w = y[:4], y[4:]
        return np.r_[
            0.5 * (q[3] * w + np.cross(q[:3], w)), -0.5 * q[:3] @ w, -np.cross(w, J * w) / J
        ]

    start = np.r_[Rotation.random(random_state=int(rng.integers(1 << 30))).as_quat(), w]
    path = solve_ivp(
        flow, [0, 125], start, method="DOP853", rtol=1e-11, atol=1e-12, dense_output=True
    ).sol

    def goal(t):
        y = path(np.asarray(t)).T
        R = Rotation.from_quat(y[:, :4])
        return centre + drift * t[:, None] + R.apply(c), drift + R.apply(np.cross(y[:, 4:], c))

    return goal


def ratio(goal, r0, v0, a, times):
    """a*(t) / a by the gauge at each time, 1 where thrust just suffices."""
    rho, rate = goal(times)
    out = []
    for t, p, v in zip(times, rho, rate, strict=True):
        dr, dv = p - r0 - v0 * t, v - v0
        out.append(gauge(dr, t * dv - dr).value / (a * t * t))
    return np.array(out)


def graded(P):
    """Nodes and weights over [0, 1], crowded where |P| is least."""
    D = P[2:] - P[:2]
    s0 = min(max(-(P[:2] @ D) / (D @ D), 0.0), 1.0)
    x, w = 0.5 * (GAUSS[0] + 1), 0.5 * GAUSS[1]
    s = np.r_[s0 - s0 * x**5, s0 + (1 - s0) * x**5]
    return s, np.r_[s0 * w * 5 * x**4, (1 - s0) * w * 5 * x**4]


@pytest.mark.parametrize("kind", ["general", "straight", "reversing", "collinear"])
def test_support_gradient_and_hessian_are_those_of_the_integral(kind):
    rng = np.random.default_rng(1)
    for _ in range(20):
        P = rng.normal(size=4)
        if kind == "straight":
            P[2:] = P[:2] * 1.1 + 0.05 * rng.normal(size=2)
        elif kind == "reversing":
            P[2:] = -P[:2] * rng.uniform(0.3, 2) + 0.05 * rng.normal(size=2)
        elif kind == "collinear":
            P[2:] = P[:2] * rng.uniform(0.2, 3)
        h, grad, hess = support(*P)
        s, w = graded(P)
        path = (1 - s)[:, None] * P[:2] + s[:, None] * P[2:]
        r = np.linalg.norm(path, axis=1)
        unit = path / r[:, None]
        assert h == pytest.approx(w @ r, rel=1e-10)
        assert np.allclose(grad, np.r_[(w * (1 - s)) @ unit, (w * s) @ unit], atol=1e-9)
        across = (np.eye(2) - unit[:, :, None] * unit[:, None, :]) / r[:, None, None]
        for i, f in enumerate(((1 - s) ** 2, s * (1 - s), s * s)):
            block = np.einsum("n,nij->ij", w * f, across)
            expected = [block[0, 0], block[0, 1], block[1, 1]]
            assert np.allclose(hess[3 * i : 3 * i + 3], expected, rtol=1e-8, atol=1e-9)


def test_touching_point_lies_on_the_ray_through_the_goal():
    rng = np.random.default_rng(2)
    for k in range(200):
        b0, b1 = rng.normal(size=(2, 3))
        if k % 2:
            b1 = rng.normal() * b0 + 10.0 ** rng.uniform(-14, -1) * rng.normal(size=3)
        found = gauge(b0, b1)
        first, second = integrals(found.P0[None], found.P1[None])
        reached = found.value * np.r_[second[0], first[0] - second[0]]
        assert np.allclose(reached, np.r_[b0, b1], atol=1e-11)


def test_rest_to_rest_is_bang_bang():
    plan = rendezvous(fixed([5.0, 0, 0]), ORIGIN, ORIGIN, PlanParams(a_max_mps2=0.05))
    assert plan.status is PlanStatus.OPTIMAL
    assert plan.t_go_s == pytest.approx(2 * math.sqrt(5 / 0.05), abs=1e-9)


def test_speed_alone_is_matched_along_one_straight_line():
    half = 0.5 * 0.4**2 / 0.05
    goal = fixed(
        [half - 8 * 0.4, 0, 0], [0.4, 0, 0]
    )  # full thrust for 8 s meets it exactly: w is constant
    plan = rendezvous(goal, ORIGIN, ORIGIN, PlanParams(a_max_mps2=0.05))
    assert plan.t_go_s == pytest.approx(8.0, abs=1e-6)


def test_already_there_needs_no_time():
    plan = rendezvous(fixed([1.0, 2.0, 3.0]), np.array([1.0, 2.0, 3.0]), ORIGIN)
    assert plan.t_go_s == 0.0
    assert plan.status is PlanStatus.OPTIMAL


def test_turning_the_whole_scene_turns_the_plan():
    rng = np.random.default_rng(5)
    goal, R = tumbling(rng), Rotation.random(random_state=3)
    one = rendezvous(goal, ORIGIN, ORIGIN)
    two = rendezvous(lambda t: tuple(R.apply(x) for x in goal(t)), ORIGIN, ORIGIN)
    assert two.t_go_s == pytest.approx(one.t_go_s, abs=1e-7)
    assert np.allclose(
        R.apply(np.array(one.costate).reshape(2, 3)), two.costate.reshape(2, 3), atol=1e-6
    )


def test_a_moving_observer_sees_the_same_time():
    goal, drift = tumbling(np.random.default_rng(6)), np.array([0.05, -0.02, 0.03])
    one = rendezvous(goal, ORIGIN, ORIGIN)
    two = rendezvous(lambda t: (goal(t)[0] + drift * t[:, None], goal(t)[1] + drift), ORIGIN, drift)
    assert two.t_go_s == pytest.approx(one.t_go_s, abs=1e-7)


@pytest.mark.parametrize("seed", range(8))
def test_first_feasible_time_of_a_tumbling_goal(seed):
    rng = np.random.default_rng(seed)
    goal, a = tumbling(rng), rng.uniform(0.02, 0.1)
    r0, v0 = 0.5 * rng.normal(size=3), 0.05 * rng.normal(size=3)
    plan = rendezvous(goal, r0, v0, PlanParams(a_max_mps2=a))
    assert plan.status is PlanStatus.OPTIMAL
    assert plan.t_go_s - 1e-9 <= plan.lower_bound_s <= plan.t_go_s
    assert np.all(ratio(goal, r0, v0, a, np.arange(0.05, plan.lower_bound_s, 0.2)) > 1.0)

    def fly(t, y):
        return np.r_[y[3:], flight.thrust(np.array([t]))[0]]

    flight = CostatePath.of(plan, r0, v0)
    end = solve_ivp(
        fly, [0, plan.t_go_s], np.r_[r0, v0], method="DOP853", rtol=1e-12, atol=1e-13
    ).y[:, -1]
    rho, rate = goal(np.array([plan.t_go_s]))
    assert np.linalg.norm(end[:3] - rho[0]) < 1e-8
    assert np.linalg.norm(end[3:] - rate[0]) < 1e-8
    assert plan.u_max == pytest.approx(a, rel=1e-12)


def test_the_seventh_equation_is_an_identity_and_as_printed_is_false():
    rng = np.random.default_rng(9)
    printed = []
    for _ in range(50):
        c, v0, a, end = rng.normal(size=6), rng.normal(size=3), 0.07, rng.uniform(1, 40)
        flight = CostatePath(ORIGIN, v0, a, 0.0, end, c)
        ends = np.array([0.0, end])
        p, (_, v) = np.linalg.norm(flight.p(ends), axis=1), flight.at(ends)
        assert a * (p[0] - p[1]) + c[:3] @ (v[1] - v[0]) == pytest.approx(
            0.0, abs=1e-10 * a * p.max() * end
        )
        printed.append(
            a * (p[0] - p[1])
        )  # with the end met the printed velocity term is zero: this would have to be
    assert np.min(np.abs(printed)) > 1e-4


def test_latency_is_a_coast_and_then_the_same_problem():
    goal = tumbling(np.random.default_rng(7))
    v0 = np.array([0.03, 0.0, -0.02])
    late = rendezvous(goal, ORIGIN, v0, PlanParams(latency_s=2.5))
    same = rendezvous(lambda t: goal(t + 2.5), 2.5 * v0, v0, PlanParams())
    assert late.t_go_s == pytest.approx(same.t_go_s + 2.5, abs=1e-7)
    assert np.all(CostatePath.of(late, ORIGIN, v0).thrust(np.array([0.0, 2.4])) == 0.0)
    assert late.position_error_m < 1e-8


def test_a_goal_that_moves_away_is_infeasible_until_the_stated_time():
    plan = rendezvous(
        lambda t: (0.5 * 0.06 * t[:, None] ** 2 + 1.0 + ORIGIN, 0.06 * t[:, None] + ORIGIN),
        ORIGIN,
        ORIGIN,
    )
    assert plan.status is PlanStatus.INFEASIBLE
    assert plan.lower_bound_s == pytest.approx(120.0)
    assert math.isnan(plan.t_go_s)
    assert not plan.found


@pytest.mark.parametrize(
    "bad",
    [
        {"a_max_mps2": 0.0},
        {"a_max_mps2": math.nan},
        {"horizon_s": 0.0},
        {"latency_s": -1.0},
        {"latency_s": 120.0},
    ],
)
def test_bad_parameters_are_named(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        PlanParams(**bad)


def test_a_state_that_is_not_finite_is_named():
    with pytest.raises(ValueError, match="r0 is"):
        rendezvous(fixed([1.0, 0, 0]), np.array([math.nan, 0, 0]), ORIGIN)
    with pytest.raises(ValueError, match="goal trajectory is not finite"):
        rendezvous(fixed([math.nan, 0, 0]), ORIGIN, ORIGIN)


def test_a_goal_without_relative_acceleration_does_not_divide_by_zero() -> None:
    """With a steep slope and a margin at the limit of rounding, the bound moves by one step of the
    grid.
    """
    goal = sample_goal(
        lambda t: (np.zeros((len(t), 3)),) * 2, np.ones(3), np.zeros(3), 0.0, 0.0, 10.0, 1.0
    )
    found = Gauge(np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), 1.0, 0.0)
    reached = Margin(n0=1.0, n1=1.0, slope=1e8).step(goal, found, 0.0, 1e-12, 1e-6)
    assert 0.0 < reached <= goal.end


def test_the_integrals_of_a_direction_that_hardly_changes_are_exact_to_rounding():
    """Where the closed form loses digits, Gauss-Legendre nodes take its place."""
    rng = np.random.default_rng(3)
    for k in range(200):
        P0, turn = rng.normal(size=3), rng.normal(size=3)
        size = 0.4 * SMALL_TURN * np.linalg.norm(P0) * 10.0 ** -(k % 5)
        P1 = P0 + size * turn / np.linalg.norm(turn)
        once, twice = integrals(P0[None], P1[None])
        s, w = 0.5 * (GAUSS[0] + 1.0), 0.5 * GAUSS[1]
        path = (1.0 - s)[:, None] * P0 + s[:, None] * P1
        unit = path / np.linalg.norm(path, axis=1)[:, None]
        assert np.allclose(once[0], w @ unit, rtol=0.0, atol=2e-15)
        assert np.allclose(twice[0], (w * (1.0 - s)) @ unit, rtol=0.0, atol=2e-15)


@pytest.mark.parametrize("damping", [0.0, 1e-3])
def test_a_newton_step_solves_the_system_of_the_plane(damping):
    """Against a general solver, with the blocks 00, 01 and 11 of the Hessian."""
    for P in np.random.default_rng(8).standard_normal((50, 4)):
        h, gradient, blocks = support(*P)
        b = np.asarray(gradient) / h  # P . b = 1, as h is homogeneous
        b += 0.1 * np.array([P[1], -P[0], P[3], -P[2]])
        xx, xy, yy = np.reshape(blocks, (3, 3)).T
        H = np.block(
            [
                [np.array([[xx[i + j], xy[i + j]], [xy[i + j], yy[i + j]]]) for j in (0, 1)]
                for i in (0, 1)
            ]
        )
        residual = np.asarray(gradient) - h * b
        trace = xx[0] + yy[0] + xx[2] + yy[2]
        step = np.linalg.solve(H + trace * np.outer(b, b) + damping * np.eye(4), -residual)
        step -= (b @ step) * P
        found = newton_step([*residual], blocks, [*P], [*b], damping)
        np.testing.assert_allclose(found, step, rtol=1e-7, atol=1e-9 * np.abs(step).max())


def test_a_capture_hours_ahead_is_found():
    """From rest to rest over 20,000 km at 0.05 m/s2: 2 sqrt(d / a) = 40,000 s."""
    goal = lambda t: (np.tile([2e7, 0.0, 0.0], (len(t), 1)), np.zeros((len(t), 3)))  # noqa: E731
    params = PlanParams(horizon_s=5e4, grid_s=10.0)
    plan = rendezvous(goal, np.zeros(3), np.zeros(3), params)
    assert plan.t_go_s == pytest.approx(40_000.0, rel=1e-9)


def spinning(rate, arm=0.3):
    """A grasp point that turns about an inclined axis, in closed form."""
    axis = np.array([math.sin(0.3), 0.0, math.cos(0.3)])
    e = np.array([math.cos(0.3), 0.0, -math.sin(0.3)])
    f = np.cross(axis, e)

    def goal(t):
        c, s = np.cos(rate * t)[:, None], np.sin(rate * t)[:, None]
        return np.array([0.0, 0.0, 5.0]) + arm * (c * e + s * f), arm * rate * (c * f - s * e)

    return goal


@pytest.mark.parametrize("turns_per_sample", [0.3, 0.5, 1.0, 2.0])
@pytest.mark.parametrize("share", [0.1, 1.2])
def test_a_target_that_turns_far_between_two_samples_is_captured(turns_per_sample, share):
    """The spacing of the samples follows the target, also where it turns a whole number of times
    from one to the next. A thrust beyond the centripetal one can follow it; a smaller one meets it
    once.
    """
    rate = 2.0 * math.pi * turns_per_sample / PlanParams().grid_s
    goal, zero = spinning(rate), np.zeros(3)
    plan = rendezvous(goal, zero, zero, PlanParams(a_max_mps2=share * 0.3 * rate**2))
    assert plan.status is PlanStatus.OPTIMAL
    path = CostatePath.of(plan, zero, zero)
    (r,), (v,) = path.at(np.array([plan.t_go_s]))
    (rho,), (rate_at,) = goal(np.array([plan.t_go_s]))
    assert np.linalg.norm(r - rho) < 1e-8
    assert np.linalg.norm(v - rate_at) < 1e-8


def test_a_fast_target_is_proven_out_of_reach_of_a_weak_robot():
    """Its speed of 2.4 m/s cannot be reached in 40 s with 0.05 m/s2."""
    plan = rendezvous(spinning(8.0), np.zeros(3), np.zeros(3), PlanParams(horizon_s=40.0))
    assert plan.status is PlanStatus.INFEASIBLE


def test_a_target_whose_reach_is_nearly_tangent_to_the_thrust_is_planned_or_refused():
    """A Newton step from its first feasible time leads to instants before now."""
    x = State(
        np.array([0.26289033, 0.82955745, 0.46777322, 0.15463289]),
        np.array([-0.00349092, -0.11927762, -0.00047804]),
        np.array([1.00459758, 0.66787729, 5.69097189]),
        np.array([0.00377189, 0.00904555, -0.00290264]),
        np.array([0.11924969, -0.08914719]),
        np.array([-0.54333073, -0.26959783, 0.21759411]),
        np.array([-0.23570937, -0.30050797, 0.3059129, 0.8720971]),
    )
    motion = Estimator(EstimatorParams(), None, 5.2).motion(Belief(0, x, np.zeros((20, 20))))
    r0 = np.array([0.8829696766253115, -0.1409870613604618, 3.426046788671196])
    v0 = np.array([0.03717994215811352, 0.003184640391903593, 0.29347998083436383])
    plan = rendezvous(lambda t: motion(t + 0.3), r0, v0, PlanParams(a_max_mps2=0.02))
    assert not plan.found or plan.lower_bound_s <= plan.t_go_s < 60.0
    assert plan.status is not PlanStatus.INFEASIBLE


@pytest.mark.parametrize("step", [0.25, 0.5, 2.0])
def test_the_interpolation_error_is_that_of_cubic_pieces_of_a_quartic(step):
    """Of a position c t^4, with the constant fourth derivative 24 c, the bound is reached."""
    c = 0.003
    goal = sample_goal(
        lambda t: (
            c * np.stack([t**4, 0 * t, 0 * t], 1),
            c * np.stack([4 * t**3, 0 * t, 0 * t], 1),
        ),
        ORIGIN,
        ORIGIN,
        0.0,
        0.0,
        4.0,
        step,
    )
    t = np.linspace(0.0, 4.0, 4001)
    dr, dv = np.array([goal.at(float(x))[:2] for x in t])[:, :, 0].T
    snap = 24.0 * c
    unit = replace(goal, snap=snap)
    assert np.abs(dr - c * t**4).max() == pytest.approx(
        unit.interpolation_error(1.0, 0.0, 3.0), rel=1e-3
    )
    assert 3.0 * np.abs(dv - 4.0 * c * t**3).max() == pytest.approx(
        unit.interpolation_error(0.0, 1.0, 3.0), rel=1e-3
    )
    assert goal.snap >= 0.9 * snap
