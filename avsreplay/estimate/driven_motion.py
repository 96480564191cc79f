"""The motion with a constant torque or force that fits all poses, and the belief at the last of
them.

Initial values and acceleration are fitted together. One pass of a Kalman filter over the poses,
with the disturbances between them, gives the joint mean and covariance of the initial values, the
acceleration and its onset.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from avsreplay.errors import value_class
from avsreplay.estimate import _motion
from avsreplay.estimate.batch import Poses, Prior, Problem, follow_orbit
from avsreplay.estimate.batch_covariance import sandwich
from avsreplay.estimate.chart import Chart, to_errors, to_state
from avsreplay.estimate.driven import DrivenBelief, followed
from avsreplay.estimate.driven_fit import (
    DrivenFit,
    without_drift,
)
from avsreplay.estimate.dynamics import torque_density
from avsreplay.estimate.error_state import DIM, LARGEST_MOVE, REACHED, definite
from avsreplay.estimate.measurement import GATE
from avsreplay.estimate.noise_levels import NoiseLevels, mean_share
from avsreplay.estimate.normal_points import normal_points
from avsreplay.geometry import Array

# most linearisations; size of a step, in 1 sigma, after which none follows
_LINEARISATIONS = 10
_SMALL_STEP_SIGMAS = 0.1
# size of the first step, in 1 sigma, below which the joint fit is the mean: the likelihood is bent
# there
_NEAR = 0.5
# most steps of a descent from a motion that is near; least decrease: 0.1 sigma
_LAST_STEPS = 20
_LAST_GAIN = 0.004
# most steps of a joint fit; decrease of its cost below which it ends
_JOINT_STEPS = 60
_LEAST_JOINT_GAIN = 0.05
# the same as a share of the cost, while the normal points are those of a motion that is still far
# away
_COARSE = 0.1
# damping of Levenberg-Marquardt: first value, largest value
_DAMPING = 1e-3
_MOST_DAMPING = 1e8
# profile: 1 sigma of the pin, most steps, least increase (2 if Gaussian)
_PIN = 0.1
_PROFILE_STEPS = 20
_LEAST_PROFILE_RISE = 1.0
# the acceleration and its onset after the 20 initial values
_U = slice(DIM, DIM + 6)
_ONSET = DIM + 6


def fit_jointly(
    poses: Poses,
    start: Chart,
    prior: Prior,
    factors: Array,
    onset_s: float,
    u: Array,
    widths: Array,
) -> DrivenFit:
    """Fit initial values and acceleration together by Levenberg-Marquardt along the motion with
    both.

    Where a wrong inertia makes up for a part of the acceleration, estimates of them in turn stop
    far from the minimum.

    Args:
        poses: the measurements.
        start: initial values where the descent begins.
        prior: Gaussian prior of the initial values.
        factors: (2,) noise factors of attitude and position.
        onset_s: since the epoch [s].
        u: (6,) acceleration where the descent begins.
        widths: (6,) prior 1 sigma of the acceleration, zero for a component that is zero.
    """
    chart, left = start, _JOINT_STEPS
    for last in (
        False,
        False,
        True,
    ):  # the normal points are formed about a better motion each time
        points = normal_points(without_drift(poses, chart, onset_s, u), chart, factors)
        seen, last = (
            without_drift(points, chart, onset_s, u, back=True),
            last or len(points) == len(poses),
        )
        joint = _joint(seen, prior, factors, onset_s, widths)
        joint.linearise(chart.flat, u)
        left -= _descended(joint, left, 0.0 if last else _COARSE)
        chart, u = Chart(joint.chart), joint.u
        if last:
            break
    joint.noise((float(factors[0]), float(factors[1])), True, GATE)  # Cauchy's weights
    joint.linearise(chart.flat, u)
    _descended(joint, _LAST_STEPS, 0.0, _LAST_GAIN)
    return _linear_fit(poses, seen, prior, factors, joint, onset_s)


def _joint(
    seen: Poses,
    prior: Prior,
    factors: Array,
    onset_s: float,
    widths: Array,
    slack: float | None = None,
) -> _motion.Driven:
    """The cost of initial values and an acceleration, with Huber's weights, or Cauchy's where
    ``slack`` is given.
    """
    core = _motion.Driven(seen.core, prior.mean.flat, prior.info, onset_s, widths)
    follow_orbit(core, seen)
    core.noise((float(factors[0]), float(factors[1])), slack is not None, (slack or 1.0) * GATE)
    return core


def _linear_fit(
    poses: Poses, seen: Poses, prior: Prior, factors: Array, joint: _motion.Driven, onset_s: float
) -> DrivenFit:
    """The fit to ``poses`` of a joint one to their normal points ``seen``."""
    chart, u = Chart(joint.chart), joint.u
    every, points = (without_drift(each, chart, onset_s, u) for each in (poses, seen))
    e, rows = joint.rows()
    J = rows[:, :, :DIM]
    G = np.ascontiguousarray((J @ np.linalg.inv(to_errors(chart)))[:, :, :REACHED])
    off, white = prior.info @ chart.minus(prior.mean), e - rows[:, :, _U] @ u
    problem = Problem(points, prior, factors, chart)
    motion = every, points, chart, chart, problem, joint.cost, onset_s, u
    return DrivenFit(*motion, white.reshape(-1), J.reshape(-1, DIM), G, prior.info, off, along=True)


def is_bounded(fitted: DrivenFit, widths: Array) -> bool:
    """Return whether the standard deviations of the acceleration are not too small.

    The acceleration is moved by two standard deviations in the direction in which it is known
    least, and the initial values are fitted again (profile likelihood). Half the chi-square
    increases by 2 for a Gaussian distribution. It increases less where other accelerations fit as
    well.

    Args:
        fitted: a joint fit.
        widths: as in ``fit_jointly``.
    """
    seen = without_drift(fitted.points, fitted.about, fitted.onset_s, fitted.u, back=True)
    joint = _joint(seen, fitted.problem.prior, fitted.problem.factors, fitted.onset_s, widths)
    joint.linearise(fitted.chart.flat, fitted.u)
    _descended(joint, _LAST_STEPS, 0.0)
    chart, u, cost = Chart(joint.chart), joint.u, joint.cost
    open_ = np.flatnonzero(np.append(np.ones(DIM, dtype=bool), widths > 0.0))
    P = np.linalg.inv(joint.normal()[0][np.ix_(open_, open_)])
    values, axes = np.linalg.eigh(P[DIM:, DIM:])
    step, row = np.zeros(_ONSET), np.zeros(6)
    step[open_], row[open_[DIM:] - DIM] = (
        P[:, DIM:] @ axes[:, -1] / math.sqrt(values[-1]),
        axes[:, -1],
    )
    row /= _PIN * math.sqrt(values[-1])
    for side in (-2.0, 2.0):
        joint.measure(row, side / _PIN + float(row @ fitted.u))
        joint.linearise(chart.moved(side * step[:DIM]).flat, u + side * step[_U])
        _descended(joint, _PROFILE_STEPS, 0.0)
        if joint.cost - cost < _LEAST_PROFILE_RISE:
            return False
    return True


def _descended(
    joint: _motion.Driven, most: int, share: float, least: float = _LEAST_JOINT_GAIN
) -> int:
    """Descend to the minimum of a cost, and return the number of steps, at most
    ``most``.

    The descent ends where the linearised cost decreases by less than ``least`` and this share of
    the cost.
    """
    damping, steps = _DAMPING, 0
    while steps < most and damping < _MOST_DAMPING and joint.left > max(least, share * joint.cost):
        damping, steps = joint.step(damping), steps + 1
    return steps


@value_class
class DrivenMotion:
    """The motion with an acceleration that fits all poses, about which the problem is linear.

    Attributes:
        levels: noise levels.
        chart, u, onset_s: initial values, acceleration (6,) and onset [s], about which the problem
            is linearised.
        seen: the poses, or their normal points.
        scale: (2,) on their standard deviations.
        prior: of the initial values.
        inflation: (2,) of the noise for correlated errors.
        v, P: (27,) steps of initial values, acceleration and onset by these poses, and their
            covariance (27, 27).
    """

    levels: NoiseLevels
    chart: Chart
    u: Array
    onset_s: float
    seen: Poses
    prior: Prior
    scale: Array
    inflation: Array
    v: Array
    P: Array

    def belief(self, epoch_ns: int, now_ns: int) -> DrivenBelief:
        """The belief at an instant after the last pose.

        Args:
            epoch_ns: instant of the first pose.
            now_ns: the instant [ns].
        """
        v, P = self.v, self.P
        chart, u, onset_s = (
            self.chart.moved(v[:DIM]),
            self.u + v[_U],
            max(0.0, self.onset_s + float(v[_ONSET])),
        )
        path, D = followed(chart, u, onset_s, np.array([(now_ns - epoch_ns) * 1e-9]), self.seen.arc)
        x = replace(to_state(chart), q_ab=path.q[0], w_b=path.w[0], r_a=path.r[0], v_a=path.v[0])
        C = D[0] @ P @ D[0].T
        return DrivenBelief(now_ns, x, definite(0.5 * (C + C.T)), u, P[_U, _U], D[0] @ P[:, _U])


def driven_motion(
    fitted: DrivenFit, onset_1s_s: float, widths: Array, levels: NoiseLevels
) -> DrivenMotion | None:
    """The motion of a fit with an acceleration, with disturbances and an unknown onset.

    The result is None where the steps do not become small: the problem is not linear about the
        motion found.

    Args:
        fitted: the fit.
        onset_1s_s: prior 1 sigma of the onset [s].
        widths: (6,) prior 1 sigma of the acceleration.
        levels: noise levels.
    """
    points, chart, u, onset_s = fitted.points, fitted.chart, fitted.u, fitted.onset_s
    prior, plain = fitted.problem.prior, levels.factors(mean_share(points))
    inflation = sandwich(Problem(points, prior, plain, chart, levels.slack), points, levels)[1]
    seen, scale = (
        without_drift(points, fitted.about, onset_s, u, back=True),
        plain * np.sqrt(inflation),
    )
    before = np.zeros((_ONSET + 1, _ONSET + 1))
    before[:DIM, :DIM], before[_ONSET, _ONSET] = prior.P, onset_1s_s**2
    before[_U, _U] = np.diag(np.where(u != 0.0, widths, 0.0) ** 2)
    motion = DrivenMotion(
        levels, chart, u, onset_s, seen, prior, scale, inflation, np.zeros(_ONSET + 1), before
    )
    joint = _joint(seen, prior, scale, onset_s, np.where(u != 0.0, widths, 0.0), 1.0)
    joint.linearise(chart.flat, u)
    _descended(joint, _LAST_STEPS, 0.0, _LAST_GAIN)
    chart, u = Chart(joint.chart), joint.u
    for k in range(_LINEARISATIONS):  # first about the motion of the fit, then about the one found
        off = np.concatenate([-chart.minus(prior.mean), -u, [fitted.onset_s - onset_s]])
        motion = replace(motion, chart=chart, u=u, onset_s=onset_s)
        v, P = _smoothed(motion, seen, float(seen.times_s[0]), off, before)
        if not np.isfinite(v).all() or float(np.abs(v[:DIM]).max()) > LARGEST_MOVE:
            break
        size = _size(v, P)
        if size < _SMALL_STEP_SIGMAS or (k == 0 and size < _NEAR):
            return replace(motion, v=v if size < _SMALL_STEP_SIGMAS else np.zeros_like(v), P=P)
        chart, u, onset_s = chart.moved(v[:DIM]), u + v[_U], max(0.0, onset_s + float(v[_ONSET]))
    return None


def _size(v: Array, P: Array) -> float:
    """The largest component of a step, in standard deviations."""
    open_ = np.diagonal(P) > 0.0
    return float((np.abs(v[open_]) / np.sqrt(np.diagonal(P)[open_])).max())


def _smoothed(
    motion: DrivenMotion, seen: Poses, since_s: float, v: Array, P: Array
) -> tuple[Array, Array]:
    """Steps v (27,) of initial values, acceleration and onset with covariance P, from those before
    the poses.

    ``since_s``: instant of the pose before the first one.
    """
    levels, chart = motion.levels, motion.chart
    core = _joint(seen, motion.prior, motion.scale, motion.onset_s, np.ones(6), levels.slack)
    core.linearise(chart.flat, motion.u)
    into = np.asarray(np.linalg.inv(to_errors(chart)[:REACHED, :REACHED]), dtype=np.float64)
    density = torque_density(to_state(chart).sigma, levels.torque)
    return core.smooth(v, P, into, density, levels.force**2, since_s)
