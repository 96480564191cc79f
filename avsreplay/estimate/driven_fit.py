"""The motion with a constant torque or force that fits all poses, and the belief at the last of them.

The acceleration is removed from the poses, and free motion (``batch``) is fitted to the poses as they would be without
it. About this fit the problem is linear in the initial values, the acceleration and its onset. One pass of a Kalman
filter over the poses, with the disturbances between them, gives their joint mean and covariance.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.estimate import _motion
from avsreplay.estimate.batch import FitParams, Poses, Prior, Problem, fit
from avsreplay.estimate.batch_covariance import sandwich
from avsreplay.estimate.chart import Chart, to_errors, to_state
from avsreplay.estimate.driven import DrivenBelief, drift_equivalents, drive_of, driven_steps
from avsreplay.estimate.dynamics import (
    NO_DRIVE,
    propagate_state,
    ratios,
    rotation_history,
    torque_density,
    translated,
)
from avsreplay.estimate.error_state import DIM, LARGEST_MOVE, VEL, W, definite
from avsreplay.estimate.measurement import GATE, measurement_jacobian, to_fixture
from avsreplay.estimate.noise_levels import MOST_POINTS, NoiseLevels, estimate_levels, mean_share
from avsreplay.estimate.normal_points import PositionRows, normal_points
from avsreplay.estimate.relative_orbit import OrbitArc
from avsreplay.estimate.work import Parts
from avsreplay.geometry import Array
from avsreplay.records import Belief, State

_REACHED = 12  # error states that a disturbance reaches: attitude to velocity
_PASSES, _SMALL = 10, 0.1  # most linearisations; size of a step, in 1 sigma, after which none follows
_U, _ONSET = slice(DIM, DIM + 6), DIM + 6  # the acceleration and its onset after the 20 initial values


@value_class
class DrivenFit:
    """A fit to poses from which a constant acceleration has been removed.

    Attributes:
        poses, points: with the effect of the acceleration removed, and normal points of them.
        about: initial values of the motion about which it is removed.
        chart: of the fit.  problem: the cost of the points, linearised there.  cost: half chi-square of the fit.
        onset_s: since the epoch [s].  u: (6,) acceleration: rad/s2 in {C}, m/s2 in {A}; zero for free motion.
        e, J: white residuals (6n,), extrapolated to no acceleration, and their Jacobian (6n, 20) in the chart.
        G: (n, 6, 12) Jacobian by attitude to velocity at the epoch.
        info, off: information (20, 20) of the prior and its product with the offset from the prior's mean.
    """

    poses: Poses
    points: Poses
    about: Chart
    chart: Chart
    problem: Problem
    cost: float
    onset_s: float
    u: Array
    e: Array
    J: Array
    G: Array
    info: Array
    off: Array


def fit_driven(poses: Poses, start: Chart, prior: Prior, factors: Array, onset_s: float, u: Array) -> DrivenFit:
    """Fit all poses with a given acceleration. The fit need not converge where another one acts.

    Args:
        poses: the measurements.
        start: initial values of the descent.
        prior: Gaussian prior of the initial values.
        factors: (2,) noise factors of attitude and position.
        onset_s: since the epoch [s].
        u: (6,) acceleration, zero for free motion.
    """
    poses = without_drift(poses, start, onset_s, u) if u.any() else poses
    points = normal_points(poses, start, factors)
    fitted = fit(points, start, prior, FitParams(rescale=False), factors)
    problem, chart = Problem(points, prior, factors, fitted.chart), fitted.chart
    e, H = problem.core.rows()
    G = H[:, :, :_REACHED]
    if u.any():
        e = e - drift_columns(G, points.times_s, chart, onset_s) @ u
    info = prior.info
    off, J = info @ chart.minus(prior.mean), (H @ to_errors(chart)).reshape(e.size, -1)
    return DrivenFit(poses, points, start, chart, problem, fitted.half_chi2, onset_s, u, e.reshape(-1), J, G, info, off)


def without_drift(poses: Poses, about: Chart, onset_s: float, u: Array, back: bool = False) -> Poses:
    """The poses as they would be without the acceleration u (6,) since ``onset_s``, about the motion from ``about``.

    They have the same errors in {C}, relative to free motion, as the poses relative to that with u. ``back``: the
    inverse.
    """
    x, times = to_state(about), poses.times_s
    since, late = np.maximum(times - onset_s, 0.0), times > onset_s
    q_free, at = rotation_history(x, times).q, propagate_state(x, onset_s)[0]
    q_driven, centre = q_free.copy(), translated(x, times, poses.arc)[0]
    q_driven[late] = _motion.follow(at.q_ab, at.w_b, ratios(x.sigma), NO_DRIVE, since[late], drive_of(x, u))[0]
    moved = centre + 0.5 * since[:, None] ** 2 * u[3:]
    (q_from, r_from), (q_to, r_to) = ((q_free, centre), (q_driven, moved))[:: 1 if back else -1]
    turn = geometry.multiply(q_to, geometry.conjugate(q_from))
    away = (geometry.matrix(turn) @ (poses.t - r_from)[:, :, None])[:, :, 0]
    return replace(poses, q=geometry.multiply(turn, poses.q), t=r_to + away)


def equivalents(chart: Chart, times_s: Array) -> Array:
    """``drift_equivalents`` (n, 12, 6) of unit accelerations in {C} and in {A}."""
    x = to_state(chart)
    B = drift_equivalents(x, times_s)
    B[:, :, :3] = B[:, :, :3] @ geometry.matrix(x.q_bc)
    return B


def drift_columns(G: Array, times_s: Array, chart: Chart, onset_s: float) -> Array:
    """White columns (n, 6, 6) of the residuals by an acceleration since the onset."""
    B = equivalents(chart, np.append(times_s, onset_s))
    return np.asarray((G @ (B[:-1] - B[-1])) * (times_s > onset_s)[:, None, None])


def levels_of(
    fitted: DrivenFit,
    levels: NoiseLevels,
    widths: Array,
    claimed: bool,
    fixed: tuple[float | None, float | None],
    positions: PositionRows | None = None,
) -> Parts[NoiseLevels]:
    """Noise levels from the residuals of the poses about the motion with the acceleration, in parts.

    Args:
        fitted: the fit.
        levels: the last estimate.
        widths: (6,) prior 1 sigma of the acceleration.
        claimed: the noise of the poses is as claimed; only the disturbances are estimated.
        fixed: root densities of torque and force that are given; None to estimate them.
        positions: as in ``estimate_levels``.
    """
    old, kinds = fitted.problem, np.flatnonzero(fitted.u)
    points = normal_points(fitted.poses, fitted.chart, old.factors, MOST_POINTS)
    problem = Problem(points, old.prior, old.factors, fitted.chart, np.inf)
    unknowns = drift_unknowns(fitted, points, problem, widths, kinds)
    return (yield from estimate_levels(points, problem, levels, claimed, fixed, unknowns, positions))


def drift_unknowns(
    fitted: DrivenFit, points: Poses, problem: Problem, widths: Array, kinds: NDArray[np.int64]
) -> tuple[Array, Array]:
    """The acceleration as unknowns of ``disturbed_likelihood``: columns at the prior 1 sigma ``widths``, and size."""
    G = problem.core.rows()[1][:, :, :_REACHED]
    columns = drift_columns(G, points.times_s, fitted.chart, fitted.onset_s) * widths
    return columns[:, :, kinds], (fitted.u / widths)[kinds]


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
        states, D = _followed(chart, u, onset_s, np.array([(now_ns - epoch_ns) * 1e-9]), self.seen.arc)
        C = D[0] @ P @ D[0].T
        return DrivenBelief(now_ns, states[0], definite(0.5 * (C + C.T)), u, P[_U, _U], D[0] @ P[:, _U])


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
    for _ in range(_PASSES):  # linearised about the motion of the fit, then about the one found
        off = np.concatenate([-chart.minus(prior.mean), -u, [fitted.onset_s - onset_s]])
        motion = replace(motion, chart=chart, u=u, onset_s=onset_s)
        v, P = _smoothed(motion, seen, float(seen.times_s[0]), off, before.copy())
        yield 12 * len(seen)
        if not np.isfinite(v).all() or float(np.abs(v[:DIM]).max()) > LARGEST_MOVE:
            break
        if _small(v, P):
            return replace(motion, v=v, P=P)
        chart, u, onset_s = chart.moved(v[:DIM]), u + v[_U], max(0.0, onset_s + float(v[_ONSET]))
    return None


def _small(v: Array, P: Array) -> bool:
    """Return whether a step is so small that the linearisation holds."""
    open_ = np.diagonal(P) > 0.0
    return bool(np.all(np.abs(v[open_]) < _SMALL * np.sqrt(np.diagonal(P)[open_])))


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
    states, D = _followed(motion.chart, motion.u, motion.onset_s, np.sort(every), seen.arc)
    density = np.sqrt(torque_density(to_state(motion.chart).sigma, levels.torque))
    push = np.zeros((DIM, 6))
    push[W, :3], push[VEL, 3:] = np.diag(density), levels.force * np.eye(3)
    M = np.linalg.solve(D[place[:n]][:, :, :DIM], push) * np.sqrt(lengths)[:, None, None]
    Q = M @ np.swapaxes(M, 1, 2)
    here = [states[k] for k in place[n:]]
    q, centre = (np.array([getattr(x.T_ac, name) for x in here]) for name in ("q", "t"))
    theta = geometry.log(geometry.multiply(geometry.conjugate(seen.q), q))
    moved = np.swapaxes(geometry.matrix(seen.q), 1, 2) @ (centre - seen.t)[:, :, None]
    root = seen.root / np.repeat(motion.scale, 3)
    e = (root @ np.concatenate([theta, moved[:, :, 0]], axis=1)[:, :, None])[:, :, 0]
    H = np.array([to_fixture(x.T_ac.q, x.q_bc) @ measurement_jacobian(x) for x in here])
    weight = np.sqrt(1.0 / np.maximum(1.0, (e * e).sum(axis=1) / gate))
    e, rows = weight[:, None] * e, weight[:, None, None] * (root @ H @ D[place[n:]])
    for k in range(n):
        P[:DIM, :DIM] += Q[k]
        seen_by = rows[k] @ P
        K = np.linalg.solve(seen_by @ rows[k].T + np.eye(6), seen_by).T
        left = one - K @ rows[k]
        v, P = v - K @ (e[k] + rows[k] @ v), left @ P @ left.T + K @ K.T
    return v, P


def _followed(
    chart: Chart, u: Array, onset_s: float, times_s: Array, arc: OrbitArc | None
) -> tuple[list[State], Array]:
    """The states at ``times_s`` (n,) [s], ascending, and their derivatives (n, 20, 27) by chart steps, u and onset."""
    first, T = int(np.searchsorted(times_s, onset_s, side="right")), to_errors(chart)
    D = np.zeros((len(times_s), DIM, _ONSET + 1))
    start = Belief(0, to_state(chart), np.eye(DIM))
    states, Phi, _, _ = driven_steps(start, np.append(times_s[:first], onset_s), 0.0, arc)
    D[:first, :, :DIM], at, until = Phi[:-1] @ T, states.pop(), Phi[-1] @ T
    if first < len(times_s):
        driven = DrivenBelief(0, at, np.eye(DIM), u, np.zeros((6, 6)), np.zeros((DIM, 6)))
        arc = None if arc is None else arc.shifted(onset_s)
        later, Phi, by_u, _ = driven_steps(driven, times_s[first:] - onset_s, 0.0, arc)
        missed = np.zeros(DIM)  # per second by which the onset is later
        missed[W], missed[VEL] = -np.array(drive_of(at, u)), -u[3:]
        D[first:, :, :DIM], D[first:, :, _U], D[first:, :, _ONSET] = Phi @ until, by_u, Phi @ missed
        states += later
    return states, D
