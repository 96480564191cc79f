"""Maximum likelihood of the 20 initial values over all healthy poses: Levenberg-Marquardt on the manifold.

The motion is taken as deterministic; each pose's residual d = [theta; v] stands in {C}, where its covariance is given.
Jacobians are H Phi chained, in the coordinates of ``chart``, which keep the inertia physical without a bound. A prior,
given or weak, keeps directions finite that the poses do not tell yet. A pose beyond the 99.99 % point of chi-square
with 6 degrees of freedom is weighted down (Huber's weight on the way in, Cauchy's at the end), others are not touched,
so honest noise costs nothing. The poses' noise may be rescaled by two factors, attitude and position, taken from the
residuals themselves; where these are correlated in time, as registration's are, the covariance is widened by their
integrated autocorrelation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.estimate.arc import arc
from avsreplay.estimate.chart import RATE, Chart, to_errors, to_state
from avsreplay.estimate.layout import DIM, DMU, DQ, RHO, SIGMA, VARRHO, VEL, W
from avsreplay.geometry import Array
from avsreplay.records import State

__all__ = ["GATE", "FitParams", "Fitted", "Pin", "Poses", "Prior", "cost", "fit", "linearised", "pinned"]

GATE = 27.86  # chi-square with 6 degrees of freedom, 99.99 %
_FEWEST_FOR_FACTORS = 12
_LAGS = (5, 10, 20, 40)
_WILD_RADPS = 0.5  # a step that adds more to the rate than this and the rate itself is not tried
_PIN_TOL = 0.02  # half chi-square: how well a held fit needs to be known


@dataclass(frozen=True, slots=True)
class FitParams:
    """How far the fit goes."""

    # most steps of Levenberg-Marquardt
    max_steps: int = 40
    # a step is the last one when it gains less than this in half chi-square
    gain_tol: float = 1e-3
    # take the two noise factors from the residuals
    rescale: bool = True
    # how many times less than white ones the poses say at least, for their errors' correlation in time
    least_colour: float = 1.0
    # directions, weakest first, whose cost is tried for bending
    try_directions: int = 3
    # the cost two sigma away may be this many times the normal one before the direction counts as bent
    bend_max: float = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Healthy poses T_ac, oldest first.

    Attributes:
        times_s: (n,) since the fit's epoch [s].  q: (n, 4) q_ac.  t: (n, 3) [m].
        C: (n, 6, 6) covariance of d = [theta; v] in {C} [rad, m], T_true = T_ac Exp(d).
    """

    times_s: Array
    q: Array
    t: Array
    C: Array

    def __len__(self) -> int:
        return len(self.times_s)

    def upto(self, count: int) -> Poses:
        """The first ``count`` of them."""
        return Poses(self.times_s[:count], self.q[:count], self.t[:count], self.C[:count])


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """A normal belief about the initial values: mean and covariance P (20, 20) of the chart's coordinates."""

    mean: Chart
    P: Array

    @property
    def one_sigma(self) -> Array:
        """(20,) 1 sigma of each coordinate."""
        return np.sqrt(np.diagonal(self.P))


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """What the poses say.

    Attributes:
        chart: initial values at the epoch.  P_chart: (20, 20) their covariance.
        half_chi2: cost, half the weighted chi-square with the prior's share, at ``effective``.
        d: (n, 6) residuals in {C} [rad, m].  weights: (n,) in (0, 1].  factors: (2,) of attitude and position noise.
        colour: (2,) 1 + 2 sum of the residuals' autocorrelations: how many times less the poses say than if white.
        steps: taken.  converged: the last step gained too little to go on.
    """

    chart: Chart
    P_chart: Array
    half_chi2: float
    d: Array
    weights: Array
    factors: Array
    colour: Array
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
        """(2,) noise factors the covariance stands on: of white noise that would say as little as the poses do."""
        return np.asarray(self.factors * np.sqrt(self.colour))

    @property
    def rms(self) -> tuple[float, float]:
        """Root mean square residual: attitude [rad] and position [m]."""
        return float(np.sqrt(np.mean(self.d[:, :3] ** 2) * 3)), float(np.sqrt(np.mean(self.d[:, 3:] ** 2) * 3))


@dataclass(frozen=True, slots=True, eq=False)
class _Whitener:
    """(n, 6, 6) roots with root C root' = 1, and the inverse covariances of each block (n, 3, 3)."""

    root: Array
    attitude: Array
    position: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Here:
    """Linearisation at a state: residuals d (n, 6), derivative J (n, 6, 20) in the chart, weights, cost."""

    chart: Chart
    d: Array
    J: Array
    weights: Array
    cost: float


@dataclass(frozen=True, slots=True, eq=False)
class Pin:
    """A wish that row . (chart - centre) be ``target``, to ``one_sigma``: holds one direction fixed."""

    centre: Chart
    row: Array
    target: float
    one_sigma: float

    def error(self, chart: Chart) -> float:
        """How far off, in 1 sigma."""
        return (float(self.row @ chart.minus(self.centre)) - self.target) / self.one_sigma


