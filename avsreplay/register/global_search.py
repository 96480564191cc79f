"""Global search: the pose from one scan alone, without a guess, for any attitude; and whether it is unique.

The search goes from coarse to fine. Every start (an attitude, with the centroid of the scan placed on the centroid of
the surface visible from there) is refined by a few point-to-plane passes with few points against points sampled from
the model; the best are refined with more points; the last few, all different poses, are registered to the model itself
and ranked by the truncated distances that remain. If the camera position is unknown, six directions are tried for every
attitude. If no pose explains the scan, more starts follow.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.records import Surface
from avsreplay.register.backend import Target
from avsreplay.register.horn import HornBackend
from avsreplay.register.params import AcquireParams
from avsreplay.register.sampling import sample, thin_to, without_sparse_points
from avsreplay.register.surface_index import IcpParams, SurfaceIndex

MODEL_POINTS = 3000
REACH_OF_EXTENT = 0.5
COARSE_OF_EXTENT, MIDDLE_OF_EXTENT = 0.03, 0.02  # distances beyond which a point counts as unexplained
SAME_RAD, SAME_OF_EXTENT = np.radians(10.0), 0.05  # two poses nearer than that are the same
SIGMAS = 5.0
FINE_PASSES = 40  # ICP from a wrong pose can take hundreds
PSI = 1.533751168755204288118041  # positive root of psi^4 = psi + 4 (super-Fibonacci spirals)
CELL_OF_EXTENT = 0.02
LEAST_COSINE = 0.05
SHIFT_OF_EXTENT = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A pose T_ca with the mean truncated squared distance that remains and the share of inliers."""

    T_ca: Pose
    unexplained: float
    inlier_ratio: float


@dataclass(frozen=True, slots=True, eq=False)
class SearchResult:
    """Result of a global search.

    Attributes:
        best, second: the two best poses that differ by more than 10 deg or 0.05 of the extent; second may be None.
        found: the best pose explains enough of the scan.
        ambiguous: the second pose explains the scan as well, within the statistical error of these points.
        starts: number of starts.
    """

    best: Candidate
    second: Candidate | None
    found: bool
    ambiguous: bool
    starts: int


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    T_ca: Array  # (4, 4)
    cost: float

    @property
    def pose(self) -> Pose:
        return Pose.from_matrix(self.T_ca)


