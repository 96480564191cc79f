"""Coordinates in which the batch fit is nearly linear, and the permutations of the principal axes.

Rate, arm and inertia are expressed in {C}, the inertia as a traceless symmetric matrix. The second
mass moments of a body about its centre, E = tr(I)/2 1 - I, are positive definite exactly where the
moments of inertia obey the triangle inequalities. Their logarithm M, traceless because scale has no
effect, is an arbitrary symmetric 3x3 matrix. Its five numbers replace (sigma, mu). They need no
bounds, do not depend on the order of the axes, and have no singularity where two moments are equal.
With the eigenvalues m of M, sigma1 = tanh((mz - my) / 2), sigma2 = tanh((mx - mz) / 2), sigma3 =
tanh((my - mx) / 2); the eigenvectors are the principal axes, A(mu)'.

Chart step y (20): half angle of eta in {C}, rate in {C}, position and velocity of the fixture in
{A}, M (5), arm (3) from the centre of mass to the fixture in {C}.

The order and the signs of the principal axes are arbitrary: (q, mu, sigma) are determined only up
to 24 axis permutations, proper rotations R_bn (columns: new axes in the old {B}). sigma follows the
permutation and changes its sign if the permutation is odd: s'_i = parity * s_perm(i). The truth is
therefore compared modulo these.

Displacement, difference, state, Jacobian and inertia of a chart are computed by the extension
(``kernel/chart.cpp``), which the fit uses as well, and so is NEES (``kernel/nees.cpp``).

``body_parameters`` gives inertia, mass centre and rate in {C}, which do not depend on order and
signs of the axes.
"""

from __future__ import annotations

import math
from itertools import permutations, product

import numpy as np

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.estimate import _motion
from avsreplay.estimate.dynamics import sigma3
from avsreplay.estimate.error_state import DMU, SIGMA, VARRHO
from avsreplay.geometry import Array
from avsreplay.outcome import BodyParameters
from avsreplay.records import BLOCKS, Belief, State

ETA, RATE, POSITION, VELOCITY = (slice(k, k + 3) for k in (0, 3, 6, 9))
INERTIA = slice(12, 17)
ARM = slice(17, 20)
ANY_HALF_RAD = 0.5 * float(
    np.sqrt(np.pi**2 / 3.0 + 2.0)
)  # rms half angle of a uniformly distributed attitude
# largest 1 sigma of the logarithm of the mass moments; above it the inertia is undetermined
_LARGEST_1S = 3.0
# least difference of two values of M, and largest move for its sake [sigma]
_LEAST_GAP = 0.02
_MOST_MOVED = 0.1


@value_class
class AxisPermutation:
    """One of the 24: R_bn (3, 3), its quaternion, new axis i is old axis perm[i] up to sign,
    parity of perm.
    """

    R_bn: Array
    q_bn: Array
    perm: tuple[int, int, int]
    parity: float


def _axis_permutations() -> tuple[AxisPermutation, ...]:
    found = []
    for perm in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            R = np.zeros((3, 3))
            R[perm, (0, 1, 2)] = signs
            if np.linalg.det(R) > 0.0:
                parity = float(np.sign(np.linalg.det(np.abs(R))))
                found.append(
                    AxisPermutation(R, geometry.quaternion(R), (perm[0], perm[1], perm[2]), parity)
                )
    return tuple(found)


def _basis() -> Array:
    """(5, 3, 3) orthonormal traceless symmetric matrices."""
    B = np.zeros((5, 3, 3))
    B[0], B[1] = np.diag([1.0, -1.0, 0.0]) / np.sqrt(2.0), np.diag([1.0, 1.0, -2.0]) / np.sqrt(6.0)
    for k, (i, j) in enumerate(((1, 2), (0, 2), (0, 1)), start=2):
        B[k, i, j] = B[k, j, i] = np.sqrt(0.5)
    return B


AXIS_PERMUTATIONS = _axis_permutations()
_BASIS = _basis()
_R_NB = np.array([p.R_bn.T for p in AXIS_PERMUTATIONS])
_Q_BN = np.array([p.q_bn for p in AXIS_PERMUTATIONS])


