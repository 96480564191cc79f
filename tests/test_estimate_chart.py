"""The 24 permutations of the principal axes: the same motion, the same pose, the same NEES."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tumbling
from state_errors import boxminus, permute_covariance

from avsreplay import geometry
from avsreplay.estimate import dynamics
from avsreplay.estimate.chart import (
    AXIS_PERMUTATIONS,
    AxisPermutation,
    nearest_permutation,
    nees,
    nees_by_block,
    permute_axes,
    separated,
    to_chart,
    to_errors,
    to_state,
)
from avsreplay.estimate.error_state import DMU, DQ, boxplus, semidefinite
from avsreplay.records import BLOCKS, Belief, State

EACH = pytest.mark.parametrize("naming", AXIS_PERMUTATIONS, ids=lambda n: "".join(map(str, n.perm)))


@pytest.fixture
def world() -> tumbling.World:
    return tumbling.draw(4, seconds=1.0)


def test_there_are_24_proper_rotations() -> None:
    assert len({tuple(n.R_bn.ravel()) for n in AXIS_PERMUTATIONS}) == 24
    assert all(np.linalg.det(n.R_bn) == pytest.approx(1.0) for n in AXIS_PERMUTATIONS)


@EACH
def test_sigma_is_that_of_the_permuted_moments(
    world: tumbling.World, naming: AxisPermutation
) -> None:
    moments = world.moments[list(naming.perm)]
    assert permute_axes(world.states[0], naming).sigma == pytest.approx(
        tumbling.ratios(moments), abs=1e-14
    )


@EACH
def test_the_motion_is_the_same(world: tumbling.World, naming: AxisPermutation) -> None:
    x = world.states[0]
    for h in (0.0, 7.0):
        step = dynamics.flow(x.w_b, x.sigma, h)
        y = permute_axes(x, naming)
        far = dynamics.advance(y, dynamics.flow(y.w_b, y.sigma, h), h)
        want = dynamics.advance(x, step, h)
        assert np.abs(far.T_ac.matrix - want.T_ac.matrix).max() < 1e-12
        assert np.abs(far.fixture_velocity - want.fixture_velocity).max() < 1e-13


@EACH
def test_the_covariance_follows(world: tumbling.World, naming: AxisPermutation) -> None:
    x, eps = world.states[0], 1e-6
    P = np.diag(np.linspace(1.0, 2.0, 20))
    J = np.empty((20, 20))
    for k in range(20):
        d = np.zeros(20)
        d[k] = eps
        J[:, k] = boxminus(
            permute_axes(boxplus(x, d), naming), permute_axes(boxplus(x, -d), naming)
        ) / (2 * eps)
    assert np.abs(permute_covariance(P, x, naming) - J @ P @ J.T).max() < 1e-7


@EACH
def test_nees_is_independent_of_the_axis_names(
    world: tumbling.World, naming: AxisPermutation
) -> None:
    x = world.states[0]
    d = np.random.Generator(np.random.PCG64(0)).normal(size=20) * 1e-3
    belief = Belief(0, boxplus(x, d), np.eye(20) * 1e-6)
    named, size = nearest_permutation(belief, permute_axes(x, naming))
    assert size == pytest.approx(float(d @ d) * 1e6, rel=1e-9)
    assert np.abs(boxminus(named, x)).max() < 1e-12
    assert nees(belief, permute_axes(x, naming)) == pytest.approx(nees(belief, x), rel=1e-9)
    assert nees(belief, x) == pytest.approx(size, rel=0.05)


@pytest.mark.parametrize("naming", AXIS_PERMUTATIONS[::5])
def test_nees_of_every_block_is_that_of_the_solved_equations(
    world: tumbling.World, naming: AxisPermutation
) -> None:
    x, rng = world.states[0], np.random.Generator(np.random.PCG64(1))
    root = 1e-3 * rng.normal(size=(20, 20))
    P = root @ root.T
    belief = Belief(0, boxplus(x, root @ rng.normal(size=20)), P)
    truth = permute_axes(x, naming)
    named, size = nearest_permutation(belief, truth)
    e, y = boxminus(named, belief.x), to_chart(truth).minus(to_chart(belief.x))
    d = to_errors(to_chart(belief.x)) @ y
    assert size == pytest.approx(e @ np.linalg.solve(P, e), rel=1e-6)
    total, blocks = nees_by_block(belief, truth)
    assert total == pytest.approx(d @ np.linalg.solve(P, d), rel=1e-6)
    assert blocks == pytest.approx(
        {name: d[b] @ np.linalg.solve(P[b, b], d[b]) for name, b in BLOCKS.items()}
    )


@pytest.mark.parametrize("seed", range(5))
def test_nees_of_the_rate_is_right_where_the_axes_are_unknown(seed: int) -> None:
    """Errors drawn in the chart, with axes uncertain by tens of degrees and a rate that is well
    known in {C}.
    """
    rng, found = np.random.default_rng(seed), []
    chart = to_chart(tumbling.draw(seed, seconds=1.0).states[0])
    sigma = np.repeat([1e-3, 1e-4, 1e-3, 1e-3, 0.7, 0.1], [3, 3, 3, 3, 5, 3])
    T = to_errors(chart)
    belief = Belief(0, to_state(chart), T @ np.diag(sigma**2) @ T.T)
    for _ in range(200):
        truth = to_state(chart.moved(sigma * rng.normal(size=20)))
        found.append(nees_by_block(belief, truth)[1]["rate"])
    assert np.mean(found) == pytest.approx(3.0, rel=0.25)


@pytest.mark.parametrize("size", [1.0, 30.0, 1e3, 1e8])
def test_the_inertia_stays_in_its_range_however_large_the_step(
    world: tumbling.World, size: float
) -> None:
    rng, chart = np.random.Generator(np.random.PCG64(3)), to_chart(world.states[0])
    for _ in range(50):
        step = np.zeros(20)
        step[12:17] = size * rng.normal(size=5)
        sigma = to_state(chart.moved(step)).sigma
        assert np.abs(sigma).max() < 1.0
        assert abs(dynamics.sigma3(sigma)) <= 1.0


def test_a_covariance_of_zero_ends_in_no_error(world: tumbling.World) -> None:
    """Standard deviations of 1e-200 are allowed in the settings, and their squares are 0."""
    x, P = world.states[0], np.eye(20) * 1e-6
    P[6:9, 6:9] = 0.0
    other = permute_axes(x, AXIS_PERMUTATIONS[5])
    named, _ = nearest_permutation(Belief(0, x, P), other)
    assert np.abs(boxminus(named, x)).max() < 1e-12
    total, blocks = nees_by_block(Belief(0, x, P), other)
    assert np.isnan([total, blocks["position"]]).all()
    assert blocks["velocity"] == pytest.approx(0.0, abs=1e-12)


def test_a_covariance_is_semidefinite_in_units_of_its_variances() -> None:
    scale = np.geomspace(1e-6, 1e3, 20)
    P = np.outer(scale, scale) * (np.eye(20) + 0.5)
    assert semidefinite(P)
    assert semidefinite(np.zeros((20, 20)))
    P[0, 1] = P[1, 0] = 1.51 * scale[0] * scale[1]
    assert not semidefinite(P)
    P[0, 1] = P[1, 0] = np.nan
    assert not semidefinite(P)


def test_a_wrong_inertia_is_not_explained_by_a_permutation(world: tumbling.World) -> None:
    x = world.states[0]
    other = State(x.q_ab, x.w_b, x.r_a, x.v_a, x.sigma + 0.1, x.c_b, x.q_bc)
    assert nees(Belief(0, other, np.eye(20) * 1e-6), x) > 1e4


def test_a_fixture_turned_by_180_degrees_is_distinguished(world: tumbling.World) -> None:
    """A relabelling keeps the pose; turning the fixture on the body does not."""
    x = world.states[0]
    turned = State(
        x.q_ab, x.w_b, x.r_a, x.v_a, x.sigma, x.c_b, geometry.multiply([1.0, 0, 0, 0], x.q_bc)
    )
    assert nees(Belief(0, turned, np.eye(20) * 1e-4), x) > 5e3


@pytest.mark.parametrize("seed", range(8))
def test_nearly_equal_moments_are_separated_by_a_small_part_of_their_standard_deviation(
    seed: int,
) -> None:
    """The error of the pose is half the sum of those of attitude and mu, computed without a loss of
    precision.
    """
    rng = np.random.default_rng(seed)
    x = tumbling.draw(seed, seconds=1.0).states[0]
    chart = to_chart(replace(x, sigma=rng.normal(size=2) * 10.0 ** rng.uniform(-12.0, -4.0)))
    root = np.diag(10.0 ** np.concatenate([rng.uniform(-5.0, -3.0, 12), rng.uniform(-1.0, 0.5, 8)]))
    root[12:17, 12:17] @= rng.normal(size=(5, 5))
    P = root @ root.T
    moved = separated(chart, P)
    y = moved.minus(chart)
    assert float(y @ np.linalg.solve(P, y)) <= 0.1**2 + 1e-9
    T = to_errors(moved)
    E = T @ P @ T.T
    assert E[DMU, DMU].max() < 1e3
    of_pose = E[DQ, DQ] + E[DMU, DMU] + E[DQ, DMU] + E[DMU, DQ]
    R = moved.R_cb
    np.testing.assert_allclose(of_pose, R.T @ P[:3, :3] @ R, rtol=1e-3, atol=1e-12)


def test_moments_that_are_known_to_differ_stay_as_they_are(world: tumbling.World) -> None:
    chart = to_chart(world.states[0])
    assert separated(chart, 1e-4 * np.eye(20)) is chart
