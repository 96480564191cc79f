"""Maximum likelihood of the 20 initial values over all healthy poses: Levenberg-Marquardt on the manifold.

The motion is taken as deterministic; the residuals d = [theta; v] are expressed in {C}, where their noise is given.
Jacobians are H Phi, in the coordinates of ``chart``, which keep the inertia physical without a bound. A prior, given or
weak, keeps directions finite that the poses do not determine yet. The likelihood is that of an M-estimator: a pose
above the 99.99 % point of chi-square with 6 degrees of freedom gets Huber's weight in the first descent and Cauchy's in
the last; other poses keep the weight 1, so that Gaussian noise costs no efficiency. Two factors on the poses' noise,
attitude and position, may be estimated from the residuals; where the residuals are correlated in time, as those of
registration are, the covariance is inflated by their integrated autocorrelation.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.estimate.chart import RATE, Chart, to_errors, to_state
from avsreplay.estimate.dynamics import RotationHistory, rotation_history
from avsreplay.estimate.error_state import DIM, DMU, RHO, SIGMA, VARRHO, VEL
from avsreplay.estimate.noise import integrated_autocorrelation, weigh
from avsreplay.geometry import Array, skew
from avsreplay.records import State
from avsreplay.settings import Settings, setting

_FEWEST_FOR_FACTORS = 12
_LARGEST_RADPS = 0.5  # a step that changes the rate by more than this plus the rate itself is not tried
_PIN_TOL = 0.02  # half chi-square: tolerance of a fit with one direction fixed


@dataclass(frozen=True, slots=True)
class FitParams(Settings):
    """Settings of the batch fit."""

    max_steps: int = setting(40, "Largest number of Levenberg-Marquardt steps.", low=1)
    gain_tol: float = setting(
        1e-3, "The iteration ends when a step reduces half the chi-square by less than this.", low=0.0
    )
    rescale: bool = setting(True, "Estimate the two noise factors from the residuals.")
    least_inflation: float = setting(
        1.0, "Smallest factor by which the correlation of pose errors in time inflates their covariance.", above=0.0
    )
    try_directions: int = setting(
        3, "Number of directions, least observable first, in which the profile likelihood is tested.", low=0
    )
    bend_max: float = setting(
        2.0, "Ratio of the cost at 2 sigma to that of a Gaussian from which a direction is non-Gaussian.", above=0.0
    )


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Healthy poses T_ac, oldest first.

    Attributes:
        times_s: (n,) since the fit's epoch [s].  q: (n, 4) q_ac.  t: (n, 3) [m].
        C: (n, 6, 6) covariance of d = [theta; v] in {C} [rad, m], T_true = T_ac Exp(d).
        root: (n, 6, 6) with root C root' = 1.  R_ca: (n, 3, 3).
    """

    times_s: Array
    q: Array
    t: Array
    C: Array
    root: Array = field(init=False)
    R_ca: Array = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "root", _inverse(np.linalg.cholesky(self.C)))
        object.__setattr__(self, "R_ca", np.swapaxes(geometry.matrix(self.q), -1, -2).copy())

    def __len__(self) -> int:
        return len(self.times_s)

    def upto(self, count: int) -> Poses:
        """The first ``count`` poses."""
        return Poses(self.times_s[:count], self.q[:count], self.t[:count], self.C[:count])

    def latest(self, count: int, epoch_s: float) -> Poses:
        """The last ``count`` poses, with times from ``epoch_s``."""
        return Poses(self.times_s[-count:] - epoch_s, self.q[-count:], self.t[-count:], self.C[-count:])


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """A Gaussian prior of the initial values: mean and covariance P (20, 20) of the chart coordinates."""

    mean: Chart
    P: Array

    @property
    def one_sigma(self) -> Array:
        """(20,) 1 sigma of each coordinate."""
        return np.sqrt(np.diagonal(self.P))


