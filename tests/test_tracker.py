"""The kinematic tracker: which poses it confirms, for motions that are not those of a free body."""

from __future__ import annotations

import numpy as np
import pytest

from avsreplay import geometry
from avsreplay.estimate import EstimatorParams
from avsreplay.estimate.frame import EstimatorFrame
from avsreplay.estimate.kinematic import Motion, kinematic_track
from avsreplay.estimate.measurement import measurement_jacobian
from avsreplay.estimate.track import Track
from avsreplay.geometry import Pose
from avsreplay.records import Alignment, AlignStatus
from avsreplay.tracker import Tracker

EXTENT, MIDDLE = 4.0, np.array([0.3, -0.2, 0.5])
ROT, POS = 0.004, 0.01  # 1 sigma of an axis of the poses [rad, m]
HZ = 10.0


def alignment(pose, rng, status=AlignStatus.ALIGNED, errors=1.0):
    turn = geometry.exp(errors * ROT * rng.normal(size=3))
    noisy = Pose(geometry.multiply(pose.q, turn), pose.t + errors * POS * rng.normal(size=3))
    C = np.diag(np.repeat([ROT**2, POS**2], 3))
    return Alignment(noisy, 5, True, 500, 500, 0.01, np.linalg.inv(C), status, C)


def driven(seed, count):
    """A vehicle that accelerates, brakes and steers."""
    rng = np.random.Generator(np.random.PCG64(seed))
    acceleration, turn = (np.zeros(count), np.zeros(count))
    for k in range(1, count):
        acceleration[k] = 0.9 * acceleration[k - 1] + 0.6 * rng.normal()
        turn[k] = 0.9 * turn[k - 1] + 0.05 * rng.normal()
    yaw, speed = np.cumsum(0.2 + turn) / HZ, 5.0 + np.cumsum(acceleration) / HZ
    moves = np.stack([speed * np.cos(yaw), speed * np.sin(yaw), 0.0 * yaw], axis=1)
    places = np.cumsum(moves, axis=0) / HZ
    return [
        Pose(geometry.exp([0.0, 0.0, a]), p - geometry.matrix(geometry.exp([0.0, 0.0, a])) @ MIDDLE)
        for a, p in zip(yaw, places, strict=True)
    ]


def swung(seed, count):
    """A load on a cable."""
    phase = np.random.Generator(np.random.PCG64(seed)).uniform(0.0, 6.0)
    angle = 0.4 * np.sin(2.0 * np.arange(count) / HZ + phase)
    return [
        Pose(geometry.exp([a, 0.0, 0.0]), [0.0, 5.0 * np.sin(a), 5.0 * np.cos(a)]) for a in angle
    ]


def confirmed(poses, seed, errors=1.0, replaced=()):
    """Whether the tracker confirms each pose; ``replaced``: (number, pose) of wrong ones."""
    rng, tracker = np.random.Generator(np.random.PCG64(seed)), Tracker(MIDDLE, EXTENT)
    wrong, state, out = dict(replaced), None, []
    for k, pose in enumerate(poses):
        found = alignment(wrong.get(k, pose), rng, errors=errors)
        t_ns = round(k / HZ * 1e9)
        state, sure = tracker.after(state, t_ns, found)
        state = tracker.used(state, t_ns) if k == 0 else state
        out.append(sure)
    return np.array(out)


@pytest.mark.parametrize("motion", [driven, swung])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("errors", [1.0, 4.0])
def test_right_poses_of_a_driven_target_are_confirmed(motion, seed, errors):
    """Also where their errors are larger than claimed."""
    found = confirmed(motion(seed, 50), seed, errors)
    assert not found[:3].any()  # fewer poses determine no acceleration
    assert np.count_nonzero(found[5:]) >= 44


