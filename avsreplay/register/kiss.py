"""kiss-icp: as a back end against voxel maps of the model, and as odometry where there is no model.

Properties of kiss-icp 1.2 and 1.3: correspondences reach over one voxel; ``kernel`` is used as a squared length; with
more than one thread results are not repeatable to the bit; a guess whose rotation is not orthonormal by 2e-9, and
points that are all of one instant where it deskews, abort the interpreter; it returns only a pose, and returns the
guess if nothing matched; scans are deskewed to the end of the sweep.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.records import Fit
from avsreplay.register.backend import Target
from avsreplay.register.sampling import sample

POINTS_PER_VOXEL = 20
SURFACE_POINTS = 100_000
SETTLED_OF_GATE = 0.01
FINE_CALLS = 6  # with the finest map, each of at most n_max iterations
STEP_OF_EPS = 10.0  # gives 1e-4, the default of the library: its last steps move from one map point to the next
FAR_M = 1e9  # no part of the map is deleted because of its distance
THINNED = 1.5  # voxel of the points used in the coarse stages over the voxel of the map, the rule of the library
THRESHOLD_VOXELS = 2.0  # first threshold of the library over its voxel
MIN_MOTION_VOXELS = 0.1
VOXELS = 100.0  # the library's rule: range over voxel
RECENTRE_VOXELS = 50.0


class KissBackend:
    """Three maps, coarse to fine, with voxels of ``reach_m``, of ``gate_m`` and of their geometric mean in between.

    The coarse maps are used with points thinned by the library's rule, the middle one with the library's adaptive
    threshold, which follows the error of the guess. Deskewing is the pipeline's, by the predicted
    motion. The library does not return its iteration count, so ``Fit.iterations`` counts its calls. ``converged``
    means that one more call, started from the last result, moved the outermost points of the model by less than 0.01
    ``gate_m``.
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
        (reach, coarse), (voxel, middle), (gate, fine) = self._maps
        T_ca = self._run(_thinned_at(scan, guess, reach), coarse, guess, reach)
        sigma = self.threshold(guess, T_ca)
        T_ca = self._run(_thinned_at(scan, T_ca, voxel), middle, T_ca, 3.0 * sigma)
        T_ca = self._run(scan, fine, T_ca, gate)
        for calls in range(1, FINE_CALLS):
            before, T_ca = T_ca, self._run(scan, fine, T_ca, gate)
            if self._settled(before, T_ca):
                return Fit(T_ca, len(self._maps) + calls, True)
        return Fit(T_ca, len(self._maps) + FINE_CALLS - 1, False)

    def threshold(self, guess: Pose, found: Pose) -> float:
        """Return the library's adaptive threshold [m] after the first stage, which measured the error of the guess.

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
        return Pose.from_matrix(self._registration.align_points_to_map(scan, voxel_map, T_ca.matrix, reach_m, kernel))

    def _settled(self, before: Pose, after: Pose) -> bool:
        step = after @ before.inverse()  # in {C}, where a rotation of the target does not appear as a translation
        turn, move = float(geometry.angle(step.q)), float(np.linalg.norm(step.t))
        small = SETTLED_OF_GATE * self._limits.gate_m
        return move < small and turn * self._radius_m < small


class KissOdometry:
    """The odometry of KISS-ICP relative to the target instead of the surroundings; it needs no model.

    Adaptive threshold, constant velocity, deskewing and the thinning by voxels are the library's. Lengths are given to
    it in voxels, so that its defaults (voxel 1, threshold 2, least motion 0.1, range 100) hold for a target of any
    size: the voxel is a hundredth of the extent. The first motion is that of the centroid, where the library would
    begin at rest. {C} is parallel to {A} of the first scan, its origin at the centroid of that scan. What does not move
    with the target must be cropped before.
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
        """Keep the origin of what the library sees near the target, where its range has its usual meaning."""
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
    """The points thinned by voxels of {C}, where moving the camera together with the guess changes nothing."""
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
