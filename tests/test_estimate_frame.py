"""The estimate does not depend on the origin of the model: poses about one origin against
poses about another.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tumbling
from state_errors import boxminus

from avsreplay import geometry
from avsreplay.estimate import Estimator, EstimatorParams, Track
from avsreplay.estimate.chart import Chart, body_parameters, to_chart
from avsreplay.estimate.driven import DrivenBelief
from avsreplay.estimate.error_state import boxplus
from avsreplay.estimate.frame import EstimatorFrame
from avsreplay.estimate.mixture import Component, mixture_forecast
from avsreplay.estimate.params import Start
from avsreplay.geometry import Array, Pose
from avsreplay.records import Admission, Alignment, AlignStatus, Belief

FAR = np.array([12.0, -5.0, 9.0])
AHEAD = np.array([0.0, 5.0, 30.0])


def shifted(pose: Pose, by: Array) -> Pose:
    """The pose of a point ``by`` (3,) in {C} that moves with the body."""
    return pose @ Pose(geometry.IDENTITY_QUAT, by)


def about(alignment: Alignment, by: Array) -> Alignment:
    """The same measurement with the origin of {C} moved by ``by``: covariance by differences
    of the poses.
    """
    exact, J, step = shifted(alignment.T_ac, by), np.zeros((6, 6)), 1e-5
    for k in range(6):
        d = step * np.eye(6)[k]
        moved = shifted(alignment.T_ac @ Pose(geometry.exp(d[:3]), d[3:]), by)
        between = exact.inverse() @ moved
        J[:, k] = np.concatenate([geometry.log(between.q), between.t]) / step
    inverse, C = np.linalg.inv(J), alignment.covariance
    assert C is not None
    return replace(
        alignment, T_ac=exact, covariance=J @ C @ J.T, info=inverse.T @ alignment.info @ inverse
    )


def followed(
    estimator: Estimator, seen: list[tuple[float, Alignment]]
) -> tuple[list[float], Track]:
    """The NIS of each pose, and the track after the last."""
    track, nis = estimator.initial(0, seen[0][1].T_ac), []
    for t, alignment in seen:
        prediction = estimator.predict(track, round(t * 1e9))
        innovation = estimator.innovate(prediction, alignment)
        track, _ = estimator.step(track, prediction, innovation, Admission.ADMITTED, False)
        nis.append(innovation.chi2)
    return nis, track


def test_mean_and_covariance_about_another_origin_are_those_of_displaced_states() -> None:
    world, rng, step = tumbling.draw(72, seconds=1.0, hz=2.0), np.random.default_rng(72), 1e-6
    x, root = world.states[0], rng.normal(size=(20, 20))
    for acceleration in (np.zeros(3), np.array([0.1, -0.2, 0.3])):
        frame, t_ns = EstimatorFrame(FAR, acceleration, 0), 2_000_000_000
        found, J = frame.belief_out(Belief(t_ns, x, root @ root.T)), np.zeros((20, 20))
        for k in range(20):
            moved = frame.state_out(boxplus(x, step * np.eye(20)[k]), t_ns)
            J[:, k] = boxminus(moved, found.x) / step
        expected = J @ root @ root.T @ J.T
        np.testing.assert_allclose(found.P, expected, atol=1e-5 * np.abs(expected).max())
        np.testing.assert_allclose(
            found.x.T_ac.t, shifted(x.T_ac, -FAR).t + 2.0 * acceleration, rtol=1e-12
        )
        np.testing.assert_allclose(
            frame.belief_into(found).P, root @ root.T, atol=1e-10 * np.abs(expected).max()
        )


@pytest.mark.parametrize("poses", [6, 40])
def test_the_origin_of_the_model_does_not_change_the_estimate(poses: int) -> None:
    world = tumbling.draw(71, seconds=20.0, hz=2.0, sigma_max=0.85)
    rng = np.random.default_rng(71)
    seen = [
        (t, tumbling.alignment(x.T_ac, rng, 2e-3, np.radians(0.1)))
        for t, x in zip(world.times[:poses], world.states, strict=False)
    ]
    near, far = (
        Estimator(EstimatorParams(), None, 4.0),
        Estimator(EstimatorParams(), None, 4.0, 0, FAR),
    )
    nis, plain = followed(near, seen)
    moved, track = followed(far, [(t, about(alignment, -FAR)) for t, alignment in seen])
    np.testing.assert_allclose(moved, nis, rtol=1e-4, atol=1e-6)
    here, there = near.published(plain), far.published(track)
    np.testing.assert_allclose(there.x.T_ac.t, shifted(here.x.T_ac, -FAR).t, atol=1e-6)
    np.testing.assert_allclose(there.x.r_a, here.x.r_a, atol=1e-5)
    body, other = body_parameters(here), body_parameters(there)
    np.testing.assert_allclose(other.centre_c, body.centre_c + FAR, atol=1e-5)
    np.testing.assert_allclose(other.centre_1s_m, body.centre_1s_m, rtol=1e-3)
    np.testing.assert_allclose(other.inertia, body.inertia, atol=1e-3 * body.inertia_1s.max())
    ahead, farther = near.track_forecast(plain, AHEAD), far.track_forecast(track, AHEAD)
    np.testing.assert_allclose(farther.rot_1s_rad, ahead.rot_1s_rad, rtol=1e-4)
    assert np.all(
        farther.pos_1s_m > ahead.pos_1s_m
    )  # the far point has the error of the attitude times its distance


@pytest.mark.parametrize("seed", range(3))
def test_the_forecast_of_a_mixture_at_a_point_is_that_of_components_about_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    state = tumbling.draw(seed, seconds=2.0, hz=1.0).states[0]
    origin = rng.normal(size=3)
    parts, there = [], []
    for weight in (0.7, 0.3):
        x = boxplus(state, 1e-3 * rng.normal(size=20))
        A = 1e-3 * rng.normal(size=(20, 20))
        chart, P = to_chart(x), A @ A.T
        J = np.array(
            [
                (_about(chart.moved(e), origin).minus(_about(chart.moved(-e), origin))) / 2e-6
                for e in 1e-6 * np.eye(20)
            ]
        ).T
        parts.append(Component(weight, weight, 0, chart, P))
        there.append(Component(weight, weight, 0, _about(chart, origin), J @ P @ J.T))
    x, y, z = origin.tolist()
    found = mixture_forecast(tuple(parts), 0, AHEAD, 1e-5, 1e-5, (x, y, z))
    expected = mixture_forecast(tuple(there), 0, AHEAD, 1e-5, 1e-5)
    np.testing.assert_allclose(found.pos_1s_m, expected.pos_1s_m, rtol=1e-5)
    np.testing.assert_allclose(found.vel_1s_mps, expected.vel_1s_mps, rtol=1e-5)
    np.testing.assert_allclose(found.rot_1s_rad, expected.rot_1s_rad, rtol=1e-5)


def test_a_belief_is_converted_as_its_draws_are() -> None:
    rng = np.random.default_rng(5)
    x, A = tumbling.draw(5, seconds=1.0).states[0], 1e-4 * rng.normal(size=(26, 26))
    joint, frame = A @ A.T, EstimatorFrame(FAR, np.array([0.1, 0.0, -0.2]), 10**9)
    driven = DrivenBelief(
        3 * 10**9, x, joint[:20, :20], np.zeros(6), joint[20:, 20:], joint[:20, 20:]
    )
    out = frame.belief_out(driven)
    assert isinstance(out, DrivenBelief)
    draws = rng.multivariate_normal(np.zeros(26), joint, size=4000)
    moved = [frame.state_out(boxplus(x, d[:20]), driven.t_ns) for d in draws]
    arms = np.array([m.c_b for m in moved]) - out.x.c_b
    np.testing.assert_allclose(
        np.cov(arms.T), out.P[14:17, 14:17], rtol=0.15, atol=0.1 * out.P[14:17, 14:17].max()
    )
    cross = arms.T @ draws[:, 20:] / len(draws)
    np.testing.assert_allclose(cross, out.cross[14:17], atol=0.1 * np.abs(out.cross[14:17]).max())
    back = frame.belief_into(out)
    np.testing.assert_allclose(back.P, driven.P, atol=1e-12)
    np.testing.assert_allclose(back.x.c_b, x.c_b, atol=1e-12)
    np.testing.assert_allclose(back.x.r_a, x.r_a, atol=1e-12)


def test_motions_and_instants_are_those_of_the_moved_origin() -> None:
    frame = EstimatorFrame(FAR, np.zeros(3), 0)
    motion = np.array([1e-6, -2e-6, 3e-6, 1e-6, 0.0, 2e-6])
    pose = Pose(geometry.exp(motion[:3]), motion[3:])  # of {C'}
    of_c = Pose(geometry.IDENTITY_QUAT, FAR) @ pose @ Pose(geometry.IDENTITY_QUAT, -FAR)
    expected = np.concatenate([geometry.log(of_c.q), of_c.t])
    np.testing.assert_allclose(frame.motions_out(motion[:, None])[:, 0], expected, atol=1e-10)
    M = np.diag([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    shown = frame.motions_out(frame.instants_into(M) @ motion[:, None])
    np.testing.assert_allclose(shown, M @ frame.motions_out(motion[:, None]), atol=1e-15)


def test_the_papers_method_estimates_the_origin_of_the_model_itself() -> None:
    start = Belief(0, tumbling.draw(1, seconds=1.0).states[0], np.eye(20) * 1e-6)
    assert not Estimator(EstimatorParams(start=Start.PAPER), start, 4.0, 0, FAR).frame.shifted
    assert Estimator(EstimatorParams(), start, 4.0, 0, FAR).frame.shifted


def test_a_degenerate_view_is_converted_with_its_information() -> None:
    frame, info = EstimatorFrame(FAR, np.zeros(3), 0), np.diag([0.0, 1e4, 1e4, 1e6, 1e6, 1e6])
    free = np.eye(6)[:, :1]
    seen = Alignment(
        Pose.identity(), 1, True, 100, 100, 0.0, info, AlignStatus.DEGENERATE, None, free=free
    )
    found = frame.alignment_into(seen, 0)
    assert found.covariance is None
    assert found.free is not None
    np.testing.assert_allclose(found.info @ found.free, 0.0, atol=1e-6)
    np.testing.assert_allclose(found.T_ac.t, FAR)


def _about(chart: Chart, origin: Array) -> Chart:
    """The chart with the fixture at ``origin`` in {C}."""
    R = geometry.matrix(chart.q_ac)
    t, u = chart.t_a + R @ origin, chart.u_a + R @ np.cross(chart.w_c, origin)
    return Chart.of(chart.q_ac, chart.w_c, t, u, chart.M, chart.arm_c + origin, chart.R_cb)
