"""The motion with a constant torque or force that fits all poses, and the belief at the last of them.

Initial values and acceleration are fitted together. One pass of a Kalman filter over the poses, with the disturbances
between them, gives the joint mean and covariance of the initial values, the acceleration and its onset.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.estimate.batch import Poses, Prior, Problem
from avsreplay.estimate.batch_covariance import sandwich
from avsreplay.estimate.chart import Chart, to_errors, to_state
from avsreplay.estimate.driven import DrivenBelief, followed, followed_poses
from avsreplay.estimate.driven_fit import (
    NO_ACCELERATION,
    REACHED,
    DrivenFit,
    residuals_along,
    white_residuals,
    without_drift,
)
from avsreplay.estimate.dynamics import torque_density
from avsreplay.estimate.error_state import DIM, LARGEST_MOVE, VEL, W, definite
from avsreplay.estimate.measurement import GATE
from avsreplay.estimate.noise_levels import NoiseLevels, mean_share
from avsreplay.estimate.normal_points import normal_points
from avsreplay.estimate.work import Parts
from avsreplay.geometry import Array

_PASSES, _SMALL = 10, 0.1  # most linearisations; size of a step, in 1 sigma, after which none follows
_NEAR = 0.5  # size of the first step, in 1 sigma, below which the joint fit is the mean: the likelihood is bent there
_LAST_STEPS, _LAST_GAIN = 20, 0.004  # most steps of a descent from a motion that is near; least decrease: 0.1 sigma
_JOINT_STEPS, _LEAST_GAIN = 60, 0.05  # most steps of a joint fit; decrease of its cost below which it ends
_COARSE = 0.1  # the same, as a part of the cost, with normal points about a motion that is far from the one found
_DAMPING, _LESS, _MORE, _MOST_DAMPING = 1e-3, 5.0, 4.0, 1e8  # of Levenberg-Marquardt: first, divided, multiplied, last
_GOOD = 0.5  # least decrease of the cost over the expected one from which the damping is reduced
_PROBE, _LARGEST_BEND = 0.1, 0.375  # part of a step where its second order is found; largest over the first order
_PIN, _PIN_STEPS, _LEAST_RISE = 0.1, 20, 1.0  # of a profile: 1 sigma, most steps, least increase, 2 for a Gaussian one
_JOINT_WORK = 10  # work of a step for each pose, in linearised poses
_U, _ONSET = slice(DIM, DIM + 6), DIM + 6  # the acceleration and its onset after the 20 initial values


def fit_jointly(
    poses: Poses, start: Chart, prior: Prior, factors: Array, onset_s: float, u: Array, widths: Array
) -> Parts[DrivenFit]:
    """Fit initial values and acceleration together by Levenberg-Marquardt along the motion with both, in parts.

    Where a wrong inertia makes up for a part of the acceleration, estimates of them in turn stop far from the minimum.

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
    for last in (False, False, True):  # with normal points about a motion that comes closer
        points = normal_points(without_drift(poses, chart, onset_s, u), chart, factors)
        seen, last = without_drift(points, chart, onset_s, u, back=True), last or len(points) == len(poses)
        joint = _Joint(seen, prior, factors, onset_s, widths)
        yield _JOINT_WORK * len(seen)
        now, steps = yield from _descended(joint, joint.linearised(chart, u), left, 0.0 if last else _COARSE)
        chart, u, left = now.chart, now.u, left - steps
        if last:
            break
    joint = replace(joint, redescend=True)
    now, _ = yield from _descended(joint, joint.linearised(chart, u), _LAST_STEPS, 0.0, _LAST_GAIN)
    return _linear_fit(poses, joint, now)


def _linear_fit(poses: Poses, joint: _Joint, now: _Linear) -> DrivenFit:
    """The fit to ``poses`` of a joint one to their normal points."""
    chart, u, prior, n = now.chart, now.u, joint.prior, len(joint.seen)
    every, points = (without_drift(each, chart, joint.onset_s, u) for each in (poses, joint.seen))
    problem, J = Problem(points, prior, joint.factors, chart), now.J[:, :DIM]
    G = (J.reshape(n, 6, DIM) @ np.linalg.inv(to_errors(chart)))[:, :, :REACHED]
    off = prior.info @ chart.minus(prior.mean)
    motion = every, points, chart, chart, problem, now.cost, joint.onset_s, u
    return DrivenFit(*motion, now.e - now.J[:, DIM:] @ u, J, G, prior.info, off, along=True)


