"""Tests that a registered pose must pass before it is called aligned, beyond the inlier ratio.

A pose can be wrong and still have many inliers: in a local minimum, among outliers, on a wall. Four quantities
separate such poses from correct ones. They do not use the guess, so they also hold after a global search.

Noise
    Robust standard deviation of the distances to the model, from their smaller quantiles: correct for up to 60 % of
    outliers. A wrong pose spreads the distances.
Contrast
    Points within three standard deviations of the surface over points within the next three. Outliers alone, or a
    surface that crosses the model, give a ratio near one.
Free-space violation
    Share of the model surface that should be visible, but through which the rays of the scan passed: the points
    measured in that direction lie behind it. Applied only where the camera position is known
    (``Visibility.camera_c``).
Missing surface
    Share of that surface in free space or in a direction without any point. A pose is rejected for it only if a part of
    the scan is also not on the model, because the field of view may end there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.records import Alignment, AlignStatus, Surface
from avsreplay.register.quality import Visibility, not_measured
from avsreplay.register.sampling import sample
from avsreplay.register.surface_index import SurfaceIndex

SURFACE_POINTS = 1500
LEVELS = np.array([0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9])  # quantiles of |distance|
NORMAL_QUANTILES = np.array([0.38532, 0.52440, 0.67449, 0.84162, 1.03643, 1.28155, 1.64485])  # for a standard normal
REFINEMENTS = 2
NOISE_OF_EXTENT = 0.012  # with more noise than this no pose is accepted
LEAST_CONTRAST, LEAST_CONTRAST_OF_PART = 6.0, 15.0  # the second if more than MOST_MISSING of the points are off
MOST_VIOLATED = 0.15  # largest violated share of the surface that is either supported or violated
MOST_MISSING = 0.1  # largest missing share, if at least as large a share of the scan is not on the model
LEAST_SCAN_OF_EXTENT = 0.05  # a smaller scan is about as large as the rejection distance, and any face explains it
SIZED_POINTS = 200  # points of the scan that nearly always suffice to show that it is larger
LEAST_COMPARED = 30  # with fewer surface points the test has no power
LEAST_COSINE = 0.25  # a surface point is expected in the scan if the cosine of its incidence is larger
HIDDEN_OF_EXTENT = 0.05  # a surface point this much behind the nearest of its cell is hidden
POINTS_PER_CELL = 8.0
GRID = 4096


@dataclass(frozen=True, slots=True)
class Plausibility:
    """What the tests found at a pose.

    Attributes:
        noise_m: robust standard deviation of the distances to the model [m].
        contrast: points within 3 noise_m over points between 3 and 6 noise_m.
        violated: share of the model surface that lies in free space; 0 if the camera position is unknown.
        missing: share that lies in free space or where the scan has no point; 0 if the camera position is unknown.
        covered: enough of the model surface was compared, and little of it is missing.
        unexplained: share of the points that are not on the model.
        reason: why the pose is rejected, "" if it is plausible.
    """

    noise_m: float
    contrast: float
    violated: float
    missing: float
    covered: bool
    unexplained: float
    reason: str


class PlausibilityTest:
    """The tests for one surface."""

    def __init__(self, surface: Surface, index: SurfaceIndex, visibility: Visibility, gate_m: float) -> None:
        self._index, self._visibility, self._gate, self._extent = index, visibility, gate_m, surface.extent
        # distances to a cloud contain the spacing of its points, which has a longer tail than noise
        self._contrast_of_part = LEAST_CONTRAST_OF_PART if len(surface.faces) else LEAST_CONTRAST
        self._points, self._normals = sample(surface, SURFACE_POINTS)
        self._points = self._points[:: max(1, len(self._points) // SURFACE_POINTS)]
        self._normals = self._normals[: len(self._points)]

    def refused(self, scan: NDArray[Any], points: int, guess: Pose | None = None) -> Alignment | None:
        """Return the alignment of a scan that is not registered at all; None for others.

        Args:
            scan: (n, 3) finite points in {A} [m].
            points: of the scan, also those that are not finite.
            guess: T_ac.

        Returns:
            NO_POINTS; or IMPLAUSIBLE for a scan so much smaller than the model that any of its faces would explain it.
        """
        if len(scan) == 0:
            return not_measured(points, AlignStatus.NO_POINTS, guess)
        least = LEAST_SCAN_OF_EXTENT * self._extent
        if geometry.bounding_diagonal(scan[:: max(1, len(scan) // SIZED_POINTS)]) >= least:
            return None
        size = geometry.bounding_diagonal(scan)
        if size >= least:
            return None
        text = f"the scan measures {size:.3g} m, the model {self._extent:.3g} m: is --model-unit right?"
        return replace(not_measured(points, AlignStatus.IMPLAUSIBLE, guess), message=text)

    def check(self, points: NDArray[Any], T_ca: Pose, scene: NDArray[Any] | None = None) -> Plausibility:
        """Test the pose.

        Args:
            points: (n, 3) in {A} [m], n >= 1: the scan, or the part of it that may be the target; a few thousand points
                are enough.
            T_ca: the pose to be tested.
            scene: (m, 3) in {A} [m], the whole scan, for contrast and free space; ``points`` if None.

        Returns:
            The quantities and the reason of a rejection.
        """
        camera_c = self._visibility.camera_c(self._index, points, T_ca)
        distance = self.measure(points, T_ca)
        noise = robust_noise(distance)
        width = max(self._gate, 3.0 * noise)
        inner = int(np.count_nonzero(distance < width))
        around = distance if scene is None else self.measure(scene, T_ca)
        on, near = (int(np.count_nonzero(around < factor * width)) for factor in (1.0, 2.0))
        contrast = on / max(1, near - on)
        rays = np.asarray(points if scene is None else scene, dtype=np.float64)
        free = None if camera_c is None else self._not_supported(rays, T_ca, noise)
        violated, missing = free or (0.0, 0.0)
        covered = free is not None and missing <= MOST_MISSING
        found = Plausibility(noise, contrast, violated, missing, covered, 1.0 - inner / len(points), "")
        return replace(found, reason=self._reason(found))

    def measure(self, points: NDArray[Any], T_ca: Pose) -> Array:
        """Return the distances (n,) [m] of points (n, 3) in {A} to the visible faces, at most the reach."""
        camera_c = self._visibility.camera_c(self._index, points, T_ca)
        d2 = self._index.closest(T_ca.apply(points), camera_c=camera_c).d2
        return np.asarray(np.sqrt(np.minimum(d2, self._index.reach_m**2)))

    def _reason(self, found: Plausibility) -> str:
        if found.noise_m > NOISE_OF_EXTENT * self._extent:
            return f"distances to the model spread by {found.noise_m:.3g} m"
        if found.contrast < (self._contrast_of_part if found.unexplained > MOST_MISSING else LEAST_CONTRAST):
            return f"only {found.contrast:.1f} times as many points on the surface as beside it"
        if found.violated > MOST_VIOLATED:
            return f"{100.0 * found.violated:.0f} % of the visible model surface lies in free space"
        if min(found.missing, found.unexplained) > MOST_MISSING:
            off, missing = 100.0 * found.unexplained, 100.0 * found.missing
            return (
                f"{off:.0f} % of the points are not on the model and {missing:.0f} % of its surface is not in the scan"
            )
        return ""

    def _not_supported(self, points: Array, T_ca: Pose, noise: float) -> tuple[float, float] | None:
        """Shares of the visible surface that rays passed through, and missing; None with too few points to compare."""
        from scipy.spatial import cKDTree

        T_ac = T_ca.inverse()
        image = _Image(points)
        surface, normals = T_ac.apply(self._points), self._normals @ T_ac.R.T
        cells, expected = self._expected(image, surface, normals)
        if not len(expected):
            return None
        tree = cKDTree(points)
        spacing = float(np.median(np.asarray(tree.query(points[:: max(1, len(points) // 500)], k=2)[0])[:, -1]))
        near = max(self._gate, 3.0 * noise, 3.0 * spacing)
        supported = np.asarray(tree.query(surface[expected])[0]) < near
        missing = expected[~supported]
        limits = np.linalg.norm(surface[missing], axis=1) + 2.0 * near
        behind, empty = image.share_behind(cells, cells.of(surface[missing]), limits)
        held, violated = int(np.count_nonzero(supported)), int(np.count_nonzero(behind >= 0.5))
        absent = violated + int(np.count_nonzero(empty))
        if held + violated < LEAST_COMPARED:
            return None
        return violated / (held + violated), absent / (held + absent)

    def _expected(self, image: _Image, surface: Array, normals: Array) -> tuple[_Cells, NDArray[np.intp]]:
        """The cells of the image, and the surface points (in {A}) that the camera should see."""
        ranges = np.linalg.norm(surface, axis=1)
        cosine = -np.einsum("ij,ij->i", normals, surface) / ranges
        facing = np.flatnonzero((cosine > 0.02) & image.in_front(surface))
        cells = _Cells(image, surface[facing])
        _, cell = np.unique(cells.of(surface[facing]), return_inverse=True)
        nearest = np.full(cell.max(initial=-1) + 1, np.inf)
        np.minimum.at(nearest, cell.reshape(-1), ranges[facing])
        visible = ranges[facing] < nearest[cell.reshape(-1)] + HIDDEN_OF_EXTENT * self._extent
        return cells, facing[visible & (cosine[facing] > LEAST_COSINE)]


class _Image:
    """The scan as seen from the origin of {A}: tangent plane about the direction of its median."""

    def __init__(self, points: Array) -> None:
        towards = np.median(points, axis=0)
        towards /= np.linalg.norm(towards)
        self._axes = np.vstack([np.linalg.svd(towards[None])[2][1:], towards])
        self._points = points[self.in_front(points)]

    def in_front(self, points: Array) -> NDArray[np.bool_]:
        """Return which points are within 70 deg of the viewing direction."""
        return np.asarray(points @ self._axes[2] > 0.34 * np.linalg.norm(points, axis=1))

    def plane(self, points: Array) -> Array:
        """Coordinates (n, 2) in the tangent plane."""
        turned = points @ self._axes.T
        return np.asarray(turned[:, :2] / turned[:, 2:])

    def share_behind(self, cells: _Cells, wanted: NDArray[np.int64], limits: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Share of the scan points in each wanted cell whose range exceeds the limit, and which cells have no point."""
        codes, ranges = cells.of(self._points), np.linalg.norm(self._points, axis=1)
        order = np.argsort(codes, kind="stable")
        codes, ranges = codes[order], ranges[order]
        first, last = np.searchsorted(codes, wanted), np.searchsorted(codes, wanted, side="right")
        counts = last - first
        which = np.repeat(np.arange(len(wanted)), counts)
        member = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(first, counts)
        behind = np.bincount(which, ranges[member] > limits[which], len(wanted))
        return np.asarray(behind / np.maximum(counts, 1)), counts == 0


