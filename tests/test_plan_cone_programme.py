"""The cone programme of one iteration against an independent solver, and invalid input of the
extension.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from avsreplay.plan import _cone
from avsreplay.plan.cone_programme import PointRows, Subproblem, solve
from avsreplay.plan.convexification import (
    Case,
    ReferencePath,
    convex_subproblem,
    interval_fractions,
)
from avsreplay.plan.limits import SampledScene, margins
from avsreplay.plan.rendezvous import PlanParams
from avsreplay.plan.robot import Limits

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))
from plan_scenes import problems


def _rows(rng, n, count, vectors, offset, slack=True):
    """Rows at random instants; the first of each group has the offset and the slack."""
    group = vectors.shape[1]
    interval = np.repeat(rng.integers(0, n, count), group)
    fraction = np.repeat(np.where(rng.random(count) < 0.5, 0.5, 1.0), group)
    constant = np.zeros((count, group))
    constant[:, 0] = offset
    first = np.tile(np.eye(1, group)[0] * slack, count)
    return PointRows(
        interval,
        fraction,
        vectors.reshape(-1, 3),
        constant.ravel(),
        0.1 * rng.normal(size=count * group),
        first,
    )


def _problem(seed, n=8):
    """A random rendezvous with half-spaces, balls and bounds on speed and contact."""
    rng = np.random.default_rng(seed)
    rho, rate = 4.0 * rng.normal(size=3), 0.05 * rng.normal(size=3)
    planes = _rows(rng, n, 6, rng.normal(size=(6, 1, 3)), rng.uniform(-0.5, 4.0, 6))
    ball = np.concatenate([np.zeros((4, 1, 3)), np.tile(np.eye(3), (4, 1, 1))], axis=1)
    return Subproblem(
        n=n,
        h=2.2 * np.sqrt(np.linalg.norm(rho) / 0.1) / n,
        r0=np.zeros(3),
        v0=0.05 * rng.normal(size=3),
        rho=rho,
        rate=rate,
        acceleration=0.003 * rng.normal(size=3),
        a_max=0.1,
        change=0.25,
        speed=1.0 if seed % 2 else None,
        contact=0.08 if seed % 3 == 0 else None,
        axes=np.eye(3) / 0.08 if seed % 4 == 0 else None,
        planes=(planes,),
        cones=((4, _rows(rng, n, 4, ball, rng.uniform(2.0, 6.0, 4))),),
    )


def _independent(p):
    """The same programme in Clarabel, its constraints collected by evaluating them: interval
    length and slack.
    """
    clarabel = pytest.importorskip("clarabel", reason="the independent solver is not installed")
    from scipy import sparse

    def values(x):
        """All constraints at x = (w, h/h_ref, slack), in metres; positive parts first, then
        cones of four rows.
        """
        w, g, slack = x[:-2].reshape(p.n, 3), x[-2], x[-1]
        q = p.v0 * p.h * g + np.concatenate([np.zeros((1, 3)), np.cumsum(w, axis=0)])
        r = p.r0 + np.concatenate([np.zeros((1, 3)), np.cumsum(q[:-1] + 0.5 * w, axis=0)])

        def at(rows):
            k, s = rows.interval, rows.fraction[:, None]
            point = r[k] + s * q[k] + 0.5 * s * s * w[k]
            return (
                np.sum(rows.vector * point, axis=1)
                + rows.offset
                + rows.rate * (g - 1.0)
                + rows.slack * slack
            )

        positive = [
            g - max(1.0 - p.change, p.earliest / p.h),
            1.0 + p.change - g,
            slack,
            *at(p.planes[0]),
        ]
        if p.axes is not None:
            bound = p.h**2 * (2.0 * g - 1.0)
            positive += [*(bound - w @ p.axes.T).ravel(), *(bound + w @ p.axes.T).ravel()]
        cones = [np.array([p.a_max * p.h**2 * (2.0 * g - 1.0), *w[k]]) for k in range(p.n)]
        if p.speed is not None:
            cones += [np.array([p.speed * p.h * g, *q[k + 1]]) for k in range(p.n)]
        if p.contact is not None:
            square = p.h**2 * (2.0 * g - 1.0)
            cones.append(np.array([p.contact * square, *(w[-1] - p.acceleration * square)]))
        cones.append(np.array([slack, *(r[-1] - p.rho - p.rate * p.n * p.h * (g - 1.0))]))
        turn = p.acceleration * p.n * p.h
        cones.append(np.array([slack / p.n, *(q[-1] - p.h * (p.rate + turn) * g + p.h * turn)]))
        return np.concatenate([positive, *cones, at(p.cones[0][1])]), len(positive)

    size = 3 * p.n + 2
    base, positive = values(np.zeros(size))
    C = np.stack([values(e)[0] - base for e in np.eye(size)], axis=1)
    scale = max(np.linalg.norm(p.rho - p.r0 - p.v0 * p.n * p.h), 0.5 * p.a_max * (p.n * p.h) ** 2)
    cost = np.zeros(size)
    cost[-2:] = 1.0, p.weight / scale
    kinds = [clarabel.NonnegativeConeT(positive)]
    kinds += [clarabel.SecondOrderConeT(4)] * ((len(base) - positive) // 4)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    problem = sparse.csc_matrix((size, size)), cost, sparse.csc_matrix(-C), base, kinds, settings
    x = np.array(clarabel.DefaultSolver(*problem).solve().x)
    return p.h * x[-2], x[-1], values, scale


@pytest.mark.parametrize("seed", range(24))
def test_a_programme_has_the_solution_of_an_independent_solver(seed):
    """Cost, feasibility in the constraints written anew, and the interval length where the slack is
    zero in both.
    """
    p = _problem(seed)
    h, slack, values, scale = _independent(p)
    found = solve(p)
    assert found is not None
    ours, theirs = (
        found.h / p.h + p.weight * found.slack / scale,
        h / p.h + p.weight * slack / scale,
    )
    assert ours == pytest.approx(theirs, abs=3e-5 * max(1.0, abs(theirs)))
    x = np.concatenate([(found.u * found.h**2).ravel(), [found.h / p.h, found.slack]])
    s, positive = values(x)
    assert s[:positive].min() > -1e-6 * scale
    cones = s[positive:].reshape(-1, 4)
    assert (cones[:, 0] - np.linalg.norm(cones[:, 1:], axis=1)).min() > -1e-6 * scale


def test_a_programme_without_a_solution_has_none():
    """A speed bound below the speed at the begin."""
    p = _problem(2)
    p = Subproblem(
        **{
            name: getattr(p, name)
            for name in ("n", "h", "r0", "rho", "rate", "acceleration", "a_max")
        },
        v0=np.array([5.0, 0.0, 0.0]),
        change=0.25,
        speed=0.01,
    )
    assert solve(p) is None


def test_rows_that_do_not_fit_are_refused():
    """Cones across stages, rows without a cone, stages outside the programme."""
    C, d = np.zeros((2, 11)), np.zeros(2)

    def call(stage, cones):
        return _cone.solve(
            2,
            (0.0, 0.0, 0.0),
            (1.0, 1.0),
            np.array(stage, np.int32),
            C,
            d,
            np.array(cones, np.int32),
        )

    for stage, cones in (
        ([0, 1], [2]),
        ([0, 0], [1]),
        ([0, 2], [1, 1]),
        ([0, 0], [5]),
        ([0, 0], [1, 0, 1]),
    ):
        with pytest.raises(ValueError, match=r"cone|stage"):
            call(stage, cones)


def _reference(limits, entry=None):
    """A case of a tumbling box and a reference path near it."""
    problem = problems(1, 5)[0]
    params = PlanParams(a_max_mps2=problem.a_max)
    resolved = limits.resolved(8.0)
    case = Case(
        SampledScene(problem.scene, 120.0, 0.2, 60.0),
        resolved,
        params,
        problem.r0,
        np.zeros(3),
        1e-4,
    )
    s = interval_fractions(resolved.nodes)
    goal = problem.scene.goal(40.0 * s)[0]
    path = goal * s[:, None] + 0.3 * np.sin(7.0 * s)[:, None] + (1.0 - s)[:, None]
    return replace(case, entry=entry), ReferencePath(40.0, path)


def _values(p, rows, h=1.0):
    """Rows at the positions of the reference, ``vector.r + offset + rate (h - 1)``, without
    slack.
    """
    r = p[np.asarray(2 * rows.interval + (rows.fraction == 1.0), dtype=int)]
    return np.sum(rows.vector * r, axis=1) + rows.offset + rows.rate * (h - 1.0)


@pytest.mark.parametrize("entry", [None, (0.5, 0.8)])
def test_rows_of_the_constraints_have_the_margins_at_the_reference(entry):
    """A plane has the margin of the second alternative there; in a cone the first row less
    the norm of the others.
    """
    base = (0.0, 2.0, 0.0)
    workspace = Limits(reach_max_m=30.0, reach_min_m=0.01, base_m=base)
    limits = replace(workspace, cone_deg=35.0, final_deg=15.0, clearance_m=0.2, keepout_m=0.4)
    case, reference = _reference(limits, entry)
    n = case.limits.nodes
    made = convex_subproblem(case, reference, np.zeros((2 * n, 5)), 0.2)
    times = reference.t * interval_fractions(n)
    y = case.sampled.coordinates(times, reference.r)
    found = margins(case.scene, case.limits, y, reference.r)
    away, from_base = np.linalg.norm(y, axis=1), np.linalg.norm(reference.r - base, axis=1)
    tight = np.linalg.norm(np.diff(np.vstack([case.begin_c, y]), 2, axis=0), axis=1) / 8.0
    tight = np.append(tight, tight[-1])
    (planes,), ((sizes, cones),) = made.planes, made.cones
    value = _values(reference.r, cones)
    begins = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    assert set(sizes) == {3, 4}
    for begin, size in zip(begins, sizes, strict=True):
        k = 2 * cones.interval[begin] + (cones.fraction[begin] == 1.0)
        margin = value[begin] - np.linalg.norm(value[begin + 1 : begin + size])
        rest = margin + tight[k]
        balls = (
            case.limits.keepout_release_m - away[k],
            case.limits.final_range_m - away[k],
            30.0 - from_base[k],
        )
        expected = balls if size == 4 else (found.first[k, 0], found.first[k, 1])
        assert np.abs(np.array(expected) - rest).min() < 1e-9
    value = _values(reference.r, planes)
    k = np.asarray(2 * planes.interval + (planes.fraction == 1.0), dtype=int)
    expected = [from_base[k] - 0.01, found.second[k, 2], found.second[k, 3]]
    for length in (
        case.limits.cone_range_m,
        case.limits.final_range_m,
    ):  # where too near, towards the entry of the cone
        missing = np.sqrt(np.maximum(1.0 - away[k] / length, 0.0))[:, None]
        out = y[k] / away[k, None] + 2.0 * missing * case.scene.axis_c
        expected.append(np.sum(out * y[k], axis=1) / np.linalg.norm(out, axis=1) - length)
    assert np.abs(np.array(expected) - value - tight[k]).min(axis=0).max() < 1e-9
    assert len(planes.interval) > n


def test_rows_change_with_the_end_time_as_the_target_moves():
    """The rate of a row is its derivative by the relative end time, the robot fixed in {A}."""
    case, reference = _reference(Limits(cone_deg=35.0, cone_range_m=9.0), (0.0, 0.0))
    n, step = case.limits.nodes, 1e-5
    off = np.zeros((2 * n, 5))
    at, later = (
        convex_subproblem(case, ReferencePath(t, reference.r), off, 0.2).cones[0][1]
        for t in (reference.t, reference.t * (1.0 + step))
    )
    bend = [
        np.linalg.norm(np.diff(np.vstack([case.begin_c, y]), 2, axis=0), axis=1) / 8.0
        for t in (reference.t, reference.t * (1.0 + step))
        for y in [case.sampled.coordinates(t * interval_fractions(n), reference.r)]
    ]
    change = (_values(reference.r, later) - _values(reference.r, at)) / step
    tightened = np.append(bend[1] - bend[0], (bend[1] - bend[0])[-1])[:-1] / step
    change[::3] += tightened
    assert np.abs(at.rate).max() > 0.1
    np.testing.assert_allclose(at.rate, change, atol=2e-3 * np.abs(at.rate).max())


def test_motion_between_samples_is_the_cubic_spline():
    rng = np.random.default_rng(3)
    x, times = (
        np.linspace(0.0, 7.0, 29),
        np.concatenate([rng.uniform(0.0, 7.0, 200), [0.0, 7.0, 0.25, 7.1]]),
    )
    spline = CubicSpline(x, rng.normal(size=(29, 12)))
    for order in (0, 1):
        rho, turn = _cone.motion(np.ascontiguousarray(spline.c), x, times, order)
        expected = spline(times, order)
        np.testing.assert_allclose(rho, expected[:, :3], atol=1e-12)
        np.testing.assert_allclose(turn.reshape(-1, 9), expected[:, 3:], atol=1e-12)
    with pytest.raises(ValueError, match="pieces"):
        _cone.motion(np.ascontiguousarray(spline.c), x[:-1], times, 0)


@pytest.mark.parametrize("n", [4, 5, 60])
def test_coefficients_and_values_are_those_of_the_spline_of_scipy(n):
    rng = np.random.default_rng(n)
    x, y = np.cumsum(rng.uniform(0.1, 1.0, n)), rng.normal(size=(n, 3))
    spline, pieces, times = CubicSpline(x, y), _cone.spline(x, y), rng.uniform(x[0], x[-1], 100)
    np.testing.assert_allclose(pieces, spline.c, atol=1e-11 * np.abs(spline.c).max())
    for order in (0, 1):
        np.testing.assert_allclose(
            _cone.values(pieces, x, times, order), spline(times, order), atol=1e-11
        )


def test_nodes_of_a_spline_ascend_and_are_at_least_four():
    x = np.arange(5.0)
    for nodes, values in (
        (x[:3], x[:3]),
        (x, x[:4]),
        (x[::-1].copy(), x),
        (np.array([0.0, 1.0, 1.0, 2.0]), x[:4]),
    ):
        with pytest.raises(ValueError, match="spline"):
            _cone.spline(nodes, values[:, None].copy())
    with pytest.raises(ValueError, match="pieces"):
        _cone.values(_cone.spline(x, x[:, None]), x[:-1], x, 0)
