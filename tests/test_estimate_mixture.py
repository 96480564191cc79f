"""A fit's mixture of Gaussians between two fits, against the filter's own equations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tumbling
from scipy.stats import chi2

from avsreplay import geometry
from avsreplay.estimate import Estimator, EstimatorParams, dynamics
from avsreplay.estimate.batch_covariance import propagate_chart
from avsreplay.estimate.chart import nees, to_chart, to_errors
from avsreplay.estimate.measurement import (
    chart_update,
    in_camera,
    innovation_of,
    innovation_vector,
    measurement_jacobian,
    to_fixture,
)
from avsreplay.estimate.mixture import (
    Component,
    carried,
    mixture_forecast,
    moments,
    not_worse,
    volumes,
    worn,
)
from avsreplay.estimate.relative_orbit import OrbitArc, RelativeOrbit
from avsreplay.estimate.track import Track
from avsreplay.geometry import Array, Pose
from avsreplay.records import Admission, Belief, State

C = np.diag(np.repeat([1e-3, 2e-3], 3) ** 2)
ROOT = np.linalg.inv(np.linalg.cholesky(C))
NOISE, T_NS = (1e-4, 2e-4), 1_700_000_000


def body(seed: int) -> tuple[State, Array]:
    """A state and a covariance of its chart."""
    A = np.random.default_rng(seed).normal(size=(20, 20)) * 1e-3
    return tumbling.draw(seed, seconds=2.0, hz=1.0).states[0], A @ A.T


def seen(x: State, h: float) -> Pose:
    """The pose h seconds later, with an error."""
    there = dynamics.propagate_state(x, h)[0].T_ac
    return Pose(
        geometry.multiply(there.q, geometry.exp(np.array([1e-4, 2e-4, -1e-4]))), there.t + 1e-3
    )


@pytest.mark.parametrize("seed", range(4))
def test_a_component_is_corrected_as_the_filter_corrects_its_estimate(seed: int) -> None:
    x, P = body(seed)
    T, pose, factors, weight = (
        to_errors(to_chart(x)),
        seen(x, T_NS * 1e-9),
        np.array([1.5, 0.7]),
        0.5,
    )
    prior, _ = dynamics.propagate(Belief(0, x, T @ P @ T.T), T_NS, *NOISE)
    H, alpha = measurement_jacobian(prior.x), innovation_vector(prior.x, pose)
    scale = np.repeat(factors, 3)
    R = in_camera(C * np.outer(scale, scale) / weight, pose.q, prior.x.q_bc)
    expected = chart_update(prior, H, innovation_of(prior.P, H, alpha, R), np.ones(2))
    (found,) = carried(
        (Component(1.0, 1.0, 0, to_chart(x), P),), T_NS, pose, ROOT, factors, weight, NOISE
    )
    U = to_errors(to_chart(expected.x))
    assert np.abs(found.chart.minus(to_chart(expected.x))).max() < 1e-10
    in_chart = np.linalg.solve(U, np.linalg.solve(U, expected.P).T)
    assert np.abs(found.P - in_chart).max() < 1e-9 * np.abs(found.P).max()


@pytest.mark.parametrize("arc", [None, RelativeOrbit(1e-2, np.eye(3), 0).at(5_000_000_000)])
@pytest.mark.parametrize("h", [-3.0, 0.0, 7.3])
def test_steps_of_a_chart_are_carried_as_the_error_states_are(
    h: float, arc: OrbitArc | None
) -> None:
    x, _ = body(5)
    later, Phi = dynamics.propagate_state(x, h, arc)
    there, step = propagate_chart(to_chart(x), h, arc)
    assert np.abs(there.minus(to_chart(later))).max() < 1e-12
    assert (
        np.abs(
            step - np.linalg.solve(to_errors(to_chart(later)), Phi @ to_errors(to_chart(x)))
        ).max()
        < 1e-11
    )


def spin_claims(axis: int) -> Array:
    """(80, 2) predicted 1 sigma at one instant after each pose of a spin without disturbances.

    In the columns, the Jacobians are taken along the trajectory of the fit, and at the corrected
    mean.
    """
    x = replace(
        tumbling.draw(axis, seconds=1.0, hz=1.0).states[0], w_b=0.1 * np.eye(3)[axis] + 1e-5
    )
    rng = np.random.Generator(np.random.PCG64(axis))
    widths = np.repeat([1e-3, 1e-4, 2e-3, 2e-4, 0.5, 1e-3], [3, 3, 3, 3, 5, 3])
    along_the_fit = at_the_mean = (Component(1.0, 1.0, 0, to_chart(x), np.diag(widths**2)),)
    claims = []
    for t in range(1, 81):
        there, d = (
            dynamics.propagate_state(x, float(t))[0].T_ac,
            rng.normal(size=6) * np.repeat([1e-3, 2e-3], 3),
        )
        seen_there = (
            Pose(geometry.multiply(there.q, geometry.exp(d[:3])), there.t + d[3:]),
            ROOT,
            np.ones(2),
            1.0,
        )
        along_the_fit = carried(along_the_fit, t * 1_000_000_000, *seen_there, (0.0, 0.0))
        (corrected,) = carried(at_the_mean, t * 1_000_000_000, *seen_there, (0.0, 0.0))
        at_the_mean, ahead = (replace(corrected, reference=None),), np.array([110.0 - t])
        found = [
            mixture_forecast(c, c[0].t_ns, ahead, 0.0, 0.0) for c in (along_the_fit, at_the_mean)
        ]
        claims.append([float(each.pos_1s_m[0]) for each in found])
    return np.array(claims)


def test_in_a_spin_no_pose_makes_a_future_instant_less_certain() -> None:
    rises = np.array(
        [(claims[1:] / claims[:-1]).max(axis=0) for claims in map(spin_claims, range(3))]
    )
    assert np.all(rises[:, 0] < 1.0 + 1e-9)
    assert rises[:, 1].max() > 1.02  # with a point of linearisation that follows the mean


def test_the_forecast_of_a_mixture_has_its_second_moments() -> None:
    x, P = body(4)
    here, times, off = to_chart(x), np.array([0.0, 1.0, 30.0]), np.zeros(20)
    alone = mixture_forecast((Component(1.0, 1.0, 0, here, P),), 0, times, *NOISE)
    T = to_errors(here)
    expected = dynamics.grasp_forecast(Belief(0, x, T @ P @ T.T), times, *NOISE)
    for found, wanted in (
        (alone.pos_1s_m, expected.pos_1s_m),
        (alone.vel_1s_mps, expected.vel_1s_mps),
    ):
        assert found == pytest.approx(wanted, rel=1e-9)
    assert alone.rot_1s_rad == pytest.approx(expected.rot_1s_rad, rel=1e-9)
    off[9] = 0.01  # m/s
    pair = tuple(Component(0.5, 0.5, 0, here.moved(side * off), P) for side in (1.0, -1.0))
    both = mixture_forecast((replace(pair[0], weight=0.0, chart=here), *pair), 0, times, *NOISE)
    assert both.pos_1s_m**2 == pytest.approx(alone.pos_1s_m**2 + (0.01 * times) ** 2, rel=1e-9)
    assert both.vel_1s_mps**2 == pytest.approx(alone.vel_1s_mps**2 + 1e-4, rel=1e-9)


def test_volumes_are_those_of_the_conditional_covariances() -> None:
    rng = np.random.default_rng(2)
    P = [A @ A.T for A in rng.normal(size=(3, 20, 20))]
    rest = [C[2:, 2:] - C[2:, :2] @ np.linalg.solve(C[:2, :2], C[:2, 2:]) for C in P]
    expected = np.sqrt([np.linalg.det(C) for C in rest])
    assert volumes(P, np.eye(20)[:2]) == pytest.approx(expected / expected.max(), rel=1e-9)
    assert volumes(P[:1], []) == pytest.approx([1.0])


def test_weights_follow_the_likelihood_of_the_poses_and_the_mean_follows_the_weights() -> None:
    x, P = body(1)
    here = to_chart(x)
    off = np.zeros(20)
    off[6] = 0.05  # m, far beyond the error of a pose
    fitted = tuple(
        Component(w, w, 0, here.moved(side * off), 1e-4 * P)
        for w, side in ((4 / 6, 0.0), (1 / 6, 1.0), (1 / 6, -1.0))
    )
    assert np.abs(moments(fitted).x.T_ac.t - x.T_ac.t).max() < 1e-12
    moved = Pose(x.T_ac.q, x.T_ac.t + off[6:9])
    after = carried(fitted, 1, moved, ROOT, np.ones(2), 1.0, (0.0, 0.0))
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


@pytest.mark.parametrize("seed", range(4))
def test_a_fit_is_corrected_by_its_last_pose_where_it_is_less_precise_than_that_pose(
    seed: int,
) -> None:
    """The pose's covariance afterwards is the measured one in the directions in which it was
    larger, and the mean moves by the share 1 - C/S of the residual there; the other directions
    remain."""
    x, _ = body(seed)
    rng = np.random.default_rng(seed)
    J = to_fixture(x.T_ac.q, x.q_bc) @ measurement_jacobian(x) @ to_errors(to_chart(x))
    ratios = np.array([0.25, 0.5, 0.9, 3.0, 30.0, 1e4])
    axes = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    root = np.sqrt(np.diag(C))[:, None] * axes
    S = root @ np.diag(ratios) @ root.T
    P = np.eye(20) * 1e-12 + np.linalg.pinv(J) @ S @ np.linalg.pinv(J).T
    fitted = (Component(1.0, 1.0, T_NS, to_chart(x), P),)
    off = 1e-4 * rng.normal(size=6)
    pose = Pose(geometry.multiply(x.T_ac.q, geometry.exp(off[:3])), x.T_ac.t + x.T_ac.R @ off[3:])
    after = not_worse(fitted, T_NS, pose, C, 1.0, (0.0, 0.0))
    there = moments(after).x
    J2 = (
        to_fixture(there.T_ac.q, there.q_bc)
        @ measurement_jacobian(there)
        @ to_errors(to_chart(there))
    )
    white = np.linalg.inv(root)
    assert np.diag(white @ J2 @ after[0].P @ J2.T @ white.T) == pytest.approx(
        np.minimum(ratios, 1.0), rel=2e-3
    )
    between = x.T_ac.inverse() @ there.T_ac
    moved = white @ np.concatenate([geometry.log(between.q), between.t])
    asked = np.maximum(1.0 - 1.0 / ratios, 0.0) * (white @ off)
    assert moved == pytest.approx(asked, abs=2e-3 * np.abs(white @ off).max())
    precise = (Component(1.0, 1.0, T_NS, to_chart(x), 1e-3 * P * 0.1),)
    assert not_worse(precise, T_NS, pose, 1.1 * C, 1.0, (0.0, 0.0)) is precise


@pytest.mark.parametrize("seed", range(4))
def test_a_fit_is_compared_with_a_pose_at_the_instant_of_that_pose(seed: int) -> None:
    """A fit whose pose is precise at its scan and not half a second later, where the mean instant
    of the points is.
    """
    x, _ = body(seed)
    T = to_errors(to_chart(x))
    Phi = dynamics.propagate_state(x, 0.5)[1]
    variances = np.full(20, 1e-12)
    variances[3:6], variances[9:12] = 1e-2**2, 2e-2**2  # rate [rad/s] and velocity [m/s]
    P = np.linalg.inv(T) @ np.diag(variances) @ np.linalg.inv(T).T
    fitted = (Component(1.0, 1.0, T_NS, to_chart(x), P),)
    there = dynamics.propagate_state(x, 0.5)[0]
    H = to_fixture(there.T_ac.q, there.q_bc) @ measurement_jacobian(there)
    S = H @ Phi @ np.diag(variances) @ Phi.T @ H.T
    white = np.linalg.inv(np.linalg.cholesky(C))
    assert np.linalg.eigvalsh(white @ S @ white.T)[-1] > 10.0
    late = T_NS + 500_000_000
    after = moments(not_worse(fitted, late, seen(x, 0.5), C, 1.0, (0.0, 0.0)))
    assert after.t_ns == late
    H = to_fixture(after.x.T_ac.q, after.x.q_bc) @ measurement_jacobian(after.x)
    assert np.linalg.eigvalsh(white @ H @ after.P @ H.T @ white.T)[-1] == pytest.approx(
        1.0, rel=0.01
    )
    exact = moments(not_worse(fitted, T_NS, x.T_ac, C, 1.0, (0.0, 0.0)))
    np.testing.assert_allclose(
        exact.P, np.diag(variances), atol=1e-15
    )  # at its own instant it is precise enough


def after_scans(times: Array, states: list[State], seed: int) -> tuple[Estimator, Track]:
    """A cold estimate after poses of 2 mm and 0.1 deg."""
    rng, estimator = np.random.default_rng(seed), Estimator(EstimatorParams(), None, 4.0)
    track = estimator.initial(0, states[0].T_ac)
    for t, x in zip(times, states, strict=True):
        prediction = estimator.predict(track, round(t * 1e9))
        seen = estimator.innovate(
            prediction, tumbling.alignment(x.T_ac, rng, 2e-3, np.radians(0.1))
        )
        track, _ = estimator.step(track, prediction, seen, Admission.ADMITTED, False)
    return estimator, track


@pytest.mark.parametrize("seed", [41, 43, 44])
def test_a_gap_before_convergence_leaves_the_estimate_consistent(seed: int) -> None:
    """Poses for 20 s, then none for 30 s; about the mean alone NEES is 150 to 1,100."""
    world = tumbling.draw(seed, seconds=50.0, hz=2.0, sigma_max=0.85)
    estimator, track = after_scans(world.times[:41], world.states[:41], seed)
    assert track.batch is not None
    assert len(track.batch.components) > 1
    bound = chi2.ppf(0.999, 20)
    at_once = estimator.predict(track, round(world.times[-1] * 1e9)).belief
    assert nees(at_once, world.states[-1]) < bound
    for t in world.times[41:]:
        track = estimator.update(track, estimator.predict(track, round(t * 1e9)), None, 0)
    assert nees(track.belief, world.states[-1]) < bound


def test_no_weight_of_a_mixture_in_a_pure_spin_is_negative() -> None:
    """More than three directions are not Gaussian: the weights of Gauss-Hermite would give
    the mean a negative one.
    """
    world = tumbling.draw(54, seconds=60.0, hz=1.0, sigma_max=0.85)
    spin = replace(world.states[0], w_b=np.array([0.0, 0.1, 0.0]))
    _, track = after_scans(world.times, tumbling.follow(world.times, world.moments, spin), 54)
    assert track.batch is not None
    weights = np.array([c.quadrature for c in track.batch.components])
    assert len(weights) > 7
    assert weights.min() >= 0.0
    assert weights.sum() == pytest.approx(1.0)
