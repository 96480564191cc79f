"""A persistent torque or force on the target: found in the residuals of the batch fit, with its onset and its size.

A constant angular acceleration in {B} and a constant acceleration in {A}, both from an unknown instant on, are linear
unknowns about the trajectory of the fit. The error states at the epoch that a unit acceleration since tau is equivalent
to at t are B(t) - B(tau), B(t) being the integral of Phi(s, 0)^-1 G ds; the residuals of the poses depend on them as on
the initial values themselves. With a Gaussian prior on the size the evidence against free motion is in closed form, as
in ``hypotheses``. The noise of the poses is that of the residuals with the drift removed, correlation included.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from avsreplay.estimate.batch import FitParams, Poses, Prior, Problem, fit
from avsreplay.estimate.chart import Chart, to_errors, to_state
from avsreplay.estimate.dynamics import rotation_history
from avsreplay.estimate.initialise import PoseFix, poses_of, weak_prior
from avsreplay.estimate.noise import integrated_autocorrelation
from avsreplay.estimate.noise_levels import MOST_POINTS, NO_LEVELS, NoiseLevels, disturbance_evidence
from avsreplay.estimate.normal_points import normal_points
from avsreplay.estimate.params import EstimatorParams
from avsreplay.geometry import Array
from avsreplay.records import Drift, State

_ONSETS = 12  # number of onsets tried, the first at the epoch
_LATEST_ONSET = 0.85  # share of the poses before the last onset tried
_STEP_RAD = 0.1  # step of the integral B
_FOUND = 14.0  # log odds of a drift over free motion from which it is reported
_CONSTANT = 5.0  # log odds of a drift over random disturbances from which it is reported
_KINDS = (slice(0, 3), slice(3, 6), slice(0, 6))  # torque, force, both
_PER_KIND = (0.0, 0.0, math.log(1e-2))  # log prior odds of each


@dataclass(frozen=True, slots=True, eq=False)
class _Linear:
    """Residuals e (6n,) and Jacobian J (6n, 20) in the chart, of unit variance.

    ``G`` (6n, 12) is the Jacobian by attitude to velocity at the epoch; ``info`` and ``off`` are those of the prior.
    ``late`` (6n,) are the times of the rows.
    """

    e: Array
    J: Array
    G: Array
    info: Array
    off: Array
    late: Array


def find_drift(
    fixes: tuple[PoseFix, ...],
    start: Chart,
    params: EstimatorParams,
    factors: Array,
    scale: tuple[float, float],
    levels: NoiseLevels = NO_LEVELS,
) -> Drift | None:
    """The drift that the poses show, None where free motion explains them.

    Args:
        fixes: healthy poses, oldest first.
        start: initial values at the first pose, where the fit of free motion begins.
        params: settings, auto values filled in.
        factors: (2,) noise factors of attitude and position of the poses.
        scale: prior 1 sigma of the angular acceleration [rad/s2] and of the acceleration [m/s2].
        levels: noise levels; random disturbances explain the poses as well, and better unless they are constant.
    """
    poses = poses_of(fixes)
    prior = weak_prior(poses, params)
    points = normal_points(poses, start, factors)
    fitted = fit(points, start, prior, FitParams(rescale=False), factors)
    if not fitted.converged:
        return None
    widths = np.repeat(scale, 3)
    problem = Problem(points, prior, factors, fitted.chart)
    onsets = _onsets(points.times_s)
    B = _equivalents(to_state(fitted.chart), np.concatenate([points.times_s, onsets]))
    here, there = B[: len(points)], B[len(points) :]
    linear = _linear(problem, fitted.chart)
    columns = _columns(linear, here, there, onsets)
    inflation = 1.0
    for _ in range(2):  # with the claimed noise, then with that of the residuals without the drift
        found = _explained(linear, columns, onsets, widths, inflation)
        k = int(np.argmax([f.log_odds for f in found]))
        best, inflation = found[k], _remaining_noise(linear, columns[k], found[k])
    if best.log_odds < _FOUND or best.log_odds - _random(poses, fitted.chart, prior, factors, levels) < _CONSTANT:
        return None
    odds = np.array([f.log_odds for f in found])
    weight = np.exp(odds - odds.max())
    mean = float(weight @ onsets / weight.sum())
    spacing = float(np.diff(np.append(onsets, points.times_s[-1])).max())
    spread = math.hypot(math.sqrt(float(weight @ (onsets - mean) ** 2 / weight.sum())), spacing / math.sqrt(12.0))
    onset_ns = fixes[0].t_ns + round(best.onset_s * 1e9)
    return Drift(onset_ns, spread, best.u[3:], best.u[:3], best.P, fixes[-1].scan_ns)


def _random(poses: Poses, chart: Chart, prior: Prior, factors: Array, levels: NoiseLevels) -> float:
    """Log odds of random disturbances over free motion."""
    points = normal_points(poses, chart, factors, MOST_POINTS)
    return disturbance_evidence(points, Problem(points, prior, factors, chart), levels)


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """Log odds of a drift from ``onset_s`` on, its most likely size u (6,) with covariance P, and the fit's step y."""

    log_odds: float
    onset_s: float
    u: Array
    P: Array
    y: Array


