"""A persistent torque or force on the target: found in the residuals of the batch fit, with its onset and its size.

A constant angular acceleration in {B} and a constant acceleration in {A}, both from an unknown instant on, are linear
unknowns about the trajectory of the fit. The error states at the epoch that a unit acceleration since tau is equivalent
to at t are B(t) - B(tau), B(t) being the integral of Phi(s, 0)^-1 G ds; the residuals of the poses depend on them as on
the initial values themselves. With a Gaussian prior on the size the evidence against free motion is in closed form, as
in ``hypotheses``. The noise of the poses is that of the residuals with the drift removed, correlation included.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from avsreplay import geometry
from avsreplay.estimate.batch import FitParams, Poses, Prior, Problem, fit
from avsreplay.estimate.chart import Chart, to_errors, to_state
from avsreplay.estimate.dynamics import drift_equivalents, flow, rotation_history
from avsreplay.estimate.initialise import PoseFix, poses_of, weak_prior
from avsreplay.estimate.noise import integrated_autocorrelation
from avsreplay.estimate.noise_levels import MOST_POINTS, NO_LEVELS, NoiseLevels, disturbed_likelihood
from avsreplay.estimate.normal_points import normal_points
from avsreplay.estimate.params import EstimatorParams
from avsreplay.geometry import Array
from avsreplay.records import Drift

_ONSETS, _FINER = 12, 9  # number of onsets tried, the first at the epoch, and around the most likely one
_LATEST_ONSET = 0.85  # share of the poses before the last onset tried
_FOUND = 14.0  # log odds of a drift over free motion from which it is reported
_CONSTANT = 6.0  # log odds over random disturbances from which it is reported
_ROUNDS, _LEAST_GAIN = 10, 0.5  # of linearisation; decrease of the cost (half chi-square) from which another follows
_PARTS = (1.0, 0.3, 0.1, 0.03)  # of a step, the first that decreases the cost is taken
_WIDTHS = (1.0, 0.1)  # of the prior 1 sigma: a large or a small drift
_SCALES = (1.0, 0.1, 0.01)  # the same, where a drift is compared with disturbances of any density
_KINDS = (slice(0, 3), slice(3, 6), slice(0, 6))  # torque, force, both
_PER_KIND = (0.0, 0.0, math.log(1e-2))  # log prior odds of each


def find_drift(
    fixes: tuple[PoseFix, ...],
    start: Chart,
    params: EstimatorParams,
    factors: Array,
    scale: tuple[float, float],
    levels: NoiseLevels = NO_LEVELS,
    known: Drift | None = None,
) -> tuple[Drift, Chart] | None:
    """The drift that the poses show with the initial values of the motion, None where free motion explains them.

    Args:
        fixes: healthy poses, oldest first.
        start: initial values at the first pose, where the fit begins: that of free motion, or of the ``known`` drift.
        params: settings, auto values filled in.
        factors: (2,) noise factors of attitude and position of the poses.
        scale: prior 1 sigma of the angular acceleration [rad/s2] and of the acceleration [m/s2].
        levels: noise levels; random disturbances explain the poses as well, and better unless they are constant.
        known: a drift that was found in fewer poses and is to be refined.
    """
    poses, widths, first = poses_of(fixes), np.repeat(scale, 3), _NONE
    prior = weak_prior(poses, params)
    if known is not None:
        onset_s = max(0.0, (known.t_ns - fixes[0].t_ns) * 1e-9)
        first = replace(_NONE, onset_s=onset_s, u=np.concatenate([known.rate, known.velocity]))
    free = _about(poses, start, prior, factors, first)
    frame, found, onsets = _descended(poses, prior, factors, widths, free)
    best = max(found, key=lambda f: f.log_odds)
    if best.log_odds < _FOUND or not frame.drift.u.any():
        return None
    if known is None:
        free = min(free, _about(poses, frame.chart, prior, factors, _NONE), key=lambda f: f.cost)
        if free.cost - frame.cost < _FOUND or not _constant(frame, free, levels, best, widths):
            return None
    left = best.u - frame.drift.u  # not zero where the descent ended before the minimum
    size = frame.drift.u if np.array_equal(frame.drift.u != 0.0, best.u != 0.0) else best.u
    odds = np.array([f.log_odds for f in found])
    weight = np.exp(odds - odds.max())
    mean = float(weight @ onsets / weight.sum())
    spacing = float(np.diff(np.append(_onsets(poses.times_s), poses.times_s[-1])).max())
    spread = math.hypot(math.sqrt(float(weight @ (onsets - mean) ** 2 / weight.sum())), spacing / math.sqrt(12.0))
    onset_ns = fixes[0].t_ns + round(best.onset_s * 1e9)
    misfit = max(1.0, frame.cost / (3.0 * len(frame.points.times_s)))  # reduced chi-square: 1 if the drift explains all
    P = misfit * best.P + np.outer(left, left)
    return Drift(onset_ns, spread, size[3:], size[:3], P, fixes[-1].scan_ns), frame.chart


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """Log odds of a drift from ``onset_s`` on, its most likely size u (6,) with covariance P, and the fit's step y."""

    log_odds: float
    onset_s: float
    u: Array
    P: Array
    y: Array


