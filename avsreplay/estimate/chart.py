"""Coordinates in which the fit is nearly linear: everything in {C}, and inertia as a traceless symmetric matrix.

The mass moments of a body about its centre, E = tr(I)/2 1 - I, are positive definite exactly where the moments obey the
triangle inequalities. Its logarithm M, traceless as scale does not matter, is any symmetric 3x3 matrix: five numbers
for (sigma, mu) that need no bounds, no naming of axes, and have no singular point where two moments are equal.
With the eigenvalues m of M, sigma1 = tanh((mz - my) / 2), sigma2 = tanh((mx - mz) / 2), sigma3 = tanh((my - mx) / 2);
the eigenvectors are the principal axes, A(mu)'.

Chart step y (20): half angle of eta in {C}, rate in {C}, position and velocity of the fixture in {A}, M (5), arm (3)
from the centre of mass to the fixture in {C}. Pose and twist are what is measured; the arm and M are what is inferred.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avsreplay import geometry
from avsreplay.estimate.layout import DIM
from avsreplay.estimate.naming import NAMINGS
from avsreplay.geometry import Array
from avsreplay.records import State

__all__ = ["RATE", "Chart", "to_chart", "to_errors", "to_state"]

ETA, RATE, POSITION, VELOCITY = (slice(k, k + 3) for k in (0, 3, 6, 9))
INERTIA, ARM = slice(12, 17), slice(17, 20)
LEAST_GAP = 1e-4  # of two eigenvalues of M: axes of equal moments have no direction, so a hair is put between them


def _basis() -> Array:
    """(5, 3, 3) orthonormal traceless symmetric matrices."""
    B = np.zeros((5, 3, 3))
    B[0], B[1] = np.diag([1.0, -1.0, 0.0]) / np.sqrt(2.0), np.diag([1.0, 1.0, -2.0]) / np.sqrt(6.0)
    for k, (i, j) in enumerate(((1, 2), (0, 2), (0, 1)), start=2):
        B[k, i, j] = B[k, j, i] = np.sqrt(0.5)
    return B


_BASIS = _basis()
_NAMED = np.array([naming.R_bn for naming in NAMINGS])


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """A state in chart coordinates.

    Attributes:
        q_ac: (4,) attitude of the fixture.  w_c: (3,) rate in {C} [rad/s].  t_a, u_a: (3,) its position and velocity.
        M: (3, 3) logarithm of the mass moments.  arm_c: (3,) from the centre of mass to the fixture [m].
        R_cb: (3, 3) eigenvectors of M, in the order and with the signs that name the principal axes.
    """

    q_ac: Array
    w_c: Array
    t_a: Array
    u_a: Array
    M: Array
    arm_c: Array
    R_cb: Array

    def moved(self, y: Array) -> Chart:
        """Displaced by a step y (20,); a half-angle vector over 1 is cut to a half turn."""
        turn = _half_angle(y[ETA])
        M = self.M + np.tensordot(y[INERTIA], _BASIS, 1)
        return Chart(
            geometry.multiply(self.q_ac, turn),
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
    """R_cb: eigenvectors of M in the order and with the signs nearest to ``near``, right-handed."""
    V = np.linalg.eigh(M)[1]
    V = V if np.linalg.det(V) > 0.0 else -V
    out: Array = V @ _NAMED[int(np.argmax(np.tensordot(_NAMED, V.T @ near, 2)))]
    return out


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
    """The state of chart coordinates, its axes named as ``R_cb`` says."""
    m = _eigenvalues(c)
    sigma = np.tanh(0.5 * np.array([m[2] - m[1], m[0] - m[2]]))
    q_bc = geometry.quaternion(c.R_cb.T)
    q_ab = geometry.multiply(c.q_ac, geometry.conjugate(q_bc))
    R_ac = geometry.matrix(c.q_ac)
    r_a, v_a = c.t_a - R_ac @ c.arm_c, c.u_a - R_ac @ (geometry.skew(c.w_c) @ c.arm_c)
    return State(q_ab, c.R_cb.T @ c.w_c, r_a, v_a, sigma, c.R_cb.T @ c.arm_c, q_bc)


def to_errors(c: Chart) -> Array:
    """T (20, 20): error states d = T y of ``to_state`` for a small chart step y."""
    A, m = c.R_cb.T, _eigenvalues(c)
    D = A @ _BASIS @ A.T  # basis seen in {B}
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
