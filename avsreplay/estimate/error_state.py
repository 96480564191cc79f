"""The 20 error states (eq:x): their order, and the operations x (+) d and x (-) y on the state.

dq_v and dmu_v are HALF-angle vectors in {B}: q = dq (x) q_hat is ``q_hat * dq`` and mu = mu_hat (x)
dmu is ``dmu * mu_hat`` in Hamilton's product. All other states are additive.
"""

from __future__ import annotations

import math

import numpy as np

from avsreplay.estimate import _motion
from avsreplay.geometry import Array
from avsreplay.records import BLOCKS, STATES, State

DIM = STATES
# error states that a disturbance reaches: attitude to velocity; they depend on chart steps of these
# alone
REACHED = 12
DQ, W, RHO, VEL, SIGMA, VARRHO, DMU = (BLOCKS[name] for name in BLOCKS)

# least eigenvalue of a covariance, in units of its variances, that rounding may make negative
ROUNDING = 1e-9
# least eigenvalue of a product of a root with itself, in the same units
_LEAST_ROOT_EIGENVALUE = 1e-9
_SMALLEST = 1e-300 * np.eye(DIM)
# largest correction in chart steps, of which none has a larger unit than a metre or a radian
LARGEST_MOVE = 1e3

Quad = tuple[float, float, float, float]


def hamilton(a: Array | Quad, b: Array | Quad) -> Quad:
    """Hamilton's product of two quaternions [x y z w], in scalars: faster than
    geometry.multiply for a single pair.
    """
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + bw * ax + ay * bz - az * by,
        aw * by + bw * ay + az * bx - ax * bz,
        aw * bz + bw * az + ax * by - ay * bx,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def rotation(q: Array) -> Array:
    """R (3, 3) of a unit quaternion (4,): faster than geometry.matrix for a single quaternion."""
    x, y, z, w = q.tolist()
    return np.array(
        (
            (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)),
            (2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)),
            (2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)),
        )
    )


def conjugate_quad(q: Array) -> Quad:
    """The inverse of a unit quaternion (4,), in scalars."""
    x, y, z, w = q.tolist()
    return -x, -y, -z, w


def _half_angle(v: Array) -> Quad:
    """The unit quaternion with vector part v (3,); a vector longer than 1 is cut to a half turn."""
    x, y, z = v.tolist()
    n2 = x * x + y * y + z * z
    if n2 < 1.0:
        return x, y, z, math.sqrt(1.0 - n2)
    n = math.sqrt(n2)
    return x / n, y / n, z / n, 0.0


def boxplus(x: State, d: Array) -> State:
    """The state displaced by the error d (20,): x (+) d."""
    q = hamilton(x.q_ab.tolist(), _half_angle(d[DQ]))
    mu = hamilton(_half_angle(d[DMU]), x.q_bc.tolist())
    return State(
        _unit(q),
        x.w_b + d[W],
        x.r_a + d[RHO],
        x.v_a + d[VEL],
        x.sigma + d[SIGMA],
        x.c_b + d[VARRHO],
        _unit(mu),
    )


def _unit(q: Quad) -> Array:
    x, y, z, w = q
    n = 1.0 / math.sqrt(x * x + y * y + z * z + w * w)
    return np.array((x * n, y * n, z * n, w * n))


def semidefinite(P: Array) -> bool:
    """Whether P (20, 20) is finite and no eigenvalue, in units of its variances, is below
    -1e-6; variances may be 0.
    """
    return _motion.above(P + _SMALLEST, -1e-6)


def definite(P: Array) -> Array:
    """P with its eigenvalues, in units of its variances, raised to ``ROUNDING`` where rounding made
    one negative.

    Standard deviations are limited to ``LARGEST_MOVE``: about an unstable spin they grow without
    bound.
    """
    if _motion.above(P, 0.0) and float(np.diagonal(P).max()) <= LARGEST_MOVE**2:
        return P
    scale = np.sqrt(np.maximum(np.abs(np.diagonal(P)), np.finfo(float).tiny))
    values, axes = np.linalg.eigh(0.5 * (P + P.T) / np.outer(scale, scale))
    half = np.minimum(scale, LARGEST_MOVE)[:, None] * axes * np.sqrt(np.maximum(values, ROUNDING))
    return np.asarray(half @ half.T)


def definite_product(root: Array) -> Array:
    """Root root' with its eigenvalues, in units of its variances, raised to
    ``_LEAST_ROOT_EIGENVALUE``, so that it has an inverse.
    """
    scale = np.linalg.norm(root, axis=1)
    values, axes = np.linalg.eigh((root / scale[:, None]) @ (root / scale[:, None]).T)
    half = axes * np.sqrt(np.maximum(values, _LEAST_ROOT_EIGENVALUE)) * scale[:, None]
    return np.asarray(half @ half.T)
