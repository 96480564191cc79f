"""Free motion that fits all poses with a constant torque or force removed, and what depends on it
linearly.

The acceleration is removed from the poses, and free motion (``batch``) is fitted to the poses as
they would be without it. About this fit the problem is linear in the initial values, the
acceleration and its onset.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.estimate import _motion
from avsreplay.estimate.batch import FitParams, Poses, Prior, Problem, fit
from avsreplay.estimate.chart import Chart, to_errors, to_state
from avsreplay.estimate.driven import drift_equivalents, drive_of
from avsreplay.estimate.dynamics import translated
from avsreplay.estimate.error_state import DIM, REACHED
from avsreplay.estimate.noise_levels import (
    MOST_NORMAL_POINTS,
    NoiseLevels,
    estimate_levels,
    pose_error_covariance,
)
from avsreplay.estimate.normal_points import PositionRows, normal_points
from avsreplay.geometry import Array

NO_ACCELERATION = np.zeros(6)
_CONFIDENCE = 3.09  # standard deviations of a normal distribution with 99.9 % below
_HALF_S = 1e-3  # half the time over which a derivative is taken [s]


@value_class
class DrivenFit:
    """A fit to poses from which a constant acceleration has been removed.

    Attributes:
        poses, points: with the effect of the acceleration removed, and normal points of them.
        about: initial values of the motion about which it is removed.
        chart: of the fit.
        problem: the cost of the points, linearised there.
        cost: half chi-square of the fit.
        onset_s: since the epoch [s].
        u: (6,) acceleration: rad/s2 in {C}, m/s2 in {A}; zero for free motion.
        e, J: white residuals (6n,), extrapolated to no acceleration, and their Jacobian (6n, 20) in
            the chart.
        G: (n, 6, 12) Jacobian by attitude to velocity at the epoch.
        info, off: information (20, 20) of the prior and its product with the offset from the
            prior's mean.
        along: e, J and G are linearised about the motion with the acceleration; else about free
            motion.
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
    along: bool = False

    def equivalents(self, times_s: Array) -> Array:
        """``equivalents`` about the motion about which this is linearised."""
        return (
            equivalents(self.chart, times_s, self.onset_s, self.u)
            if self.along
            else equivalents(self.chart, times_s)
        )

    def columns(self, onset_s: float) -> Array:
        """White columns (n, 6, 6) of the residuals by an acceleration since an onset."""
        return _columns(
            self.G,
            self.equivalents(np.append(self.points.times_s, onset_s)),
            self.points.times_s,
            onset_s,
        )


