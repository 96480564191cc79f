"""Points of a moving target, each measured at its own instant, transformed to one instant."""

from __future__ import annotations

import numpy as np
import pytest
import tumbling

from avsreplay import geometry
from avsreplay.estimate import Estimator, EstimatorParams
from avsreplay.estimate.error_state import boxplus
from avsreplay.estimate.initialise import PoseFix
from avsreplay.estimate.measurement import innovation_vector
from avsreplay.estimate.scan_duration import deskew, with_scan_duration
from avsreplay.estimate.track import Track, turned
from avsreplay.geometry import Pose
from avsreplay.records import Alignment, AlignStatus, Belief


def skewed(rate: float, span: float, at: float):
    """Points on the body in {C}, what a scanner sees of them over ``span`` s around ``at``, and the
    true cloud then.
    """
    times = np.sort(np.random.Generator(np.random.PCG64(0)).uniform(-span / 2, span / 2, 500))
    world = tumbling.draw(3, rate=rate, seconds=1.0)
    states = tumbling.follow(
        np.append(at + times, at)[np.argsort(np.append(at + times, at))],
        world.moments,
        world.states[0],
    )
    order = int(np.searchsorted(times, 0.0))
    now = states.pop(order)
    body = np.random.Generator(np.random.PCG64(1)).normal(size=(500, 3))
    seen = np.array([x.T_ac.apply(p) for x, p in zip(states, body, strict=True)])
    return seen, times, now, now.T_ac.apply(body)


def predict(now, t_ns: int = 0):
    estimator = Estimator(EstimatorParams(), Belief(0, now, np.eye(20) * 1e-6), 2.0)
    return estimator.predict(estimator.initial(0, now.T_ac), t_ns)


@pytest.mark.parametrize("rate", [0.1, 0.3])
@pytest.mark.parametrize("span", [0.2, 1.0])
def test_points_come_back_to_one_instant(rate: float, span: float) -> None:
    seen, times, now, whole = skewed(rate, span, 2.0)
    assert np.abs(seen - whole).max() > 0.2 * rate * span
    assert np.abs(deskew(seen, times, predict(now).belief.x) - whole).max() < 3e-5


def test_float32_points_and_one_instant() -> None:
    seen, times, now, whole = skewed(0.1, 1.0, 2.0)
    assert (
        np.abs(
            deskew(seen.astype(np.float32), times.astype(np.float32), predict(now).belief.x) - whole
        ).max()
        < 1e-4
    )
    assert np.array_equal(deskew(seen, np.zeros(500), predict(now).belief.x), seen)
    assert deskew(np.zeros((0, 3)), np.zeros(0), predict(now).belief.x).shape == (0, 3)


def test_inputs_of_inconsistent_size_are_refused() -> None:
    seen, times, now, _ = skewed(0.1, 1.0, 2.0)
    with pytest.raises(ValueError, match="do not fit"):
        deskew(seen, times[1:], predict(now).belief.x)
    with pytest.raises(ValueError, match="not finite"):
        deskew(seen, np.full(500, np.nan), predict(now).belief.x)


# --- what the carried scan's pose is a measurement of