def is_bounded(fitted: DrivenFit, widths: Array) -> Parts[bool]:
    """Return whether the standard deviations of the acceleration are not too small, in parts.

    The acceleration is moved by two standard deviations in the direction in which it is known least, and the initial
    values are fitted again (profile likelihood). Half the chi-square increases by 2 for a Gaussian distribution. It
    increases less where other accelerations fit as well.

    Args:
        fitted: a joint fit.
        widths: as in ``fit_jointly``.
    """
    seen = without_drift(fitted.points, fitted.about, fitted.onset_s, fitted.u, back=True)
    joint = _Joint(seen, fitted.problem.prior, fitted.problem.factors, fitted.onset_s, widths)
    now, open_ = joint.linearised(fitted.chart, fitted.u), np.flatnonzero(joint.open)
    now, _ = yield from _descended(joint, now, _LAST_STEPS, 0.0)
    P = np.linalg.inv(now.normal[np.ix_(open_, open_)])
    values, axes = np.linalg.eigh(P[DIM:, DIM:])
    step, row = np.zeros(_ONSET), np.zeros(6)
    step[open_], row[open_[DIM:] - DIM] = P[:, DIM:] @ axes[:, -1] / math.sqrt(values[-1]), axes[:, -1]
    for side in (-2.0, 2.0):
        pin = row / (_PIN * math.sqrt(values[-1])), side / _PIN + float(row @ fitted.u) / (_PIN * math.sqrt(values[-1]))
        pinned = replace(joint, pin=pin)
        there, _ = yield from _descended(pinned, pinned.linearised(*now.moved(side * step)), _PIN_STEPS, 0.0)
        if there.cost - now.cost < _LEAST_RISE:
            return False
    return True


def _descended(
    joint: _Joint, now: _Linear, most: int, share: float, least: float = _LEAST_GAIN
) -> Parts[tuple[_Linear, int]]:
    """The minimum of a cost, and the number of steps to it, at most ``most``.

    The descent ends where the linearised cost decreases by less than ``least`` and this share of the cost.
    """
    damping, steps = _DAMPING, 0
    while steps < most and damping < _MOST_DAMPING and now.left > max(least, share * now.cost):
        step = joint.step(now, damping)
        then, steps = joint.linearised(*now.moved(step)), steps + 1
        yield _JOINT_WORK * len(joint.seen)
        expected = -float(now.slope @ step) - 0.5 * float(step @ now.normal @ step)
        gain = now.cost - then.cost
        damping *= _MORE if gain <= 0.0 else 1.0 if gain < _GOOD * expected else 1.0 / _LESS
        now = then if gain > 0.0 else now
    return now, steps


@value_class
class _Linear:
    """The cost about initial values and an acceleration u (6,).

    Attributes:
        e, J: weighted residuals (6n,) and their Jacobian (6n, 26).  weights: (6n,) their square roots.
        slope, normal: gradient (26,) and normal matrix (26, 26).  left: decrease of the linearised cost to its minimum.
    """

    chart: Chart
    u: Array
    cost: float
    e: Array
    J: Array
    weights: Array
    slope: Array
    normal: Array
    left: float

    def moved(self, step: Array) -> tuple[Chart, Array]:
        """Initial values and acceleration after a step (26,)."""
        return self.chart.moved(step[:DIM]), self.u + step[_U]