@value_class
class Chart:
    """A state in chart coordinates, as the extension's 34 numbers ``flat``."""

    flat: Array

    @classmethod
    def of(
        cls, q_ac: Array, w_c: Array, t_a: Array, u_a: Array, M: Array, arm_c: Array, R_cb: Array
    ) -> Chart:
        """The chart of its parts, which the properties describe."""
        return cls(np.concatenate((q_ac, w_c, t_a, u_a, M.reshape(-1), arm_c, R_cb.reshape(-1))))

    @property
    def q_ac(self) -> Array:
        """(4,) attitude of the fixture."""
        return self.flat[:4]

    @property
    def w_c(self) -> Array:
        """(3,) rate in {C} [rad/s]."""
        return self.flat[4:7]

    @property
    def t_a(self) -> Array:
        """(3,) position of the fixture in {A} [m]."""
        return self.flat[7:10]

    @property
    def u_a(self) -> Array:
        """(3,) velocity of the fixture in {A} [m/s]."""
        return self.flat[10:13]

    @property
    def M(self) -> Array:
        """(3, 3) logarithm of the second mass moments."""
        return self.flat[13:22].reshape(3, 3)

    @property
    def arm_c(self) -> Array:
        """(3,) vector from the centre of mass to the fixture in {C} [m]."""
        return self.flat[22:25]

    @property
    def R_cb(self) -> Array:
        """(3, 3) eigenvectors of M, in the order and with the signs that define the principal
        axes.
        """
        return self.flat[25:].reshape(3, 3)

    def moved(self, y: Array) -> Chart:
        """Displaced by a step y (20,); a half-angle vector longer than 1 is cut to a half turn.

        A logarithm M of the mass moments longer than 12 is cut to this length, so that |sigma|
        stays below 1. The columns of R_cb are the eigenvectors in the order and with the signs
        nearest to those before.
        """
        return Chart(_motion.moved(self.flat, np.ascontiguousarray(y, dtype=np.float64)))

    def minus(self, other: Chart) -> Array:
        """The step y (20,) with ``other.moved(y)`` equal to this."""
        return _motion.minus(self.flat, other.flat)


def to_chart(x: State) -> Chart:
    """Chart coordinates of a state; |sigma| must be below 1."""
    return Chart(_motion.chart(x.flat))


def to_state(c: Chart) -> State:
    """The state of chart coordinates, its principal axes being the columns of ``R_cb``."""
    return State.of(_motion.state(c.flat))


def to_errors(c: Chart) -> Array:
    """Jacobian T (20, 20): error states d = T y of ``to_state`` for a small chart step y."""
    return _motion.errors(c.flat)


def separated(c: Chart, P: Array) -> Chart:
    """The chart, moved by a small part of its standard deviation if two principal moments are too
    nearly equal.

    The error of the principal axes is an error of M over the difference of two of its eigenvalues.
    Without a bound, the covariances of the error states of attitude and mu grow beyond the
    precision in which their sum, the error of a pose, can be computed. The move is the most likely
    one that separates the eigenvalues.

    Args:
        c: mean.
        P: (20, 20) covariance of the chart.
    """
    S = P[INERTIA, INERTIA]
    if _motion.least_gap(c.flat) >= _LEAST_GAP * math.sqrt(S.trace()):
        return c
    values = np.diagonal(c.R_cb.T @ c.M @ c.R_cb)
    order = np.argsort(values, kind="stable")
    gaps = np.diff(values[order])
    axes = c.R_cb[:, order].T
    first, second = axes[:-1], axes[1:]
    across = np.sqrt(2.0) * np.einsum("nij,ki,kj->kn", _BASIS, first, second)
    missing = np.maximum(
        _LEAST_GAP * np.sqrt(np.einsum("kn,nm,km->k", across, S, across)) - gaps, 0.0
    )
    if not missing.any():
        return c
    along = np.einsum("nij,ki,kj->kn", _BASIS, second, second) - np.einsum(
        "nij,ki,kj->kn", _BASIS, first, first
    )
    weights = np.linalg.solve(along @ S @ along.T, missing)
    part = min(1.0, _MOST_MOVED / float(np.sqrt(missing @ weights)))
    return c.moved(part * (P[:, INERTIA] @ (along.T @ weights)))