def _onsets(times_s: Array) -> Array:
    return np.asarray(np.linspace(0.0, _LATEST_ONSET, _ONSETS) * float(times_s[-1]))


def _equivalents(x: State, times_s: Array) -> Array:
    """B (n, 12, 6) at ``times_s`` (n,): errors of attitude to velocity at the epoch that equal a unit drift since."""
    last = float(times_s.max())
    count = max(100, math.ceil(float(np.linalg.norm(x.w_b)) * last / _STEP_RAD))
    grid = np.linspace(0.0, last, count + 1)
    S = rotation_history(x, grid).S[:, :, :6]
    rate = np.linalg.inv(S)[:, :, 3:]
    total = np.zeros((count + 1, 6, 3))
    np.cumsum(0.5 * (rate[1:] + rate[:-1]) * (last / count), axis=0, out=total[1:])
    B = np.zeros((len(times_s), 12, 6))
    place = np.clip(times_s / (last / count), 0.0, count)
    low = np.minimum(place.astype(int), count - 1)
    part = (place - low)[:, None, None]
    B[:, :6, :3] = (1.0 - part) * total[low] + part * total[low + 1]
    B[:, 6:9, 3:] = -0.5 * (times_s**2)[:, None, None] * np.eye(3)
    B[:, 9:12, 3:] = times_s[:, None, None] * np.eye(3)
    return B


def _linear(problem: Problem, chart: Chart) -> _Linear:
    e, H = problem.core.rows()
    info = np.asarray(np.linalg.inv(problem.prior.P), dtype=np.float64)
    J, G = (H @ to_errors(chart)).reshape(-1, H.shape[2]), H[:, :, :12].reshape(-1, 12)
    off = info @ chart.minus(problem.prior.mean)
    return _Linear(e.reshape(-1), J, G, info, off, np.repeat(problem.poses.times_s, e.shape[1]))


def _columns(linear: _Linear, here: Array, there: Array, onsets: Array) -> Array:
    """White columns (k, 6n, 6) of the residuals by the drift since each onset (k,)."""
    now = (linear.G.reshape(len(here), -1, 12) @ here).reshape(-1, 6)
    return np.asarray((now - linear.G @ there) * (linear.late > onsets[:, None])[:, :, None])


def _explained(linear: _Linear, columns: Array, onsets: Array, widths: Array, inflation: float) -> list[_Found]:
    """The drift since each onset: the kind with the greatest evidence. ``inflation`` is on the variance of the poses.

    Args:
        linear: residuals and their Jacobian.
        columns: of ``_columns``.
        onsets: (k,) [s].
        widths: (6,) prior 1 sigma of torque and force.
        inflation: as said.
    """
    J, e = linear.J, linear.e
    solve = np.linalg.inv(J.T @ J / inflation + linear.info)
    g = J.T @ e / inflation + linear.off
    cross = J.T @ columns / inflation  # (k, 20, 6)
    back = np.swapaxes(columns, 1, 2)
    weighted = np.swapaxes(cross, 1, 2) @ solve
    precision = back @ columns / inflation - weighted @ cross
    rhs = weighted @ g - back @ e / inflation
    best: list[_Found | None] = [None] * len(onsets)
    for kind, prior_odds in zip(_KINDS, _PER_KIND, strict=True):
        scaled = widths[kind]
        own = np.linalg.inv(precision[:, kind, kind] * np.outer(scaled, scaled) + np.eye(len(scaled)))
        b = rhs[:, kind] * scaled
        v = (own @ b[:, :, None])[:, :, 0]
        odds = 0.5 * (v * b).sum(axis=1) + 0.5 * np.linalg.slogdet(own)[1] + prior_odds
        for k, known in enumerate(best):
            if known is not None and known.log_odds >= odds[k]:
                continue
            u, P = np.zeros(6), np.zeros((6, 6))
            u[kind], P[kind, kind] = scaled * v[k], np.outer(scaled, scaled) * own[k]
            best[k] = _Found(float(odds[k]), float(onsets[k]), u, P, -solve @ (g + cross[k] @ u))
    return [found for found in best if found is not None]


def _remaining_noise(linear: _Linear, columns: Array, best: _Found) -> float:
    """Variance of the white residuals with the drift removed, times their integrated autocorrelation."""
    left = (linear.e + linear.J @ best.y + columns @ best.u).reshape(-1, 6)
    dof = max(left.size - 26, 6)
    blocks = [integrated_autocorrelation(left[:, k : k + 3]) for k in (0, 3)]
    return max(float((left * left).sum()) / dof * max(blocks), 1e-3)
