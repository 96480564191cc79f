"""The covariance of a batch fit: corrected where the likelihood is not Gaussian, and with process noise.

Before a few turns are seen, some directions of the inertia are determined so poorly that the minimum of the cost bends
within its own 1 sigma; the curvature at the minimum then understates the uncertainty. Two sigma along each of the
weakest directions the cost is compared with the Gaussian one. Along a non-Gaussian direction the fit is repeated with
that direction fixed on either side (the profile likelihood) where the cost, minimised over everything else, has risen
by 3/2, as it does at root three sigma of a Gaussian: with the Gauss-Hermite weights 1/6, 4/6, 1/6 the three fits, each
with its remaining covariance, carry the second moments. They are propagated to the requested instant one by one.

The fit takes the motion as deterministic. About its trajectory the problem is linear, so one pass of a Kalman filter
over the poses, with the disturbance's covariance between them, is the maximum likelihood with process noise. The
errors are propagated back to the epoch, where the transition is the identity, and stand in chart coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from avsreplay.estimate import _motion
from avsreplay.estimate.batch import BatchFit, FitParams, Pin, Poses, Prior, cost, linearised, pinned
from avsreplay.estimate.chart import Chart, to_chart, to_errors, to_state
from avsreplay.estimate.dynamics import propagate_state, ratios, torque_density
from avsreplay.estimate.error_state import DIM, RHO, VEL
from avsreplay.geometry import Array
from avsreplay.records import Belief, State

_NODE, _WEIGHT = np.sqrt(3.0), 1.0 / 6.0
_TRIAL = 2.0  # sigma
_RISE, _TRIES = 0.5 * _NODE**2, 4
_PIN_1S = 0.02  # of the direction's sigma
_LINEAR_RAD = 0.05  # largest rotation by disturbances for which the problem about the fitted trajectory is linear
_DISTURBED = 12  # error states that a disturbance reaches: attitude, rate, position, velocity
_SPHERE = 3.0  # tr I / I


@dataclass(frozen=True, slots=True, eq=False)
class ProfilePoint:
    """A fit with one direction fixed, and its remaining covariance P (20, 20)."""

    chart: Chart
    P: Array


@dataclass(frozen=True, slots=True, eq=False)
class NonGaussianDirection:
    """A non-Gaussian direction: its part ``axis axis'`` of P_chart, and the profile fits on either side."""

    axis: Array
    points: tuple[ProfilePoint, ProfilePoint]


@dataclass(frozen=True, slots=True, eq=False)
class BatchCovariance:
    """A fit with its non-Gaussian directions."""

    fitted: BatchFit
    directions: tuple[NonGaussianDirection, ...]

    @property
    def gaussian(self) -> bool:
        """Is the likelihood Gaussian as far as two sigma?"""
        return not self.directions


def covariance_of(poses: Poses, fitted: BatchFit, prior: Prior, params: FitParams) -> BatchCovariance:
    """Test the weakest directions of a fit (relative to the prior) and profile the non-Gaussian ones."""
    scale = prior.one_sigma
    values, vectors = np.linalg.eigh(fitted.P_chart / np.outer(scale, scale))
    directions = []
    for value, vector in zip(values[::-1][: params.try_directions], vectors.T[::-1], strict=False):
        axis = vector * scale * np.sqrt(max(float(value), 0.0))
        if _non_gaussian(poses, fitted, prior, params, axis):
            row = vector / scale / np.sqrt(value)  # 1 at the end of the axis
            points = [_profile(poses, fitted, prior, params, axis, row, s) for s in (_NODE, -_NODE)]
            directions.append(NonGaussianDirection(axis, (points[0], points[1])))
    return BatchCovariance(fitted, tuple(directions))


def _non_gaussian(poses: Poses, fitted: BatchFit, prior: Prior, params: FitParams, axis: Array) -> bool:
    gaussian = 0.5 * _TRIAL**2
    for side in (_TRIAL, -_TRIAL):
        rise = cost(poses, fitted.chart.moved(side * axis), prior, params, fitted.effective) - fitted.half_chi2
        if not gaussian / params.bend_max < rise < gaussian * params.bend_max:
            return True
    return False