@pytest.mark.parametrize("seed", range(3))
def test_a_wrong_pose_is_not_confirmed_and_the_next_right_one_is(seed):
    poses, rng = driven(seed, 40), np.random.Generator(np.random.PCG64(seed))
    numbers = (15, 22, 29)
    axes = rng.normal(size=(3, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    wrong = [
        (k, Pose(geometry.multiply(poses[k].q, geometry.exp(axis)), poses[k].t + 2.0 * axis))
        for k, axis in zip(numbers, axes, strict=True)
    ]
    found = confirmed(poses, seed, replaced=wrong)
    assert not found[list(numbers)].any()
    assert found[[k + 1 for k in numbers]].all()


def test_poses_after_a_jump_are_not_confirmed_until_one_is_used():
    """A lasting offset is consistent with itself, and only another test can tell it from motion."""
    rng, tracker = np.random.Generator(np.random.PCG64(3)), Tracker(MIDDLE, EXTENT)
    poses, state, found = driven(3, 40), None, []
    for k, pose in enumerate(poses):
        t_ns, offset = round(k / HZ * 1e9), np.array([0.0, 0.0, 2.0 if k >= 20 else 0.0])
        state, sure = tracker.after(state, t_ns, alignment(Pose(pose.q, pose.t + offset), rng))
        state = tracker.used(state, t_ns) if k in (0, 32) else state
        found.append(sure)
    assert all(found[5:20])
    assert not any(found[20:33])
    assert all(found[33:])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("errors", [1.0, 10.0])
def test_the_covariance_of_poses_with_larger_errors_is_multiplied(seed, errors):
    """By a factor below the true one, and by none where the errors are as claimed."""
    rng, tracker, state, found = np.random.default_rng(seed), Tracker(MIDDLE, EXTENT), None, None
    factors = []
    for k, pose in enumerate(driven(seed, 60)):
        found = alignment(pose, rng, errors=errors)
        weighed = tracker.weighed(state, found)
        factors.append(np.trace(weighed.covariance[:3, :3]) / np.trace(found.covariance[:3, :3]))
        assert np.allclose(weighed.info, np.linalg.inv(weighed.covariance))
        state, _ = tracker.after(state, round(k / HZ * 1e9), found)
    late = np.sqrt(factors[30:])
    assert factors[0] == 1.0
    assert (0.3 * errors < np.median(late) < 1.2 * errors) if errors > 1.0 else late.max() < 2.0


def test_a_pose_that_is_repeated_is_not_confirmed():
    """As of a sensor that sends its last scan again, while the target moves slowly."""
    rng, tracker, state = np.random.Generator(np.random.PCG64(9)), Tracker(MIDDLE, EXTENT), None
    for k in range(20):
        found = alignment(Pose(geometry.exp([0.0, 0.0, 0.001 * k]), [0.0, 0.001 * k, 5.0]), rng)
        state, sure = tracker.after(state, round(k / HZ * 1e9), found)
        state = tracker.used(state, round(k / HZ * 1e9))
    assert sure
    again, sure = tracker.after(state, round(2.0 * 1e9), found)
    assert (again, sure) == (state, False)


@pytest.mark.parametrize("status", [AlignStatus.AMBIGUOUS, AlignStatus.DEGENERATE])
def test_a_pose_that_is_not_determined_is_no_part_of_a_track(status):
    rng, tracker = np.random.Generator(np.random.PCG64(1)), Tracker(MIDDLE, EXTENT)
    state, _ = tracker.after(None, 0, alignment(Pose.identity(), rng))
    assert tracker.after(state, 10**8, alignment(Pose.identity(), rng, status)) == (state, False)


def test_the_prediction_covers_its_error_and_ends_with_its_certainty():
    rng, tracker = np.random.Generator(np.random.PCG64(5)), Tracker(MIDDLE, EXTENT)
    poses, state, off = driven(5, 200), None, []
    for k, pose in enumerate(poses):
        motion = tracker.predicted(state, round(k / HZ * 1e9))
        assert (motion is None) == (k < 3)
        if motion is not None:
            away = motion.T_ac.apply(MIDDLE) - pose.apply(MIDDLE)
            off.append(float(away @ away) / motion.pos_1s**2)
        state, _ = tracker.after(state, round(k / HZ * 1e9), alignment(pose, rng))
    assert 1.0 < np.mean(off[20:]) < 4.0  # of three axes; the tracker does not know the noise
    assert tracker.predicted(state, round((len(poses) + 100) / HZ * 1e9)) is None


def test_the_published_belief_has_the_pose_the_rates_and_their_covariance():
    rng = np.random.Generator(np.random.PCG64(7))
    T = Pose(geometry.exp(rng.normal(size=3)), rng.normal(size=3))
    rate, velocity = rng.normal(size=3), rng.normal(size=3)
    params = EstimatorParams().resolved(EXTENT)
    frame = EstimatorFrame(MIDDLE, np.zeros(3), 0)
    motion = Motion(T, rate, velocity, 0.01, 0.02, 0.03, 0.04, 0.1, 0.2)
    free = Track(frame.belief_into(_belief(params)), "fit")
    belief = kinematic_track(frame, params, free, 5, motion).belief
    shown = frame.belief_out(belief)
    assert np.allclose(shown.x.T_ac.matrix, T.matrix)
    assert np.allclose(geometry.matrix(shown.x.q_ab) @ shown.x.w_b, rate)
    assert np.allclose(shown.x.v_a, velocity)
    H = measurement_jacobian(belief.x)
    sigma = np.sqrt(np.diag(H @ belief.P @ H.T))
    assert sigma == pytest.approx(np.repeat([0.02, 0.005], 3), rel=0.05)


def _belief(params):
    from avsreplay.estimate.initialise import guessed_belief

    return guessed_belief(0, Pose.identity(), params)