class _Problem:
    """The cost over the initial values, at given noise factors."""

    def __init__(self, poses: Poses, prior: Prior, params: FitParams, factors: Array, pin: Pin | None = None) -> None:
        self.poses, self.prior, self.params, self.pin = poses, prior, params, pin
        self.white = _whitener(poses.C)
        self.redescend = True
        self.factors = factors
        self.R_ca = np.swapaxes(geometry.matrix(poses.q), -1, -2)
        self.prior_info = _inverse(prior.P)

    def at(self, chart: Chart) -> _Here:
        d, J = self._residuals(chart)
        e = self.whitened(d)
        chi2 = np.einsum("ni,ni->n", e, e)
        weights, robust = _robust(chi2, self.redescend)
        off = chart.minus(self.prior.mean)
        cost = 0.5 * float(robust.sum()) + 0.5 * float(off @ self.prior_info @ off)
        if self.pin is not None:
            cost += 0.5 * self.pin.error(chart) ** 2
        return _Here(chart, d, J, weights, cost)

    def normal(self, here: _Here) -> tuple[Array, Array]:
        """A (20, 20) and b (20,) of the step: A step = b."""
        e, J = self.whitened(here.d), self.whitened(here.J)
        JW = J * here.weights[:, None, None]
        A = np.tensordot(JW, J, ([0, 1], [0, 1])) + self.prior_info
        b = -np.tensordot(JW, e, ([0, 1], [0, 1])) - self.prior_info @ here.chart.minus(self.prior.mean)
        if self.pin is not None:
            row = self.pin.row / self.pin.one_sigma
            A += np.outer(row, row)
            b -= row * self.pin.error(here.chart)
        return A, b

    def rescaled(self, here: _Here, P: Array) -> Array:
        """Factors (2,) from the residuals: mean of d' C^-1 d and of what the fit took up of it, J P J'."""
        w = here.weights
        found = []
        for rows, info in ((slice(0, 3), self.white.attitude), (slice(3, 6), self.white.position)):
            d, J = here.d[:, rows], here.J[:, rows]
            size = np.einsum("ni,nij,nj->n", d, info, d) + np.einsum("nij,njk,kl,nil->n", info, J, P, J, optimize=True)
            found.append(np.sqrt(float(w @ size) / (3.0 * float(w.sum()))))
        return np.array(found)

    def colour(self, here: _Here) -> Array:
        """(2,) 1 + 2 sum of the residuals' autocorrelations, of attitude and position."""
        e = self.whitened(here.d) * np.sqrt(here.weights)[:, None]
        return np.array([_colour(e[:, :3]), _colour(e[:, 3:])])

    def whitened(self, rows: Array) -> Array:
        scaled = rows / np.repeat(self.factors, 3).reshape((6,) + (1,) * (rows.ndim - 2))
        out: Array = np.einsum("nij,nj...->ni...", self.white.root, scaled)
        return out

    def _residuals(self, chart: Chart) -> tuple[Array, Array]:
        """From measured to fitted pose in {C}, d (n, 6), and its derivative (n, 6, 20) in the chart."""
        p, x = self.poses, to_state(chart)
        path = arc(x, p.times_s)
        A_ab, A_cb = geometry.matrix(path.q), geometry.matrix(x.q_bc).T
        q_ac = geometry.multiply(path.q, x.q_bc)
        d = np.empty((len(p), 6))
        d[:, :3] = geometry.log(geometry.multiply(geometry.conjugate(p.q), q_ac))
        centre = x.r_a + p.times_s[:, None] * x.v_a
        d[:, 3:] = np.einsum("nij,nj->ni", self.R_ca, centre + A_ab @ x.c_b - p.t)
        J = np.zeros((len(p), 6, DIM))
        turn = path.S[:, :3]
        columns = np.r_[DQ, W, SIGMA]
        J[:, :3, columns] = 2.0 * A_cb @ turn
        J[:, :3, DMU] = 2.0 * A_cb
        R_cb = self.R_ca @ A_ab
        J[:, 3:, columns] = -2.0 * (R_cb @ geometry.skew(x.c_b)) @ turn
        J[:, 3:, RHO] = self.R_ca
        J[:, 3:, VEL] = self.R_ca * p.times_s[:, None, None]
        J[:, 3:, VARRHO] = R_cb
        return d, J @ to_errors(chart)


def _robust(chi2: Array, redescend: bool) -> tuple[Array, Array]:
    """Weights and costs (n,): plain up to the gate; beyond it Cauchy's logarithm, or Huber's root on the way in."""
    over = np.maximum(chi2 / GATE, 1.0)
    if redescend:
        return 1.0 / over, np.where(over > 1.0, GATE * (1.0 + np.log(over)), chi2)
    return 1.0 / np.sqrt(over), np.where(over > 1.0, GATE * (2.0 * np.sqrt(over) - 1.0), chi2)


