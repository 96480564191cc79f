"""Differences of states and renamed covariances, by which tests compare states of the estimator."""

from __future__ import annotations

import numpy as np

from avsreplay import geometry
from avsreplay.estimate.chart import AxisPermutation
from avsreplay.estimate.error_state import DMU, DQ, RHO, SIGMA, VARRHO, VEL, W
from avsreplay.geometry import Array
from avsreplay.records import State


def boxminus(a: State, b: State) -> Array:
    """The error d (20,) with ``boxplus(b, d)`` equal to a: a (-) b."""
    d = np.empty(20)
    turns = (
        (DQ, geometry.multiply(geometry.conjugate(b.q_ab), a.q_ab)),
        (DMU, geometry.multiply(a.q_bc, geometry.conjugate(b.q_bc))),
    )
    for block, q in turns:
        d[block] = q[:3] if q[3] >= 0.0 else -q[:3]
    d[W], d[RHO], d[VEL] = a.w_b - b.w_b, a.r_a - b.r_a, a.v_a - b.v_a
    d[SIGMA], d[VARRHO] = a.sigma - b.sigma, a.c_b - b.c_b
    return d


def permute_covariance(P: Array, x: State, permutation: AxisPermutation) -> Array:
    """P (20, 20) about ``x``, as a covariance about ``permute_axes(x, permutation)``."""
    J = np.eye(20)
    for block in (DQ, W, VARRHO, DMU):
        J[block, block] = permutation.R_bn.T
    a, b = (float(v) for v in x.sigma)
    third = np.array([b**2 - 1.0, a**2 - 1.0]) / (1.0 + a * b) ** 2
    join = np.vstack([np.eye(2), third])
    J[SIGMA, SIGMA] = permutation.parity * join[list(permutation.perm[:2])]
    out: Array = J @ P @ J.T
    return out
