"""The motion with a constant torque or force that fits all poses, and the belief at the last of them.

The acceleration is removed from the poses: what is left is the fit of free motion (``batch``) to poses as they would be
without it. About this fit the problem is linear in the initial values, the acceleration and its onset, so that one pass
of a Kalman filter over the poses, with the disturbances between them, gives their joint mean and covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.estimate import _motion
from avsreplay.estimate.batch import FitParams, Poses, Prior, Problem, fit
from avsreplay.estimate.batch_covariance import sandwich
from avsreplay.estimate.chart import Chart, to_errors, to_state
from avsreplay.estimate.driven import DrivenBelief, drift_equivalents, drive_of, propagated
from avsreplay.estimate.dynamics import NO_DRIVE, propagate_state, ratios, rotation_history, torque_density
from avsreplay.estimate.error_state import DIM, RHO, VEL, W, definite
from avsreplay.estimate.noise_levels import MOST_POINTS, NoiseLevels, estimate_levels, mean_share
from avsreplay.estimate.normal_points import normal_points
from avsreplay.estimate.relative_orbit import RelativeOrbit
from avsreplay.geometry import Array

_REACHED = 12  # error states that a disturbance reaches: attitude to velocity
_U, _ONSET = slice(DIM, DIM + 6), DIM + 6  # the acceleration and its onset after the 20 initial values


@dataclass(frozen=True, slots=True, eq=False)
class DrivenFit:
    """A fit to poses from which a constant acceleration has been removed.

    Attributes:
        poses, points: with the effect of the acceleration removed, and normal points of them.
        chart: of the fit.  problem: the cost of the points, linearised there.  cost: half chi-square of the fit.
        onset_s: since the epoch [s].  u: (6,) acceleration: rad/s2 in {C}, m/s2 in {A}; zero for free motion.
        e, J: white residuals (6n,), extrapolated to no acceleration, and their Jacobian (6n, 20) in the chart.
        G: (n, 6, 12) Jacobian by attitude to velocity at the epoch.
        info, off: information (20, 20) of the prior and its product with the offset from the prior's mean.
    """

    poses: Poses
    points: Poses
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
    info = np.asarray(np.linalg.inv(prior.P), dtype=np.float64)
    off, J = info @ chart.minus(prior.mean), (H @ to_errors(chart)).reshape(e.size, -1)
    return DrivenFit(poses, points, chart, problem, fitted.half_chi2, onset_s, u, e.reshape(-1), J, G, info, off)


def without_drift(poses: Poses, start: Chart, onset_s: float, u: Array) -> Poses:
    """The poses as they would be without the acceleration u (6,) since ``onset_s``, about the motion from ``start``."""
    x, times = to_state(start), poses.times_s
    since = np.maximum(times - onset_s, 0.0)
    q_free, late = rotation_history(x, times).q, times > onset_s
    at, q_driven = propagate_state(x, onset_s)[0], q_free.copy()
    q_driven[late] = _motion.follow(at.q_ab, at.w_b, ratios(x.sigma), NO_DRIVE, since[late], drive_of(x, u))[0]
    drifted, free = geometry.multiply(q_driven, x.q_bc), geometry.multiply(q_free, x.q_bc)
    turned = geometry.multiply(poses.q, geometry.multiply(geometry.conjugate(drifted), free))
    arm = (geometry.matrix(q_free) - geometry.matrix(q_driven)) @ x.c_b
    return replace(poses, q=turned, t=poses.t + arm - 0.5 * since[:, None] ** 2 * u[3:])


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
    fitted: DrivenFit, levels: NoiseLevels, widths: Array, claimed: bool, fixed: tuple[float | None, float | None]
) -> NoiseLevels:
    """Noise levels from the residuals of the poses about the motion with the acceleration.

    Args:
        fitted: the fit.
        levels: the last estimate, of which the disturbances are not used: the acceleration may have caused them.
        widths: (6,) prior 1 sigma of the acceleration.
        claimed: the noise of the poses is as claimed; only the disturbances are estimated.
        fixed: root densities of torque and force that are given; None to estimate them.
    """
    old, kinds = fitted.problem, np.flatnonzero(fitted.u)
    points = normal_points(fitted.poses, fitted.chart, old.factors, MOST_POINTS)
    problem = Problem(points, old.prior, old.factors, fitted.chart, np.inf)
    begin = replace(levels, torque=0.0, force=0.0)
    unknowns = drift_unknowns(fitted, points, problem, widths, kinds)
    return estimate_levels(points, problem, begin, claimed, fixed, unknowns)


def drift_unknowns(
    fitted: DrivenFit, points: Poses, problem: Problem, widths: Array, kinds: NDArray[np.int64]
) -> tuple[Array, Array]:
    """The acceleration as unknowns of ``disturbed_likelihood``: columns at the prior 1 sigma ``widths``, and size."""
    G = problem.core.rows()[1][:, :, :_REACHED]
    columns = drift_columns(G, points.times_s, fitted.chart, fitted.onset_s) * widths
    return columns[:, :, kinds], (fitted.u / widths)[kinds]


def driven_belief(
    fitted: DrivenFit,
    onset_1s_s: float,
    widths: Array,
    levels: NoiseLevels,
    epoch_ns: int,
    now_ns: int,
    orbit: RelativeOrbit | None,
) -> tuple[DrivenBelief, Array]:
    """The belief at the last pose, and the inflation (2,) of the noise for correlated errors.

    Args:
        fitted: the fit.
        onset_1s_s: prior 1 sigma of the onset [s].
        widths: (6,) prior 1 sigma of the acceleration.
        levels: noise levels.
        epoch_ns: instant of the first pose.
        now_ns: instant of the last scan.
        orbit: the relative orbit that the target is on; None for free motion.
    """
    points, chart, prior = fitted.points, fitted.chart, fitted.problem.prior
    plain = levels.factors(mean_share(points))
    problem = Problem(points, prior, plain, chart, levels.slack)
    inflation = sandwich(problem, points, levels)[1]
    problem.reweigh(plain * np.sqrt(inflation))
    e, H = problem.core.rows()
    A = np.concatenate([H @ to_errors(chart), _unknowns(fitted, H[:, :, :_REACHED])], axis=2)
    e = e - A[:, :, _U] @ fitted.u
    v, P = np.zeros(_ONSET + 1), np.zeros((_ONSET + 1, _ONSET + 1))
    v[:DIM], P[:DIM, :DIM] = -chart.minus(prior.mean), prior.P
    P[_U, _U] = np.diag(np.where(fitted.u != 0.0, widths, 0.0) ** 2)
    P[_ONSET, _ONSET] = onset_1s_s**2
    one = np.eye(len(v))
    for rows, off, Q in zip(A, e, _noise_between(points.times_s, chart, levels), strict=True):
        P[:_REACHED, :_REACHED] += Q
        AP = rows @ P
        K = np.linalg.solve(AP @ rows.T + np.eye(6), AP).T
        left = one - K @ rows
        v, P = v - K @ (off + rows @ v), left @ P @ left.T + K @ K.T
    return _at(chart.moved(v[:DIM]), v, P, fitted, epoch_ns, now_ns, orbit), inflation


def _unknowns(fitted: DrivenFit, G: Array) -> Array:
    """White columns (n, 6, 7) by the acceleration and by its onset."""
    times, onset, u = fitted.points.times_s, fitted.onset_s, fitted.u
    x, back = to_state(fitted.chart), np.zeros((_REACHED, 1))  # of a later onset [1/s], as errors at the epoch
    S = rotation_history(x, np.array([onset])).S[0, :, :6]
    back[:6, 0] = -np.linalg.inv(S)[:, 3:] @ np.array(drive_of(x, u))
    back[RHO, 0], back[VEL, 0] = onset * u[3:], -u[3:]
    later = (G @ back) * (times > onset)[:, None, None]
    return np.concatenate([drift_columns(G, times, fitted.chart, onset), later], axis=2)


def _noise_between(times_s: Array, chart: Chart, levels: NoiseLevels) -> Array:
    """Covariance (n, 12, 12) in chart steps at the epoch of the disturbance before each pose since the one before.

    It acts as one impulse in the middle, as in ``noise_levels``.
    """
    x, lengths = to_state(chart), np.diff(times_s, prepend=times_s[0])
    middle = times_s - 0.5 * lengths
    M = np.zeros((len(times_s), _REACHED, 6))
    density = np.sqrt(torque_density(x.sigma, levels.torque))
    M[:, :6, :3] = np.linalg.inv(rotation_history(x, middle).S[:, :, :6])[:, :, 3:] * density
    M[:, RHO, 3:] = -levels.force * middle[:, None, None] * np.eye(3)
    M[:, VEL, 3:] = levels.force * np.eye(3)
    into = np.linalg.inv(to_errors(chart)[:_REACHED, :_REACHED])
    steps = into @ M * np.sqrt(lengths)[:, None, None]
    return np.asarray(steps @ np.swapaxes(steps, 1, 2))


def _at(
    chart: Chart, v: Array, P: Array, fitted: DrivenFit, epoch_ns: int, now_ns: int, orbit: RelativeOrbit | None
) -> DrivenBelief:
    """The belief at ``now_ns`` by initial values, acceleration and onset, with their covariance P (27, 27)."""
    x0, u = to_state(chart), v[_U]
    onset_s = float(np.clip(fitted.onset_s + v[_ONSET], 0.0, (now_ns - epoch_ns) * 1e-9))
    x, Phi = propagate_state(x0, onset_s, fitted.poses.arc)
    M = np.zeros((DIM + 6, _ONSET + 1))
    M[:DIM, :DIM], M[_U, _U] = Phi @ to_errors(chart), np.eye(6)
    M[W, _ONSET], M[VEL, _ONSET] = -np.array(drive_of(x, u)), -u[3:]
    C = M @ P @ M.T
    onset = DrivenBelief(epoch_ns + round(onset_s * 1e9), x, C[:DIM, :DIM], u, C[_U, _U], C[:DIM, _U])
    there, _ = propagated(onset, now_ns, 0.0, 0.0, orbit)
    if not isinstance(there, DrivenBelief):
        raise AssertionError("a driven belief remains one")
    return replace(there, P=definite(there.P))
