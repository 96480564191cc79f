"""Back ends for comparison with ``horn``: the ICP of the paper, and libraries that use sampled
points of the model.

``reference`` is the ICP of the paper (eq:ICP), corrected: every pass matches each point with its
closest point on the model, then applies Horn's closed-form motion. ``KissOdometry`` tracks scans
where there is no model.

Properties of small_gicp 1.0: clouds far apart are returned as converged with no inlier; one and two
threads differ in the last digits; an unknown method name returns the identity.

Properties of kiss-icp 1.2 and 1.3: Correspondences reach over one voxel. ``kernel`` is used as a
squared length. With more than one thread results are not repeatable to the bit. A guess whose
rotation is not orthonormal by 2e-9 aborts the interpreter; so do points that all have one instant
if it deskews. It returns only a pose, and the guess if nothing matched. Scans are deskewed to the
end of the sweep.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.records import Fit
from avsreplay.register.backend import TIGHTEN, Backend, Target
from avsreplay.register.sampling import sample
from avsreplay.settings import Settings, setting

MIN_INLIERS = 6
SETTLED_GATE = 0.01  # the gate has settled once a pass changes it by less than this share
STEP_EPS = 10.0  # steps end at this many eps, because the covariances are not smooth in the pose
SETTLED_OF_GATE = 0.01
FINE_CALLS = 6  # calls with the finest map, each with at most n_max iterations
# 1e-4 as by default in the library, whose last steps change from one map point to the next
STEP_OF_EPS = 10.0
FAR_M = 1e9  # no part of the map is deleted because of its distance
# voxel of the points used in the coarse stages over the voxel of the map, the rule of the library
THINNED = 1.5
THRESHOLD_VOXELS = 2.0  # first threshold of the library over its voxel
MIN_MOTION_VOXELS = 0.1
VOXELS = 100.0  # the library's rule: range over voxel
RECENTRE_VOXELS = 50.0


@dataclass(frozen=True, slots=True)
class SampledParams(Settings):
    """Parameters of a back end that samples the model and needs neighbourhoods of its points."""

    surface_points: int = setting(
        100_000,
        "Points sampled from the surface of the model. More of them give a more exact pose and take"
        " more time and memory.",
        low=100,
        high=10_000_000,
    )
    neighbours: int = setting(
        20,
        "Nearest points from which the normal or the covariance at a point is estimated. More of"
        " them suppress noise and smooth edges; a scan with fewer points is not aligned.",
        low=3,
        high=1000,
    )


class GicpCost(Enum):
    """What small_gicp minimises."""

    GICP = "gicp"  # distances between distributions at both points
    PLANE = "plane"  # distances to the tangent planes of the model


@dataclass(frozen=True, slots=True)
class SmallGicpParams(SampledParams):
    """Parameters of the back end ``small_gicp``."""

    cost: GicpCost = setting(
        GicpCost.GICP,
        "What is minimised: distances between distributions (gicp), or distances to the tangent"
        " planes of the model (plane).",
    )


@dataclass(frozen=True, slots=True)
class KissParams(Settings):
    """Parameters of the back end ``kiss``."""

    voxel_m: float | None = setting(
        None,
        "Edge of the voxels of the finest map. A larger value takes less time and gives a less"
        " exact pose.",
        unit="m",
        above=0.0,
        unset="the same as register.gate_m",
    )
    points_per_voxel: int = setting(
        20,
        "Points of the model that each voxel of a map keeps. A larger value gives a more exact pose"
        " and takes more time.",
        low=1,
        high=100_000,
    )
    surface_points: int = setting(
        100_000,
        "Points sampled from the surface of the model. More of them give a more exact pose and take"
        " more time and memory.",
        low=100,
        high=10_000_000,
    )


class ReferenceBackend(Backend):
    """Horn's quaternion ICP, point to surface, from the first pass to the fixed point.

    Rejection: a point is used while its distance to the model is below the gate. The gate starts at
    ``reach_m``; after each pass it is min(gate, max(gate_m, 3 rms)): wide while the guess is off,
    narrow at the end, never growing.
    Stopping: a pass that rotates by less than ``eps_rad`` and moves the centroid of the inliers by
    less than ``eps_m`` after the gate has settled.
    """

    name: ClassVar[str] = "reference"
    accuracy: ClassVar[tuple[float, float]] = (0.01, 0.0001)
    same_bytes: ClassVar[bool] = True  # on every x86-64 processor
    about: ClassVar[str] = (
        "Horn's quaternion ICP against the mesh itself, in numpy: slow, for comparison"
    )

    def __init__(self, target: Target) -> None:
        self._limits, self._visibility, self._index = target.limits, target.visibility, target.index

    def align(self, points: NDArray[Any], guess: Pose) -> Fit:
        """Return T_ca, see :class:`avsreplay.register.backend.Backend`."""
        scan = np.ascontiguousarray(points, dtype=np.float64)
        return self._visibility.consistent(
            self._index, scan, guess, lambda *start: self._align(scan, *start)
        )

    def _align(self, scan: Array, T_ca: Pose, facing: bool) -> Fit:
        gate = self._limits.reach_m
        for passes in range(1, self._limits.n_max + 1):
            moved = T_ca.apply(scan)
            found = self._index.closest(moved, camera_c=T_ca.t if facing else None)
            inlier = found.d2 < gate**2
            if inlier.sum() < MIN_INLIERS:
                return Fit(T_ca, passes, False)
            step = best_motion(moved[inlier], found.foot[inlier])
            T_ca = step @ T_ca
            tighter = min(
                gate, max(self._limits.gate_m, TIGHTEN * float(np.sqrt(found.d2[inlier].mean())))
            )
            if (
                self._small(step, moved[inlier].mean(axis=0))
                and gate - tighter <= SETTLED_GATE * gate
            ):
                return Fit(T_ca, passes, True)
            gate = tighter
        return Fit(T_ca, self._limits.n_max, False)

    def _small(self, step: Pose, centroid: Array) -> bool:
        moved = float(np.linalg.norm(step.apply(centroid) - centroid))
        return float(geometry.angle(step.q)) < self._limits.eps_rad and moved < self._limits.eps_m


def horn_matrix(N: Array) -> Array:
    """Horn's M (4, 4) of N = mean(c d') - c_bar d_bar' (3, 3) (eq:M), for SCALAR-FIRST
    quaternions.
    """
    M = np.empty((4, 4))
    M[0, 0] = np.trace(N)
    M[0, 1:] = M[1:, 0] = (N[1, 2] - N[2, 1], N[2, 0] - N[0, 2], N[0, 1] - N[1, 0])
    M[1:, 1:] = N + N.T - M[0, 0] * np.eye(3)
    return M


def best_motion(moving: Array, fixed: Array) -> Pose:
    """Least-squares rigid motion T with ``fixed ~ T.apply(moving)``; both (n, 3) [m], n >= 1."""
    c_bar, d_bar = moving.mean(axis=0), fixed.mean(axis=0)
    N = (moving - c_bar).T @ (fixed - d_bar) / len(moving)
    w, x, y, z = np.linalg.eigh(horn_matrix(N))[1][
        :, -1
    ]  # the eigenvector of M is [w x y z]; Pose is scalar last
    turn = Pose(np.array([x, y, z, w]), np.zeros(3))
    return Pose(turn.q, d_bar - turn.R @ c_bar)


_METHODS = {GicpCost.GICP: "GICP", GicpCost.PLANE: "PLANE_ICP"}


class SmallGicpBackend(Backend):
    """GICP or point-to-plane ICP, coarse to fine: first with correspondences up to ``reach_m``,
    then up to ``gate_m``. Points farther than ``reach_m`` from the model are left out: they match
    nothing, and the library's search for the nearest point of the model takes longest for them.

    ``Fit.iterations`` is the sum of both; ``converged`` is the flag of the library for the second,
    if it had an inlier.
    """

    name: ClassVar[str] = "small_gicp"
    accuracy: ClassVar[tuple[float, float]] = (0.01, 0.0001)
    about: ClassVar[str] = (
        "small_gicp's GICP or point-to-plane ICP against points sampled from the model, one thread"
    )
    requires: ClassVar[tuple[tuple[str, str], ...]] = (("small_gicp", "small_gicp"),)
    get: ClassVar[str] = "pip install 'avsreplay[small_gicp]'"
    parameters = SmallGicpParams

    def __init__(self, target: Target) -> None:
        import small_gicp

        self._library: Any = small_gicp
        self._limits, self._own = target.limits, target.parameters(SmallGicpParams)
        self._index = target.index
        points, _ = sample(target.surface, self._own.surface_points)
        self._cloud, self._tree = self._prepared(points)

    def align(self, points: NDArray[Any], guess: Pose) -> Fit:
        """Return T_ca, see :class:`avsreplay.register.backend.Backend`."""
        scan = np.ascontiguousarray(points, dtype=np.float64)
        T_ca, passes, ended = guess, 0, False
        used, source = np.zeros(len(scan), dtype=bool), None
        for reach in (self._limits.reach_m, self._limits.gate_m):
            near = self._index.closest(T_ca.apply(scan)).d2 < self._limits.reach_m**2
            if np.count_nonzero(near) < self._own.neighbours:
                return Fit(T_ca, passes, False)
            if not np.array_equal(near, used):
                used, source = near, self._prepared(scan[near])[0]
            found = self._library.align(
                self._cloud,
                source,
                self._tree,
                T_ca.matrix,
                registration_type=_METHODS[self._own.cost],
                max_correspondence_distance=reach,
                num_threads=1,
                max_iterations=self._limits.n_max,
                rotation_epsilon=STEP_EPS * self._limits.eps_rad,
                translation_epsilon=STEP_EPS * self._limits.eps_m,
            )
            T_ca, passes = Pose.from_matrix(found.T_target_source), passes + int(found.iterations)
            ended = bool(found.converged) and int(found.num_inliers) > 0
        return Fit(T_ca, passes, ended)

    def _prepared(self, points: Array) -> tuple[Any, Any]:
        cloud = self._library.PointCloud(points)
        tree = self._library.KdTree(cloud, num_threads=1)
        self._library.estimate_normals_covariances(
            cloud, tree, num_neighbors=self._own.neighbours, num_threads=1
        )
        return cloud, tree


class Open3dBackend(Backend):
    """Point-to-plane, coarse to fine: first with correspondences up to ``reach_m``, then up to
    ``gate_m``.

    The library returns no iteration count and no flag: ``Fit.iterations`` counts its calls, and
    ``converged`` means that the last one ended with matched points.
    """

    name: ClassVar[str] = "open3d"
    accuracy: ClassVar[tuple[float, float]] = (0.01, 0.0001)
    about: ClassVar[str] = "Open3D's point-to-plane ICP against points sampled from the model"
    requires: ClassVar[tuple[tuple[str, str], ...]] = (("open3d", "open3d"),)
    get: ClassVar[str] = "pip install 'avsreplay[open3d]'"
    parameters = SampledParams

    def __init__(self, target: Target) -> None:
        import open3d

        self._library: Any = open3d.pipelines.registration
        self._geometry: Any = open3d.geometry.PointCloud
        self._vector: Any = open3d.utility.Vector3dVector
        self._limits, own = target.limits, target.parameters(SampledParams)
        points, normals = sample(target.surface, own.surface_points)
        self._cloud = self._geometry(self._vector(points))
        if normals.any():
            self._cloud.normals = self._vector(normals)
        else:
            self._cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(own.neighbours))

    def align(self, points: NDArray[Any], guess: Pose) -> Fit:
        """Return T_ca, see :class:`avsreplay.register.backend.Backend`."""
        scan = self._geometry(self._vector(np.ascontiguousarray(points, dtype=np.float64)))
        rule = self._library.ICPConvergenceCriteria(1e-8, 1e-8, self._limits.n_max)
        method = self._library.TransformationEstimationPointToPlane()
        T_ca, matched = guess, 0
        for reach in (self._limits.reach_m, self._limits.gate_m):
            found = self._library.registration_icp(
                scan, self._cloud, reach, T_ca.matrix, method, rule
            )
            T_ca, matched = Pose.from_matrix(found.transformation), len(found.correspondence_set)
        return Fit(T_ca, 2, matched > 0)


class KissBackend(Backend):
    """Three maps, coarse to fine, with voxels of ``reach_m``, of ``voxel_m`` and of their geometric
    mean in between.

    The coarse maps are used with points thinned by the library's rule, the middle one with the
    library's adaptive threshold, which follows the error of the guess. Deskewing is the pipeline's,
    by the predicted motion. The library does not return its iteration count, so ``Fit.iterations``
    counts its calls. ``converged`` means that one more call, started from the last result, moved
    the outermost points of the model by less than 0.01 ``gate_m``.
    """

    name: ClassVar[str] = "kiss"
    accuracy: ClassVar[tuple[float, float]] = (0.3, 0.003)
    about: ClassVar[str] = "kiss-icp against a voxel map of the model, one thread"
    requires: ClassVar[tuple[tuple[str, str], ...]] = (("kiss_icp", "kiss-icp"),)
    get: ClassVar[str] = "pip install kiss-icp"
    parameters = KissParams

    def __init__(self, target: Target) -> None:
        from kiss_icp.mapping import VoxelHashMap
        from kiss_icp.registration import Registration

        self._limits, self._radius_m = target.limits, 0.5 * target.surface.extent
        own = target.parameters(KissParams)
        points = np.ascontiguousarray(sample(target.surface, own.surface_points)[0])
        finest = own.voxel_m or target.limits.gate_m
        coarsest = max(target.limits.reach_m, finest)
        self._maps: list[tuple[float, Any]] = []
        for voxel in (coarsest, math.sqrt(coarsest * finest), finest):
            voxel_map: Any = VoxelHashMap(voxel, FAR_M, own.points_per_voxel)
            voxel_map.add_points(points)
            self._maps.append((voxel, voxel_map))
        self._registration = Registration(
            target.limits.n_max, STEP_OF_EPS * target.limits.eps_rad, 1
        )

    def align(self, points: NDArray[Any], guess: Pose) -> Fit:
        """Return T_ca, see :class:`avsreplay.register.backend.Backend`."""
        scan = np.ascontiguousarray(points, dtype=np.float64)
        (reach, coarse), (voxel, middle), (finest, fine) = self._maps
        T_ca = self._run(_thinned_at(scan, guess, reach), coarse, guess, reach)
        sigma = self.threshold(guess, T_ca)
        T_ca = self._run(_thinned_at(scan, T_ca, voxel), middle, T_ca, 3.0 * sigma)
        T_ca = self._run(scan, fine, T_ca, finest)
        for calls in range(1, FINE_CALLS):
            before, T_ca = T_ca, self._run(scan, fine, T_ca, finest)
            if self._settled(before, T_ca):
                return Fit(T_ca, len(self._maps) + calls, True)
        return Fit(T_ca, len(self._maps) + FINE_CALLS - 1, False)

    def threshold(self, guess: Pose, found: Pose) -> float:
        """Return the library's adaptive threshold [m] after the first stage, which measured the
        error of the guess.

        Args:
            guess: initial T_ca.
            found: T_ca after the first stage.
        """
        from kiss_icp.config.parser import KISSConfig
        from kiss_icp.threshold import AdaptiveThreshold

        gate = self._limits.gate_m
        config = KISSConfig()
        config.adaptive_threshold.initial_threshold = THRESHOLD_VOXELS * gate
        config.adaptive_threshold.min_motion_th = MIN_MOTION_VOXELS * gate
        config.data.max_range = self._radius_m
        rule: Any = AdaptiveThreshold(config)
        rule.update_model_deviation((guess.inverse() @ found).matrix)
        return float(rule.get_threshold())

    def _run(self, scan: Array, voxel_map: Any, T_ca: Pose, reach_m: float) -> Pose:
        # Pose re-orthonormalises: the matrix of a unit quaternion is a rotation to 1e-16.
        kernel = (reach_m / 3.0) ** 2
        return Pose.from_matrix(
            self._registration.align_points_to_map(scan, voxel_map, T_ca.matrix, reach_m, kernel)
        )

    def _settled(self, before: Pose, after: Pose) -> bool:
        step = (
            after @ before.inverse()
        )  # in {C}, where a rotation of the target does not appear as a translation
        turn, move = float(geometry.angle(step.q)), float(np.linalg.norm(step.t))
        small = SETTLED_OF_GATE * self._limits.gate_m
        return move < small and turn * self._radius_m < small


class KissOdometry:
    """The odometry of KISS-ICP relative to the target instead of the surroundings; it needs no
    model.

    Adaptive threshold, constant velocity, deskewing and the thinning by voxels are the library's.
    Lengths are given to it in voxels, so that its defaults (voxel 1, threshold 2, least motion 0.1,
    range 100) hold for a target of any
    size: the voxel is a hundredth of the extent. The first motion is that of the centroid, where
    the library would begin at rest. {C} is parallel to {A} of the first scan, its origin at the
    centroid of that scan. Points that do not move with the target must be cropped first.
    """

    def __init__(self, extent_m: float, deskew: bool = True) -> None:
        """Begin with an empty map.

        Args:
            extent_m: largest size of the target [m].
            deskew: use the instants of the points where they are given.
        """
        self._voxel_m, self._deskew = extent_m / VOXELS, deskew
        self._odometry: Any = None
        self._centre, self._first, self._count = np.zeros(3), np.zeros(3), 0

    def add(self, points: NDArray[Any], times_s: NDArray[Any] | None = None) -> tuple[Pose, float]:
        """Register the next scan.

        Args:
            points: (n, 3) finite, n >= 1, in {A} [m].
            times_s: (n,) instants of the points [s], or None.

        Returns:
            T_ac and its instant [s]: that of the last point if the scan was deskewed, otherwise 0.
        """
        scan = np.ascontiguousarray(points, dtype=np.float64)
        middle = scan.mean(axis=0)
        self._recentre(middle)
        if self._count == 1:
            self._odometry.last_delta[:3, 3] = (self._first - middle) / self._voxel_m
        self._count += 1
        timed = times_s is not None and self._deskew and float(np.ptp(times_s)) > 0.0
        instants = np.asarray(times_s, dtype=np.float64) if timed else np.empty(0)
        self._odometry.register_frame((scan - self._centre) / self._voxel_m, instants)
        pose = Pose.from_matrix(self._odometry.last_pose)
        T_ca = Pose(pose.q, self._voxel_m * pose.t - pose.R @ self._centre)
        return T_ca.inverse(), float(instants.max()) if timed else 0.0

    def _recentre(self, middle: Array) -> None:
        """Keep the origin of the library's points near the target, so that its limit on the range
        applies as usual.
        """
        if self._odometry is None:
            from kiss_icp.config.parser import load_config
            from kiss_icp.kiss_icp import KissICP

            config: Any = load_config(None)
            config.data.max_range, config.mapping.voxel_size = VOXELS, 1.0
            config.data.deskew, config.registration.max_num_threads = self._deskew, 1
            self._odometry, self._centre = KissICP(config), middle
            self._first = middle
        shift = np.eye(4)
        shift[:3, 3] = (middle - self._centre) / self._voxel_m
        if float(np.linalg.norm(shift[:3, 3])) > RECENTRE_VOXELS:
            back = np.linalg.inv(shift)
            self._odometry.last_pose = self._odometry.last_pose @ shift
            self._odometry.last_delta = back @ self._odometry.last_delta @ shift
            self._centre = middle


def _thinned_at(scan: Array, T_ca: Pose, voxel_m: float) -> Array:
    """The points thinned by voxels of {C}, where moving the camera together with the guess changes
    nothing.
    """
    return T_ca.inverse().apply(thinned(T_ca.apply(scan), voxel_m))


def thinned(points: Array, voxel_m: float) -> Array:
    """Return one point of each voxel by the library's rule, the same for any order of the points.

    Args:
        points: (n, 3) [m].
        voxel_m: voxel of the map; that of the points is 1.5 times larger.
    """
    from kiss_icp.voxelization import voxel_down_sample

    ordered = np.ascontiguousarray(points[np.lexsort(points.T)])
    return np.asarray(voxel_down_sample(ordered, THINNED * voxel_m))
