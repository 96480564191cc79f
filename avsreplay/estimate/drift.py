"""A persistent torque or force on the target: found in the residuals of the batch fit, with its
onset and its size.

A constant angular acceleration in {C} and a constant acceleration in {A}, both from an unknown
instant on, are linear unknowns about the trajectory of the fit. A unit acceleration since tau has
the same effect at t as the error states B(t) - B(tau) at the epoch, where B(t) is the integral of
Phi(s, 0)^-1 G ds. The residuals of the poses depend on them as on the initial values. With a
Gaussian prior on the size the evidence against free motion is in closed form, as in ``hypotheses``.
The noise of the poses is that of the residuals with the drift removed, correlation included.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import numpy as np

from avsreplay.errors import value_class
from avsreplay.estimate.batch import Poses, Prior, Problem
from avsreplay.estimate.chart import Chart, to_chart
from avsreplay.estimate.driven_fit import (
    NO_ACCELERATION,
    DrivenFit,
    drift_unknowns,
    fit_driven,
    poor_fit,
    step_columns,
    without_drift,
)
from avsreplay.estimate.driven_motion import fit_jointly, is_bounded
from avsreplay.estimate.initialise import PoseFix, poses_of, rough_state, weak_prior
from avsreplay.estimate.noise import integrated_autocorrelation
from avsreplay.estimate.noise_levels import (
    MOST_NORMAL_POINTS,
    NO_LEVELS,
    NoiseLevels,
    disturbed_likelihood,
)
from avsreplay.estimate.normal_points import normal_points
from avsreplay.estimate.params import EstimatorParams
from avsreplay.geometry import Array

# number of onsets tried, the first at the epoch, and around the most likely one
_ONSETS = 12
_FINER = 9
_LATEST_ONSET = 0.85  # share of the poses before the last onset tried
_FOUND = 14.0  # log odds of a drift over free motion from which it is reported
# log odds over one step of the velocity and random disturbances: 3 less 0.5, the gain of the
# likeliest by Wilks' theorem
_CONSTANT = 2.5
_MOST_JOINT_FITS = 3  # largest number of joint fits with another onset or kind
# decrease of the cost (half chi-square) above which another linearisation follows
_RELINEARISED_GAIN = 0.5
_WIDTHS = (1.0, 0.1)  # factors on the prior 1 sigma: a large or a small drift
_SCALES = (1.0, 0.1, 0.01)  # the same, where a drift is compared with disturbances of any density
_KINDS = (slice(0, 3), slice(3, 6), slice(0, 6))  # torque, force, both
# prior 1 sigma of a change that is compared with a drift, over that of a manoeuvre
_SMALL_CHANGE = 0.1
_NEGLIGIBLE_ONSET = 1e-3  # probability of an onset hypothesis that is left out
_PER_KIND = (0.0, 0.0, math.log(1e-2))  # log prior odds of each


def find_drift(
    fixes: tuple[PoseFix, ...],
    start: Chart,
    params: EstimatorParams,
    factors: Array,
    scale: tuple[float, float],
    levels: NoiseLevels = NO_LEVELS,
    known: tuple[float, Array] | None = None,
) -> DriftFound | None:
    """The drift that the poses show with the initial values of the motion.

    The result is None where free motion explains the poses.

    Args:
        fixes: healthy poses, oldest first.
        start: initial values at the first pose, where the fit begins: that of free motion, or of
            the ``known`` drift.
        params: settings, auto values filled in.
        factors: (2,) noise factors of attitude and position of the poses.
        scale: prior 1 sigma of the angular acceleration [rad/s2] and of the acceleration [m/s2].
        levels: noise levels; random disturbances explain the poses as well, and better unless they
            are constant.
        known: onset [s] and size u (6,) of a drift that was found in fewer poses and is to be
            refined.
    """
    poses, widths, prior = poses_of(fixes), np.repeat(scale, 3), weak_prior(poses_of(fixes), params)
    onset_s, u = (0.0, NO_ACCELERATION) if known is None else known
    free = fit_driven(poses, start, prior, factors, onset_s, u)
    anew = known is None and poor_fit(free, factors, levels)
    begin = _from_sphere(fixes, poses, prior, factors, widths) if anew else free
    frame, found, onsets = _improved(poses, prior, factors, widths, begin)
    if poor_fit(frame, factors, levels):  # a local minimum, or no constant acceleration at all
        begin = free if anew else _from_sphere(fixes, poses, prior, factors, widths)
        other = _improved(poses, prior, factors, widths, begin)
        frame, found, onsets = min((frame, found, onsets), other, key=lambda each: each[0].cost)
    best = max(found, key=lambda f: f.log_odds)
    if not frame.u.any() or (known is not None and best.log_odds < _FOUND):
        return None
    if known is None and (
        poor_fit(frame, factors, levels)
        or not _shown(poses, frame, free, best, params, levels, widths)
    ):
        return None
    within = _Onset(onsets, np.array([f.log_odds for f in found]))
    later = DrivenHypothesis(frame, 1.0, within.spread_s if frame.onset_s else 0.0)
    if frame.onset_s == 0.0:
        return DriftFound((later,), best.width * widths, within.spread_s)
    always, _, _ = _improved(poses, prior, factors, widths, frame, only=np.zeros(1))
    noise = _remaining_noise(frame, frame.columns(best.onset_s).reshape(-1, 6), best)
    odds = (_cost(always, poses) - _cost(frame, poses)) / noise + math.log(
        within.width_s / float(poses.times_s[-1])
    )
    share = 1.0 / (1.0 + math.exp(min(odds, 700.0)))
    both = DrivenHypothesis(always, share, 0.0), replace(later, weight=1.0 - share)
    likely = tuple(h for h in sorted(both, key=lambda h: -h.weight) if h.weight > _NEGLIGIBLE_ONSET)
    return DriftFound(likely, best.width * widths, within.spread_s)


def _shown(
    poses: Poses,
    frame: DrivenFit,
    free: DrivenFit,
    best: _Found,
    params: EstimatorParams,
    levels: NoiseLevels,
    widths: Array,
) -> bool:
    """Whether the poses show a drift better than free motion, a change of the velocities, and
    random disturbances do.

    Args:
        poses: the measurements.
        frame: fit with the drift.
        free: fit of free motion. The one that begins at ``frame`` may be the better one.
        best: the drift.
        params: settings.
        levels: noise levels.
        widths: (6,) prior 1 sigma of the drift.
    """
    if _odds(best, frame, free) < _FOUND:
        return False
    known = frame.problem
    other = fit_driven(poses, frame.chart, known.prior, known.factors, 0.0, NO_ACCELERATION)
    free = min(free, other, key=lambda f: f.cost)
    if _odds(best, frame, free) < _FOUND:
        return False
    if best.log_odds - _step_odds(frame, params, best.noise) < _CONSTANT:
        return False
    if not _constant(frame, free, levels, best, widths):
        return False
    return is_bounded(frame, np.where(frame.u != 0.0, widths, 0.0))


@value_class
class DrivenHypothesis:
    """The fit with a drift since some instant, its probability, and the 1 sigma of the instant [s],
    0 for the epoch.
    """

    fitted: DrivenFit
    weight: float
    onset_1s_s: float


@value_class
class DriftFound:
    """A drift.

    Attributes:
        hypotheses: on its onset, the most likely first.
        widths: (6,) prior 1 sigma of its size.
        onset_1s_s: 1 sigma of the onset over all instants that were tried [s].
    """

    hypotheses: tuple[DrivenHypothesis, ...]
    widths: Array
    onset_1s_s: float


@value_class
class _Found:
    """Log odds of a drift since ``onset_s``, its most likely size u (6,), the fit's step y, and its
    most likely prior.

    ``width`` is the 1 sigma of that prior over the given one, ``noise`` the factor on the variance
    of the poses, and ``gain`` the decrease of the cost in the log odds.
    """

    log_odds: float
    onset_s: float
    u: Array
    y: Array
    width: float
    noise: float
    gain: float


def _improved(
    poses: Poses,
    prior: Prior,
    factors: Array,
    widths: Array,
    begin: DrivenFit,
    only: Array | None = None,
) -> tuple[DrivenFit, list[_Found], Array]:
    """The best joint fit with any onset and kind of acceleration, and the drifts from each onset
    (n,) on about it.

    About each fit the most likely onset and kind of the linearised problem are those of the next
    one. ``only``: the onsets that are tried.
    """
    frame = begin
    for k in range(_MOST_JOINT_FITS + 1):
        onsets = (
            _onsets(frame.points.times_s, frame.onset_s if k else None) if only is None else only
        )
        found = _compared(frame, onsets, widths)
        best = max(found, key=lambda f: f.log_odds)
        same = (
            frame.along
            and best.onset_s == frame.onset_s
            and bool(np.array_equal(best.u != 0.0, frame.u != 0.0))
        )
        if best.log_odds < _FOUND or same or k == _MOST_JOINT_FITS:
            break
        open_ = np.where(best.u != 0.0, widths, 0.0)
        start = np.where(best.u != 0.0, frame.u, 0.0)
        closer = fit_jointly(poses, frame.chart, prior, factors, best.onset_s, start, open_)
        if closer.cost > frame.cost - _RELINEARISED_GAIN and (
            only is None or k
        ):  # the first of given onsets may be worse
            break
        frame = closer
    return frame, found, onsets


def _from_sphere(
    fixes: tuple[PoseFix, ...], poses: Poses, prior: Prior, factors: Array, widths: Array
) -> DrivenFit:
    """The joint fit of a torque since the first pose that begins with a sphere at a constant rate.

    In the fit of free motion a wrong inertia explains a part of the torque. A descent from there
    may end in a local minimum.
    """
    start, torque = to_chart(rough_state(fixes)), np.append(widths[:3], np.zeros(3))
    return fit_jointly(poses, start, prior, factors, 0.0, NO_ACCELERATION, torque)


def _constant(
    frame: DrivenFit, free: DrivenFit, levels: NoiseLevels, best: _Found, widths: Array
) -> bool:
    """Return whether a constant disturbance alone explains the poses better than random ones do."""
    random = _evidence(free, levels, best, None)
    constant = _evidence(frame, levels, best, widths)
    return constant - random >= _CONSTANT


def _evidence(frame: DrivenFit, levels: NoiseLevels, drift: _Found, widths: Array | None) -> float:
    """Log likelihood of the poses with a constant disturbance, or with random ones of the same
    kind.

    ``widths`` is the prior of the constant one; None for random ones.
    """
    problem = frame.problem
    points = normal_points(frame.poses, frame.chart, problem.factors, MOST_NORMAL_POINTS)
    coarse = Problem(points, problem.prior, problem.factors, frame.chart, np.inf)
    kinds, open_ = [k for k in (0, 1) if drift.u[3 * k : 3 * k + 3].any()], np.flatnonzero(drift.u)
    likely = []
    if widths is not None:
        unknown, size = drift_unknowns(frame, points, coarse, widths, open_)
        likely = [(scale * unknown, size / scale) for scale in _SCALES]
    return disturbed_likelihood(points, coarse, levels, kinds, likely)


def _odds(best: _Found, frame: DrivenFit, free: DrivenFit) -> float:
    """Log odds of a drift by Laplace's approximation about the minimum with it and that of free
    motion.

    A linear problem about one of them does not reach the other. The odds are at most the decrease
    of the cost.
    """
    decrease = free.cost - frame.cost
    return min(best.log_odds - best.gain + decrease / best.noise, decrease)


def _cost(frame: DrivenFit, poses: Poses) -> float:
    """Half chi-square of all poses about a fit, normal points being different ones for each."""
    every = without_drift(poses, frame.chart, frame.onset_s, frame.u)
    return Problem(every, frame.problem.prior, frame.problem.factors).cost(frame.chart)


@value_class
class _Onset:
    """The posterior of the onset among instants (n,) by the log odds (n,) of a drift since each."""

    instants_s: Array
    odds: Array

    @property
    def spread_s(self) -> float:
        """Standard deviation, with that of an instant between two that are tried."""
        weight = np.exp(self.odds - self.odds.max())
        share = weight / weight.sum()
        spacing = float(np.diff(self.instants_s).max(initial=0.0))
        variance = float(share @ (self.instants_s - share @ self.instants_s) ** 2)
        return math.sqrt(variance + spacing**2 / 12.0)

    @property
    def width_s(self) -> float:
        """Integral of the likelihood over that of the most likely instant."""
        weight = np.exp(self.odds - self.odds.max())
        return float(np.sum(0.5 * (weight[1:] + weight[:-1]) * np.diff(self.instants_s)))


def _onsets(times_s: Array, near_s: float | None = None) -> Array:
    """Onsets that are tried, with more of them around ``near_s``."""
    found = np.linspace(0.0, _LATEST_ONSET, _ONSETS) * float(times_s[-1])
    if near_s is None:
        return np.asarray(found)
    finer = near_s + np.linspace(-1.0, 1.0, _FINER) * found[1]
    return np.unique(np.concatenate([found, np.clip(finer, 0.0, found[-1])]))


def _compared(frame: DrivenFit, onsets: Array, widths: Array) -> list[_Found]:
    """The most likely drift from each onset on, with the claimed noise, then with that of the
    residuals without it.
    """
    n, times = len(frame.points), frame.points.times_s
    B = frame.equivalents(np.concatenate([times, onsets]))
    here, late = (frame.G @ B[:n]).reshape(-1, 6), np.repeat(times, 6) > onsets[:, None]
    columns = (here - frame.G.reshape(-1, 12) @ B[n:]) * late[:, :, None]
    products, inflation = _products(frame, columns), 1.0
    for _ in range(2):
        found = _explained(frame, products, onsets, widths, inflation)
        k = int(np.argmax([f.log_odds for f in found]))
        inflation = _remaining_noise(frame, columns[k], found[k])
    return found


def _products(frame: DrivenFit, columns: Array) -> tuple[Array, ...]:
    back = np.swapaxes(columns, 1, 2)
    return (
        frame.J.T @ frame.J,
        frame.J.T @ frame.e,
        frame.J.T @ columns,
        back @ columns,
        back @ frame.e,
    )


def _step_odds(frame: DrivenFit, params: EstimatorParams, noise: float) -> float:
    """Log odds over free motion of the most likely single change of the velocities: it may
    explain the poses better.
    """
    times, widths = frame.points.times_s, _SMALL_CHANGE * np.repeat(params.change_1s, 3)
    instants = 0.5 * (times[1:] + times[:-1])
    found = _explained(
        frame, _products(frame, step_columns(frame, instants)), instants, widths, noise
    )
    return max(f.log_odds for f in found)


def _explained(
    linear: DrivenFit, products: tuple[Array, ...], onsets: Array, widths: Array, inflation: float
) -> list[_Found]:
    """The drift since each onset: the kind with the greatest evidence. ``inflation`` is on the
    variance of the poses.

    Args:
        linear: residuals e and their Jacobian J.
        products: J' J, J' e, J' D (k, 20, 6), D' D (k, 6, 6), D' e (k, 6); D: effects of a drift
            since each onset.
        onsets: (k,) [s].
        widths: (6,) prior 1 sigma of torque and force.
        inflation: factor on the variance of the poses for errors that are correlated in time.
    """
    JJ, Je, cross, square, along = (each / inflation for each in products)
    solve, g = np.linalg.inv(JJ + linear.info), Je + linear.off
    weighted = np.swapaxes(cross, 1, 2) @ solve
    precision, rhs = square - weighted @ cross, weighted @ g - along
    tried, odds = [], []
    for (kind, prior_odds), width in product(zip(_KINDS, _PER_KIND, strict=True), _WIDTHS):
        scaled = width * widths[kind]
        own = np.linalg.inv(
            precision[:, kind, kind] * np.outer(scaled, scaled) + np.eye(len(scaled))
        )
        b = rhs[:, kind] * scaled
        v = (own @ b[:, :, None])[:, :, 0]
        gain = 0.5 * (v * b).sum(axis=1)
        odds.append(gain + 0.5 * np.linalg.slogdet(own)[1] + prior_odds - math.log(len(_WIDTHS)))
        tried.append((kind, width, scaled * v, gain))
    found = []
    for k, best in enumerate(np.argmax(odds, axis=0).tolist()):
        kind, width, size, gain = tried[best]
        u = np.zeros(6)
        u[kind] = size[k]
        y = -solve @ (g + cross[k] @ u)
        found.append(
            _Found(float(odds[best][k]), float(onsets[k]), u, y, width, inflation, float(gain[k]))
        )
    return found


def _remaining_noise(linear: DrivenFit, columns: Array, best: _Found) -> float:
    """Variance of the white residuals with the drift removed, times their integrated
    autocorrelation.
    """
    left = (linear.e + linear.J @ best.y + columns @ best.u).reshape(-1, 6)
    dof = max(left.size - 26, 6)
    blocks = [integrated_autocorrelation(left[:, k : k + 3]) for k in (0, 3)]
    return max(float((left * left).sum()) / dof * max(blocks), 1e-3)
