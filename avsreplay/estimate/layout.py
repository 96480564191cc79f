"""Where each of the 20 error states stands (eq:x), and the quaternion steps that belong to them.

dq_v and dmu_v are HALF-angle vectors in {B}: q = dq (x) q_hat is ``q_hat * dq`` and mu = mu_hat (x) dmu is
``dmu * mu_hat`` in Hamilton's product. All other states are additive.
"""

from __future__ import annotations

import math

import numpy as np

from avsreplay.geometry import Array
from avsreplay.records import BLOCKS, State

__all__ = ["DIM", "DMU", "DQ", "RHO", "SIGMA", "VARRHO", "VEL", "W", "boxminus", "boxplus", "hamilton", "rotation"]

DIM = 20
DQ, W, RHO, VEL, SIGMA, VARRHO, DMU = (BLOCKS[name] for name in BLOCKS)

Quad = tuple[float, float, float, float]


def hamilton(a: Array | Quad, b: Array | Quad) -> Quad:
    """Hamilton's product of two quaternions [x y z w], in scalars: the hot path's form of geometry.multiply."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + bw * ax + ay * bz - az * by,
        aw * by + bw * ay + az * bx - ax * bz,
        aw * bz + bw * az + ax * by - ay * bx,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def rotation(q: Array) -> Array:
    """R (3, 3) of a unit quaternion (4,): the hot path's form of geometry.matrix."""
    x, y, z, w = q.tolist()
    return np.array(
        (
            (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)),
            (2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)),
            (2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)),
        )
    )


def boxplus(x: State, d: Array) -> State:
    """The state displaced by the error d (20,): x (+) d."""
    q = hamilton(_quad(x.q_ab), _half_angle(d[DQ]))
    mu = hamilton(_half_angle(d[DMU]), _quad(x.q_bc))
    return State(
        _unit(q), x.w_b + d[W], x.r_a + d[RHO], x.v_a + d[VEL], x.sigma + d[SIGMA], x.c_b + d[VARRHO], _unit(mu)
    )


def boxminus(a: State, b: State) -> Array:
    """The error d (20,) with ``boxplus(b, d)`` equal to a: a (-) b."""
    d = np.empty(DIM)
    d[DQ] = _vector(hamilton(_conjugate(b.q_ab), _quad(a.q_ab)))
    d[DMU] = _vector(hamilton(_quad(a.q_bc), _conjugate(b.q_bc)))
    d[W], d[RHO], d[VEL] = a.w_b - b.w_b, a.r_a - b.r_a, a.v_a - b.v_a
    d[SIGMA], d[VARRHO] = a.sigma - b.sigma, a.c_b - b.c_b
    return d


def _quad(q: Array) -> Quad:
    x, y, z, w = q.tolist()
    return x, y, z, w


def _conjugate(q: Array) -> Quad:
    x, y, z, w = q.tolist()
    return -x, -y, -z, w


def _vector(q: Quad) -> tuple[float, float, float]:
    """Vector part, of the sign with w >= 0."""
    x, y, z, w = q
    return (x, y, z) if w >= 0.0 else (-x, -y, -z)


def _half_angle(v: Array) -> Quad:
    """The quaternion whose vector part is v; beyond a half turn the nearest one, a half turn."""
    x, y, z = v.tolist()
    n2 = x * x + y * y + z * z
    if n2 < 1.0:
        return x, y, z, math.sqrt(1.0 - n2)
    n = math.sqrt(n2)
    return x / n, y / n, z / n, 0.0


def _unit(q: Quad) -> Array:
    x, y, z, w = q
    n = 1.0 / math.sqrt(x * x + y * y + z * z + w * w)
    return np.array((x * n, y * n, z * n, w * n))
