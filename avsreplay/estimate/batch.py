"""Maximum likelihood of the 20 initial values over all healthy poses: Levenberg-Marquardt on the
manifold.

Until the body has turned a few times, the minimum lies in a curved and narrow valley of the cost. A
step therefore contains its second-order part (geodesic acceleration: Transtrum and Sethna,
arXiv:1201.5885).

The motion is taken as deterministic; the residuals d = [theta; v] are expressed in {C}, where their
noise is given. Jacobians are H Phi, in the coordinates of ``chart``, which keep the inertia
physical without a bound. A prior, given or weak, keeps directions finite that the poses do not
determine yet. The likelihood is that of an M-estimator. A pose above the 99.99 % point of
chi-square with 6 degrees of freedom gets Huber's weight in the first descent and Cauchy's in the
last; other poses keep the weight 1, which is efficient for Gaussian noise. Two factors on the
poses' noise, attitude and position, may be estimated from the residuals. The covariance is inflated
by the integrated autocorrelation of the residuals, because those of registration are correlated.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.estimate import _motion
from avsreplay.estimate.chart import Chart, to_errors, to_state
from avsreplay.estimate.measurement import GATE
from avsreplay.estimate.noise import integrated_autocorrelation
from avsreplay.estimate.relative_orbit import OrbitArc
from avsreplay.geometry import Array
from avsreplay.records import State
from avsreplay.settings import Settings, setting

_FEWEST_FOR_FACTORS = 12
_PIN_TOL = 0.02  # half chi-square: tolerance of a fit with one direction fixed


@dataclass(frozen=True, slots=True)
class FitParams(Settings):
    """Settings of the batch fit."""

    max_steps: int = setting(40, "Largest number of Levenberg-Marquardt steps.", low=1)
    gain_tol: float = setting(
        1e-3,
        "The iteration ends when a step reduces half the chi-square by less than this.",
        low=0.0,
    )
    rescale: bool = setting(True, "Estimate the two noise factors from the residuals.")
    least_inflation: float = setting(
        1.0,
        "Smallest factor by which the correlation of pose errors in time inflates their"
        " covariance.",
        above=0.0,
    )
    try_directions: int = setting(
        5,
        "Number of directions, least observable first, in which the profile likelihood is tested.",
        low=0,
    )
    bend_max: float = setting(
        2.0,
        "Ratio of the cost at 2 sigma to that of a Gaussian from which a direction is"
        " non-Gaussian.",
        above=0.0,
    )


@value_class
class Poses:
    """Healthy poses T_ac, oldest first.

    Attributes:
        times_s: (n,) since the fit's epoch [s].
        q: (n, 4) q_ac.
        t: (n, 3) [m].
        C: (n, 6, 6) covariance of d = [theta; v] in {C} [rad, m], T_true = T_ac Exp(d).
        counts: (n,) number of poses that each of them stands for; None where they are measured
            poses.
        shares: (n,) part of C that poses seen from nearly the same direction have in common; None
            for 0.
        within: squared whitened differences of poses from their normal points, of attitude and
            position, and their degrees of freedom; None where there are none.
        arc: the orbit from the epoch on; None for free motion.
        shift: (n, 6) added to d, None for 0: the mean of the poses that a normal point stands for
            lies at -shift from it. Along directions that they do not determine this may be too far
            for a linear covariance.
        root: (n, 6, 6) lower triangular with root C root' = 1.
    """

    times_s: Array
    q: Array
    t: Array
    C: Array
    counts: Array | None = None
    shares: Array | None = None
    within: tuple[tuple[float, float], float] | None = None
    arc: OrbitArc | None = None
    shift: Array | None = None
    root: Array = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "root", _motion.roots(self.C))

    def __len__(self) -> int:
        return len(self.times_s)

    @property
    def core(self) -> _motion.Poses:
        """The poses, as the extension takes them."""
        return _motion.Poses(
            times=self.times_s,
            q=self.q,
            t=self.t,
            shift=self.shifts,
            root=self.root,
        )

    def whitened(self, d: Array, factors: Array) -> Array:
        """(n, 6) residuals d of unit variance, with noise factors (2,) of attitude and position."""
        return np.asarray((self.root @ d[:, :, None])[:, :, 0] / np.repeat(factors, 3))

    @property
    def shifts(self) -> Array:
        """(n, 6) ``shift``, zeros where there is none."""
        return np.zeros((len(self), 6)) if self.shift is None else self.shift

    def residuals(self, problem: Problem, chart: Chart | None = None) -> Array:
        """(n, 6) d = [theta; v] in {C} of these poses at a chart, by default where
        ``problem`` is linearised.
        """
        if problem.poses is self and chart is None:
            return problem.core.d
        own = problem if problem.poses is self else Problem(self, problem.prior, problem.factors)
        return own.core.residuals((problem.chart if chart is None else chart).flat)[2]

    def some(self, which: slice | NDArray[np.bool_]) -> Poses:
        """Some of measured poses."""
        shares = None if self.shares is None else self.shares[which]
        return Poses(
            self.times_s[which],
            self.q[which],
            self.t[which],
            self.C[which],
            shares=shares,
            arc=self.arc,
            shift=None if self.shift is None else self.shift[which],
        )

    def moved(self, q: Array, t: Array) -> Poses:
        """Other poses with the same instants and errors."""
        out = copy(self)
        object.__setattr__(out, "q", q)
        object.__setattr__(out, "t", t)
        return out

    def latest(self, count: int, epoch_s: float) -> Poses:
        """The last ``count`` poses, with times from ``epoch_s``."""
        arc = None if self.arc is None else self.arc.shifted(epoch_s)
        return Poses(
            self.times_s[-count:] - epoch_s,
            self.q[-count:],
            self.t[-count:],
            self.C[-count:],
            arc=arc,
            shift=None if self.shift is None else self.shift[-count:],
        )


@value_class
class Prior:
    """A Gaussian prior of the initial values: mean and covariance P (20, 20) of the chart
    coordinates.

    Attributes:
        info: (20, 20) inverse of P.
    """

    mean: Chart
    P: Array
    info: Array = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "info", _inverse(self.P))

    @property
    def one_sigma(self) -> Array:
        """(20,) 1 sigma of each coordinate."""
        return np.sqrt(np.diagonal(self.P))


@value_class
class BatchFit:
    """The result of a fit.

    Attributes:
        chart: initial values at the epoch.
        P_chart: (20, 20) their covariance.
        half_chi2: cost, half the weighted chi-square including the prior, at ``effective``.
        d: (n, 6) residuals in {C} [rad, m].
        weights: (n,) in (0, 1].
        factors: (2,) of attitude and position noise.
        inflation: (2,) 1 + 2 sum of the residuals' autocorrelations: the factor on the variance of
            the poses.
        steps: taken.
        converged: the stopping rule was met within the allowed steps.
    """

    chart: Chart
    P_chart: Array
    half_chi2: float
    d: Array
    weights: Array
    factors: Array
    inflation: Array
    steps: int
    converged: bool

    @property
    def x(self) -> State:
        """Initial values at the epoch."""
        return to_state(self.chart)

    @property
    def P(self) -> Array:
        """(20, 20) covariance of the 20 error states about ``x``."""
        T = to_errors(self.chart)
        P = T @ self.P_chart @ T.T
        return np.asarray(0.5 * (P + P.T))

    @property
    def effective(self) -> Array:
        """(2,) noise factors of the covariance: those of white noise that carries the same
        information.
        """
        return np.asarray(self.factors * np.sqrt(self.inflation))

    @property
    def rms(self) -> tuple[float, float]:
        """Root mean square residual: attitude [rad] and position [m]."""
        return float(np.sqrt(np.mean(self.d[:, :3] ** 2) * 3)), float(
            np.sqrt(np.mean(self.d[:, 3:] ** 2) * 3)
        )


@value_class
class Pin:
    """A pseudo-measurement row . (chart - centre) = ``target`` with ``one_sigma``: it fixes
    one direction.
    """

    centre: Chart
    row: Array
    target: float
    one_sigma: float

    def error(self, chart: Chart) -> float:
        """Deviation from the target, in 1 sigma."""
        return (float(self.row @ chart.minus(self.centre)) - self.target) / self.one_sigma


class Problem:
    """The cost over the initial values at given noise factors, its linearisation and its minimum.

    The loops over the poses are those of the extension (``kernel/fit.cpp``): propagation,
    transition matrix, measurement Jacobian in the error states at the epoch, M-estimator weights,
    normal equations in chart steps.

    Args:
        poses: the measurements.
        prior: Gaussian prior of the initial values.
        factors: (2,) on the standard deviations of attitude and position.
        start: the chart of the first linearisation.
        slack: factor on the squared residual from which a pose is an outlier, where disturbances
            add to it.
    """

    def __init__(
        self,
        poses: Poses,
        prior: Prior,
        factors: Array,
        start: Chart | None = None,
        slack: float = 1.0,
    ) -> None:
        self.poses, self.prior, self.factors, self._slack = poses, prior, factors, slack
        core = self.core = _motion.Problem(poses.core, prior.mean.flat, prior.info)
        follow_orbit(core, poses)
        self.reweigh(factors)
        if start is not None:
            core.linearise(start.flat)

    def reweigh(self, factors: Array, redescend: bool = True) -> None:
        """Use other noise factors, or Huber's weights in place of Cauchy's, with the same
        linearisation.
        """
        self.factors = factors
        self.core.noise((float(factors[0]), float(factors[1])), redescend, self._slack * GATE)

    def cost(self, chart: Chart) -> float:
        """Half chi-square of initial values, including the prior."""
        return self.core.residuals(chart.flat)[0]

    def misfit(self, chart: Chart) -> float:
        """Half chi-square of the poses alone."""
        return self.core.residuals(chart.flat)[1]

    def pinned(self, start: Chart, params: FitParams, pin: Pin, most: int) -> tuple[Chart, Array]:
        """The fit from ``start`` with one direction fixed.

        Returns:
            Its chart and its covariance (20, 20) in the chart, after at most ``most`` steps.
        """
        self.core.pin(pin.centre.flat, pin.row, pin.target, pin.one_sigma)
        self.core.linearise(start.flat)
        self.core.descend(most, max(params.gain_tol, _PIN_TOL))
        found = self.chart, self.covariance
        self.core.unpin()
        return found

    @property
    def chart(self) -> Chart:
        """Where the cost is linearised."""
        return Chart(self.core.chart)

    @property
    def covariance(self) -> Array:
        """(20, 20) inverse of the normal matrix, in chart coordinates."""
        return _inverse(self.core.normal()[0])


def follow_orbit(core: _motion.Problem, poses: Poses) -> None:
    """Move the centre of mass along the orbit of the poses, if they have one, in place of free
    motion.
    """
    if poses.arc is not None:
        moved = poses.arc.transitions(poses.times_s)
        core.paths(np.stack([moved[:, :3, :3], moved[:, :3, 3:]], axis=1))


def _inverse(A: NDArray[Any]) -> Array:
    return np.asarray(np.linalg.inv(A), dtype=np.float64)


def fit(
    poses: Poses,
    start: Chart,
    prior: Prior,
    params: FitParams,
    factors: Array | None = None,
    every: Poses | None = None,
    robust_start: bool = False,
    slack: float = 1.0,
) -> BatchFit:
    """Fit from ``start``. The noise factors begin at ``factors``; they are refined for
    ``params.rescale``.

    The residuals' correlation can be estimated only once there are many; ``params.least_inflation``
    bounds it.

    Args:
        poses: the measurements, or their normal points.
        start: initial values of the descent.
        prior: Gaussian prior of the initial values.
        params: settings of the fit.
        factors: (2,) noise factors of a fit that ended at ``start``. None begins at 1, with Huber's
            weights.
        every: the poses that ``poses`` are normal points of; the noise is estimated from their
            residuals.
        robust_start: begin with Huber's weights although ``factors`` are given.
        slack: as in ``Problem``.

    Raises:
        ValueError: fewer than three poses.
    """
    if len(poses) < 3:
        raise ValueError(f"{len(poses)} poses, three at least are needed")
    every = poses if every is None else every
    least = np.sqrt(np.full(2, params.least_inflation))
    problem = Problem(poses, prior, least if factors is None else factors, start, slack)
    core, steps = problem.core, 0
    if factors is None or robust_start:
        problem.reweigh(problem.factors, redescend=False)
        steps, _ = core.descend(params.max_steps, params.gain_tol)
        problem.reweigh(problem.factors)
    more, done = core.descend(params.max_steps, params.gain_tol)
    steps += more
    plain, inflation = problem.factors / least, least**2
    if params.rescale and len(every) >= _FEWEST_FOR_FACTORS:
        for _ in range(2):
            plain, found = _noise_of(problem, every)
            inflation = np.maximum(found, params.least_inflation)
            problem.reweigh(plain * np.sqrt(inflation))
            more, done = core.descend(params.max_steps, params.gain_tol)
            steps += more
    core.linearise(
        core.chart
    )  # the last steps kept the Jacobian; the covariance needs that of the minimum
    return BatchFit(
        problem.chart,
        problem.covariance,
        core.cost,
        core.d,
        core.weights,
        plain,
        inflation,
        steps,
        done,
    )


def _noise_of(problem: Problem, every: Poses) -> tuple[Array, Array]:
    """Noise factors (2,) and inflation (2,), of attitude and position, from the residuals of all
    poses.

    The squared factor is the mean of the squares of root d, plus those of root J P^1/2, the part
    that the fit absorbed; the inflation is 1 + 2 sum of the residuals' autocorrelations.
    """
    white = every.whitened(every.residuals(problem), problem.factors)
    weights = 1.0 / np.maximum((white * white).sum(axis=1) / GATE, 1.0)
    sizes = (weights[:, None] * white**2).reshape(-1, 2, 3).sum(axis=(0, 2)) * problem.factors**2
    factors = np.sqrt(
        (sizes + problem.core.absorbed(problem.covariance)) / (3.0 * float(weights.sum()))
    )
    white *= np.sqrt(weights)[:, None]
    return factors, np.array(
        [integrated_autocorrelation(white[:, :3]), integrated_autocorrelation(white[:, 3:])]
    )