_NONE = _Found(0.0, 0.0, np.zeros(6), np.zeros((6, 6)), np.zeros(20))


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """The poses about a fitted motion with a ``drift``, or without.

    Attributes:
        poses, points: with the effect of the drift removed, and normal points of them.
        chart: of the fit.  problem: the cost of the points, linearised there.  cost: half chi-square of the fit.
        e, J: white residuals (6n,), extrapolated to no drift, and their Jacobian (6n, 20) in the chart.
        G: (n, 6, 12) Jacobian by attitude to velocity at the epoch.
        info, off: information (20, 20) of the prior and its product with the offset from the prior's mean.
    """

    poses: Poses
    points: Poses
    chart: Chart
    drift: _Found
    problem: Problem
    cost: float
    e: Array
    J: Array
    G: Array
    info: Array
    off: Array


def _about(poses: Poses, start: Chart, prior: Prior, factors: Array, drift: _Found) -> _Frame:
    """The frame of a fit to all poses with a drift. The fit need not converge where a drift is missing."""
    poses = _without(poses, start, drift) if drift.u.any() else poses
    points = normal_points(poses, start, factors)
    fitted = fit(points, start, prior, FitParams(rescale=False), factors)
    return _linearised(poses, points, Problem(points, prior, factors, fitted.chart), drift, fitted.half_chi2)


def _descended(
    poses: Poses, prior: Prior, factors: Array, widths: Array, free: _Frame
) -> tuple[_Frame, list[_Found], Array]:
    """The best frame of a descent from free motion, and the drifts from each onset (n,) on about it.

    Free motion fits the poses of a drifting body so poorly that a full step of the linearised problem often leads away
    from the minimum. A step is therefore taken only as far as the cost decreases.
    """
    frame, gain = free, math.inf
    for k in range(_ROUNDS + 1):
        onsets = _onsets(frame.points.times_s, frame.drift.onset_s if k else None)
        found = _compared(frame, onsets, widths)
        best = max(found, key=lambda f: f.log_odds)
        if best.log_odds < _FOUND or gain < _LEAST_GAIN or k == _ROUNDS:
            break
        step, at, was = best.y, frame.chart, frame.drift.u
        tried = ((at.moved(part * step), replace(best, u=was + part * (best.u - was))) for part in _PARTS)
        closer = (_about(poses, start, prior, factors, drift) for start, drift in tried)
        lower = next((f for f in closer if f.cost < frame.cost), None)
        if lower is None:
            break
        frame, gain = lower, frame.cost - lower.cost
    return frame, found, onsets


def _linearised(poses: Poses, points: Poses, problem: Problem, drift: _Found, cost: float = math.inf) -> _Frame:
    chart = problem.chart
    e, H = problem.core.rows()
    G = H[:, :, :12]
    info = np.asarray(np.linalg.inv(problem.prior.P), dtype=np.float64)
    if drift.u.any():
        e = e - _columns(G, points.times_s, chart, drift.onset_s) @ drift.u
    off = info @ chart.minus(problem.prior.mean)
    J = (H @ to_errors(chart)).reshape(e.size, -1)
    return _Frame(poses, points, chart, drift, problem, cost, e.reshape(-1), J, G, info, off)


def _without(poses: Poses, start: Chart, drift: _Found) -> Poses:
    """The poses as they would be without the drift: it acts as two impulses in each interval."""
    x, times, u = to_state(start), poses.times_s, drift.u
    lengths = np.diff(times, prepend=0.0)
    half = 0.5 * np.clip(times - drift.onset_s, 0.0, lengths)[:, None] * u  # (n, 6)
    before = np.cumsum(half, axis=0)[:, 3:] + np.vstack([np.zeros((1, 3)), np.cumsum(half, axis=0)[:-1, 3:]])
    moved = np.cumsum(before * lengths[:, None], axis=0)
    q_free, w, q_pushed = rotation_history(x, times).q, x.w_b, np.empty((len(times), 4))
    q = x.q_ab
    for k, h in enumerate(lengths.tolist()):
        step = flow(w + half[k, :3], x.sigma, h)
        q, w = geometry.multiply(q, step.q), step.w + half[k, :3]
        q_pushed[k] = q
    drifted, free = geometry.multiply(q_pushed, x.q_bc), geometry.multiply(q_free, x.q_bc)
    turned = geometry.multiply(poses.q, geometry.multiply(geometry.conjugate(drifted), free))
    arm = (geometry.matrix(q_free) - geometry.matrix(q_pushed)) @ x.c_b
    return replace(poses, q=turned, t=poses.t + arm - moved)


def _constant(frame: _Frame, free: _Frame, levels: NoiseLevels, best: _Found, widths: Array) -> bool:
    """Return whether a constant disturbance alone explains the poses better than random ones do."""
    return _evidence(frame, levels, best, widths) - _evidence(free, levels, best, None) >= _CONSTANT


