"""Levels of the noise from the data: restricted maximum likelihood of its variance components.

The residuals of a fit are a sum of independent parts whose covariances are known but for a factor:

- errors of the registered poses, independent from scan to scan; - errors of the registered poses
that views of the target from nearly the same direction have in common (points next to
  an edge, interior faces, a coarse mesh): a function on the sphere of view directions, with a
  Gaussian correlation;
- the disturbance torque and force, white in time, which displace all later poses.

Attitude and position have factors of their own, so that there are six. They are estimated from some
tens of normal points by the average-information algorithm (Gilmour, Thompson and Cullis, Biometrics
51, 1995), which takes the degrees of freedom of the fit into account. Differences within the normal
points give the independent part of the errors as well. The claimed noise is the prior, with the
weight of a few poses.

The density of a disturbance stands for all candidates, none among them (``disturbance_density``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.estimate.batch import Poses, Problem
from avsreplay.estimate.chart import Chart, to_errors, to_state
from avsreplay.estimate.disturbance_density import (
    DENSITIES,
    Marginal,
    Residuals,
    divided,
    information_root,
    marginal,
    mean_square,
    probability_beside,
)
from avsreplay.estimate.driven import impulses
from avsreplay.estimate.dynamics import torque_density
from avsreplay.estimate.error_state import RHO, VEL
from avsreplay.estimate.normal_points import PositionRows, error_parts
from avsreplay.estimate.pose_noise import cholesky_root
from avsreplay.geometry import Array

MOST_NORMAL_POINTS = 24  # normal points of an estimate
FEWEST = 12  # poses from which the levels are estimated
# weight of the prior of the independent and of the common errors
_CLAIMED_DOF = 6.0
_LAW_DOF = 1.0
_STEP = 3.0  # largest factor on a variance in one step
_VANISHING_PART = 0.3  # part of its standard deviation below which a disturbance may become zero
_MOST_FACTOR = 100.0  # largest factor on a claimed variance
# sum of cubes of the numbers of points over the steps of an estimate
_WORK = 2 * MOST_NORMAL_POINTS**3
_MOST_STEPS = 6
_ESTABLISHED = 3.0  # log evidence of a random disturbance that the poses show
# the same from which it is reported: the poses of free bodies reach it in none of 40 logs
_REPORTED = 10.0
_LARGEST = 4.0  # largest squared residual with disturbances over the mean one
POSE_BLOCKS = 2  # attitude, position


@dataclass(frozen=True, slots=True)
class NoiseLevels:
    """Variance components, relative to the covariance that the registration claims.

    Attributes:
        white: (attitude, position) factor on the independent part of the claimed variance.
        common: the same on the part that near views have in common.
        torque, force: root densities of the disturbances [rad/s^1.5, m/s^1.5].
        slack: by which disturbances enlarge the squared residuals of a fit without them, at least
            1.
        count: poses of the estimate, 0 for the prior.
        evidence: log likelihood of the random disturbance that the poses show most clearly, over
            none.
        excluded: root densities of torque and force from which on the poses exclude a random
            disturbance.
    """

    white: tuple[float, float] = (1.0, 1.0)
    common: tuple[float, float] = (1.0, 1.0)
    torque: float = 0.0
    force: float = 0.0
    slack: float = 1.0
    count: int = 0
    evidence: float = 0.0
    excluded: tuple[float, float] = (math.inf, math.inf)

    def factors(self, share: float) -> Array:
        """(2,) factors on the claimed standard deviations of poses with this claimed share of
        common errors.
        """
        return np.sqrt(
            [w * (1.0 - share) + c * share for w, c in zip(self.white, self.common, strict=True)]
        )

    @property
    def established(self) -> bool:
        """Return whether the poses show a random disturbance."""
        return self.evidence > _ESTABLISHED

    @property
    def certain(self) -> bool:
        """Return whether the poses show one that is reported."""
        return self.evidence > _REPORTED


NO_LEVELS = NoiseLevels()
"""The prior: noise as claimed, no disturbances."""


def pose_error_covariance(points: Poses, levels: NoiseLevels, factors: Array) -> Array:
    """(2, n, n) covariance of the whitened residuals of attitude and of position, each the same for
    its three axes.

    Args:
        points: poses, or normal points.
        levels: variance components.
        factors: (2,) noise factors with which the residuals are whitened.
    """
    white, common = error_parts(points)
    return np.array(
        [
            (levels.white[b] * white + levels.common[b] * common) / factors[b] ** 2
            for b in range(POSE_BLOCKS)
        ]
    )


def mean_share(points: Poses) -> float:
    """Mean claimed part of the variance of poses that near views have in common."""
    return 0.0 if points.shares is None else float(np.mean(points.shares))


def estimate_levels(
    points: Poses,
    problem: Problem,
    levels: NoiseLevels,
    claimed: bool,
    fixed: tuple[float | None, float | None],
    others: tuple[Array, Array] | None = None,
    positions: PositionRows | None = None,
) -> NoiseLevels:
    """Improve variance components by a bounded number of steps, from those of an estimate with
    fewer poses.

    Args:
        points: normal points, at most ``MOST_NORMAL_POINTS``.
        problem: their cost, linearised at the fit.
        levels: the last estimate.
        claimed: only the disturbances are estimated.
        fixed: root densities of torque and force that are given; None to estimate them.
        others: effects and size of other unknowns, as in ``disturbed_likelihood``.
        positions: of more poses, from which the density of the force is found; None for those of
            ``points``.
    """
    n, theta = len(points), _variances(levels)
    open_ = np.array([*([not claimed] * 4), *(f is None for f in fixed)])
    open_[2:4] &= points.shares is not None and bool(np.any(points.shares))
    theta[4:] = [
        old if given is None else given**2 for old, given in zip(theta[4:], fixed, strict=True)
    ]
    data, parts = _linearised(points, problem)
    data = data if others is None else _extended(data, *others)
    for _ in range(min(_MOST_STEPS, max(1, _WORK // n**3))):
        theta = _improved(theta, open_, parts, data, points)
    likely = theta.copy()
    found: dict[int, Marginal] = {}
    for k in (k for k in (4, 5) if open_[k]):
        if positions is not None and k == 5:
            found[k] = force_likelihood(likely, positions)
        else:
            found[k] = _of_impulses(k - 4, likely, parts, data)
    for k, each in found.items():
        beside = found[9 - k].evidence if 9 - k in found else 0.0
        theta[k] = mean_square(each, probability_beside(beside))
    white, common = (float(theta[0]), float(theta[1])), (float(theta[2]), float(theta[3]))
    slack = _slack(data.e, theta, parts) if theta[4] or theta[5] else 1.0
    return replace(
        levels,
        white=white,
        common=common,
        torque=math.sqrt(theta[4]),
        force=math.sqrt(theta[5]),
        slack=slack,
        evidence=max((each.evidence for each in found.values()), default=0.0),
        excluded=(
            found[4].excluded if 4 in found else 0.0,
            found[5].excluded if 5 in found else 0.0,
        ),
    )


def force_likelihood(theta: Array, rows: PositionRows) -> Marginal:
    """Return the likelihood of a random force from positions alone.

    Args:
        theta: (6,) variance components: factors on the independent part of the claimed variances of
            attitude and position, on their common part, and squared root densities, not used here.
        rows: the positions.
    """
    V = np.kron(np.eye(3), theta[1] * rows.white + theta[3] * rows.common)
    root = information_root(rows.info)
    return marginal(V, rows.force, Residuals(rows.e, rows.J, root, np.zeros(len(root))))


def _of_impulses(k: int, theta: Array, parts: _Components, data: Residuals) -> Marginal:
    """The likelihood of a random torque (k = 0) or force (1), given the density of the other."""
    other = parts.impulses(1 - k, theta)
    known = data.extended(other, np.zeros(other.shape[1])) if theta[5 - k] > 0.0 else data
    return marginal(parts.errors(theta), parts.effects[k], known)


def _slack(e: Array, theta: Array, parts: _Components) -> float:
    """Mean square of the residuals over that of the pose errors, with a margin for the largest."""
    n = len(e) // 6
    noise = np.concatenate([np.diagonal(block) for block in _pose_errors(theta, parts)])
    return 1.0 + _LARGEST * max(float(np.sum(e * e / noise)) / (6 * n) - 1.0, 0.0)


def disturbed_likelihood(
    points: Poses,
    problem: Problem,
    levels: NoiseLevels,
    kinds: Sequence[int],
    others: Sequence[tuple[Array, Array]] = (),
) -> float:
    """Log likelihood of the poses with random disturbances of the likeliest densities, or with
    other unknowns instead.

    The greatest likelihood and not its mean over all densities: these range over eight decades, and
    the mean would make random disturbances less likely by the logarithm of the number of
    candidates.

    Args:
        points: normal points, at most ``MOST_NORMAL_POINTS``.
        problem: their cost, linearised at the fit.
        levels: variance components; those of the errors of the poses and of the other disturbance
            are used.
        kinds: 0 for a random torque, 1 for a random force, or both.
        others: the other unknowns with each of several priors that are equally likely: (n, 6, m)
            effect on the whitened residuals of each at its prior 1 sigma, and (m,) size in the
            motion about which the residuals are, in 1 sigma.
    """
    data, parts = _linearised(points, problem)
    theta, likelihood = _variances(levels), -math.inf
    if others:
        V, nothing = parts.errors(theta), np.zeros((data.e.size, 0))
        for k in (0, 1):
            if k not in kinds and theta[4 + k] > 0.0:
                data = data.extended(beside := parts.impulses(k, theta), np.zeros(beside.shape[1]))
        return _log_mean(
            np.array([marginal(V, nothing, _extended(data, *each)).none for each in others])
        )
    for k in (*kinds, *kinds[:-1]):  # each given the other
        density, likelihood = _of_impulses(k, theta, parts, data).likeliest
        theta[4 + k] = density**2
    return likelihood


def _log_mean(values: Array) -> float:
    return float(np.logaddexp.reduce(values)) - math.log(len(values))


def _variances(levels: NoiseLevels) -> Array:
    return np.array([*levels.white, *levels.common, levels.torque**2, levels.force**2])


@value_class
class _Components:
    """The six components at unit factors.

    Attributes:
        C: covariances (3n, 3n) of the errors of attitude and position, first the independent ones,
            then the common ones.
        effects: (6n, 3(n - 1)) of impulses of torque and of force, of unit density.
    """

    C: tuple[Array, ...]
    effects: tuple[Array, Array]

    def errors(self, theta: Array) -> Array:
        """Covariance (6n, 6n) of the errors of the poses."""
        half = len(self.C[0])
        V = np.zeros((2 * half, 2 * half))
        V[:half, :half], V[half:, half:] = _pose_errors(theta, self)
        return V

    def impulses(self, k: int, theta: Array) -> Array:
        """Effects of impulses of torque (k = 0) or force (1) with the density of theta."""
        return self.effects[k] * math.sqrt(theta[4 + k])


def _linearised(points: Poses, problem: Problem) -> tuple[Residuals, _Components]:
    """Residuals about the chart of ``problem``, ordered by axis, attitude first, then pose, and the
    six components.
    """
    (e, H), T = problem.core.rows(), to_errors(problem.chart)
    white, common = (np.kron(np.eye(3), part) for part in error_parts(points))
    effects = _disturbances(points, problem.chart, H)
    torque, force, J = (
        np.ascontiguousarray(M.transpose(1, 0, 2)).reshape(e.size, -1) for M in (*effects, H @ T)
    )
    f, off = problem.factors**-2.0, problem.chart.minus(problem.prior.mean)
    C, root = (
        (white * f[0], white * f[1], common * f[0], common * f[1]),
        information_root(problem.prior.info),
    )
    data = Residuals(np.ascontiguousarray(e.T).reshape(-1), J, root, off)
    return data, _Components(C, (torque, force))


def _extended(data: Residuals, effects: Array, size: Array) -> Residuals:
    """The residuals with other unknowns, as in ``disturbed_likelihood``."""
    m = len(size)
    return data.extended(np.ascontiguousarray(effects.transpose(1, 0, 2)).reshape(-1, m), size)


def _pose_errors(theta: Array, parts: _Components) -> list[Array]:
    """Covariances (3n, 3n) of the errors of the poses, attitude and position."""
    return [theta[b] * parts.C[b] + theta[2 + b] * parts.C[2 + b] for b in range(POSE_BLOCKS)]


def _disturbances(points: Poses, chart: Chart, H: Array) -> tuple[Array, Array]:
    """Derivatives (n, 6, 3(n-1)) of whitened residuals by impulses of torque and force of unit
    density.

    The disturbance between two neighbouring poses acts as one impulse in the middle. An impulse
    equals the errors at the epoch from which free motion leads to it.
    """
    x, times, n = to_state(chart), points.times_s, len(points)
    middle, root = 0.5 * (times[1:] + times[:-1]), np.sqrt(np.diff(times))
    later = times[:, None] > middle
    back = impulses(x, middle) * np.sqrt(torque_density(x.sigma, 1.0))
    turn = (H[:, :, :6].reshape(-1, 6) @ back.transpose(1, 0, 2).reshape(6, -1)).reshape(
        n, 6, -1, 3
    )
    push = H[:, :, None, VEL] - middle[:, None] * H[:, :, None, RHO]
    weight = (later * root)[:, None, :, None]
    return (turn * weight).reshape(n, 6, -1), (push * weight).reshape(n, 6, -1)


def _improved(
    theta: Array, open_: NDArray[np.bool_], parts: _Components, data: Residuals, points: Poses
) -> Array:
    """Variance components (6,) after one step of average information from theta (6,).

    P is the inverse of the covariance of the residuals with all unknowns marginal. It follows from
    an orthogonal basis of the unknowns' effects and never from the covariance itself, which is
    singular to rounding where a disturbance acts for long.
    """
    everything = data
    for k in (0, 1):
        if theta[4 + k] > 0.0:
            impulses_k = parts.impulses(k, theta)
            everything = everything.extended(impulses_k, np.zeros(impulses_k.shape[1]))
    root = cholesky_root(parts.errors(theta))
    white = divided(root, np.hstack([everything.J, data.e[:, None]]))
    Q, _ = np.linalg.qr(np.vstack([white[:, :-1], everything.root]))
    known = np.concatenate([white[:, -1], everything.root @ everything.off])
    n, back = len(root), np.ascontiguousarray(divided(root, np.eye(len(root))).T)
    left = (known - Q @ (Q.T @ known))[:n]
    reduced = back @ Q[:n]
    P, Py = back @ back.T - reduced @ reduced.T, back @ left
    applied, traces, half = np.zeros((6, n)), np.zeros(6), len(parts.C[0])
    for k in np.flatnonzero(open_).tolist():
        if k < 4:
            here = slice(half * (k % 2), half * (k % 2) + half)
            applied[k, here] = parts.C[k] @ Py[here]
            traces[k] = float(np.sum(parts.C[k] * P[here, here]))
        else:
            effects = parts.effects[k - 4]
            applied[k] = effects @ (effects.T @ Py)
            traces[k] = float(np.sum(effects * (P @ effects)))
    score = 0.5 * (applied @ Py - traces)
    info = 0.5 * (applied @ P @ applied.T)
    for k, (dof, size) in enumerate(_priors(points)):
        if dof > 0.0:
            score[k] += 0.5 * dof * (size / theta[k] - 1.0) / theta[k]
            info[k, k] += 0.5 * dof / theta[k] ** 2
    return _stepped(theta, open_, score, info)


def _priors(points: Poses) -> list[tuple[float, float]]:
    """Degrees of freedom and mean of what is known of the first four components besides the normal
    points.
    """
    out, share = [], mean_share(points)
    for b in range(POSE_BLOCKS):
        dof, total = _CLAIMED_DOF, _CLAIMED_DOF
        if points.within is not None:
            dof, total = (
                dof + points.within[1],
                total + points.within[0][b] / max(1.0 - share, 1e-3),
            )
        out.append((dof, total / dof))
    return [*out, (_LAW_DOF, 1.0), (_LAW_DOF, 1.0)]


def _stepped(theta: Array, open_: NDArray[np.bool_], score: Array, info: Array) -> Array:
    """The components after a step, each changed by a bounded factor.

    A disturbance whose derivative is negative goes to zero once it is a small part of its own
    standard deviation.
    """
    disturbance = np.arange(6) >= 4
    free = open_ & ((theta > 0.0) | (score > 0.0)) & (np.diagonal(info) > 0.0)
    out = theta.copy()
    if not np.any(free):
        return out
    scale = np.sqrt(np.diagonal(info)[free])
    inverse = np.linalg.pinv(
        info[np.ix_(free, free)] / np.outer(scale, scale), rcond=1e-9, hermitian=True
    )
    factor = np.where(disturbance, _STEP**2, _STEP)[free]
    old, new = theta[free], theta[free] + inverse @ (score[free] / scale) / scale
    started = np.where(old > 0.0, np.clip(new, old / factor, old * factor), np.maximum(new, 0.0))
    started = np.where(disturbance[free], np.minimum(started, DENSITIES[-1] ** 2), started)
    small = disturbance[free] & (new <= 0.0) & (old * scale < _VANISHING_PART)
    out[free] = np.where(small, 0.0, started)
    out[:4] = np.clip(out[:4], 1.0 / _MOST_FACTOR, _MOST_FACTOR)
    return out
