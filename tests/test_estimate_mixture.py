"""A fit's mixture of Gaussians between two fits, against the filter's own equations."""

from __future__ import annotations

import numpy as np
import pytest
import tumbling

from avsreplay import geometry
from avsreplay.estimate import Estimator, EstimatorParams, dynamics
from avsreplay.estimate.batch_covariance import propagate_chart
from avsreplay.estimate.chart import to_chart, to_errors
from avsreplay.estimate.measurement import (
    chart_update,
    in_camera,
    innovation_of,
    innovation_vector,
    measurement_jacobian,
)
from avsreplay.estimate.mixture import Component, carried, moments, worn
from avsreplay.estimate.relative_orbit import OrbitArc, RelativeOrbit
from avsreplay.geometry import Array, Pose
from avsreplay.records import Belief, State

C = np.diag(np.repeat([1e-3, 2e-3], 3) ** 2)
NOISE, T_NS = (1e-4, 2e-4), 1_700_000_000


def body(seed: int) -> tuple[State, Array]:
    """A state and a covariance of its chart."""
    A = np.random.default_rng(seed).normal(size=(20, 20)) * 1e-3
    return tumbling.draw(seed, seconds=2.0, hz=1.0).states[0], A @ A.T


def seen(x: State, h: float) -> Pose:
    """The pose h seconds later, with an error."""
    there = dynamics.propagate_state(x, h)[0].T_ac
    return Pose(geometry.multiply(there.q, geometry.exp(np.array([1e-4, 2e-4, -1e-4]))), there.t + 1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_a_component_is_corrected_as_the_filter_corrects_its_estimate(seed: int) -> None:
    x, P = body(seed)
    T, pose, factors, weight = to_errors(to_chart(x)), seen(x, T_NS * 1e-9), np.array([1.5, 0.7]), 0.5
    prior, _ = dynamics.propagate(Belief(0, x, T @ P @ T.T), T_NS, *NOISE)
    H, alpha = measurement_jacobian(prior.x), innovation_vector(prior.x, pose)
    scale = np.repeat(factors, 3)
    R = in_camera(C * np.outer(scale, scale) / weight, pose.q, prior.x.q_bc)
    expected = chart_update(prior, H, innovation_of(prior.P, H, alpha, R), np.ones(2))
    (found,) = carried((Component(1.0, 1.0, 0, to_chart(x), P),), T_NS, pose, C, factors, weight, NOISE)
    U = to_errors(to_chart(expected.x))
    assert np.abs(found.chart.minus(to_chart(expected.x))).max() < 1e-10
    in_chart = np.linalg.solve(U, np.linalg.solve(U, expected.P).T)
    assert np.abs(found.P - in_chart).max() < 1e-9 * np.abs(found.P).max()


@pytest.mark.parametrize("arc", [None, RelativeOrbit(1e-2, np.eye(3), 0).at(5_000_000_000)])
@pytest.mark.parametrize("h", [-3.0, 0.0, 7.3])
def test_steps_of_a_chart_are_carried_as_the_error_states_are(h: float, arc: OrbitArc | None) -> None:
    x, _ = body(5)
    later, Phi = dynamics.propagate_state(x, h, arc)
    there, step = propagate_chart(to_chart(x), h, arc)
    assert np.abs(there.minus(to_chart(later))).max() < 1e-12
    assert np.abs(step - np.linalg.solve(to_errors(to_chart(later)), Phi @ to_errors(to_chart(x)))).max() < 1e-11


def test_weights_follow_the_likelihood_of_the_poses_and_the_mean_follows_the_weights() -> None:
    x, P = body(1)
    here = to_chart(x)
    off = np.zeros(20)
    off[6] = 0.05  # m, far beyond the error of a pose
    fitted = tuple(
        Component(w, w, 0, here.moved(side * off), 1e-4 * P) for w, side in ((4 / 6, 0.0), (1 / 6, 1.0), (1 / 6, -1.0))
    )
    assert np.abs(moments(fitted).x.T_ac.t - x.T_ac.t).max() < 1e-12
    moved = Pose(x.T_ac.q, x.T_ac.t + off[6:9])
    after = carried(fitted, 1, moved, C, np.ones(2), 1.0, (0.0, 0.0))
    assert after[1].weight > 1.0 - 1e-12
    assert worn(after)
    assert not worn(fitted)
    assert np.abs(moments(after).x.T_ac.t - moved.t).max() < 1e-6


@pytest.mark.parametrize("seed", [0, 3])
def test_between_fits_the_pose_is_known_better_than_from_the_last_scan(seed: int) -> None:
    world = tumbling.draw(seed, seconds=30.0, hz=2.0, sigma_max=0.85)
    rng = np.random.Generator(np.random.PCG64(seed))
    estimator = Estimator(EstimatorParams(correlated_share=0.0), None, 4.0)
    track, errors = None, []
    for t, x in zip(world.times, world.states, strict=True):
        alignment = tumbling.alignment(x.T_ac, rng, 0.002, np.radians(0.1))
        track = estimator.initial(0, alignment.T_ac) if track is None else track
        prediction = estimator.predict(track, round(t * 1e9))
        innovation = estimator.innovate(prediction, alignment)
        track = estimator.update(track, prediction, innovation, 1)
        if track.since and track.batch is not None and not track.batch.gaussian:
            H = measurement_jacobian(track.belief.x)
            S = H @ track.belief.P @ H.T
            assert np.trace(S[:3, :3]) < np.trace(innovation.R[:3, :3])
            assert np.trace(S[3:, 3:]) < np.trace(innovation.R[3:, 3:])
            errors.append((track.belief.x.T_ac.t - x.T_ac.t, alignment.T_ac.t - x.T_ac.t))
    assert len(errors) >= 15
    estimated, measured = np.square(errors).sum(axis=(0, 2))
    assert estimated < measured