def _evidence(frame: _Frame, levels: NoiseLevels, drift: _Found, widths: Array | None) -> float:
    """Log likelihood of the poses with a constant disturbance, or with random ones of the same kind.

    ``widths`` is the prior of the constant one; None for random ones.
    """
    problem = frame.problem
    points = normal_points(frame.poses, frame.chart, problem.factors, MOST_POINTS)
    coarse = _linearised(
        frame.poses, points, Problem(points, problem.prior, problem.factors, frame.chart, np.inf), _NONE
    )
    kinds, open_ = [k for k in (0, 1) if drift.u[3 * k : 3 * k + 3].any()], np.flatnonzero(drift.u)
    if widths is None:
        return min(disturbed_likelihood(points, coarse.problem, levels, k)[1] for k in kinds)
    unknown = (_columns(coarse.G, points.times_s, frame.chart, frame.drift.onset_s) * widths)[:, :, open_]
    size = (frame.drift.u / widths)[open_]
    each = [
        [disturbed_likelihood(points, coarse.problem, levels, k, scale * unknown, size / scale)[0] for scale in _SCALES]
        for k in kinds
    ]
    return min(float(np.logaddexp.reduce(found)) - math.log(len(_SCALES)) for found in each)


def _onsets(times_s: Array, near_s: float | None = None) -> Array:
    """Onsets that are tried, with more of them around ``near_s``."""
    found = np.linspace(0.0, _LATEST_ONSET, _ONSETS) * float(times_s[-1])
    if near_s is None:
        return np.asarray(found)
    finer = near_s + np.linspace(-1.0, 1.0, _FINER) * found[1]
    return np.unique(np.concatenate([found, np.clip(finer, 0.0, found[-1])]))


def _columns(G: Array, times_s: Array, chart: Chart, onset_s: float) -> Array:
    """White columns (n, 6, 6) of the residuals by the drift since the onset."""
    B = drift_equivalents(to_state(chart), np.append(times_s, onset_s))
    return np.asarray((G @ (B[:-1] - B[-1])) * (times_s > onset_s)[:, None, None])


def _compared(frame: _Frame, onsets: Array, widths: Array) -> list[_Found]:
    """The most likely drift from each onset on, with the claimed noise, then with that of the residuals without it."""
    n, times = len(frame.points), frame.points.times_s
    B = drift_equivalents(to_state(frame.chart), np.concatenate([times, onsets]))
    here, late = (frame.G @ B[:n]).reshape(-1, 6), np.repeat(times, 6) > onsets[:, None]
    columns = (here - frame.G.reshape(-1, 12) @ B[n:]) * late[:, :, None]
    inflation = 1.0
    for _ in range(2):
        found = _explained(frame, columns, onsets, widths, inflation)
        k = int(np.argmax([f.log_odds for f in found]))
        inflation = _remaining_noise(frame, columns[k], found[k])
    return found


def _explained(linear: _Frame, columns: Array, onsets: Array, widths: Array, inflation: float) -> list[_Found]:
    """The drift since each onset: the kind with the greatest evidence. ``inflation`` is on the variance of the poses.

    Args:
        linear: residuals and their Jacobian.
        columns: (k, 6n, 6) of the drift since each onset.
        onsets: (k,) [s].
        widths: (6,) prior 1 sigma of torque and force.
        inflation: factor on the variance of the poses for errors that are correlated in time.
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
    for (kind, prior_odds), width in product(zip(_KINDS, _PER_KIND, strict=True), _WIDTHS):
        scaled = width * widths[kind]
        own = np.linalg.inv(precision[:, kind, kind] * np.outer(scaled, scaled) + np.eye(len(scaled)))
        b = rhs[:, kind] * scaled
        v = (own @ b[:, :, None])[:, :, 0]
        odds = 0.5 * (v * b).sum(axis=1) + 0.5 * np.linalg.slogdet(own)[1] + prior_odds - math.log(len(_WIDTHS))
        for k, known in enumerate(best):
            if known is not None and known.log_odds >= odds[k]:
                continue
            u, P = np.zeros(6), np.zeros((6, 6))
            u[kind], P[kind, kind] = scaled * v[k], np.outer(scaled, scaled) * own[k]
            best[k] = _Found(float(odds[k]), float(onsets[k]), u, P, -solve @ (g + cross[k] @ u))
    return [found for found in best if found is not None]


def _remaining_noise(linear: _Frame, columns: Array, best: _Found) -> float:
    """Variance of the white residuals with the drift removed, times their integrated autocorrelation."""
    left = (linear.e + linear.J @ best.y + columns @ best.u).reshape(-1, 6)
    dof = max(left.size - 26, 6)
    blocks = [integrated_autocorrelation(left[:, k : k + 3]) for k in (0, 3)]
    return max(float((left * left).sum()) / dof * max(blocks), 1e-3)