class GlobalSearch:
    """Searches the pose of one target. Built once; a search does not change it.

    The first round takes the origin of {A} as the camera position if the scan allows it
    (``Visibility.direction_to_camera``); the second does not.
    """

    def __init__(self, target: Target, params: AcquireParams) -> None:
        self._target, self._params = target, params
        self._extent = target.surface.extent
        self._points, self._normals = _sampled(target.surface)
        cloud = Surface(self._points, np.empty((0, 3), dtype=np.int32), target.surface.name, "")
        self._cloud = SurfaceIndex.build(cloud, REACH_OF_EXTENT * self._extent)
        self._sided = target.visibility.sided
        self._centroids = VisibleCentroids(self._points, self._normals, self._extent)
        self._middle = self._points.mean(axis=0)
        brief = replace(target.limits, n_max=min(FINE_PASSES, target.limits.n_max))
        self._refine = HornBackend(replace(target, limits=brief))
        self._settle = HornBackend(target)

    def search(self, points: NDArray[Any], first_round: int = 0, last_round: int = 2) -> SearchResult:
        """Return the best poses for a scan (n, 3) in {A} [m], finite, n >= 1.

        Round 0 assumes that the whole visible side is in the scan. Round 1 shifts the starts, for a target that is
        partly outside the scan or hidden. Round 2 does not assume the camera position. The first round that explains
        the scan ends the search.
        """
        scan = without_sparse_points(np.asarray(points, dtype=np.float64))
        p = self._params
        few, some, fine = (thin_to(scan, count) for count in (p.coarse_points, p.middle_points, p.fine_points))
        sight = self._target.visibility.direction_to_camera(scan)
        finals: list[Candidate] = []
        tried = 0
        for sights, shifts, sided in self._rounds(few, sight)[first_round : last_round + 1]:
            starts = list(self._starts(few.mean(axis=0), sights, shifts))
            finals += self._refined(fine, self._selected(few, some, starts, sided))
            tried += len(starts)
            if max((final.inlier_ratio for final in finals), default=0.0) >= p.enough_ratio:
                break
        return self._verdict(fine, finals, tried)

    def _rounds(self, few: Array, sight: Array | None) -> list[tuple[Sequence[Array | None], Array, bool]]:
        """Camera directions, shifts of the scan (k, 3) in {A} [m], and whether the directions can be relied on."""
        none = np.zeros((1, 3))
        axes = np.linalg.svd((few - few.mean(axis=0)) if sight is None else sight[None])[2]
        across = SHIFT_OF_EXTENT * self._extent * (axes[:2] if sight is None else axes[1:])
        known = sight is not None
        return [
            ([sight], none, known),
            ([sight], np.vstack([across, -across]), known),
            ([sight, *_axes(few)], none, False),
        ]

    def _starts(self, centroid_a: Array, sights: Sequence[Array | None], shifts: Array) -> Iterator[Pose]:
        """Every attitude with every camera direction and shift: centroid of the scan on that of the visible surface."""
        quaternions = attitudes(self._params.starts)
        for q, R_ca in zip(quaternions, geometry.matrix(quaternions), strict=True):
            for sight in sights:
                middle = self._middle if sight is None else self._centroids.of(R_ca @ sight)
                for shift in shifts:
                    yield Pose(q, middle - R_ca @ (centroid_a + shift))

    def _selected(self, few: Array, some: Array, starts: list[Pose], sided: bool) -> list[Pose]:
        """The best starts after passes with few points, then the best of these, all different, with more points."""
        p, extent = self._params, self._extent
        coarse = IcpParams(
            n_max=p.coarse_passes,
            n_plane=p.coarse_passes,
            floor_m=COARSE_OF_EXTENT * extent,
            eps_rad=1e-3,
            eps_m=1e-3 * extent,
        )
        middle = IcpParams(
            n_max=p.middle_passes,
            n_plane=p.middle_passes,
            gate_m=0.15 * extent,
            floor_m=0.01 * extent,
            eps_rad=1e-4,
            eps_m=1e-4 * extent,
        )
        trials = [self._trial(few, T_ca, coarse, COARSE_OF_EXTENT, sided) for T_ca in starts]
        best = sorted(trials, key=lambda trial: trial.cost)[: p.middle_starts]
        return self._different([self._trial(some, t.pose, middle, MIDDLE_OF_EXTENT, sided) for t in best])

    def _trial(self, points: Array, T_ca: Pose, rule: IcpParams, beyond: float, sided: bool) -> _Trial:
        end = self._cloud.icp(points, T_ca, rule).T_ca
        found = self._cloud.closest(points @ end[:3, :3].T + end[:3, 3])
        cost = np.minimum(found.d2 / (beyond * self._extent) ** 2, 1.0)
        if sided and self._sided:  # the sampled points keep the outward normal of their face
            away = np.einsum("ij,ij->i", self._normals[found.id], end[:3, 3] - self._points[found.id]) <= 0.0
            cost[away] = 1.0
        return _Trial(end, float(cost.mean()))

    def _different(self, trials: list[_Trial]) -> list[Pose]:
        """The best few that are different poses, best first."""
        kept: list[Pose] = []
        for trial in sorted(trials, key=lambda trial: trial.cost):
            pose = trial.pose
            if all(not self._same(pose, other, 0.5) for other in kept):
                kept.append(pose)
            if len(kept) == self._params.fine_starts:
                break
        return kept

    def _refined(self, fine: Array, poses: list[Pose]) -> list[Candidate]:
        return [self._measured(fine, self._refine.align(fine, T_ca).T_ca) for T_ca in poses]

    def _measured(self, points: Array, T_ca: Pose) -> Candidate:
        cost = self._unexplained(points, T_ca)
        return Candidate(T_ca, float(cost.mean()), float(np.mean(cost < 1.0)))

    def _unexplained(self, points: Array, T_ca: Pose) -> Array:
        """(n,) min(1, squared distance to the visible faces in units of the gate)."""
        target = self._target
        camera_c = target.visibility.camera_c(target.index, points, T_ca)
        found = target.index.closest(T_ca.apply(points), camera_c=camera_c)
        return np.minimum(found.d2 / target.limits.gate_m**2, 1.0)

    def _verdict(self, fine: Array, finals: list[Candidate], starts: int) -> SearchResult:
        ranked = sorted(finals, key=lambda final: final.unexplained)
        second = next((other for other in ranked[1:] if not self._same(ranked[0].T_ca, other.T_ca, 1.0)), None)
        rivals = [ranked[0], *([second] if second else [])]  # compared only after both have converged
        rivals = [self._measured(fine, self._settle.align(fine, rival.T_ca).T_ca) for rival in rivals]
        best, *rest = sorted(rivals, key=lambda rival: rival.unexplained)
        second = rest[0] if rest and not self._same(best.T_ca, rest[0].T_ca, 1.0) else None
        found = best.inlier_ratio >= self._params.least_ratio
        return SearchResult(best, second, found, second is not None and self._as_good(fine, best, second), starts)

    def _as_good(self, fine: Array, best: Candidate, second: Candidate) -> bool:
        """Test whether the excess cost of the second, point by point, is below 5 sigma of its mean or the margin."""
        excess = self._unexplained(fine, second.T_ca) - self._unexplained(fine, best.T_ca)
        error = SIGMAS * float(excess.std()) / np.sqrt(len(fine))
        return bool(excess.mean() < max(self._params.margin, error))

    def _same(self, first: Pose, other: Pose, scale: float) -> bool:
        step = first @ other.inverse()  # in {C}
        shift = float(np.linalg.norm(step.apply(self._middle) - self._middle))
        return float(geometry.angle(step.q)) < scale * SAME_RAD and shift < scale * SAME_OF_EXTENT * self._extent