def _colour(e: Array) -> float:
    """1 + 2 sum of autocorrelations of rows e (n, 3), over the lags that show most, where three sigma do."""
    n, total = len(e), float(np.sum(e * e))
    lags = [k for k in _LAGS if k <= n // 8]
    rho = [float(np.sum(e[k:] * e[:-k])) / total * n / (n - k) for k in range(1, max(lags, default=0) + 1)]
    sums = [(sum(rho[:k]), 3.0 * np.sqrt(k / (3.0 * n))) for k in lags]
    return 1.0 + 2.0 * max((found for found, doubt in sums if found > doubt), default=0.0)


def _whitener(C: Array) -> _Whitener:
    root = _inverse(np.linalg.cholesky(C))
    return _Whitener(root, _inverse(C[:, :3, :3]), _inverse(C[:, 3:, 3:]))


def _inverse(A: NDArray[Any]) -> Array:
    return np.asarray(np.linalg.inv(A), dtype=np.float64)


def fit(poses: Poses, start: Chart, prior: Prior, params: FitParams, factors: Array | None = None) -> Fitted:
    """Fit from ``start``. The noise factors begin at ``factors`` and are refined where ``params.rescale`` says so.

    Residuals show a correlation in time only once there are many; until then ``params.least_colour`` stands for it.

    Raises:
        ValueError: fewer than three poses.
    """
    if len(poses) < 3:
        raise ValueError(f"{len(poses)} poses, three at least are needed")
    least = np.sqrt(np.full(2, params.least_colour))
    problem = _Problem(poses, prior, params, least if factors is None else factors)
    problem.redescend = False
    here, steps, done = _descend(problem, problem.at(start), params.max_steps)
    problem.redescend = True
    here, more, done = _descend(problem, problem.at(here.chart), params.max_steps)
    steps += more
    plain, colour = problem.factors / least, least**2
    if params.rescale and len(poses) >= _FEWEST_FOR_FACTORS:
        for _ in range(2):
            plain = problem.rescaled(here, _inverse(problem.normal(here)[0]))
            colour = np.maximum(problem.colour(here), params.least_colour)
            problem.factors = plain * np.sqrt(colour)
            here, more, done = _descend(problem, problem.at(here.chart), params.max_steps)
            steps += more
    P = _inverse(problem.normal(here)[0])
    return Fitted(here.chart, P, here.cost, here.d, here.weights, plain, colour, steps, done)


def cost(poses: Poses, chart: Chart, prior: Prior, params: FitParams, factors: Array) -> float:
    """Half chi-square of initial values, the prior's share included."""
    return _Problem(poses, prior, params, factors).at(chart).cost


def linearised(poses: Poses, chart: Chart, prior: Prior, params: FitParams, factors: Array) -> tuple[Array, Array]:
    """Residuals (n, 6) and their derivative (n, 6, 20) in the chart, whitened and weighted: each of unit variance."""
    problem = _Problem(poses, prior, params, factors)
    here = problem.at(chart)
    root = np.sqrt(here.weights)[:, None]
    return problem.whitened(here.d) * root, problem.whitened(here.J) * root[:, None]


def pinned(
    poses: Poses, start: Chart, prior: Prior, params: FitParams, factors: Array, pin: Pin
) -> tuple[Chart, Array]:
    """The fit with one direction held, and its covariance (20, 20) in the chart."""
    rough = replace(params, gain_tol=max(params.gain_tol, _PIN_TOL))
    problem = _Problem(poses, prior, rough, factors, pin)
    here = _descend(problem, problem.at(start), rough.max_steps)[0]
    return here.chart, _inverse(problem.normal(here)[0])


def _descend(problem: _Problem, here: _Here, max_steps: int) -> tuple[_Here, int, bool]:
    damping = 1e-3
    A, b = problem.normal(here)
    for count in range(1, max_steps + 1):
        step = np.asarray(np.linalg.solve(A + damping * np.diag(np.diagonal(A)), b), dtype=np.float64)
        expected = float(step @ b) - 0.5 * float(step @ A @ step)
        wild = float(np.linalg.norm(step[RATE])) > _WILD_RADPS + float(np.linalg.norm(here.chart.w_c))
        trial = here if wild else problem.at(here.chart.moved(step))
        gain = here.cost - trial.cost
        if gain > 0.0:
            damping = max(damping * (0.1 if gain > 0.5 * expected else 0.5), 1e-9)
            here = trial
            A, b = problem.normal(here)
        else:
            damping *= 8.0
        if (abs(expected) < problem.params.gain_tol and not wild) or damping > 1e9:
            return here, count, True
    return here, max_steps, False
