"""Coordinates in which the batch fit is nearly linear, and the permutations of the principal axes.

Rate, arm and inertia are expressed in {C}, the inertia as a traceless symmetric matrix. The second mass moments of a
body about its centre, E = tr(I)/2 1 - I, are positive definite exactly where the moments of inertia obey the triangle
inequalities. Their logarithm M, traceless because scale has no effect, is an arbitrary symmetric 3x3 matrix: five
numbers for (sigma, mu) that need no bounds, do not depend on the order of the axes, and have no singularity where two
moments are equal. With the eigenvalues m of M, sigma1 = tanh((mz - my) / 2), sigma2 = tanh((mx - mz) / 2), sigma3 =
tanh((my - mx) / 2); the eigenvectors are the principal axes, A(mu)'.

Chart step y (20): half angle of eta in {C}, rate in {C}, position and velocity of the fixture in {A}, M (5), arm (3)
from the centre of mass to the fixture in {C}.

The order and the signs of the principal axes are arbitrary: (q, mu, sigma) are determined only up to 24 axis
permutations, proper rotations R_bn (columns: new axes in the old {B}). sigma follows the permutation and changes its
sign if the permutation is odd: s'_i = parity * s_perm(i). The truth is therefore compared modulo these.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from avsreplay import geometry
from avsreplay.estimate.dynamics import sigma3, sigma_join
from avsreplay.estimate.error_state import DIM, DMU, DQ, RHO, SIGMA, VARRHO, VEL, W
from avsreplay.geometry import Array
from avsreplay.records import Belief, State

ETA, RATE, POSITION, VELOCITY = (slice(k, k + 3) for k in (0, 3, 6, 9))
INERTIA, ARM = slice(12, 17), slice(17, 20)
LEAST_GAP = 1e-4  # smallest difference of two eigenvalues of M: the axes of equal moments have no direction


@dataclass(frozen=True, slots=True, eq=False)
class AxisPermutation:
    """One of the 24: R_bn (3, 3), its quaternion, new axis i is old axis perm[i] up to sign, parity of perm."""

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
                found.append(AxisPermutation(R, geometry.quaternion(R), (perm[0], perm[1], perm[2]), parity))
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
_R_BN = np.array([p.R_bn for p in AXIS_PERMUTATIONS])
_R_NB = np.array([p.R_bn.T for p in AXIS_PERMUTATIONS])
_Q_BN = np.array([p.q_bn for p in AXIS_PERMUTATIONS])
_Q_NB = geometry.conjugate(_Q_BN)
_PARITY = np.array([[p.parity] for p in AXIS_PERMUTATIONS])
_PERMS = np.array([p.perm[:2] for p in AXIS_PERMUTATIONS])


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """A state in chart coordinates.

    Attributes:
        q_ac: (4,) attitude of the fixture.  w_c: (3,) rate in {C} [rad/s].  t_a, u_a: (3,) its position and velocity.
        M: (3, 3) logarithm of the second mass moments.  arm_c: (3,) from the centre of mass to the fixture [m].
        R_cb: (3, 3) eigenvectors of M, in the order and with the signs that define the principal axes.
    """

    q_ac: Array
    w_c: Array
    t_a: Array
    u_a: Array
    M: Array
    arm_c: Array
    R_cb: Array

    def moved(self, y: Array) -> Chart:
        """Displaced by a step y (20,); a half-angle vector longer than 1 is cut to a half turn."""
        M = self.M + np.tensordot(y[INERTIA], _BASIS, 1)
        return Chart(
            geometry.multiply(self.q_ac, _half_angle(y[ETA])),
            self.w_c + y[RATE],
            self.t_a + y[POSITION],
            self.u_a + y[VELOCITY],
            M,
            self.arm_c + y[ARM],
            _axes(M, self.R_cb),
        )

    def minus(self, other: Chart) -> Array:
        """The step y (20,) with ``other.moved(y)`` equal to this."""
        y = np.empty(DIM)
        y[ETA] = geometry.normalise(geometry.multiply(geometry.conjugate(other.q_ac), self.q_ac))[:3]
        y[RATE], y[POSITION], y[VELOCITY] = self.w_c - other.w_c, self.t_a - other.t_a, self.u_a - other.u_a
        y[INERTIA] = np.tensordot(_BASIS, self.M - other.M, 2)
        y[ARM] = self.arm_c - other.arm_c
        return y


def _half_angle(v: Array) -> Array:
    n2 = float(v @ v)
    return np.append(v, np.sqrt(1.0 - n2)) if n2 < 1.0 else np.append(v / np.sqrt(n2), 0.0)


def _axes(M: Array, near: Array) -> Array:
    """R_cb: right-handed eigenvectors of M in the order and with the signs nearest to ``near``."""
    V = np.linalg.eigh(M)[1]
    V = V if np.linalg.det(V) > 0.0 else -V
    out: Array = V @ _R_BN[int(np.argmax(np.tensordot(_R_BN, V.T @ near, 2)))]
    return out


def inertia_matrices(y: Array) -> Array:
    """Traceless symmetric matrices (n, 3, 3) of the chart's inertia steps (n, 5)."""
    return np.asarray(np.tensordot(y, _BASIS, 1))


