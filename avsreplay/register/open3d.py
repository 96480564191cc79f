"""The ``open3d`` back end: Open3D's point-to-plane ICP against points sampled from the model."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Pose
from avsreplay.records import Fit
from avsreplay.register.backend import Target
from avsreplay.register.sampling import sample

SURFACE_POINTS = 100_000
NEIGHBOURS = 20


class Open3dBackend:
    """Point-to-plane, coarse to fine: first with correspondences up to ``reach_m``, then up to ``gate_m``.

    The library returns no iteration count and no flag: ``Fit.iterations`` counts its calls, and ``converged`` means
    that the last one ended with matched points.
    """

    name: ClassVar[str] = "open3d"
    accuracy: ClassVar[tuple[float, float]] = (0.01, 0.0001)
    about: ClassVar[str] = "Open3D's point-to-plane ICP against points sampled from the model"
    requires: ClassVar[tuple[tuple[str, str], ...]] = (("open3d", "open3d"),)
    get: ClassVar[str] = "pip install 'avsreplay[open3d]'"

    def __init__(self, target: Target) -> None:
        import open3d

        self._library: Any = open3d.pipelines.registration
        self._geometry: Any = open3d.geometry.PointCloud
        self._vector: Any = open3d.utility.Vector3dVector
        self._limits = target.limits
        points, normals = sample(target.surface, SURFACE_POINTS)
        self._cloud = self._geometry(self._vector(points))
        if normals.any():
            self._cloud.normals = self._vector(normals)
        else:
            self._cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS))

    def align(self, points: NDArray[Any], guess: Pose) -> Fit:
        """Return T_ca, see :class:`avsreplay.register.backend.Backend`."""
        scan = self._geometry(self._vector(np.ascontiguousarray(points, dtype=np.float64)))
        rule = self._library.ICPConvergenceCriteria(1e-8, 1e-8, self._limits.n_max)
        method = self._library.TransformationEstimationPointToPlane()
        T_ca, matched = guess, 0
        for reach in (self._limits.reach_m, self._limits.gate_m):
            found = self._library.registration_icp(scan, self._cloud, reach, T_ca.matrix, method, rule)
            T_ca, matched = Pose.from_matrix(found.transformation), len(found.correspondence_set)
        return Fit(T_ca, 2, matched > 0)