def fit_driven(
    poses: Poses, start: Chart, prior: Prior, factors: Array, onset_s: float, u: Array
) -> DrivenFit:
    """Fit all poses with a given acceleration. The fit need not converge where another
    one acts.

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
    G = H[:, :, :REACHED]
    if u.any():
        e = e - drift_columns(G, points.times_s, chart, onset_s) @ u
    info = prior.info
    off, J = info @ chart.minus(prior.mean), (H @ to_errors(chart)).reshape(e.size, -1)
    return DrivenFit(
        poses,
        points,
        start,
        chart,
        problem,
        fitted.half_chi2,
        onset_s,
        u,
        e.reshape(-1),
        J,
        G,
        info,
        off,
    )


def without_drift(
    poses: Poses, about: Chart, onset_s: float, u: Array, back: bool = False
) -> Poses:
    """The poses as they would be without the acceleration u (6,) since ``onset_s``, about the
    motion from ``about``.

    They have the same errors in {C}, relative to free motion, as the poses relative to that with u.
    ``back``: the inverse.
    """
    centre = translated(to_state(about), poses.times_s, poses.arc)[0]
    return poses.moved(*_motion.without_drift(about.flat, u, onset_s, poses.core, centre, back))


def equivalents(
    chart: Chart, times_s: Array, onset_s: float = 0.0, u: Array = NO_ACCELERATION
) -> Array:
    """``drift_equivalents`` (n, 12, 6) of unit accelerations in {C} and in {A}, about a motion with
    u (6,).
    """
    x = to_state(chart)
    B = drift_equivalents(x, times_s, onset_s, drive_of(x, u))
    B[:, :, :3] = B[:, :, :3] @ geometry.matrix(x.q_bc)
    return B


def drift_columns(G: Array, times_s: Array, chart: Chart, onset_s: float) -> Array:
    """White columns (n, 6, 6) of the residuals by an acceleration since the onset, about free
    motion.
    """
    return _columns(G, equivalents(chart, np.append(times_s, onset_s)), times_s, onset_s)


def _columns(G: Array, B: Array, times_s: Array, onset_s: float) -> Array:
    return np.asarray((G @ (B[:-1] - B[-1])) * (times_s > onset_s)[:, None, None])


def step_columns(fitted: DrivenFit, instants_s: Array) -> Array:
    """White columns (k, 6n, 6) of the residuals by a change of rate and velocity at each instant
    (k,), about the fit.

    Such a change is a large acceleration for a short time: its effect is the derivative of that of
    an acceleration by its onset.
    """
    B, k = (
        fitted.equivalents(np.concatenate([instants_s - _HALF_S, instants_s + _HALF_S])),
        len(instants_s),
    )
    columns = fitted.G.reshape(-1, fitted.G.shape[2]) @ ((B[k:] - B[:k]) / (2.0 * _HALF_S))
    return np.asarray(
        columns * (np.repeat(fitted.points.times_s, 6) > instants_s[:, None])[:, :, None]
    )


def poor_fit(frame: DrivenFit, factors: Array, levels: NoiseLevels) -> bool:
    """Return whether the noise of the poses does not explain the residuals of a fit, with 99.9 %
    confidence.

    The noise is at least as claimed. Errors of near views are correlated, so that the squared
    residuals are not chi-square. Their sum is approximated by the multiple of a chi-square value
    that has its mean and variance (Satterthwaite, Biometrics Bulletin 2, 1946), the quantile by
    Wilson and Hilferty.
    """
    white, common = ((max(1.0, a), max(1.0, b)) for a, b in (levels.white, levels.common))
    V = pose_error_covariance(frame.points, NoiseLevels(white, common), factors)
    total, squares = 3.0 * float(np.trace(V, axis1=1, axis2=2).sum()), 3.0 * float((V * V).sum())
    mean = total * max(1.0 - (DIM + 6) / (6 * len(frame.points)), 1.0 / len(frame.points))
    dof = mean * total / squares
    bound = mean * (1.0 - 2.0 / (9.0 * dof) + _CONFIDENCE * math.sqrt(2.0 / (9.0 * dof))) ** 3
    return 2.0 * frame.cost > bound


def levels_of(
    fitted: DrivenFit,
    levels: NoiseLevels,
    widths: Array,
    claimed: bool,
    fixed: tuple[float | None, float | None],
    positions: PositionRows | None = None,
) -> NoiseLevels:
    """Noise levels from the residuals of the poses about the motion with the acceleration.

    Args:
        fitted: the fit.
        levels: the last estimate.
        widths: (6,) prior 1 sigma of the acceleration.
        claimed: the noise of the poses is as claimed; only the disturbances are estimated.
        fixed: root densities of torque and force that are given; None to estimate them.
        positions: as in ``estimate_levels``.
    """
    old, kinds = fitted.problem, np.flatnonzero(fitted.u)
    points = normal_points(
        fitted.poses, fitted.chart, old.factors, MOST_NORMAL_POINTS, scatter=True
    )
    problem = Problem(points, old.prior, old.factors, fitted.chart, np.inf)
    unknowns = drift_unknowns(fitted, points, problem, widths, kinds)
    return estimate_levels(points, problem, levels, claimed, fixed, unknowns, positions)


def drift_unknowns(
    fitted: DrivenFit, points: Poses, problem: Problem, widths: Array, kinds: NDArray[np.int64]
) -> tuple[Array, Array]:
    """The acceleration as unknowns of ``disturbed_likelihood``: columns at the prior 1 sigma
    ``widths``, and size.
    """
    G = problem.core.rows()[1][:, :, :REACHED]
    columns = drift_columns(G, points.times_s, fitted.chart, fitted.onset_s) * widths
    return columns[:, :, kinds], (fitted.u / widths)[kinds]