class VisibleCentroids:
    """Centroid of the part of a model that a distant camera sees, tabulated for ``count`` directions."""

    def __init__(self, points: Array, normals: Array, extent_m: float, count: int = 200) -> None:
        """Build it from points sampled on the surface, (n, 3) in {C} [m]; zero normals: visible from all sides."""
        self._directions = directions(count)
        cell = CELL_OF_EXTENT * extent_m
        self._centroids = np.stack([_visible_centroid(points, normals, u, cell) for u in self._directions])

    def of(self, direction_c: Array) -> Array:
        """Return the centroid (3,) in {C} [m] for the direction to the camera in {C}."""
        centroid: Array = self._centroids[int(np.argmax(self._directions @ direction_c))]
        return centroid


def attitudes(count: int) -> Array:
    """Return (count, 4) unit quaternions [x y z w], uniform over all rotations: super-Fibonacci spiral (Alexa 2022)."""
    s = np.arange(count) + 0.5
    inner, outer = np.sqrt(s / count), np.sqrt(1.0 - s / count)
    a, b = 2.0 * np.pi * s / np.sqrt(2.0), 2.0 * np.pi * s / PSI
    return np.stack([inner * np.sin(a), inner * np.cos(a), outer * np.sin(b), outer * np.cos(b)], axis=1)


def directions(count: int) -> Array:
    """Return (count, 3) unit vectors, uniform over the sphere: Fibonacci spiral."""
    k = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + np.sqrt(5.0)) * k
    ring = np.sqrt(1.0 - z * z)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)


def _visible_centroid(points: Array, normals: Array, towards: Array, cell_m: float) -> Array:
    """Centroid over the image of the points that face the camera and are the nearest of their pixel, within a cell."""
    sided = normals.any()
    cosine = normals @ towards if sided else np.ones(len(points))
    facing = cosine > LEAST_COSINE
    p, weight, depth = points[facing], cosine[facing], points[facing] @ towards
    across = np.linalg.svd(towards[None])[2][1:]
    pixels = np.floor(p @ across.T / cell_m).astype(np.int64)
    _, pixel = np.unique(pixels, axis=0, return_inverse=True)
    nearest = np.full(pixel.max(initial=-1) + 1, -np.inf)
    np.maximum.at(nearest, pixel.reshape(-1), depth)
    weight = weight * (depth > nearest[pixel.reshape(-1)] - cell_m)
    if not weight.sum() > 0.0:
        return np.asarray(points.mean(axis=0))
    return np.asarray((p * weight[:, None]).sum(axis=0) / weight.sum())


def _axes(points: Array) -> list[Array]:
    """Both directions of each principal axis of a scan: one of them is near the direction to the camera."""
    axes = np.linalg.eigh(np.cov(points.T))[1].T if len(points) > 3 else np.eye(3)
    return [*axes, *-axes]


def _sampled(surface: Surface) -> tuple[Array, Array]:
    points, normals = sample(surface, MODEL_POINTS)
    if len(surface.faces):
        return points, normals
    thinned = thin_to(points, MODEL_POINTS)
    return thinned, np.zeros_like(thinned)
