"""Horn's quaternion ICP (eq:ICP): the ``horn`` back end in C++, and the ``reference`` back end in numpy.

``horn`` makes point-to-plane passes first and ends at the fixed point of Horn's iteration. ``reference`` is the ICP of
the paper, corrected, for comparison with the others: every pass matches each point with its closest point on the model,
then applies Horn's closed-form motion.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.records import Fit
from avsreplay.register.backend import Target
from avsreplay.register.surface_index import IcpParams

PLANE_PASSES = 3
TIGHTEN = 4.0  # rejection distance over rms: three standard deviations of a face that is seen at right angles
LEAST_GATE_OF_EXTENT = 0.004  # the rejection distance follows the rms down to this
MOST_WITHIN = 60  # passes of an alignment that begins near its result
FEW_POINTS = 600  # of a scan that has many more, for the first passes
TIGHTEN = 3.0  # the gate of the reference in units of the rms of the last pass
MIN_INLIERS = 6
SETTLED_GATE = 0.01  # the gate has settled once a pass changes it by less than this share


class HornBackend:
    """Exact closest points on the model, one fused pass, identical results for any number of threads.

    Rejection and stopping are those of :class:`~avsreplay.register.surface_index.IcpParams`: the gate starts at
    ``reach_m``, follows four times the rms of the last pass and never goes below 0.004 of the extent, or ``gate_m`` if
    that is less: points beyond three standard deviations, at the edges of hidden surface, bias the pose. Where the
    position of the camera is known, only faces that face it are matched.
    """

    name: ClassVar[str] = "horn"
    accuracy: ClassVar[tuple[float, float]] = (0.001, 1e-05)
    same_bytes: ClassVar[bool] = True  # on every x86-64 processor
    about: ClassVar[str] = (
        "point-to-plane start, then Newton steps to the fixed point of Horn's quaternion ICP on the mesh itself, C++"
    )
    requires: ClassVar[tuple[tuple[str, str], ...]] = (("avsreplay.register._kernel", "avsreplay"),)
    get: ClassVar[str] = "a C++17 compiler, then pip install ."

    def __init__(self, target: Target) -> None:
        limits = target.limits
        self._index, self._visibility = target.index, target.visibility
        rule = IcpParams(
            n_max=limits.n_max,
            n_plane=min(PLANE_PASSES, limits.n_max),
            few=FEW_POINTS,
            gate_m=limits.reach_m,
            floor_m=min(limits.gate_m, LEAST_GATE_OF_EXTENT * target.index.extent_m),
            tighten=TIGHTEN,
            eps_rad=limits.eps_rad,
            eps_m=limits.eps_m,
            threads=limits.threads,
        )
        self._rules = {facing: replace(rule, facing=facing) for facing in (False, True)}

    def align(self, points: NDArray[Any], guess: Pose) -> Fit:
        """Return T_ca, see :class:`avsreplay.register.backend.Backend`."""
        return self._run(points, guess, self._rules)

    def align_within(self, points: NDArray[Any], guess: Pose, gate_m: float, near: bool = False) -> Fit:
        """Return T_ca with correspondences nearer than ``gate_m`` [m] from the first pass to the last.

        ``near``: the guess is a registered pose, so that no point-to-plane passes and no passes over few points come
        first: they would end further from the result than it is.
        """
        most = min(self._rules[True].n_max, MOST_WITHIN)
        rules = {
            facing: replace(
                rule,
                n_max=most,
                n_plane=0 if near else rule.n_plane,
                few=0 if near else rule.few,
                gate_m=gate_m,
                floor_m=gate_m,
                tighten=0.0,
            )
            for facing, rule in self._rules.items()
        }
        return self._run(points, guess, rules)

    def _run(self, points: NDArray[Any], guess: Pose, rules: dict[bool, IcpParams]) -> Fit:
        facing = self._visibility.camera_c(self._index, points, guess) is not None
        found = self._index.icp(points, guess, rules[facing])
        return Fit(Pose.from_matrix(found.T_ca), found.iterations, found.converged, found.matches)


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