class _Cells:
    """Square cells of an image with about ``POINTS_PER_CELL`` of the given points each."""

    def __init__(self, image: _Image, points: Array) -> None:
        plane = image.plane(points) if len(points) else np.zeros((1, 2))
        area = float(np.prod(np.maximum(np.ptp(plane, axis=0), 1e-9)))
        self._size = max(np.sqrt(area * POINTS_PER_CELL / len(plane)), 1e-9)
        self._low, self._image = plane.min(axis=0), image

    def of(self, points: Array) -> NDArray[np.int64]:
        """Number of the cell of each point; all cells outside the image share the border."""
        k = np.floor((self._image.plane(points) - self._low) / self._size) + 1.0
        k = np.clip(k, 0.0, GRID - 1.0).astype(np.int64)
        return np.asarray(k[:, 0] * GRID + k[:, 1])


def robust_noise(distance: Array) -> float:
    """Return the standard deviation of a normal error with magnitudes ``distance`` (n,), outliers among them.

    The first estimate is the least of those from the 30 % to the 90 % quantile; outliers only raise them, by a factor
    of three if they are 60 %. The result uses the median of the magnitudes within three standard deviations.
    """
    ordered = np.sort(distance)
    noise = float(np.min(np.interp(LEVELS * (len(ordered) - 1), np.arange(len(ordered)), ordered) / NORMAL_QUANTILES))
    for _ in range(REFINEMENTS):
        if near := int(np.searchsorted(ordered, 3.0 * noise)):
            middle = 0.5 * float(ordered[(near - 1) // 2] + ordered[near // 2])
            noise = min(noise, middle / NORMAL_QUANTILES[2])
    return noise