@dataclass(frozen=True, slots=True, eq=False)
class BatchFit:
    """The result of a fit.

    Attributes:
        chart: initial values at the epoch.  P_chart: (20, 20) their covariance.
        half_chi2: cost, half the weighted chi-square including the prior, at ``effective``.
        d: (n, 6) residuals in {C} [rad, m].  weights: (n,) in (0, 1].  factors: (2,) of attitude and position noise.
        inflation: (2,) 1 + 2 sum of the residuals' autocorrelations: the factor on the variance of the poses.
        steps: taken.  converged: the stopping rule was met within the allowed steps.
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
        """(2,) noise factors of the covariance: those of white noise that carries the same information."""
        return np.asarray(self.factors * np.sqrt(self.inflation))

    @property
    def rms(self) -> tuple[float, float]:
        """Root mean square residual: attitude [rad] and position [m]."""
        return float(np.sqrt(np.mean(self.d[:, :3] ** 2) * 3)), float(np.sqrt(np.mean(self.d[:, 3:] ** 2) * 3))


@dataclass(frozen=True, slots=True, eq=False)
class _Residuals:
    """Residuals d (n, 6) of the poses at a state, weights, cost; and the motion they come from."""

    chart: Chart
    x: State
    path: RotationHistory
    A_ab: Array
    d: Array
    weights: Array
    cost: float


@dataclass(frozen=True, slots=True, eq=False)
class _Linearised:
    """Linearisation at a state: residuals d (n, 6), Jacobian J (n, 6, 20) in the chart, weights, cost."""

    chart: Chart
    d: Array
    J: Array
    weights: Array
    cost: float


@dataclass(frozen=True, slots=True, eq=False)
class Pin:
    """A pseudo-measurement row . (chart - centre) = ``target`` with ``one_sigma``: it fixes one direction."""

    centre: Chart
    row: Array
    target: float
    one_sigma: float

    def error(self, chart: Chart) -> float:
        """Deviation from the target, in 1 sigma."""
        return (float(self.row @ chart.minus(self.centre)) - self.target) / self.one_sigma


class _Problem:
    """The cost over the initial values, at given noise factors."""

    def __init__(self, poses: Poses, prior: Prior, params: FitParams, factors: Array, pin: Pin | None = None) -> None:
        self.poses, self.prior, self.params, self.pin = poses, prior, params, pin
        self.redescend = True
        self.factors = factors
        self.prior_info = _inverse(prior.P)

    def at(self, chart: Chart) -> _Linearised:
        return self.linear(self.residuals(chart))

    def residuals(self, chart: Chart) -> _Residuals:
        x, p = to_state(chart), self.poses
        path = rotation_history(x, p.times_s)
        A_ab, d = geometry.matrix(path.q), np.empty((len(p), 6))
        d[:, :3] = geometry.log(geometry.multiply(geometry.conjugate(p.q), geometry.multiply(path.q, x.q_bc)))
        off_a = x.r_a + p.times_s[:, None] * x.v_a + A_ab @ x.c_b - p.t
        d[:, 3:] = (p.R_ca @ off_a[:, :, None])[:, :, 0]
        return _Residuals(chart, x, path, A_ab, d, *self._weighted(chart, d))

    def reweighted(self, here: _Linearised) -> _Linearised:
        """The same linearisation with the present noise factors and weight function."""
        weights, cost = self._weighted(here.chart, here.d)
        return replace(here, weights=weights, cost=cost)

    def linear(self, at: _Residuals) -> _Linearised:
        """The Jacobian H Phi in chart coordinates."""
        x, p, turn = at.x, self.poses, at.path.S[:, :3]
        A_cb, R_cb = geometry.matrix(x.q_bc).T.copy(), p.R_ca @ at.A_ab
        J = np.zeros((len(p), 6, DIM))
        for rows, by_turn in ((slice(0, 3), 2.0 * A_cb @ turn), (slice(3, 6), -2.0 * (R_cb @ skew(x.c_b)) @ turn)):
            J[:, rows, :6], J[:, rows, SIGMA] = by_turn[:, :, :6], by_turn[:, :, 6:]
        J[:, :3, DMU] = 2.0 * A_cb
        J[:, 3:, RHO] = p.R_ca
        J[:, 3:, VEL] = p.R_ca * p.times_s[:, None, None]
        J[:, 3:, VARRHO] = R_cb
        J = (J.reshape(-1, DIM) @ to_errors(at.chart)).reshape(J.shape)
        return _Linearised(at.chart, at.d, J, at.weights, at.cost)

    def normal(self, here: _Linearised) -> tuple[Array, Array]:
        """Normal equations of the step: A (20, 20) step = b (20,)."""
        e, J = self.rows(here)
        J = J.reshape(-1, DIM)
        A = J.T @ J + self.prior_info
        b = -(J.T @ e.reshape(-1)) - self.prior_info @ here.chart.minus(self.prior.mean)
        if self.pin is not None:
            row = self.pin.row / self.pin.one_sigma
            A += np.outer(row, row)
            b -= row * self.pin.error(here.chart)
        return A, b

    def rescaled(self, here: _Linearised, P: Array) -> Array:
        """Noise factors (2,) from the residuals: mean of d' C^-1 d plus J P J', the part that the fit absorbed."""
        w, found = here.weights, []
        for rows in (slice(0, 3), slice(3, 6)):
            info, d, J = _inverse(self.poses.C[:, rows, rows]), here.d[:, rows], here.J[:, rows]
            size = np.einsum("ni,nij,nj->n", d, info, d) + ((info @ J) * (J @ P)).sum(axis=(1, 2))
            found.append(np.sqrt(float(w @ size) / (3.0 * float(w.sum()))))
        return np.array(found)

    def inflation(self, here: _Linearised) -> Array:
        """(2,) 1 + 2 sum of the residuals' autocorrelations, of attitude and position."""
        e = self.whitened(here.d[:, :, None])[:, :, 0] * np.sqrt(here.weights)[:, None]
        return np.array([integrated_autocorrelation(e[:, :3]), integrated_autocorrelation(e[:, 3:])])

    def rows(self, here: _Linearised) -> tuple[Array, Array]:
        """Residuals (n, 6) and Jacobian (n, 6, 20), whitened and weighted: each of unit variance."""
        columns = np.concatenate([here.J, here.d[:, :, None]], axis=2)
        both = self.whitened(columns) * np.sqrt(here.weights)[:, None, None]
        return both[:, :, DIM], both[:, :, :DIM]

    def whitened(self, columns: Array) -> Array:
        """Columns (n, 6, k) whitened by the noise."""
        out: Array = (self.poses.root / np.repeat(self.factors, 3)) @ columns
        return out

    def _weighted(self, chart: Chart, d: Array) -> tuple[Array, float]:
        """M-estimator weights (n,) of the residuals, and the cost."""
        e = self.whitened(d[:, :, None])
        chi2 = np.einsum("nij,nij->n", e, e)
        weights, robust = weigh(chi2, self.redescend)
        off = chart.minus(self.prior.mean)
        cost = 0.5 * float(robust.sum()) + 0.5 * float(off @ self.prior_info @ off)
        if self.pin is not None:
            cost += 0.5 * self.pin.error(chart) ** 2
        return weights, cost