@value_class
class _Joint:
    """The cost of initial values and an acceleration since a given onset; arguments as in ``fit_jointly``.

    ``pin``: row (6,) and value of a pseudo-measurement of the acceleration with unit standard deviation.
    ``redescend``: Cauchy's weights in place of Huber's.
    """

    seen: Poses
    prior: Prior
    factors: Array
    onset_s: float
    widths: Array
    pin: tuple[Array, float] = (NO_ACCELERATION, 0.0)
    redescend: bool = False

    @property
    def open(self) -> NDArray[np.bool_]:
        """(26,) which unknowns are not fixed."""
        return np.append(np.ones(DIM, dtype=bool), self.widths > 0.0)

    def residuals(self, chart: Chart, u: Array) -> tuple[Array, Array]:
        """White residuals (n, 6) of the poses, and their Jacobian (n, 6, 26)."""
        path, D = followed(chart, u, self.onset_s, self.seen.times_s, self.seen.arc)
        return residuals_along(path, D[:, :, :_ONSET], chart, self.seen, self.factors)

    def linearised(self, chart: Chart, u: Array) -> _Linear:
        """The cost about a motion."""
        e, rows = self.residuals(chart, u)
        excess = np.maximum((e * e).sum(axis=1) / GATE, 1.0)
        excess = excess if self.redescend else np.sqrt(excess)
        beyond = float((np.log(excess) if self.redescend else excess - 1.0).sum())
        weights, off = np.repeat(np.sqrt(1.0 / excess), 6), np.append(chart.minus(self.prior.mean), u)
        J, left = weights[:, None] * rows.reshape(-1, _ONSET), weights * e.reshape(-1)
        info, (row, value) = np.zeros((_ONSET, _ONSET)), self.pin
        info[:DIM, :DIM], info[_U, _U] = self.prior.info, np.diag(np.where(self.widths > 0.0, self.widths, 1.0) ** -2.0)
        missed = float(row @ u) - value
        cost = 0.5 * float(left @ left + GATE * beyond + off @ info @ off + missed * missed)
        slope, normal = J.T @ left + info @ off, J.T @ J + info
        slope[_U] += missed * row
        normal[_U, _U] += np.outer(row, row)
        found = _Linear(chart, u, cost if math.isfinite(cost) else math.inf, left, J, weights, slope, normal, 0.0)
        return replace(found, left=-0.5 * float(slope @ self._newton(found, 0.0)[0]))

    def _newton(self, now: _Linear, damping: float) -> tuple[Array, Array]:
        """The damped step (26,) in the open unknowns, and the inverse (26, 26) of the damped normal matrix."""
        open_, inverse = np.flatnonzero(self.open), np.zeros((_ONSET, _ONSET))
        A = now.normal[np.ix_(open_, open_)]
        inverse[np.ix_(open_, open_)] = np.linalg.inv(A + damping * np.diag(np.diagonal(A)))
        return -inverse @ now.slope, inverse

    def step(self, now: _Linear, damping: float) -> Array:
        """The step (26,) of Levenberg-Marquardt with its second-order part, as in ``batch``."""
        step, inverse = self._newton(now, damping)
        chart, u = now.moved(_PROBE * step)
        path = followed_poses(chart, u, self.onset_s, self.seen.times_s, self.seen.arc)
        e = white_residuals(*path, chart, self.seen, self.factors).reshape(-1)
        second = 2.0 / _PROBE * ((now.weights * e - now.e) / _PROBE - now.J @ step)
        bend, scale = -0.5 * inverse @ (now.J.T @ second), np.sqrt(np.diagonal(now.normal))
        bent = float(np.linalg.norm(scale * bend)) <= _LARGEST_BEND * float(np.linalg.norm(scale * step))
        return step + bend if bent else step


@value_class
class DrivenMotion:
    """The motion with an acceleration that fits all poses, about which the problem is linear.

    Attributes:
        levels: noise levels.
        chart, u, onset_s: initial values, acceleration (6,) and onset [s], about which the problem is linearised.
        seen: the poses, or their normal points.  scale: (2,) on their standard deviations.
        inflation: (2,) of the noise for correlated errors.
        v, P: (27,) steps of initial values, acceleration and onset by these poses, and their covariance (27, 27).
    """

    levels: NoiseLevels
    chart: Chart
    u: Array
    onset_s: float
    seen: Poses
    scale: Array
    inflation: Array
    v: Array
    P: Array

    def belief(self, epoch_ns: int, now_ns: int, later: Poses | None = None) -> DrivenBelief:
        """The belief at an instant after the last pose.

        Args:
            epoch_ns: instant of the first pose.
            now_ns: the instant [ns].
            later: poses after those of the fit.
        """
        v, P = self.v, self.P
        if later is not None:
            v, P = _smoothed(self, later, float(self.seen.times_s[-1]), v, P)
        chart, u, onset_s = self.chart.moved(v[:DIM]), self.u + v[_U], max(0.0, self.onset_s + float(v[_ONSET]))
        path, D = followed(chart, u, onset_s, np.array([(now_ns - epoch_ns) * 1e-9]), self.seen.arc)
        x = replace(to_state(chart), q_ab=path.q[0], w_b=path.w[0], r_a=path.r[0], v_a=path.v[0])
        C = D[0] @ P @ D[0].T
        return DrivenBelief(now_ns, x, definite(0.5 * (C + C.T)), u, P[_U, _U], D[0] @ P[:, _U])


