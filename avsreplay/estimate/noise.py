"""The measurement noise R: registration covariance or R0, adapted from residuals, and its
correlation in time.

Adaptation (eq:R_resudua2) uses a ring buffer that is summed anew at each epoch, so that rounding
errors do not accumulate. There are two rules. ``matrix`` is the paper's: R = Sigma + H P+ H', Sigma
the mean of r r'. ``scale`` keeps the shape of the base R (the registration's own covariance, else
R0) and adapts one factor for position and one for attitude. Its square s^2 is the sum of r' R_b^-1
r over the sum of the degrees of freedom that the update leaves, 3 - tr(R_b^-1 H P+ H') / s^2 for a
block. There the derivative of the likelihood of the innovations vanishes. The level of the last fit
is its prior, with the weight of a few scans: under large disturbances the residuals hardly
determine R. Two numbers are estimated from a window instead of 21, so that the scatter of the
factors hardly affects the consistency. The sums use the weights of the updates, so that outliers do
not increase R.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from avsreplay.errors import value_class
from avsreplay.estimate import _motion
from avsreplay.estimate.common_errors import systematic_share
from avsreplay.estimate.measurement import registration_noise, residual
from avsreplay.estimate.params import Adaptation, EstimatorParams, NoiseSource, Start
from avsreplay.estimate.pose_noise import scaled_R
from avsreplay.geometry import Array, frozen
from avsreplay.records import Alignment, Belief, Innovation, State

BOUND = 52.4  # 99.99 % point of chi-square with 20 degrees of freedom, for a state
NO_INFLATION = frozen(np.ones(2))
_ONES = frozen(np.ones(6))
_BLOCKS = [3, 0]  # attitude and position of factors (6,) on R
# standard deviation of an attitude direction that a degenerate view does not determine
_FREE_RAD = 1.0
_MANY_OUTLIERS = 0.1  # outliers are many if they lose more than this share of the window's weight
_LEVEL_DOF = 10.0  # degrees of freedom with which the level of the last fit counts in the window
_MOST_COMMON_SHARE = 0.8  # largest share from errors of the model: the views of two scans differ
_LAGS = (5, 10, 20, 40)
# log likelihood ratio of the usual noise over the risen one from which the rise has ended
_CALM = 7.0
_EDGE_LEAN = 20.0  # from tests/benchmarks/estimate_noise.py, which gives 9 to 33 on five meshes
# largest number of scans with correlated errors, reached where the view does not turn
_MOST_ALIKE = 50.0


def integrated_autocorrelation(e: Array) -> float:
    """1 + 2 sum of the autocorrelations of rows e (n, 3), over the lags with the largest
    significant (3 sigma) sum; 1 for rows of zeros, as those of exact poses.
    """
    n, e = len(e), np.ascontiguousarray(e).reshape(-1)
    total = float(e @ e)
    lags = [k for k in _LAGS if k <= n // 8] if total > 0.0 else []
    rho = [
        float(e[3 * k :] @ e[: -3 * k]) / total * n / (n - k)
        for k in range(1, max(lags, default=0) + 1)
    ]
    sums = [(sum(rho[:k]), 3.0 * np.sqrt(k / (3.0 * n))) for k in lags]
    return 1.0 + 2.0 * max((found for found, bound in sums if found > bound), default=0.0)


@value_class
class NoiseEpoch:
    """One healthy epoch.

    Attributes:
        outer: r r' (6, 6).
        HPH: H P+ H' (6, 6).
        squares: r' R_b^-1 r of position and attitude.
        left: the degrees of freedom that the update leaves of them.
        weight: of the update.
    """

    outer: Array
    HPH: Array
    squares: tuple[float, float]
    left: tuple[float, float]
    weight: float


@value_class
class NoiseRise:
    """A rise of the noise of the poses that their covariance does not contain.

    Attributes:
        factor: (6,) on the standard deviation of a pose (position, half angle); 1 without a rise.
        calm: log likelihood ratio of the usual noise over the risen one in the last scans, 0 at
            least.
    """

    factor: Array
    calm: float = 0.0

    def on(self, R: Array) -> Array:
        """R (6, 6) with this rise."""
        return scaled_R(R, self.factor[_BLOCKS])

    def off(self, R: Array) -> Array:
        """R (6, 6) without this rise."""
        return scaled_R(R, 1.0 / self.factor[_BLOCKS])


NO_RISE = NoiseRise(_ONES)


@value_class
class NoiseWindow:
    """The last healthy epochs, oldest first, at most the window's length.

    Attributes:
        factors: (6,) standard deviations relative to the base R, position three times, attitude
            three times; 1 until the window is full.
        many_outliers: more than a tenth of the weight is lost: the poses contradict the estimate.
        level: (2,) variance of position and attitude relative to the base R by the last fit.
        rise: of the noise, which the base R contains.
    """

    epochs: tuple[NoiseEpoch, ...]
    factors: Array
    many_outliers: bool
    level: tuple[float, float] = (1.0, 1.0)
    rise: NoiseRise = NO_RISE

    @property
    def blocks(self) -> Array:
        """(2,) factors of attitude and position."""
        return self.factors[_BLOCKS]

    @classmethod
    def empty(cls, rise: NoiseRise = NO_RISE) -> NoiseWindow:
        """A window without epochs."""
        return cls((), frozen(np.ones(6)), False, rise=rise)


def push(
    window: NoiseWindow, residual: Array, HPH: Array, base: Array, length: int, weight: float = 1.0
) -> NoiseWindow:
    """The window with one more epoch: residual (6,) after the update, H P+ H' (6, 6), the
    base R that was used.
    """
    (a, b), known = _motion.block_squares(base, residual, HPH)
    factors = window.factors[::3].tolist()
    p, q = (
        max(3.0 - each / (factor * factor), 0.0)
        for each, factor in zip(known, factors, strict=True)
    )
    epoch = NoiseEpoch(residual[:, None] * residual, HPH, (a, b), (p, q), weight)
    return _summed((*window.epochs[-length + 1 :], epoch), length, window.level, window.rise)


def risen(window: NoiseWindow, factor: Array) -> NoiseWindow:
    """The window with noise that has risen by a factor (6,) on the standard deviations."""
    return replace(window, rise=NoiseRise(frozen(window.rise.factor * factor)))


def lasting(window: NoiseWindow, seen: Innovation) -> NoiseWindow:
    """The window after an accepted scan: without a rise if the last scans show the usual noise.

    The log likelihood ratio of the two noise levels is summed over the scans (cumulative sum; Page,
    Biometrika 41, 1954).

    Args:
        window: before the scan.
        seen: innovation of the scan, with the risen noise.
    """
    rise = window.rise
    if rise is NO_RISE:
        return window
    usual = seen.S - seen.R + rise.off(seen.R)
    chi2 = [float(seen.alpha @ np.linalg.solve(C, seen.alpha)) for C in (seen.S, usual)]
    logs = np.linalg.slogdet(np.stack([seen.S, usual]))[1]
    calm = max(0.0, rise.calm + 0.5 * float(chi2[0] - chi2[1] + logs[0] - logs[1]))
    return replace(window, rise=NO_RISE if calm > _CALM else NoiseRise(rise.factor, calm))


def _summed(
    epochs: tuple[NoiseEpoch, ...],
    length: int,
    level: tuple[float, float],
    rise: NoiseRise = NO_RISE,
) -> NoiseWindow:
    weight = sum([epoch.weight for epoch in epochs])
    many_outliers = weight < (1.0 - _MANY_OUTLIERS) * len(epochs)
    if len(epochs) < length:
        return NoiseWindow(epochs, _ONES, many_outliers, level, rise)
    factors = []
    for block in (0, 1):
        squares = (
            sum([epoch.weight * epoch.squares[block] for epoch in epochs])
            + _LEVEL_DOF * level[block]
        )
        left = sum([epoch.weight * epoch.left[block] for epoch in epochs]) + _LEVEL_DOF
        factors += [math.sqrt(squares / left)] * 3
    return NoiseWindow(epochs, np.array(factors), many_outliers, level, rise)


def matrix_noise(window: NoiseWindow, R0: Array, length: int) -> Array:
    """The paper's R: R0 until the window is full, then Sigma, the mean of r r' over it, plus
    the latest H P+ H'.
    """
    if len(window.epochs) < length:
        return R0
    weight = sum(epoch.weight for epoch in window.epochs)
    Sigma = np.asarray(sum(epoch.weight * epoch.outer for epoch in window.epochs) / weight)
    return Sigma + window.epochs[-1].HPH


def filled(base: Array, factors: Array, length: int) -> NoiseWindow:
    """A full window with the noise ``factors`` (2,) of attitude and position that a fit found on
    ``base`` (6, 6).
    """
    attitude, position = factors.tolist()
    level = position**2, attitude**2
    epoch = NoiseEpoch(
        scaled_R(base, factors), np.zeros((6, 6)), (3.0 * level[0], 3.0 * level[1]), (3.0, 3.0), 1.0
    )
    return _summed((epoch,) * length, length, level)


def floored(R: Array, R0: Array, fraction: float) -> Array:
    """R with its eigenvalues, in units of R0, raised to at least ``fraction``."""
    if _motion.definite(R - fraction * R0):
        return R
    values, axes = _eigen(R, R0)
    half = axes * np.sqrt(np.maximum(values, fraction))
    return np.asarray(half @ half.T)


def at_floor(R: Array, R0: Array, fraction: float) -> int:
    """How many eigenvalues of R, in units of R0, lie on the floor."""
    bound = fraction * (1.0 + 1e-6)
    return 0 if _motion.definite(R - bound * R0) else int(np.sum(_eigen(R, R0)[0] <= bound))


def _eigen(R: Array, R0: Array) -> tuple[Array, Array]:
    """Values (6,) and axes (6, 6) with R = axes diag(values) axes' and R0 = axes axes'."""
    root = np.linalg.cholesky(R0)
    inside = np.linalg.solve(root, np.linalg.solve(root, R).T)
    values, vectors = np.linalg.eigh(0.5 * (inside + inside.T))
    return values, root @ vectors


def correlated_noise(R: Sequence[Array], shares: Sequence[float]) -> Array:
    """Covariance (6n, 6n) of the errors of n neighbouring scans that have a share of their variance
    in common.

    The common part of scan k is sqrt(share_k) L_k z with one z for all scans and R_k = L_k L_k', so
    the covariance of scans i and j is sqrt(share_i share_j) L_i L_j'. The matrix is positive
    semidefinite for any R and shares up to 1.

    Args:
        R: (6, 6) noise of each scan.
        shares: common share of the variance of each scan, 0 to 1.
    """
    roots = np.sqrt(np.array(shares))[:, None, None] * np.linalg.cholesky(np.array(R))
    common = roots.reshape(-1, 6)
    out: Array = common @ common.T
    for k, one in enumerate(R):
        out[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = one
    return out


class Noise:
    """R (6, 6) [m, half-angle] of a measured pose.

    Args:
        params: settings, auto values filled in.
        extent_m: the target's bounding diagonal [m].
    """

    def __init__(self, params: EstimatorParams, extent_m: float) -> None:
        self.params = params
        self._R0 = params.R0
        self._extent_m = extent_m
        self._free = (_FREE_RAD, 0.5 * extent_m)

    def of(self, alignment: Alignment, x: State, window: NoiseWindow) -> Array:
        """The base R with the rise and the adaptation of the window, and with the floor applied."""
        R = window.rise.on(self._base(alignment, x))
        if self.params.adapt is Adaptation.MATRIX:
            R = matrix_noise(window, self._R0, self.params.window)
        elif self.params.adapt is Adaptation.SCALE:
            R = scaled_R(R, window.blocks)
        return floored(R, self._R0, self.params.r_floor)

    def base(self, R: Array, window: NoiseWindow) -> Array:
        """The base R of an R that ``of`` returned with this window."""
        s = window.factors if self.params.adapt is Adaptation.SCALE else _ONES
        return scaled_R(R, 1.0 / s[_BLOCKS])

    def rescaled(self, R: Array, before: NoiseWindow, after: NoiseWindow) -> Array:
        """An R that ``of`` returned with one window, as it is with the factors and the rise of
        another.
        """
        s = after.rise.factor / before.rise.factor
        if self.params.adapt is Adaptation.SCALE:
            s = s * (after.factors / before.factors)
        return scaled_R(R, s[_BLOCKS])

    def dof(self, alignment: Alignment) -> float:
        """Degrees of freedom of the base R as an estimate from the residuals of the scan, inf where
        it is none.
        """
        own = self.params.noise is NoiseSource.R0 or self.params.adapt is Adaptation.MATRIX
        return math.inf if own or alignment.covariance is None else alignment.dof

    def floors(self, R: Array) -> int:
        """How many eigenvalues of R lie on the floor."""
        return at_floor(R, self._R0, self.params.r_floor)

    def correlated_share(self, alignment: Alignment, counted: float = 0.0) -> float:
        """The share of R, from 0 to 1, that poses from nearly the same view have in common.

        The variance from independent errors of the points falls with the number of inliers; that
        from the bias of points near edges does not. Their ratio is K inliers (rms / extent)^2,
        whatever the target's size. K was fitted to simulated scans of five meshes. Errors of the
        model are common to near views as well.

        Args:
            alignment: of the scan.
            counted: how far its systematic errors count, from 0 to 1 (``ModelErrors.counted``).
        """
        if self.params.correlated_share is not None:
            return self.params.correlated_share
        lean = _EDGE_LEAN * alignment.inliers * (alignment.rms_m / self._extent_m) ** 2
        edges = lean / (1.0 + lean)
        return (
            max(edges, min(counted * systematic_share(alignment), _MOST_COMMON_SHARE))
            if counted
            else edges
        )

    def inflation(
        self, known: Array | None, mean: float, w_b: Array, dt_ns: int, correlated_share: float
    ) -> Array:
        """(2,) factor on R for errors correlated in time: that of the last fit, else from the
        rotation between scans.

        That of the fit holds for the ``mean`` share of its poses. Without it, neighbours have
        ``correlated_share`` of their variance in common over ``correlated_rad``: 1 + 2 sum of
        correlations. The paper's filter assumes white errors.
        """
        if known is not None:
            return 1.0 + (known - 1.0) * (correlated_share / mean if mean > 0.0 else 1.0)
        if self.params.start is Start.PAPER:
            return NO_INFLATION
        turn, alike = float(np.linalg.norm(w_b)) * dt_ns * 1e-9, self.params.correlated_rad
        scans = alike / max(turn, alike / _MOST_ALIKE)
        return np.full(2, 1.0 + 2.0 * correlated_share * scans)

    def updated(
        self,
        window: NoiseWindow,
        prior: State,
        H: Array,
        innovation: Innovation,
        posterior: Belief,
        inflation: Array,
    ) -> NoiseWindow:
        """The window with this epoch's a-posteriori residual z - h(x+), relative to the base R.

        H P+ H' is divided by the inflation: it is then what an update with white noise would leave.
        """
        left = residual(posterior.x, prior, innovation.alpha)
        HPH = _motion.pose_covariance(posterior.P, H) * (2.0 / float(inflation[0] + inflation[1]))
        return push(
            window,
            left,
            HPH,
            self.base(innovation.R, window),
            self.params.window,
            innovation.weight,
        )

    def _base(self, alignment: Alignment, x: State) -> Array:
        if self.params.noise is NoiseSource.R0 or self.params.adapt is Adaptation.MATRIX:
            return self._R0
        R = registration_noise(alignment, x, self._free)
        return self._R0 if R is None else R
