"""The covariance of a batch fit: corrected where the likelihood is not Gaussian, and with process
noise.

Until the body has turned a few times, some directions of the inertia are so poorly determined that
the valley of the cost is curved within 1 sigma of its minimum. The curvature at the minimum then
understates the uncertainty. The cost is compared with the Gaussian one at two sigma along each of
the weakest directions. Along a non-Gaussian direction the fit is repeated with that direction fixed
on either side (profile likelihood), where the cost, minimised over all others, has risen by 3/2, as
at root three sigma of a Gaussian. With the Gauss-Hermite weights 1/6, 4/6, 1/6 the three fits and
their remaining covariances have the second moments. Of more than three such directions, n, the fits
lie at the root of n sigma with the weights 1 / (2 n). What remains is the covariance given all
these coordinates, and its volume is a factor of the weight. Each fit is propagated to the requested
instant.

The fit takes the motion as deterministic. About its trajectory the problem is linear, so one pass
of a Kalman filter over the poses, with the disturbance's covariance between them, is the maximum
likelihood with process noise. The errors are propagated back to the epoch, where the transition is
the identity, and are expressed in chart coordinates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from avsreplay.estimate import _motion
from avsreplay.estimate.batch import BatchFit, FitParams, Pin, Poses, Problem
from avsreplay.estimate.chart import Chart, to_errors, to_state
from avsreplay.estimate.driven import drift_equivalents
from avsreplay.estimate.dynamics import MOST_RAD, torque_density, translation
from avsreplay.estimate.error_state import DIM, LARGEST_MOVE, REACHED, ROUNDING, definite
from avsreplay.estimate.mixture import Component, volumes
from avsreplay.estimate.noise_levels import (
    POSE_BLOCKS,
    NoiseLevels,
    mean_share,
    pose_error_covariance,
)
from avsreplay.estimate.pose_noise import cholesky_root
from avsreplay.estimate.relative_orbit import OrbitArc
from avsreplay.geometry import Array

_LEAST_NODE2 = 3.0  # square of the distance of the profile fits of at most three directions [sigma]
# distance along a direction at which the cost is compared with the Gaussian one [sigma]
_TRIAL = 2.0
_TRIES = 6
_LOST = 3.0
_PINNED_FIT_STEPS = 15  # of a fit with one direction fixed
_PIN_1S = 0.02  # standard deviation of a fixed direction in units of its sigma
# largest rotation by disturbances for which the problem about the fitted trajectory is linear
_LINEAR_RAD = 0.05
_NEGLIGIBLE = 0.1  # a correction of fewer sigma is always applied
# poses that a larger correction must fit better, and its parts tried
LATEST = 12
_SHARES = (1.0, 0.5, 0.25, 0.0)
SPHERE = 3.0  # tr I / I of a sphere
# probability of a constant torque; 1 sigma, equally likely [rad/s2]
_TORQUE = 0.1
_TORQUES = (3e-4, 1e-4, 3e-5, 1e-5)


@dataclass(frozen=True, slots=True, eq=False)
class ProfilePoint:
    """A fit with one direction fixed by ``pin``, and its remaining covariance P (20, 20)."""

    chart: Chart
    P: Array
    pin: Pin


@dataclass(frozen=True, slots=True, eq=False)
class NonGaussianDirection:
    """A non-Gaussian direction: ``row`` (20,) of the coordinate along it, and the profile
    fits on either side.
    """

    row: Array
    points: tuple[ProfilePoint, ProfilePoint]


@dataclass(frozen=True, slots=True, eq=False)
class BatchCovariance:
    """A fit with its non-Gaussian directions: those that could be profiled, and whether there are
    others.

    The profile fits lie at the root of ``node2`` sigma.
    """

    fitted: BatchFit
    directions: tuple[NonGaussianDirection, ...]
    others: bool = False
    node2: float = _LEAST_NODE2

    @property
    def gaussian(self) -> bool:
        """Return whether the likelihood is Gaussian up to two sigma."""
        return not (self.directions or self.others)


def covariance_of(problem: Problem, fitted: BatchFit, params: FitParams) -> BatchCovariance:
    """Test the weakest directions of a fit (relative to the prior) and profile the non-Gaussian
    ones.

    Args:
        problem: the cost that was fitted, at the noise factors ``fitted.effective``.
        fitted: its minimum.
        params: settings of the fit.
    """
    scale = problem.prior.one_sigma
    values, vectors = np.linalg.eigh(fitted.P_chart / np.outer(scale, scale))
    weakest = zip(values[::-1][: params.try_directions], vectors.T[::-1], strict=False)
    scaled = [(v * scale * math.sqrt(max(float(value), 0.0)), value) for value, v in weakest]
    bent = [
        (axis, axis / scale**2 / value)
        for axis, value in scaled
        if _non_gaussian(problem, fitted, params, axis)
    ]
    node2 = max(_LEAST_NODE2, float(len(bent)))
    directions, others = [], False
    for axis, row in bent:  # row @ axis = 1
        points = []
        for side in (math.sqrt(node2), -math.sqrt(node2)):
            point = _profile(problem, fitted, params, axis, row, side)
            if point is None:
                others = True  # this direction keeps the covariance of the fit
                break
            points.append(point)
        else:
            directions.append(NonGaussianDirection(row, (points[0], points[1])))
    return BatchCovariance(fitted, tuple(directions), others, node2)


def _non_gaussian(problem: Problem, fitted: BatchFit, params: FitParams, axis: Array) -> bool:
    gaussian = 0.5 * _TRIAL**2
    for side in (_TRIAL, -_TRIAL):
        rise = problem.cost(fitted.chart.moved(side * axis)) - fitted.half_chi2
        if not gaussian / params.bend_max < rise < gaussian * params.bend_max:
            return True
    return False


def _profile(
    problem: Problem, fitted: BatchFit, params: FitParams, axis: Array, row: Array, side: float
) -> ProfilePoint | None:
    """The fit with the direction fixed where the cost has risen by side^2 / 2, the best of
    ``_TRIES`` from ``side`` on.

    A fit that ends far above that begins again nearer to the minimum: it did not follow the valley
    of the cost. The result is None if no fit came near, because its covariance would not be that of
    a point in the valley.
    """
    there, found, wanted = fitted.chart.moved(side * axis), [], 0.5 * side**2
    for _ in range(_TRIES):
        pin = Pin(fitted.chart, row, side, _PIN_1S)
        there, P = problem.pinned(there, params, pin, _PINNED_FIT_STEPS)
        rise = problem.cost(there) - fitted.half_chi2
        found.append((abs(float(np.log(max(rise, 1e-9) / wanted))), ProfilePoint(there, P, pin)))
        if abs(rise - wanted) < 0.2 * wanted:
            break
        side *= float(np.clip(np.sqrt(wanted / max(rise, 1e-9)), 0.4, 2.5))
        if rise > _LOST * wanted:
            there = fitted.chart.moved(side * axis)
    near = [f for f in found if f[0] < float(np.log(_LOST))]
    return min(near, key=lambda f: f[0])[1] if near else None


def sandwich(
    problem: Problem, points: Poses, levels: NoiseLevels
) -> tuple[tuple[Array, Array], Array]:
    """How correlated errors change the covariance of a fit that takes the poses as independent.

    Over many turns the poses determine some directions 1e7 times better than others. The normal
    equations have the square of this ratio, so that the factor of P is that of the residuals'
    derivatives themselves.

    Args:
        problem: linearised at the minimum of its cost, with the noise factors of the fit.
        points: the poses of the problem.
        levels: variance components.

    Returns:
        A and B (20, 20) in chart steps: A B P B' A' is the covariance of the estimate, P that of
        the fit. The inflation (2,) of independent noise of attitude and position with the same
        effect in the mean over all directions.
    """
    J, n = problem.core.rows()[1] @ to_errors(problem.chart), len(points)
    Q, R = np.linalg.qr(
        np.vstack([J.reshape(-1, DIM), cholesky_root(problem.prior.info).T])
    )  # P = (R' R)^-1
    white, total = Q[: 6 * n].reshape(n, 6, DIM), Q[6 * n :].T @ Q[6 * n :]
    plain = levels.factors(mean_share(points))
    V, inflation = pose_error_covariance(points, levels, problem.factors), np.ones(POSE_BLOCKS)
    for b in range(POSE_BLOCKS):
        rows = np.ascontiguousarray(white[:, 3 * b : 3 * b + 3]).reshape(n, -1)
        columns = rows.reshape(-1, DIM)
        found = columns.T @ (V[b] @ rows).reshape(-1, DIM)
        total = total + found
        alone = float(np.sum(columns * columns))
        inflation[b] = float(np.trace(found)) / alone * float(problem.factors[b] / plain[b]) ** 2
    values, axes = np.linalg.eigh(total)
    return (np.linalg.inv(R), (axes * np.sqrt(np.maximum(values, 0.0))) @ (axes.T @ R)), np.maximum(
        inflation, 1.0
    )


def unseen_torque(problem: Problem, after_s: float) -> Array:
    """How much a constant torque that the poses do not show adds to the covariance of a fit of free
    motion.

    A wrong inertia can explain a constant torque for most of a turn. By the law of total covariance
    the possible torques enlarge the covariance by that of the motion, given the torque, in
    proportion to their probability. It is at most the prior one: a torque that the poses show is
    found by the test for it.

    Args:
        problem: linearised at the minimum of its cost.
        after_s: instant after the epoch at which the covariance is used [s].

    Returns:
        (20, 20) in chart steps at the epoch.
    """
    e, H = problem.core.rows()
    T, times = to_errors(problem.chart), np.append(problem.poses.times_s, after_s)
    try:
        B = drift_equivalents(to_state(problem.chart), times)[:, :REACHED, :3]
    except (
        np.linalg.LinAlgError
    ):  # an unstable spin over so long a time that its motion cannot be inverted
        return np.zeros((DIM, DIM))
    J, C = (H @ T).reshape(-1, DIM), (H[:, :, :REACHED] @ B[:-1]).reshape(-1, 3)
    P, cross, total = problem.covariance, J.T @ C, np.zeros((3, 3))
    newton = (
        P @ problem.core.normal()[1]
    )  # step to the minimum of the linearised cost, near which the fit ended
    moved = -P @ cross
    moved[:REACHED] += np.linalg.solve(T[:REACHED, :REACHED], B[-1])
    precision, found = C.T @ C - cross.T @ P @ cross, -C.T @ e.reshape(-1) - cross.T @ newton
    for one_sigma in _TORQUES:
        scaled = one_sigma**2 * precision + np.eye(3)
        own = one_sigma**2 * np.linalg.inv(scaled)
        torque = own @ found
        log_odds = 0.5 * float(found @ torque - np.linalg.slogdet(scaled)[1])
        total += (
            _TORQUE
            / len(_TORQUES)
            * math.exp(min(log_odds, 0.0))
            * (own + np.outer(torque, torque))
        )
    added = np.asarray(moved @ total @ moved.T)
    return added if np.isfinite(added).all() else np.zeros((DIM, DIM))


def final_mixture(
    found: BatchCovariance,
    problem: Problem,
    latest: Poses,
    noise: tuple[float, float],
    t_ns: int,
    after_s: float,
    spread: tuple[Array, Array] | None = None,
    unseen: Array | None = None,
) -> tuple[Component, ...]:
    """The fit with process noise as a Gaussian mixture at the last pose; the first has
    the published mean.

    A direction of which a profile fit cannot be propagated is treated as Gaussian.

    Args:
        found: the fit and its non-Gaussian directions.
        problem: the cost that was fitted.
        latest: the last poses, with times from the instant of the last scan: those that the mean
            must agree with.
        noise: root densities of torque [rad/s^1.5] and force [m/s^1.5].
        t_ns: the instant of the last scan [ns].
        after_s: that instant after the epoch [s].
        spread: A and B of ``sandwich``, for the covariance with the correlation of the poses'
            errors.
        unseen: (20, 20) in chart steps at the epoch, added to the covariance of each component
            (``unseen_torque``).
    """
    fitted, n, rows, out = (
        found.fitted,
        len(found.directions),
        [d.row for d in found.directions],
        [],
    )
    points = [p for d in found.directions for p in d.points]
    weights = volumes([fitted.P_chart, *(p.P for p in points)], rows)
    weights *= np.append(1.0 - n / found.node2, np.full(2 * n, 0.5 / found.node2))
    charts, pins = [fitted.chart, *(p.chart for p in points)], [None, *(p.pin for p in points)]
    added = np.zeros((DIM, DIM)) if unseen is None else _fixed(unseen, rows)
    recent = Problem(latest, problem.prior, fitted.effective)
    for weight, chart, pin in zip((weights / weights.sum()).tolist(), charts, pins, strict=True):
        y, P = process_noise_pass(chart, pin, problem, noise)
        lost = not (
            np.all(np.isfinite(P)) and float(np.abs(y).max()) < LARGEST_MOVE
        )  # the linearisation does not hold
        if pin is None:
            y, P = (np.zeros(DIM), fitted.P_chart) if lost else (y, P)
            if spread is not None:  # the spread is that about the trajectory of the fit
                P = spread[0] @ (spread[1] @ P @ spread[1].T) @ spread[0].T
            P = definite(P)
        if pin is None or not lost:
            there, share, step, beyond = _moved_on(chart, y, P, problem, recent, after_s)
            added = (
                step @ added @ step.T if pin is None else added
            )  # the added covariance is that about the fit
            P = step @ _fixed(P, rows) @ step.T + added + beyond
            lost = not _motion.above(
                P, -ROUNDING
            )  # rounding at the epoch, where the spin is unstable
        if pin is not None and lost:
            left = _without(found, pin)
            return final_mixture(left, problem, latest, noise, t_ns, after_s, spread, unseen)
        out.append(Component(weight, weight, t_ns, there, definite(P), share))
    return tuple(out)


def _without(found: BatchCovariance, pin: Pin) -> BatchCovariance:
    """The covariance without the direction that ``pin`` fixes: the variance along it stays
    that of the Gaussian.
    """
    kept = tuple(d for d in found.directions if all(point.pin is not pin for point in d.points))
    return replace(found, directions=kept, others=True)


def _moved_on(
    chart: Chart, y: Array, P: Array, problem: Problem, recent: Problem, after_s: float
) -> tuple[Chart, float, Array, Array]:
    """The trajectory of a fit ``after_s`` after the epoch, with the part of its correction y (20,)
    that it contains.

    Returns:
        The chart, that part, the transition (20, 20), and the second moments of what it does not
        contain.
    """
    base, step = propagate_chart(chart, after_s, problem.poses.arc)
    move, share = step @ y, 1.0
    if not _motion.above(P, ROUNDING) or float(y @ np.linalg.solve(P, y)) > _NEGLIGIBLE**2:
        share = _accepted_share(base, move, recent)
    return base.moved(share * move), share, step, (1.0 - share) ** 2 * np.outer(move, move)


def _fixed(P: Array, rows: list[Array]) -> Array:
    """P given the coordinates along ``rows``: their variance is that between the components
    of the mixture.
    """
    for row in rows:
        column = P @ row
        if float(row @ column) > 0.0:
            P = P - (1.0 - _PIN_1S**2) * np.outer(column, column) / float(row @ column)
    return P


def _accepted_share(base: Chart, move: Array, latest: Problem) -> float:
    """The part of the linear correction by process noise that lowers the cost of the latest poses
    most, 0 if none does.

    The correction is a Gauss-Newton step of a linearised problem; along a strongly curved direction
    a full step can be worse than none.
    """
    span = float(np.abs(latest.poses.times_s).max())
    costs = []
    for share in _SHARES:
        there = base.moved(share * move)
        possible = float(np.linalg.norm(there.w_c)) * span < MOST_RAD
        costs.append(latest.misfit(there) if possible or share == 0.0 else np.inf)
    return _SHARES[int(np.argmin(costs))]


def propagate_chart(chart: Chart, h: float, arc: OrbitArc | None = None) -> tuple[Chart, Array]:
    """The motion h seconds later, and the transition matrix (20, 20) of steps of the chart."""
    there, step = _motion.transition(chart.flat, h, translation(h, arc))
    return Chart(there), step


def memory_s(torque: float, pose_rad: float = _LINEAR_RAD**2) -> float:
    """How far back [s] a fit may look: root density ``torque`` turns the body by its square T^3 / 3
    in variance.

    The problem is linear as long as the square of that rotation is less than the error of a pose,
    ``pose_rad``.
    """
    turn = min(_LINEAR_RAD, float(np.sqrt(pose_rad)))
    return float(np.cbrt(3.0 * (turn / (SPHERE * torque)) ** 2))


def process_noise_pass(
    chart: Chart, pin: Pin | None, problem: Problem, noise: tuple[float, float]
) -> tuple[Array, Array]:
    """Correction y (20,) of a trajectory at the epoch by process noise, and its covariance P, valid
    at the last pose.

    ``pin`` fixes a direction as in the profile fit; ``noise``: root densities of torque and force
    as in the filter.
    """
    prior = problem.prior
    y, P = -chart.minus(prior.mean), prior.P
    if pin is not None:
        k = P @ pin.row / float(pin.row @ P @ pin.row + pin.one_sigma**2)
        y, P = (
            y - k * (pin.error(chart) * pin.one_sigma + float(pin.row @ y)),
            P - np.outer(k, pin.row @ P),
        )
    into = np.asarray(np.linalg.inv(to_errors(chart)[:REACHED, :REACHED]))
    density = torque_density(to_state(chart).sigma, noise[0])
    problem.core.linearise(chart.flat)
    return problem.core.smooth(y, 0.5 * (P + P.T), into, density, noise[1] ** 2)