def _inverse(A: NDArray[Any]) -> Array:
    return np.asarray(np.linalg.inv(A), dtype=np.float64)


def fit(poses: Poses, start: Chart, prior: Prior, params: FitParams, factors: Array | None = None) -> BatchFit:
    """Fit from ``start``. The noise factors begin at ``factors`` and are refined where ``params.rescale`` is set.

    The residuals' correlation in time can be estimated only once there are many; ``params.least_inflation`` bounds it.

    Raises:
        ValueError: fewer than three poses.
    """
    if len(poses) < 3:
        raise ValueError(f"{len(poses)} poses, three at least are needed")
    least = np.sqrt(np.full(2, params.least_inflation))
    problem = _Problem(poses, prior, params, least if factors is None else factors)
    problem.redescend = False
    here, steps, done = _descend(problem, problem.at(start), params.max_steps)
    problem.redescend = True
    here, more, done = _descend(problem, problem.reweighted(here), params.max_steps)
    steps += more
    plain, inflation = problem.factors / least, least**2
    if params.rescale and len(poses) >= _FEWEST_FOR_FACTORS:
        for _ in range(2):
            plain = problem.rescaled(here, _inverse(problem.normal(here)[0]))
            inflation = np.maximum(problem.inflation(here), params.least_inflation)
            problem.factors = plain * np.sqrt(inflation)
            here, more, done = _descend(problem, problem.reweighted(here), params.max_steps)
            steps += more
    P = _inverse(problem.normal(here)[0])
    return BatchFit(here.chart, P, here.cost, here.d, here.weights, plain, inflation, steps, done)


def cost(poses: Poses, chart: Chart, prior: Prior, params: FitParams, factors: Array) -> float:
    """Half chi-square of initial values, including the prior."""
    return _Problem(poses, prior, params, factors).residuals(chart).cost


def linearised(poses: Poses, chart: Chart, prior: Prior, params: FitParams, factors: Array) -> tuple[Array, Array]:
    """Residuals (n, 6) and their Jacobian (n, 6, 20) in the chart, whitened and weighted: each of unit variance."""
    problem = _Problem(poses, prior, params, factors)
    return problem.rows(problem.at(chart))


def pinned(
    poses: Poses, start: Chart, prior: Prior, params: FitParams, factors: Array, pin: Pin
) -> tuple[Chart, Array]:
    """The fit with one direction fixed, and its covariance (20, 20) in the chart."""
    rough = replace(params, gain_tol=max(params.gain_tol, _PIN_TOL))
    problem = _Problem(poses, prior, rough, factors, pin)
    here = _descend(problem, problem.at(start), rough.max_steps)[0]
    return here.chart, _inverse(problem.normal(here)[0])


def _descend(problem: _Problem, here: _Linearised, max_steps: int) -> tuple[_Linearised, int, bool]:
    """Levenberg-Marquardt: the minimum, the steps taken, and whether the stopping rule was met."""
    damping = 1e-3
    A, b = problem.normal(here)
    for count in range(1, max_steps + 1):
        step = np.asarray(np.linalg.solve(A + damping * np.diag(np.diagonal(A)), b), dtype=np.float64)
        expected = float(step @ b) - 0.5 * float(step @ A @ step)
        too_large = float(np.linalg.norm(step[RATE])) > _LARGEST_RADPS + float(np.linalg.norm(here.chart.w_c))
        trial = None if too_large else problem.residuals(here.chart.moved(step))
        gain = 0.0 if trial is None else here.cost - trial.cost
        if trial is not None and gain > 0.0:
            damping = max(damping * (0.1 if gain > 0.5 * expected else 0.5), 1e-9)
            here = problem.linear(trial)
            A, b = problem.normal(here)
        else:
            damping *= 8.0
        if (abs(expected) < problem.params.gain_tol and not too_large) or damping > 1e9:
            return here, count, True
    return here, max_steps, False
