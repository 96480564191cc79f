"""Levels of the noise from simulated poses whose noise is known: white, common to near views,
and disturbances.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tumbling

from avsreplay import geometry
from avsreplay.estimate.batch import Problem
from avsreplay.estimate.batch_covariance import sandwich
from avsreplay.estimate.chart import to_chart
from avsreplay.estimate.common_errors import NO_MODEL_ERRORS, line_of_sight_1s
from avsreplay.estimate.disturbance_density import mean_square
from avsreplay.estimate.initialise import PoseFix, poses_of, weak_prior
from avsreplay.estimate.noise import integrated_autocorrelation
from avsreplay.estimate.noise_levels import (
    MOST_NORMAL_POINTS,
    NO_LEVELS,
    NoiseLevels,
    estimate_levels,
    force_likelihood,
)
from avsreplay.estimate.normal_points import normal_points, position_rows
from avsreplay.estimate.params import EstimatorParams
from avsreplay.geometry import Pose
from avsreplay.records import Manoeuvre

PARAMS = EstimatorParams().resolved(2.0)
SIGMA = np.repeat([np.radians(0.2), 0.004], 3)
HZ = 2.0


def fixes(states, seed: int, *, share: float = 0.0, claimed: float = 0.0, factor: float = 1.0):
    """Poses with ``share`` of the variance a smooth random function of the direction of view;
    ``claimed`` is theirs.
    """
    rng = np.random.Generator(np.random.PCG64([seed, 40]))
    waves, phases = rng.normal(size=(300, 3)) / 0.5, rng.uniform(0.0, 2.0 * np.pi, 300)
    sizes = rng.normal(size=(300, 6)) * np.sqrt(2.0 / 300)
    out = []
    for k, x in enumerate(states):
        view = geometry.matrix(x.T_ac.q).T @ x.T_ac.t
        common = np.cos(waves @ (view / np.linalg.norm(view)) + phases) @ sizes
        d = factor * SIGMA * (np.sqrt(1.0 - share) * rng.normal(size=6) + np.sqrt(share) * common)
        pose = x.T_ac @ Pose(geometry.exp(d[:3]), d[3:])
        out.append(PoseFix(round(k / HZ * 1e9), pose, np.diag(SIGMA**2), 0, claimed))
    return tuple(out)


def levels_of(found, truth, rounds: int = 4) -> tuple[NoiseLevels, Problem]:
    """Levels after some estimates that start from one another."""
    poses, chart, levels = poses_of(found), to_chart(truth), NO_LEVELS
    for _ in range(rounds):
        points = normal_points(poses, chart, levels.factors(0.0), MOST_NORMAL_POINTS, scatter=True)
        problem = Problem(points, weak_prior(poses, PARAMS), np.ones(2), chart, np.inf)
        problem.core.descend(40, 1e-3)
        chart = problem.chart
        problem.core.linearise(chart.flat)
        levels = estimate_levels(points, problem, levels, False, (None, None))
    return levels, problem


@pytest.mark.parametrize("seed", [0, 1])
def test_the_level_of_white_noise_is_found_and_no_disturbance_beside_it(seed: int) -> None:
    world = tumbling.draw(seed, seconds=100.0, hz=HZ, sigma_max=0.85)
    levels, _ = levels_of(fixes(world.states, seed, factor=2.0), world.states[0])
    assert levels.white == pytest.approx((4.0, 4.0), rel=0.25)
    assert levels.torque < 5e-6
    assert levels.force < 5e-6
    assert not levels.established
    assert max(levels.excluded) < 1e-3


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_density_of_a_random_torque_is_found_within_a_factor_of_two(seed: int) -> None:
    """3e-5 is below its standard deviation in one of these bodies, where it is taken as zero."""
    world = tumbling.pushed(seed, 1e-4, seconds=40.0, hz=HZ)
    levels, _ = levels_of(fixes(world.states, seed), world.states[0])
    assert 5e-5 < levels.torque < 2e-4
    assert levels.established
    assert levels.excluded[0] > 1e-4
    assert levels.white == pytest.approx((1.0, 1.0), rel=0.4)


def test_a_density_that_the_poses_cannot_tell_is_the_mean_of_what_they_allow() -> None:
    """Poses of 4 mm over 15 s do not exclude a force of 1e-5 m/s^1.5; those of 100 s do."""
    found = []
    for seconds in (15.0, 100.0):
        world = tumbling.draw(1, seconds=seconds, hz=HZ, sigma_max=0.85)
        found.append(levels_of(fixes(world.states, 1), world.states[0])[0].force)
    assert found[0] > 1e-5
    assert found[1] < 5e-6


@pytest.mark.parametrize(("force", "step"), [(0.0, 0.0), (1e-4, 0.0), (0.0, 0.01)])
def test_the_density_of_a_force_is_found_from_positions_under_an_unknown_torque(
    force: float, step: float
) -> None:
    """The torque turns the body by more than a fit of free motion can use; the positions are linear
    all the same.

    A manoeuvre, whose instant is known to 0.1 s, does not count as a force. Without a force the
    density in use is less than a third of the least one that the poses exclude.
    """
    found, excluded = [], []
    for seed in range(3):
        rng = np.random.Generator(np.random.PCG64([seed, 41]))
        world = tumbling.pushed(seed, 3e-4, seconds=100.0, hz=HZ)
        speed = np.cumsum(force * rng.normal(size=(len(world.states), 3)) / np.sqrt(HZ), axis=0)
        moved = np.cumsum(speed, axis=0) / HZ
        moved[:, 1] += step * np.maximum(np.arange(len(moved)) / HZ - 40.3, 0.0)
        seen = [
            replace(f, T_ac=Pose(f.T_ac.q, f.T_ac.t + m))
            for f, m in zip(fixes(world.states, seed), moved, strict=True)
        ]
        change = Manoeuvre(
            round(40.2e9), 0.1, np.array([0.0, step, 0.0]), np.zeros(3), np.eye(6), 0
        )
        arm, one = to_chart(world.states[0]).arm_c, np.ones(len(seen))
        rows = position_rows(poses_of(tuple(seen)), one, arm, 36, 0, [change] if step else [])
        likelihood = force_likelihood(np.repeat([1.0, 0.0], [4, 2]), rows)
        found.append(np.sqrt(mean_square(likelihood)))
        excluded.append(likelihood.excluded)
    if force:
        assert all(force / 2.0 < q < 2.0 * force for q in found), found
    else:
        assert all(3.0 * q < least for q, least in zip(found, excluded, strict=True)), found


def test_a_given_density_is_not_changed() -> None:
    world = tumbling.draw(3, seconds=30.0, hz=HZ, sigma_max=0.85)
    poses = poses_of(fixes(world.states, 3))
    chart = to_chart(world.states[0])
    points = normal_points(poses, chart, np.ones(2), MOST_NORMAL_POINTS, scatter=True)
    problem = Problem(points, weak_prior(poses, PARAMS), np.ones(2), chart, np.inf)
    levels = estimate_levels(points, problem, NO_LEVELS, True, (1e-5, 0.0))
    assert (levels.torque, levels.force) == (pytest.approx(1e-5), 0.0)
    assert levels.white == (1.0, 1.0)


def test_errors_that_near_views_share_are_found_and_widen_the_covariance() -> None:
    found = []
    for seed in range(4):
        world = tumbling.draw(seed, seconds=100.0, hz=HZ, sigma_max=0.85)
        for share in (0.0, 0.4):
            levels, problem = levels_of(
                fixes(world.states, seed, share=share, claimed=0.1), world.states[0]
            )
            _, inflation = sandwich(problem, problem.poses, levels)
            found.append((*(0.1 * np.array(levels.common) / levels.factors(0.1) ** 2), *inflation))
    white, shared = np.mean(found[::2], axis=0), np.mean(found[1::2], axis=0)
    assert np.all(white[:2] < 0.12)
    assert shared[:2] == pytest.approx([0.4, 0.4], abs=0.15)
    assert np.all(shared[2:] > 1.5 * white[2:])


def test_normal_points_know_the_noise_within_them() -> None:
    world = tumbling.draw(5, seconds=300.0, hz=HZ, sigma_max=0.85)
    poses = poses_of(fixes(world.states, 5, factor=3.0))
    points = normal_points(
        poses, to_chart(world.states[0]), 3.0 * np.ones(2), MOST_NORMAL_POINTS, scatter=True
    )
    assert points.within is not None
    squares, dof = points.within
    assert dof > 500.0
    assert np.array(squares) / dof == pytest.approx([9.0, 9.0], rel=0.2)


def test_the_common_error_lies_along_the_line_of_sight() -> None:
    at, R = np.array([0.0, 3.0, 4.0]), np.diag([1.0, 4.0, 9.0])
    b = line_of_sight_1s(at, 0.5 * R, NO_MODEL_ERRORS)
    assert b / np.linalg.norm(b) == pytest.approx(at / 5.0)
    assert b @ b == pytest.approx(0.25 * (0.36 * 4.0 + 0.64 * 9.0))
    assert not line_of_sight_1s(np.zeros(3), 0.5 * R, NO_MODEL_ERRORS).any()


def test_rows_of_zeros_have_no_autocorrelation() -> None:
    """Exact poses, or those of a target at rest, leave residuals that are zero."""
    assert integrated_autocorrelation(np.zeros((80, 3))) == 1.0
