"""Horn's closed form: the rigid motion that carries one set of points onto another with least squared error."""

from __future__ import annotations

import numpy as np

from avsreplay.geometry import Array, Pose

__all__ = ["best_motion", "horn_matrix"]


def horn_matrix(N: Array) -> Array:
    """Horn's M of N = mean(c d') - c_bar d_bar' (paper, eq:M), for SCALAR-FIRST quaternions. (3, 3) -> (4, 4)."""
    M = np.empty((4, 4))
    M[0, 0] = np.trace(N)
    M[0, 1:] = M[1:, 0] = (N[1, 2] - N[2, 1], N[2, 0] - N[0, 2], N[0, 1] - N[1, 0])
    M[1:, 1:] = N + N.T - M[0, 0] * np.eye(3)
    return M


def best_motion(moving: Array, fixed: Array) -> Pose:
    """T with ``fixed ~ T.apply(moving)``, the least-squares rigid motion; both (n, 3) [m], n >= 1."""
    c_bar, d_bar = moving.mean(axis=0), fixed.mean(axis=0)
    N = (moving - c_bar).T @ (fixed - d_bar) / len(moving)
    w, x, y, z = np.linalg.eigh(horn_matrix(N))[1][:, -1]  # M's eigenvector is [w x y z]; ours is scalar last
    turn = Pose(np.array([x, y, z, w]), np.zeros(3))
    return Pose(turn.q, d_bar - turn.R @ c_bar)
