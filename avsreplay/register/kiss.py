"""The ``kiss`` back end: kiss-icp against a voxel map of points sampled from the model.

Properties of kiss-icp 1.2 and 1.3: correspondences reach over one voxel; ``kernel`` is used as a squared length; with
more than one thread results are not repeatable to the bit; a guess whose rotation is not orthonormal by 2e-9 aborts the
interpreter; it returns only a pose, and returns the guess if nothing matched.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.geometry import Pose
from avsreplay.records import Fit
from avsreplay.register.backend import Target
from avsreplay.register.sampling import sample

POINTS_PER_VOXEL = 20
SURFACE_POINTS = 100_000
SETTLED_OF_GATE = 0.01
STEP_OF_EPS = 10.0  # gives 1e-4, the default of the library: its last steps move from one map point to the next
FAR_M = 1e9  # no part of the map is deleted because of its distance


class KissBackend:
    """Three maps, coarse to fine, with voxels of ``reach_m``, of ``gate_m`` and of their geometric mean in between.

    The library does not return its iteration count, so ``Fit.iterations`` counts its calls. ``converged`` means that
    one more call, started from the last result, moved the outermost points of the model by less than 0.01 ``gate_m``.
    """

    name: ClassVar[str] = "kiss"
    accuracy: ClassVar[tuple[float, float]] = (0.3, 0.003)
    about: ClassVar[str] = "kiss-icp against a voxel map of the model, one thread"
    requires: ClassVar[tuple[tuple[str, str], ...]] = (("kiss_icp", "kiss-icp"),)
    get: ClassVar[str] = "pip install kiss-icp"

    def __init__(self, target: Target) -> None:
        from kiss_icp.mapping import VoxelHashMap
        from kiss_icp.registration import Registration

        self._limits, self._radius_m = target.limits, 0.5 * target.surface.extent
        points = np.ascontiguousarray(sample(target.surface, SURFACE_POINTS)[0])
        reach, gate = target.limits.reach_m, target.limits.gate_m
        self._maps: list[tuple[float, Any]] = []
        for voxel in (reach, math.sqrt(reach * gate), gate):
            voxel_map: Any = VoxelHashMap(voxel, FAR_M, POINTS_PER_VOXEL)
            voxel_map.add_points(points)
            self._maps.append((voxel, voxel_map))
        self._registration = Registration(target.limits.n_max, STEP_OF_EPS * target.limits.eps_rad, 1)

    def align(self, points: NDArray[Any], guess: Pose) -> Fit:
        """Return T_ca, see :class:`avsreplay.register.backend.Backend`."""
        scan = np.ascontiguousarray(points, dtype=np.float64)
        T_ca = guess
        for voxel, voxel_map in self._maps:
            T_ca = self._run(scan, voxel, voxel_map, T_ca)
        again = self._run(scan, *self._maps[-1], T_ca)
        return Fit(again, len(self._maps) + 1, self._settled(T_ca, again))

    def _run(self, scan: NDArray[np.float64], voxel: float, voxel_map: Any, T_ca: Pose) -> Pose:
        # Pose re-orthonormalises: the matrix of a unit quaternion is a rotation to 1e-16.
        T = self._registration.align_points_to_map(scan, voxel_map, T_ca.matrix, voxel, (voxel / 3.0) ** 2)
        return Pose.from_matrix(T)

    def _settled(self, before: Pose, after: Pose) -> bool:
        step = after @ before.inverse()  # in {C}, where a rotation of the target does not appear as a translation
        turn, move = float(geometry.angle(step.q)), float(np.linalg.norm(step.t))
        small = SETTLED_OF_GATE * self._limits.gate_m
        return move < small and turn * self._radius_m < small