def to_chart(x: State) -> Chart:
    """Chart coordinates of a state; |sigma| must be below 1."""
    R_bc = geometry.matrix(x.q_bc)
    a1, a2 = np.arctanh(x.sigma)
    m = np.array([a1 + 2.0 * a2, -2.0 * a1 - a2, a1 - a2]) * (2.0 / 3.0)
    M = R_bc.T @ np.diag(m) @ R_bc
    q_ac = geometry.multiply(x.q_ab, x.q_bc)
    return Chart(q_ac, R_bc.T @ x.w_b, x.T_ac.t, x.fixture_velocity, 0.5 * (M + M.T), R_bc.T @ x.c_b, R_bc.T)


def _eigenvalues(c: Chart) -> Array:
    m: Array = (c.R_cb.T @ c.M @ c.R_cb).diagonal().copy()
    low, middle, high = np.argsort(m, kind="stable")
    m[middle] = max(m[middle], m[low] + LEAST_GAP)
    m[high] = max(m[high], m[middle] + LEAST_GAP)
    return m


def to_state(c: Chart) -> State:
    """The state of chart coordinates, its principal axes being the columns of ``R_cb``."""
    m = _eigenvalues(c)
    sigma = np.tanh(0.5 * np.array([m[2] - m[1], m[0] - m[2]]))
    q_bc = geometry.quaternion(c.R_cb.T)
    q_ab = geometry.multiply(c.q_ac, geometry.conjugate(q_bc))
    R_ac = geometry.matrix(c.q_ac)
    r_a, v_a = c.t_a - R_ac @ c.arm_c, c.u_a - R_ac @ (geometry.skew(c.w_c) @ c.arm_c)
    return State(q_ab, c.R_cb.T @ c.w_c, r_a, v_a, sigma, c.R_cb.T @ c.arm_c, q_bc)


def to_errors(c: Chart) -> Array:
    """Jacobian T (20, 20): error states d = T y of ``to_state`` for a small chart step y."""
    A, m = c.R_cb.T, _eigenvalues(c)
    D = A @ _BASIS @ A.T  # the basis in {B}
    dmu = np.zeros((3, 5))
    for axis, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        dmu[axis] = 0.5 * D[:, i, j] / (m[j] - m[i])
    sigma = np.tanh(0.5 * np.array([m[2] - m[1], m[0] - m[2]]))
    T = np.zeros((DIM, DIM))
    T[0:3, ETA], T[0:3, INERTIA] = A, -dmu
    T[3:6, RATE], T[3:6, INERTIA] = A, -2.0 * geometry.skew(A @ c.w_c) @ dmu
    R_ac, arm, turning = geometry.matrix(c.q_ac), geometry.skew(c.arm_c), geometry.skew(c.w_c)
    twist = geometry.skew(turning @ c.arm_c)
    T[6:9, POSITION] = T[9:12, VELOCITY] = np.eye(3)
    T[6:9, ETA], T[6:9, ARM] = 2.0 * R_ac @ arm, -R_ac
    T[9:12, ETA], T[9:12, RATE], T[9:12, ARM] = 2.0 * R_ac @ twist, R_ac @ arm, -R_ac @ turning
    T[12, INERTIA] = 0.5 * (1.0 - sigma[0] ** 2) * (D[:, 2, 2] - D[:, 1, 1])
    T[13, INERTIA] = 0.5 * (1.0 - sigma[1] ** 2) * (D[:, 0, 0] - D[:, 2, 2])
    T[14:17, ARM], T[14:17, INERTIA] = A, -2.0 * geometry.skew(A @ c.arm_c) @ dmu
    T[17:20, INERTIA] = dmu
    return T