def driven_motion(
    fitted: DrivenFit, onset_1s_s: float, widths: Array, levels: NoiseLevels
) -> Parts[DrivenMotion | None]:
    """The motion of a fit with an acceleration, with disturbances and an unknown onset, in parts.

    The result is None where the steps do not become small: the problem is not linear about the motion found.

    Args:
        fitted: the fit.
        onset_1s_s: prior 1 sigma of the onset [s].
        widths: (6,) prior 1 sigma of the acceleration.
        levels: noise levels.
    """
    points, chart, u, onset_s = fitted.points, fitted.chart, fitted.u, fitted.onset_s
    prior, plain = fitted.problem.prior, levels.factors(mean_share(points))
    inflation = sandwich(Problem(points, prior, plain, chart, levels.slack), points, levels)[1]
    seen, scale = without_drift(points, fitted.about, onset_s, u, back=True), plain * np.sqrt(inflation)
    before = np.zeros((_ONSET + 1, _ONSET + 1))
    before[:DIM, :DIM], before[_ONSET, _ONSET] = prior.P, onset_1s_s**2
    before[_U, _U] = np.diag(np.where(u != 0.0, widths, 0.0) ** 2)
    motion = DrivenMotion(levels, chart, u, onset_s, seen, scale, inflation, np.zeros(_ONSET + 1), before)
    joint = _Joint(seen, prior, scale, onset_s, np.where(u != 0.0, widths, 0.0), redescend=True)
    now, _ = yield from _descended(joint, joint.linearised(chart, u), _LAST_STEPS, 0.0, _LAST_GAIN)
    chart, u = now.chart, now.u
    for k in range(_PASSES):  # linearised about the motion of the fit, then about the one found
        off = np.concatenate([-chart.minus(prior.mean), -u, [fitted.onset_s - onset_s]])
        motion = replace(motion, chart=chart, u=u, onset_s=onset_s)
        v, P = _smoothed(motion, seen, float(seen.times_s[0]), off, before.copy())
        yield 12 * len(seen)
        if not np.isfinite(v).all() or float(np.abs(v[:DIM]).max()) > LARGEST_MOVE:
            break
        size = _size(v, P)
        if size < _SMALL or (k == 0 and size < _NEAR):
            return replace(motion, v=v if size < _SMALL else np.zeros_like(v), P=P)
        chart, u, onset_s = chart.moved(v[:DIM]), u + v[_U], max(0.0, onset_s + float(v[_ONSET]))
    return None


def _size(v: Array, P: Array) -> float:
    """The largest component of a step, in standard deviations."""
    open_ = np.diagonal(P) > 0.0
    return float((np.abs(v[open_]) / np.sqrt(np.diagonal(P)[open_])).max())


def _smoothed(motion: DrivenMotion, seen: Poses, since_s: float, v: Array, P: Array) -> tuple[Array, Array]:
    """Steps v (27,) of initial values, acceleration and onset with covariance P, from those before the poses.

    The disturbance between two poses acts as one impulse in the middle, as in ``noise_levels``. ``since_s``: instant of
    the pose before the first one.
    """
    levels, one = motion.levels, np.eye(len(v))
    times, n, gate = seen.times_s, len(seen), GATE * levels.slack
    lengths = np.diff(times, prepend=since_s)
    every = np.concatenate([times - 0.5 * lengths, times])
    place = np.argsort(np.argsort(every, kind="stable"))
    path, D = followed(motion.chart, motion.u, motion.onset_s, np.sort(every), seen.arc)
    density = np.sqrt(torque_density(to_state(motion.chart).sigma, levels.torque))
    push = np.zeros((DIM, 6))
    push[W, :3], push[VEL, 3:] = np.diag(density), levels.force * np.eye(3)
    M = np.linalg.solve(D[place[:n]][:, :, :DIM], push) * np.sqrt(lengths)[:, None, None]
    Q = M @ np.swapaxes(M, 1, 2)
    here = place[n:]
    e, rows = residuals_along(path.some(here), D[here], motion.chart, seen, motion.scale)
    weight = np.sqrt(1.0 / np.maximum(1.0, (e * e).sum(axis=1) / gate))
    e, rows = weight[:, None] * e, weight[:, None, None] * rows
    for k in range(n):
        P[:DIM, :DIM] += Q[k]
        seen_by = rows[k] @ P
        K = np.linalg.solve(seen_by @ rows[k].T + np.eye(6), seen_by).T
        left = one - K @ rows[k]
        v, P = v - K @ (e[k] + rows[k] @ v), left @ P @ left.T + K @ K.T
    return v, P