def permute_axes(x: State, permutation: AxisPermutation) -> State:
    """The same motion, described in permuted principal axes."""
    R_nb = permutation.R_bn.T
    triple = (float(x.sigma[0]), float(x.sigma[1]), sigma3(x.sigma))
    sigma = permutation.parity * np.array(
        [triple[permutation.perm[0]], triple[permutation.perm[1]]]
    )
    q_an = geometry.multiply(x.q_ab, permutation.q_bn)
    q_nc = geometry.multiply(geometry.conjugate(permutation.q_bn), x.q_bc)
    return State(q_an, R_nb @ x.w_b, x.r_a, x.v_a, sigma, R_nb @ x.c_b, q_nc)


def nearest_permutation(estimate: Belief, truth: State) -> tuple[State, float]:
    """``truth`` in the axis permutation nearest to the estimate by its covariance, and the NEES e'
    P^-1 e there.

    Where the covariance is singular, the permutation is the nearest by the variances, and the NEES
    is their sum.
    """
    found = _compared(estimate, truth)
    return permute_axes(truth, AXIS_PERMUTATIONS[found.best]), found.size


def nees(belief: Belief, truth: State) -> float:
    """Normalised estimation error squared over the 20 states, in the chart: independent of the axis
    permutation.

    Where two moments are nearly equal, sigma and mu are not valid coordinates; in the chart they
    are one smooth matrix, and what cannot be observed is only a direction with a large variance.
    NaN where the covariance is singular.
    """
    return _compared(belief, truth).chart


def nees_by_block(belief: Belief, truth: State) -> tuple[float, dict[str, float]]:
    """``nees``, and that of each block of error states.

    The error states are the differences in the chart, transformed by its Jacobian as the covariance
    is. Differences of the states themselves are not linear where the principal axes are uncertain
    by more than some degrees.

    Args:
        belief: the estimate and its covariance.
        truth: true state at the same instant.
    """
    found = _compared(belief, truth)
    return found.chart, dict(zip(BLOCKS, found.block, strict=True))


def _compared(belief: Belief, truth: State) -> _motion.Errors:
    """Number of the nearest permutation ``best``, NEES of the error states in it ``size``, NEES in
    the ``chart``, and that of each ``block``.
    """
    return _motion.nees(belief.x.flat, truth.flat, belief.P, _R_NB, _Q_BN)


def body_parameters(belief: Belief) -> BodyParameters:
    """Inertia, mass centre and rate in {C} with their 1 sigma.

    The inertia is a nonlinear function of the chart's five numbers, so its standard deviations come
    from sigma points (unscented transform). The tensor is divided by its trace, so that they stay
    in the physical range.
    """
    chart = to_chart(belief.x)
    found = _motion.body(chart.flat, belief.P, _LARGEST_1S)
    arm_variance, rate_variance = found[24:].tolist()
    return BodyParameters(
        inertia=found[:9].reshape(3, 3),
        inertia_1s=found[9:18].reshape(3, 3),
        moments=found[18:21],
        moments_1s=found[21:24],
        centre_c=-chart.arm_c,
        centre_1s_m=math.sqrt(arm_variance),
        rate_c=chart.w_c,
        rate_1s_radps=math.sqrt(rate_variance),
        limited_1s=_limited_1s(belief, arm_variance),
    )


def _limited_1s(belief: Belief, arm_variance: float) -> tuple[float, float, float, float]:
    """1 sigma of sigma1, sigma2, varrho and mu, at most that of a parameter about which nothing is
    known.

    Without information sigma is uniform in (-1, 1), mu is uniform over all attitudes, and varrho
    has any direction. The linear covariance has no such limit where two moments are nearly equal
    and the axes are undetermined.
    """
    x, variance = belief.x, np.maximum(np.diagonal(belief.P), 0.0)
    sigma = np.sqrt(np.minimum(variance[SIGMA], 1.0 / 3.0 + x.sigma**2))
    varrho = min(float(variance[VARRHO].sum()), arm_variance + 2.0 * float(x.c_b @ x.c_b))
    return (
        float(sigma[0]),
        float(sigma[1]),
        float(np.sqrt(varrho)),
        min(float(np.sqrt(variance[DMU].sum())), ANY_HALF_RAD),
    )