def permute_axes(x: State, permutation: AxisPermutation) -> State:
    """The same motion, described in permuted principal axes."""
    R_nb = permutation.R_bn.T
    triple = (float(x.sigma[0]), float(x.sigma[1]), sigma3(x.sigma))
    sigma = permutation.parity * np.array([triple[permutation.perm[0]], triple[permutation.perm[1]]])
    q_an = geometry.multiply(x.q_ab, permutation.q_bn)
    q_nc = geometry.multiply(geometry.conjugate(permutation.q_bn), x.q_bc)
    return State(q_an, R_nb @ x.w_b, x.r_a, x.v_a, sigma, R_nb @ x.c_b, q_nc)


def permute_covariance(P: Array, x: State, permutation: AxisPermutation) -> Array:
    """P (20, 20) about ``x``, as a covariance about ``permute_axes(x, permutation)``."""
    J = np.eye(DIM)
    for block in (DQ, W, VARRHO, DMU):
        J[block, block] = permutation.R_bn.T
    J[SIGMA, SIGMA] = permutation.parity * sigma_join(x.sigma)[list(permutation.perm[:2])]
    out: Array = J @ P @ J.T
    return out


def nearest_permutation(estimate: Belief, truth: State) -> tuple[State, float]:
    """``truth`` in the axis permutation nearest to the estimate by its covariance, and the NEES e' P^-1 e there."""
    errors = _errors(truth, estimate.x)
    sizes = np.einsum("ni,in->n", errors, np.linalg.solve(estimate.P, errors.T))
    best = int(np.argmin(sizes))
    return permute_axes(truth, AXIS_PERMUTATIONS[best]), float(sizes[best])


def _errors(truth: State, x: State) -> Array:
    """(24, 20) ``boxminus(permute_axes(truth, p), x)`` of every permutation p, at once."""
    triple = np.array([truth.sigma[0], truth.sigma[1], sigma3(truth.sigma)])
    d = np.empty((len(AXIS_PERMUTATIONS), DIM))
    d[:, DQ] = _vector_parts(geometry.multiply(geometry.multiply(geometry.conjugate(x.q_ab), truth.q_ab), _Q_BN))
    d[:, DMU] = _vector_parts(geometry.multiply(_Q_NB, geometry.multiply(truth.q_bc, geometry.conjugate(x.q_bc))))
    d[:, W], d[:, VARRHO] = _R_NB @ truth.w_b - x.w_b, _R_NB @ truth.c_b - x.c_b
    d[:, RHO], d[:, VEL] = truth.r_a - x.r_a, truth.v_a - x.v_a
    d[:, SIGMA] = _PARITY * triple[_PERMS] - x.sigma
    return d


def _vector_parts(q: Array) -> Array:
    """Vector part (n, 3), of the sign with w >= 0."""
    return np.where(q[:, 3:] >= 0.0, q[:, :3], -q[:, :3])


def nees(belief: Belief, truth: State) -> float:
    """Normalised estimation error squared over the 20 states, in the chart: independent of the axis permutation.

    Where two moments are nearly equal, sigma and mu are not valid coordinates; in the chart they are one smooth
    matrix, and what cannot be observed is only a direction with a large variance.
    """
    here = to_chart(belief.x)
    d = to_errors(here) @ to_chart(truth).minus(here)  # in error states, as P is
    return float(d @ np.linalg.solve(belief.P, d))
