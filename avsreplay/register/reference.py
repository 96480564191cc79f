"""The ``reference`` back end: the ICP of the paper, corrected, in numpy, for comparison with the others.

Every pass matches each point with its closest point on the model, then applies Horn's closed-form motion (eq:ICP).
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.records import Fit
from avsreplay.register.backend import Target

TIGHTEN = 3.0  # the gate in units of the rms of the last pass
MIN_INLIERS = 6
SETTLED_GATE = 0.01  # the gate has settled once a pass changes it by less than this share


class ReferenceBackend:
    """Horn's quaternion ICP, point to surface, from the first pass to the fixed point.

    Rejection: a point is used while its distance to the model is below the gate. The gate starts at ``reach_m``; after
    each pass it is min(gate, max(gate_m, 3 rms)): wide while the guess is off, narrow at the end, never growing.
    Stopping: a pass that rotates by less than ``eps_rad`` and moves the centroid of the inliers by less than ``eps_m``
    after the gate has settled.
    """

    name: ClassVar[str] = "reference"
    accuracy: ClassVar[tuple[float, float]] = (0.01, 0.0001)
    same_bytes: ClassVar[bool] = True  # on every x86-64 processor
    about: ClassVar[str] = "Horn's quaternion ICP against the mesh itself, in numpy: slow, for comparison"

    def __init__(self, target: Target) -> None:
        self._limits, self._visibility, self._index = target.limits, target.visibility, target.index

    def align(self, points: NDArray[Any], guess: Pose) -> Fit:
        """Return T_ca, see :class:`avsreplay.register.backend.Backend`."""
        scan = np.ascontiguousarray(points, dtype=np.float64)
        T_ca, gate = guess, self._limits.reach_m
        facing = self._visibility.camera_c(self._index, scan, guess) is not None
        for passes in range(1, self._limits.n_max + 1):
            moved = T_ca.apply(scan)
            found = self._index.closest(moved, camera_c=T_ca.t if facing else None)
            inlier = found.d2 < gate**2
            if inlier.sum() < MIN_INLIERS:
                return Fit(T_ca, passes, False)
            step = best_motion(moved[inlier], found.foot[inlier])
            T_ca = step @ T_ca
            tighter = min(gate, max(self._limits.gate_m, TIGHTEN * float(np.sqrt(found.d2[inlier].mean()))))
            if self._small(step, moved[inlier].mean(axis=0)) and gate - tighter <= SETTLED_GATE * gate:
                return Fit(T_ca, passes, True)
            gate = tighter
        return Fit(T_ca, self._limits.n_max, False)

    def _small(self, step: Pose, centroid: Array) -> bool:
        moved = float(np.linalg.norm(step.apply(centroid) - centroid))
        return float(geometry.angle(step.q)) < self._limits.eps_rad and moved < self._limits.eps_m


def horn_matrix(N: Array) -> Array:
    """Horn's M (4, 4) of N = mean(c d') - c_bar d_bar' (3, 3) (eq:M), for SCALAR-FIRST quaternions."""
    M = np.empty((4, 4))
    M[0, 0] = np.trace(N)
    M[0, 1:] = M[1:, 0] = (N[1, 2] - N[2, 1], N[2, 0] - N[0, 2], N[0, 1] - N[1, 0])
    M[1:, 1:] = N + N.T - M[0, 0] * np.eye(3)
    return M


def best_motion(moving: Array, fixed: Array) -> Pose:
    """Least-squares rigid motion T with ``fixed ~ T.apply(moving)``; both (n, 3) [m], n >= 1."""
    c_bar, d_bar = moving.mean(axis=0), fixed.mean(axis=0)
    N = (moving - c_bar).T @ (fixed - d_bar) / len(moving)
    w, x, y, z = np.linalg.eigh(horn_matrix(N))[1][:, -1]  # the eigenvector of M is [w x y z]; Pose is scalar last
    turn = Pose(np.array([x, y, z, w]), np.zeros(3))
    return Pose(turn.q, d_bar - turn.R @ c_bar)