def _profile(
    poses: Poses, fitted: BatchFit, prior: Prior, params: FitParams, axis: Array, row: Array, side: float
) -> ProfilePoint:
    """The fit with the direction fixed at ``side`` sigma, adjusted at most ``_TRIES`` times until the cost fits."""
    there, P = fitted.chart.moved(side * axis), fitted.P_chart
    for _ in range(_TRIES):
        there, P = pinned(poses, there, prior, params, fitted.effective, Pin(fitted.chart, row, side, _PIN_1S))
        rise = cost(poses, there, prior, params, fitted.effective) - fitted.half_chi2
        if abs(rise - _RISE) < 0.2 * _RISE:
            break
        side *= float(np.clip(np.sqrt(_RISE / max(rise, 1e-9)), 0.4, 2.5))
    return ProfilePoint(there, P)


def belief_at(found: BatchCovariance, t_ns: int, after_s: float) -> Belief:
    """Mean of the fit and its corrected covariance, ``after_s`` after the epoch; ``t_ns`` is that instant."""
    fitted = found.fitted
    x, step = propagate_chart(fitted.chart, after_s)
    here = to_chart(x)
    P0 = fitted.P_chart - sum((np.outer(d.axis, d.axis) for d in found.directions), np.zeros((DIM, DIM)))
    P = (1.0 - 2.0 * _WEIGHT * len(found.directions)) * step @ P0 @ step.T
    for point in (point for direction in found.directions for point in direction.points):
        there, step = propagate_chart(point.chart, after_s)
        y = to_chart(there).minus(here)
        P += _WEIGHT * (np.outer(y, y) + step @ point.P @ step.T)
    T = to_errors(here)
    P = T @ P @ T.T
    return Belief(t_ns, x, 0.5 * (P + P.T))


def propagate_chart(chart: Chart, h: float) -> tuple[State, Array]:
    """The state h seconds later, and the transition matrix (20, 20) in chart coordinates."""
    there, Phi = propagate_state(to_state(chart), h)
    return there, np.asarray(np.linalg.solve(to_errors(to_chart(there)), Phi @ to_errors(chart)))


def memory_s(torque: float) -> float:
    """How far back [s] a fit may look: root density ``torque`` turns the body by its square T^3 / 3 in variance."""
    return float(np.cbrt(3.0 * (_LINEAR_RAD / (_SPHERE * torque)) ** 2))


def process_noise_pass(
    found: BatchCovariance, poses: Poses, prior: Prior, rules: FitParams, torque: float, force: float
) -> BatchCovariance:
    """The fit with process noise, valid at the last pose; ``torque``, ``force``: root densities as in the filter."""
    fitted = found.fitted
    rows, J = linearised(poses, fitted.chart, prior, rules, fitted.effective)
    into = np.linalg.inv(to_errors(fitted.chart))[:, :_DISTURBED]
    Q = into @ _noise_increments(fitted.x, poses.times_s, torque, force) @ into.T
    y, P = _motion.filter(-fitted.chart.minus(prior.mean), prior.P, rows, J, Q)
    more = P - fitted.P_chart
    moved = [[ProfilePoint(p.chart.moved(y), p.P + more) for p in d.points] for d in found.directions]
    directions = tuple(
        NonGaussianDirection(d.axis, (low, high)) for d, (low, high) in zip(found.directions, moved, strict=True)
    )
    return BatchCovariance(replace(fitted, chart=fitted.chart.moved(y), P_chart=P), directions)


def _noise_increments(x: State, times_s: Array, torque: float, force: float) -> Array:
    """(n, 12, 12) process noise of attitude to velocity added before each pose, propagated back to the epoch."""
    _, _, S, added = _motion.follow(x.q_ab, x.w_b, ratios(x.sigma), torque_density(x.sigma, torque), times_s)
    back = np.linalg.inv(S[:, :, :6])
    total = np.zeros((len(times_s), _DISTURBED, _DISTURBED))
    total[:, :6, :6] = back @ added @ np.swapaxes(back, 1, 2)
    t, one = times_s[:, None, None], force**2 * np.eye(3)
    total[:, RHO, RHO], total[:, VEL, VEL] = one * t**3 / 3.0, one * t
    total[:, RHO, VEL] = total[:, VEL, RHO] = -one * t**2 / 2.0
    total[1:] -= total[:-1].copy()
    return total
