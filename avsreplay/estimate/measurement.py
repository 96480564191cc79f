"""The measurement model (eq:innovation): z = (rho, deta_v) of a registered pose, its Jacobian H, its noise R.

deta = mu_hat^-1 (x) eta (x) q_hat^-1, in Hamilton's product q_hat^-1 * eta * mu_hat^-1, of the sign with w >= 0. The
errors are zero after each update, so the attitude part of h is zero and H is taken there.
"""

from __future__ import annotations

import math

import numpy as np

from avsreplay.estimate.error_state import DIM, DMU, DQ, RHO, Quad, conjugate_quad, hamilton, rotation
from avsreplay.geometry import Array, Pose
from avsreplay.records import Alignment, State

Triple = tuple[float, float, float]


def _constant() -> Array:
    """The part of H (6, 20) that does not depend on the state."""
    H = np.zeros((6, DIM))
    H[:3, RHO] = H[3:, DQ] = H[3:, DMU] = np.eye(3)
    return H


_CONSTANT = _constant()


def measurement_jacobian(x: State) -> Array:
    """H (6, 20) at zero error: [-2A(q)[c x] 0 I 0 0 A(q) 0; I 0 0 0 0 0 I]."""
    A = rotation(x.q_ab)
    cx, cy, cz = x.c_b.tolist()
    H = _CONSTANT.copy()
    H[:3, :3] = A @ np.array([[0.0, 2 * cz, -2 * cy], [-2 * cz, 0.0, 2 * cx], [2 * cy, -2 * cx, 0.0]])
    H[:3, 14:17] = A
    return H


def innovation_vector(x: State, T_ac: Pose) -> Array:
    """The innovation alpha (6,) = z - h at zero error: [m in {A}, half-angle vector in {B}]."""
    q = hamilton(hamilton(conjugate_quad(x.q_ab), T_ac.q.tolist()), conjugate_quad(x.q_bc))
    return _difference(T_ac.t.tolist(), _fixture(x), q)


def residual(posterior: State, prior: State, alpha: Array) -> Array:
    """Z - h(x+) (6,) of the pose whose innovation at the prior is ``alpha``."""
    position, deta = _measured(prior, alpha)
    left = hamilton(conjugate_quad(posterior.q_ab), prior.q_ab.tolist())
    right = hamilton(prior.q_bc.tolist(), conjugate_quad(posterior.q_bc))
    return _difference(position, _fixture(posterior), hamilton(hamilton(left, deta), right))


def measured_pose(x: State, alpha: Array) -> Pose:
    """The pose T_ac whose innovation at x is ``alpha``: the inverse of ``innovation_vector``."""
    position, deta = _measured(x, alpha)
    return Pose(np.array(hamilton(hamilton(x.q_ab.tolist(), deta), x.q_bc.tolist())), np.array(position))


def registration_noise(alignment: Alignment, x: State, free: tuple[float, float]) -> Array | None:
    """R (6, 6) [m, half-angle] from the registration's covariance of d = [theta; v] in {C}; None if it gives none.

    Attitude is A(mu) theta / 2 in {B}, position R_ac v in {A}: both of one sign, so the cross terms stay. For a
    degenerate view the covariance is computed from ``info``, with the standard deviations ``free`` (rad, m) along the
    unobservable directions, so that the observable directions of the scan are still used.
    """
    if alignment.covariance is not None:
        C = alignment.covariance
    elif np.any(alignment.info):
        C = _inverse(alignment.info + np.diag(np.repeat(np.asarray(free) ** -2.0, 3)))
    else:
        return None
    return in_camera(C, alignment.T_ac.q, x.q_bc)


def _inverse(info: Array) -> Array:
    """The inverse; if ``info`` is numerically singular, eigenvalues are raised to 1e-15 of the largest."""
    try:
        return np.asarray(np.linalg.inv(info))
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(info)
        return np.asarray((vectors / np.maximum(values, 1e-15 * values[-1])) @ vectors.T)


def in_camera(C: Array, q_ac: Array, q_bc: Array) -> Array:
    """R (6, 6) in metres in {A} and half angles in {B} from C (6, 6) of d = [theta; v] in {C}."""
    J = to_camera(q_ac, q_bc)
    R: Array = J @ C @ J.T
    return 0.5 * (R + R.T)


def in_fixture(R: Array, q_ac: Array, q_bc: Array) -> Array:
    """The inverse of ``in_camera``."""
    J = to_fixture(q_ac, q_bc)
    C: Array = J @ R @ J.T
    return 0.5 * (C + C.T)


def to_camera(q_ac: Array, q_bc: Array) -> Array:
    """J (6, 6) from d = [theta; v] in {C} to metres in {A} and half angles in {B}."""
    J = np.zeros((6, 6))
    J[:3, 3:], J[3:, :3] = rotation(q_ac), 0.5 * rotation(q_bc)
    return J


def to_fixture(q_ac: Array, q_bc: Array) -> Array:
    """The inverse of ``to_camera``."""
    J = np.zeros((6, 6))
    J[:3, 3:], J[3:, :3] = 2.0 * rotation(q_bc).T, rotation(q_ac).T
    return J


def _measured(x: State, alpha: Array) -> tuple[Triple, Quad]:
    """Position and deta of the pose whose innovation at x is ``alpha``."""
    (x0, y0, z0), (dx, dy, dz, vx, vy, vz) = _fixture(x), alpha.tolist()
    w = math.sqrt(max(0.0, 1.0 - vx * vx - vy * vy - vz * vz))
    return (x0 + dx, y0 + dy, z0 + dz), (vx, vy, vz, w)


def _fixture(x: State) -> Triple:
    """Position of the fixture in {A}, r + A(q) c, in scalars: c + w t + v x t with t = 2 v x c."""
    (qx, qy, qz, qw), (cx, cy, cz), (rx, ry, rz) = x.q_ab.tolist(), x.c_b.tolist(), x.r_a.tolist()
    tx, ty, tz = 2.0 * (qy * cz - qz * cy), 2.0 * (qz * cx - qx * cz), 2.0 * (qx * cy - qy * cx)
    return (
        rx + (cx + qw * tx + qy * tz - qz * ty),
        ry + (cy + qw * ty + qz * tx - qx * tz),
        rz + (cz + qw * tz + qx * ty - qy * tx),
    )


def _difference(position: Triple, other: Triple, q: Quad) -> Array:
    """(6,) difference of two positions, and the vector part of q, of the sign with w >= 0."""
    s = 1.0 if q[3] >= 0.0 else -1.0
    dx, dy, dz = position[0] - other[0], position[1] - other[1], position[2] - other[2]
    return np.array((dx, dy, dz, s * q[0], s * q[1], s * q[2]))
