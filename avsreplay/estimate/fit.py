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

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.estimate.arc import Arc, arc
from avsreplay.estimate.chart import RATE, Chart, to_errors, to_state
from avsreplay.estimate.layout import DIM, DMU, RHO, SIGMA, VARRHO, VEL
from avsreplay.estimate.robust import colour_of, weigh
from avsreplay.geometry import Array, skew
from avsreplay.records import State

__all__ = ["FitParams", "Fitted", "Pin", "Poses", "Prior", "cost", "fit", "linearised", "pinned"]

_FEWEST_FOR_FACTORS = 12
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
class _Seen:
    """The poses as a state has them: residuals d (n, 6), weights, cost; the motion x and path they come from."""

    chart: Chart
    x: State
    path: Arc
    A_ab: Array
    d: Array
    weights: Array
    cost: float


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
        self.redescend = True
        self.factors = factors
        self.prior_info = _inverse(prior.P)

    def at(self, chart: Chart) -> _Here:
        return self.linear(self.seen(chart))

    def seen(self, chart: Chart) -> _Seen:
        x, p = to_state(chart), self.poses
        path = arc(x, p.times_s)
        A_ab, d = geometry.matrix(path.q), np.empty((len(p), 6))
        d[:, :3] = geometry.log(geometry.multiply(geometry.conjugate(p.q), geometry.multiply(path.q, x.q_bc)))
        off_a = x.r_a + p.times_s[:, None] * x.v_a + A_ab @ x.c_b - p.t
        d[:, 3:] = (p.R_ca @ off_a[:, :, None])[:, :, 0]
        return _Seen(chart, x, path, A_ab, d, *self._say(chart, d))

    def again(self, here: _Here) -> _Here:
        """The same place, under the factors and the kind of weights now in force."""
        weights, cost = self._say(here.chart, here.d)
        return replace(here, weights=weights, cost=cost)

    def linear(self, seen: _Seen) -> _Here:
        """With the derivative, H Phi chained and taken into the chart."""
        x, p, turn = seen.x, self.poses, seen.path.S[:, :3]
        A_cb, R_cb = geometry.matrix(x.q_bc).T.copy(), p.R_ca @ seen.A_ab
        J = np.zeros((len(p), 6, DIM))
        for rows, by_turn in ((slice(0, 3), 2.0 * A_cb @ turn), (slice(3, 6), -2.0 * (R_cb @ skew(x.c_b)) @ turn)):
            J[:, rows, :6], J[:, rows, SIGMA] = by_turn[:, :, :6], by_turn[:, :, 6:]
        J[:, :3, DMU] = 2.0 * A_cb
        J[:, 3:, RHO] = p.R_ca
        J[:, 3:, VEL] = p.R_ca * p.times_s[:, None, None]
        J[:, 3:, VARRHO] = R_cb
        J = (J.reshape(-1, DIM) @ to_errors(seen.chart)).reshape(J.shape)
        return _Here(seen.chart, seen.d, J, seen.weights, seen.cost)

    def normal(self, here: _Here) -> tuple[Array, Array]:
        """A (20, 20) and b (20,) of the step: A step = b."""
        e, J = self.rows(here)
        J = J.reshape(-1, DIM)
        A = J.T @ J + self.prior_info
        b = -(J.T @ e.reshape(-1)) - self.prior_info @ here.chart.minus(self.prior.mean)
        if self.pin is not None:
            row = self.pin.row / self.pin.one_sigma
            A += np.outer(row, row)
            b -= row * self.pin.error(here.chart)
        return A, b

    def rescaled(self, here: _Here, P: Array) -> Array:
        """Factors (2,) from the residuals: mean of d' C^-1 d and of what the fit took up of it, J P J'."""
        w, found = here.weights, []
        for rows in (slice(0, 3), slice(3, 6)):
            info, d, J = _inverse(self.poses.C[:, rows, rows]), here.d[:, rows], here.J[:, rows]
            size = np.einsum("ni,nij,nj->n", d, info, d) + ((info @ J) * (J @ P)).sum(axis=(1, 2))
            found.append(np.sqrt(float(w @ size) / (3.0 * float(w.sum()))))
        return np.array(found)

    def colour(self, here: _Here) -> Array:
        """(2,) 1 + 2 sum of the residuals' autocorrelations, of attitude and position."""
        e = self.whitened(here.d[:, :, None])[:, :, 0] * np.sqrt(here.weights)[:, None]
        return np.array([colour_of(e[:, :3]), colour_of(e[:, 3:])])

    def rows(self, here: _Here) -> tuple[Array, Array]:
        """Residuals (n, 6) and derivative (n, 6, 20), whitened and weighted: each of unit variance."""
        columns = np.concatenate([here.J, here.d[:, :, None]], axis=2)
        both = self.whitened(columns) * np.sqrt(here.weights)[:, None, None]
        return both[:, :, DIM], both[:, :, :DIM]

    def whitened(self, columns: Array) -> Array:
        """Columns (n, 6, k) in units of the noise."""
        out: Array = (self.poses.root / np.repeat(self.factors, 3)) @ columns
        return out

    def _say(self, chart: Chart, d: Array) -> tuple[Array, float]:
        """Weights (n,) of residuals, and the cost."""
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
    here, more, done = _descend(problem, problem.again(here), params.max_steps)
    steps += more
    plain, colour = problem.factors / least, least**2
    if params.rescale and len(poses) >= _FEWEST_FOR_FACTORS:
        for _ in range(2):
            plain = problem.rescaled(here, _inverse(problem.normal(here)[0]))
            colour = np.maximum(problem.colour(here), params.least_colour)
            problem.factors = plain * np.sqrt(colour)
            here, more, done = _descend(problem, problem.again(here), params.max_steps)
            steps += more
    P = _inverse(problem.normal(here)[0])
    return Fitted(here.chart, P, here.cost, here.d, here.weights, plain, colour, steps, done)


def cost(poses: Poses, chart: Chart, prior: Prior, params: FitParams, factors: Array) -> float:
    """Half chi-square of initial values, the prior's share included."""
    return _Problem(poses, prior, params, factors).seen(chart).cost


def linearised(poses: Poses, chart: Chart, prior: Prior, params: FitParams, factors: Array) -> tuple[Array, Array]:
    """Residuals (n, 6) and their derivative (n, 6, 20) in the chart, whitened and weighted: each of unit variance."""
    problem = _Problem(poses, prior, params, factors)
    return problem.rows(problem.at(chart))


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
        trial = None if wild else problem.seen(here.chart.moved(step))
        gain = 0.0 if trial is None else here.cost - trial.cost
        if trial is not None and gain > 0.0:
            damping = max(damping * (0.1 if gain > 0.5 * expected else 0.5), 1e-9)
            here = problem.linear(trial)
            A, b = problem.normal(here)
        else:
            damping *= 8.0
        if (abs(expected) < problem.params.gain_tol and not wild) or damping > 1e9:
            return here, count, True
    return here, max_steps, False
