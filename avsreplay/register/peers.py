"""Back ends of other libraries, against points sampled from the model: ``small_gicp`` and ``open3d``.

Properties of small_gicp 1.0: clouds far apart are returned as converged with no inlier; one and two threads differ in
the last digits; an unknown method name returns the identity.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Array, Pose
from avsreplay.records import Fit
from avsreplay.register.backend import Target
from avsreplay.register.sampling import sample

SURFACE_POINTS = 100_000
NEIGHBOURS = 20
SETTLED = 10.0  # its steps do not become smaller than this many eps: the covariances are not smooth in the pose
LEAST_POINTS = 20  # fewer points have no neighbourhood of NEIGHBOURS


class SmallGicpBackend:
    """GICP, coarse to fine: first with correspondences up to ``reach_m``, then up to ``gate_m``.

    ``Fit.iterations`` is the sum of both; ``converged`` is the flag of the library for the second, if it had an inlier.
    """

    name: ClassVar[str] = "small_gicp"
    accuracy: ClassVar[tuple[float, float]] = (0.01, 0.0001)
    about: ClassVar[str] = "small_gicp's GICP against points sampled from the model, one thread"
    requires: ClassVar[tuple[tuple[str, str], ...]] = (("small_gicp", "small_gicp"),)
    get: ClassVar[str] = "pip install 'avsreplay[small_gicp]'"

    def __init__(self, target: Target) -> None:
        import small_gicp

        self._library: Any = small_gicp
        self._limits = target.limits
        self._cloud, self._tree = self._prepared(sample(target.surface, SURFACE_POINTS)[0])

    def align(self, points: NDArray[Any], guess: Pose) -> Fit:
        """Return T_ca, see :class:`avsreplay.register.backend.Backend`."""
        if len(points) < LEAST_POINTS:
            return Fit(guess, 0, False)
        scan, _ = self._prepared(np.ascontiguousarray(points, dtype=np.float64))
        T_ca, passes, found = guess, 0, None
        for reach in (self._limits.reach_m, self._limits.gate_m):
            found = self._library.align(
                self._cloud,
                scan,
                self._tree,
                T_ca.matrix,
                registration_type="GICP",
                max_correspondence_distance=reach,
                num_threads=1,
                max_iterations=self._limits.n_max,
                rotation_epsilon=SETTLED * self._limits.eps_rad,
                translation_epsilon=SETTLED * self._limits.eps_m,
            )
            T_ca, passes = Pose.from_matrix(found.T_target_source), passes + int(found.iterations)
        return Fit(T_ca, passes, found is not None and bool(found.converged) and int(found.num_inliers) > 0)

    def _prepared(self, points: Array) -> tuple[Any, Any]:
        cloud = self._library.PointCloud(points)
        tree = self._library.KdTree(cloud, num_threads=1)
        self._library.estimate_normals_covariances(cloud, tree, num_neighbors=NEIGHBOURS, num_threads=1)
        return cloud, tree


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