def surface_points(seed: int, late_half: bool):
    """(500, 3) points with normals; with ``late_half`` the second half of them lies on one
    side of the body.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    p, n = rng.normal(size=(500, 3)), rng.normal(size=(500, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    if late_half:
        p[250:, 0], n[250:] = np.abs(p[250:, 0]) + 1.0, n[250:] * [1.0, 0.2, 0.2]
        n /= np.linalg.norm(n, axis=1, keepdims=True)
    return p, n


def mean_instants(p, n, times):
    J = np.hstack([np.cross(p, n), n])
    return np.linalg.solve(J.T @ J, (J.T * times) @ J), J


@pytest.mark.parametrize(
    ("late_half", "begin"), [(False, 0.0), (False, -0.5), (True, 0.0), (True, -0.25)]
)
def test_the_innovation_of_a_carried_scan_is_late_h_times_the_priors_error(
    begin: float, late_half: bool
) -> None:
    """A prior off by dx carries the points; least squares over surface distances then gives
    the pose: no H in it.
    """
    world = tumbling.draw(3, rate=0.2, seconds=1.0)
    times = begin + np.sort(np.random.Generator(np.random.PCG64(5)).uniform(0.0, 0.5, 500))
    at = 2.0
    order = np.argsort(np.append(at + times, at))
    states = tumbling.follow(np.append(at + times, at)[order], world.moments, world.states[0])
    now = states.pop(int(np.searchsorted(times, 0.0)))
    p, n = surface_points(7, late_half)
    seen = np.array([x.T_ac.apply(c) for x, c in zip(states, p, strict=True)])
    M, J = mean_instants(p, n, times)
    rng = np.random.Generator(np.random.PCG64(9))
    for _ in range(5):
        dx = 1e-3 * rng.normal(size=20)
        prior = predict(boxplus(now, -dx))
        guess = prior.belief.x.T_ac
        found = guess.inverse().apply(
            deskew(seen, times, prior.belief.x)
        )  # in the prior's {C}: p + J' d
        d = np.linalg.lstsq(J, np.einsum("ij,ij->i", n, found - p), rcond=None)[0]
        alpha = innovation_vector(prior.belief.x, guess @ Pose(geometry.exp(d[:3]), d[3:]))
        told = with_scan_duration(prior, M, times)
        error = np.linalg.norm(alpha - told.H @ dx)
        assert error < 0.015 * np.linalg.norm(alpha)
        assert error < 0.25 * np.linalg.norm(alpha - prior.H @ dx)


def test_a_flash_scan_tests_the_motion_at_its_instant() -> None:
    now = skewed(0.1, 0.2, 1.0)[2]
    prior = predict(now)
    assert with_scan_duration(prior, np.zeros((6, 6)), np.zeros(500)) is prior
    assert with_scan_duration(prior, np.zeros((6, 6)), np.zeros(0)) is prior


def test_points_all_late_by_the_same_time_test_the_pose_then() -> None:
    """Turned into {C}, H is that of the prior carried on to the instant they were measured at."""
    now = skewed(0.1, 0.2, 1.0)[2]
    prior = predict(now)
    told = with_scan_duration(prior, 0.5 * np.eye(6), np.full(500, 0.5))
    estimator = Estimator(EstimatorParams(), Belief(0, now, np.eye(20) * 1e-6), 2.0)
    then = estimator.predict(estimator.initial(0, now.T_ac), 500_000_000)
    turn = now.T_ac.R @ then.belief.x.T_ac.R.T
    want = then.H @ then.Phi
    np.testing.assert_allclose(told.H[:3], turn @ want[:3], atol=1e-12)
    np.testing.assert_allclose(told.H[3:], want[3:], atol=1e-12)


# --- the first scan that determines a rotation of a nearly symmetric model


def symmetric_track(seed: int) -> tuple[Track, Pose, np.ndarray]:
    """A track that does not know the rotation about an axis in {C}, a turn G about it, and the
    error of its pose.
    """
    rng = np.random.default_rng(seed)
    now = tumbling.draw(seed, seconds=1.0).states[0]
    axis, centre, error = rng.normal(size=3), rng.normal(size=3), 1e-6 * rng.normal(size=6)
    axis /= np.linalg.norm(axis)
    q = geometry.exp(rng.uniform(-3.0, 3.0) * axis)
    G = Pose(q, centre - geometry.matrix(q) @ centre)
    d = 2.0 * np.concatenate([axis, np.cross(centre, axis)])[:, None]
    fix = PoseFix(0, now.T_ac, np.outer(error, error))
    return (
        Track(Belief(0, now, np.eye(20) * 1e-6), "filter", fixes=(fix,), undetermined=d),
        G,
        error,
    )


def aligned(T_ac: Pose, status: AlignStatus = AlignStatus.ALIGNED) -> Alignment:
    return Alignment(T_ac, 5, True, 100, 100, 1e-3, np.eye(6), status, np.eye(6) * 1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_a_determined_rotation_turns_the_whole_track(seed: int) -> None:
    track, G, error = symmetric_track(seed)
    x = track.belief.x
    measured = x.T_ac @ G
    after = turned(track, x.T_ac, measured, aligned(measured))
    np.testing.assert_allclose(after.belief.x.T_ac.t, measured.t, atol=1e-12)
    assert (
        geometry.angle(geometry.multiply(geometry.conjugate(after.belief.x.T_ac.q), measured.q))
        < 1e-7
    )
    for name in (
        "q_ab",
        "w_b",
        "r_a",
        "v_a",
        "sigma",
    ):  # the body moves as before; only the model on it is turned
        np.testing.assert_array_equal(getattr(after.belief.x, name), getattr(x, name))
    fix = after.fixes[0]
    truth = x.T_ac @ Pose(geometry.exp(error[:3]), error[3:]) @ G
    left = fix.T_ac.inverse() @ truth
    seen = np.concatenate([geometry.log(left.q), left.t])
    np.testing.assert_allclose(fix.C, np.outer(seen, seen), atol=1e-16)


def test_other_differences_do_not_turn_the_track() -> None:
    track, G, _ = symmetric_track(1)
    x = track.belief.x
    measured = x.T_ac @ G
    assert turned(track, x.T_ac, measured, aligned(measured, AlignStatus.DEGENERATE)) is track
    two = Track(
        track.belief, "filter", undetermined=np.hstack([track.undetermined, np.eye(6)[:, 3:4]])
    )
    assert turned(two, x.T_ac, measured, aligned(measured)) is two
    assert (
        turned(Track(track.belief, "filter"), x.T_ac, measured, aligned(measured)).undetermined.size
        == 0
    )
    across = np.cross(track.undetermined[:3, 0], [0.3, -0.5, 0.8])
    other = Pose(geometry.exp(0.5 * across / np.linalg.norm(across)), np.zeros(3))
    assert turned(track, x.T_ac, measured @ other, aligned(measured)) is track


def test_a_displacement_that_no_scan_has_determined_does_not_turn_the_track() -> None:
    """A slide along a face with a rotation of 0.06 rad per metre: taken as a rotation, its axis
    would be 17 m away.
    """
    track, _, _ = symmetric_track(1)
    x, slide = track.belief.x, np.array([0.03, 0.01, 0.0, 0.0, 0.0, 0.6])[:, None]
    sliding = Track(track.belief, "filter", undetermined=slide)
    measured = x.T_ac @ Pose(geometry.exp([0.05, 0.0, 0.0]), np.array([0.0, 0.0, 0.01]))
    assert turned(sliding, x.T_ac, measured, aligned(measured)) is sliding
