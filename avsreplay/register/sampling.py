"""Points of a surface and parts of a scan: evenly distributed, on a surface, and such as may
be the target.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry, mesh
from avsreplay.geometry import Array, bounding_diagonal
from avsreplay.records import Surface
from avsreplay.register.surface_index import kernel_module

# factor: the points of a cloud are first thinned evenly to this many times the number needed
CLOUD_POINTS = 20
EVEN_ROUNDS = 10
EVEN_WITHIN = (0.85, 1.2)
STRAY_SHARE = 0.15
STRAY_VOXELS = 150
STRAY_POINTS = 10
R2 = np.array(
    [0.7548776662466927, 0.5698402909980532]
)  # plastic-number sequence: low discrepancy in the unit square
PSI = 1.533751168755204288118041  # positive root of psi^4 = psi + 4 (super-Fibonacci spirals)
# neighbour whose distance counts; points that show whether any are scattered
NEIGHBOUR = 8
TESTED = 200
# for the density of rays; no ray within so many spacings: nothing was measured
EMPTY = 2.5
SPACED = 125
# distance to neighbour NEIGHBOUR of a scattered point over that in the denser part, at least
SCATTERED = 2.0
DENSE_QUANTILE = 0.2  # the scan has at least this share of surface points
# ratio of the upper to the lower quartile of that distance in a scan with scattered points
BIMODAL = 2.5
ALONE_OF_EXTENT = 0.5  # distance to neighbour NEIGHBOUR of a point that is not on the target
SIGHT_POINTS = 1500  # of a scan, whose normals show the line of sight
NORMAL_NEIGHBOURS = 12  # points of a scan to which the plane at one of them is fitted
# a scan smaller than so many extents probably shows a part of the target, or it from a narrow side
PARTIAL_OF_EXTENT = 0.85
LARGER = 1.2  # a connected part larger than this many extents contains more than the target
GROUPED = 3000  # points of a scan in which connected groups are looked for
MOST_SEGMENTS = 3
MOST_ATTEMPTS = MOST_SEGMENTS + 3
VOXEL_OF_EXTENT = 0.04
# least size of a part: share of the scan, and points
LEAST_PART_SHARE = 0.05
LEAST_PART_POINTS = 60
PLANES_LEFT_OUT = 3
TRIALS = 200
RANSAC_POINTS = 400
PLANE_OF_EXTENT = 0.01
PLANE_SHARE = 0.2


def sample(surface: Surface, count: int) -> tuple[Array, Array]:
    """Return about ``count`` points, uniform by area, and their face normals, (n, 3) each.

    A point cloud is returned as it is, with zero normals.
    """
    if len(surface.faces) == 0:
        return np.array(surface.vertices), np.zeros_like(surface.vertices)
    return sample_faces(surface.vertices, surface.faces, count)[:2]


def sample_faces(
    vertices: Array, faces: NDArray[np.int32], count: int
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return ``count`` points of a mesh, uniform by area, the normals of their faces, (n, 3) each,
    and the faces (n,).

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3) vertex indices, m >= 1.
        count: number of points.
    """
    cross = mesh.normals(vertices, faces)
    twice_area = mesh.lengths(cross)
    edges = np.cumsum(twice_area)
    face = np.searchsorted(edges, (np.arange(count) + 0.5) * (edges[-1] / count), side="right")
    face = np.minimum(face, len(edges) - 1)
    u, v = ((np.arange(1, count + 1)[:, None] * R2) % 1.0).T
    fold = u + v > 1.0
    u, v = np.where(fold, 1.0 - u, u)[:, None], np.where(fold, 1.0 - v, v)[:, None]
    a, b, c = (vertices[faces[face, k]] for k in range(3))
    points = a + u * (b - a) + v * (c - a)
    return points, cross[face] / np.maximum(twice_area[face], np.finfo(float).tiny)[:, None], face


def sample_evenly(surface: Surface, count: int) -> tuple[Array, Array]:
    """Return about ``count`` points and normals as :func:`sample`; the points of a cloud are
    thinned to this number.
    """
    points, normals = sample(surface, count)
    if len(surface.faces):
        return points, normals
    thinned = thin_to(points[:: max(1, len(points) // (CLOUD_POINTS * count))], count)
    return thinned, np.zeros_like(thinned)


def attitudes(count: int) -> Array:
    """Return (count, 4) unit quaternions [x y z w], uniform over all rotations:
    super-Fibonacci spiral (Alexa 2022).
    """
    s = np.arange(count) + 0.5
    inner, outer = np.sqrt(s / count), np.sqrt(1.0 - s / count)
    a, b = 2.0 * np.pi * s / np.sqrt(2.0), 2.0 * np.pi * s / PSI
    return np.stack(
        [inner * np.sin(a), inner * np.cos(a), outer * np.sin(b), outer * np.cos(b)], axis=1
    )


def directions(count: int) -> Array:
    """Return (count, 3) unit vectors, uniform over the sphere: Fibonacci spiral."""
    k = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + np.sqrt(5.0)) * k
    ring = np.sqrt(1.0 - z * z)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)


def thin(points: Array, voxel_m: float) -> Array:
    """Return the first point of every occupied voxel of this size, in scan order. (n, 3) ->
    (k, 3).
    """
    if len(points) == 0:
        return points
    cells = np.floor(points / voxel_m).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    return points[np.sort(first)]


def usable_points(points: NDArray[Any], voxel_m: float) -> NDArray[Any]:
    """Return the points (n, 3) that are finite, thinned by voxels of this size where it is
    above 0.
    """
    known = np.isfinite(points)
    scan = points if known.all() else points[known.all(axis=1)]
    return thin(scan, voxel_m) if voxel_m > 0.0 else scan


def thin_to(points: Array, count: int) -> Array:
    """Return about ``count`` of the points: the first of every voxel, whose size is found
    iteratively.
    """
    if len(points) <= count:
        return points
    voxel = max(3.0 * _spread(points) / np.sqrt(count), np.finfo(float).tiny)
    for _ in range(EVEN_ROUNDS):
        first = _voxels(points, voxel)[0]
        if EVEN_WITHIN[0] * count <= len(first) <= EVEN_WITHIN[1] * count:
            break
        voxel *= float(np.clip(np.sqrt(len(first) / count), 0.5, 2.0))
    return points[first]


def without_sparse_points(points: Array) -> Array:
    """Return the points in voxels that hold at least 0.15 of the number that the median point has
    in its voxel.

    A single outlier far from everything would occupy a voxel of its own and, after thinning by
    voxels, weigh as much as a piece of surface. About 150 voxels cover the scan; a scan with fewer
    than ten points per voxel is not changed.
    """
    if len(points) < STRAY_VOXELS * STRAY_POINTS:
        return points
    _, voxel, counts = _voxels(points, 3.0 * _spread(points) / np.sqrt(STRAY_VOXELS))
    around = counts[voxel]
    return points[around >= max(2.0, STRAY_SHARE * float(np.median(around)))]


def _spread(points: Array) -> float:
    return float(np.sqrt(np.median(np.sum((points - np.median(points, axis=0)) ** 2, axis=1))))


def _voxels(
    points: Array, voxel_m: float
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """First point of every occupied voxel, the voxel of every point, and the number of points in
    each voxel.
    """
    found: tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]] = kernel_module().voxels(
        np.subtract(points, points.min(axis=0), dtype=np.float64),
        max(voxel_m, np.finfo(float).tiny),
    )
    return found


def at_instant(points: Array, times_s: NDArray[Any], rate: Array, velocity: Array) -> Array:
    """Return the points of a body that moves during its scan, moved to the instant of the scan.

    Args:
        points: (n, 3) in the body's frame at that instant [m].
        times_s: (n,) time of each point after the instant [s].
        rate: (3,) of the body in its own frame [rad/s].
        velocity: (3,) of the body's origin in its own frame [m/s].
    """
    times = np.asarray(times_s, dtype=np.float64)[:, None]
    back = geometry.matrix(geometry.exp(-times * rate))
    return np.asarray(np.einsum("nij,nj->ni", back, points - times * velocity))


def without_scattered_points(points: Array, extent_m: float) -> Array:
    """Return the points (k, 3) of a scan (n, 3) that may lie on a surface.

    A point whose eighth neighbour is half an extent away is not on the target: a few such points
    far away would move the centroid of the scan by more than the size of the target. If the scan
    has many outliers spread over a volume, those are left out too whose distance to the eighth
    neighbour is large compared with that on a surface.

    Args:
        points: (n, 3) [m].
        extent_m: of the model.
    """
    if len(points) < 10 * NEIGHBOUR:
        return points
    points = np.ascontiguousarray(points, dtype=np.float64)
    tree = kernel_module().PointTree(points)
    away = np.linalg.norm(points - np.median(points, axis=0), axis=1) > extent_m
    if away.any():
        kept = ~away
        kept[away] = (
            tree.query(points[away], k=NEIGHBOUR + 1)[0][:, -1] < ALONE_OF_EXTENT * extent_m
        )
        if 10 * NEIGHBOUR <= np.count_nonzero(kept) < len(points):
            points = np.ascontiguousarray(points[kept])
            tree = kernel_module().PointTree(points)
    few: Array = tree.query(points[:: max(1, len(points) // TESTED)].copy(), k=NEIGHBOUR + 1)[0][
        :, -1
    ]
    low, high = np.quantile(few, [0.25, 0.75])
    if high < BIMODAL * low:
        return points
    distance: Array = tree.query(points, k=NEIGHBOUR + 1)[0][:, -1]
    return points[distance < SCATTERED * float(np.quantile(distance, DENSE_QUANTILE))]


def scan_axes(points: Array) -> list[Array]:
    """Return both directions of each principal axis of points (n, 3); without axes, those of
    the frame.
    """
    axes = np.linalg.eigh(np.cov(points.T))[1].T if len(points) > 3 else np.eye(3)
    return [*axes, *-axes]


def fitted_normals(points: Array, full: Array) -> Array:
    """Return the unit normals (n, 3), up to their signs, of the planes through the nearest points.

    Args:
        points: (n, 3) [m].
        full: (m, 3) all points of the scan, m > ``NORMAL_NEIGHBOURS`` [m].
    """
    full, points = (np.ascontiguousarray(each, dtype=np.float64) for each in (full, points))
    tree = kernel_module().PointTree(full)
    return np.asarray(tree.planes(full, full, points, points, NORMAL_NEIGHBOURS)[0])


def line_of_sight(normals: Array) -> Array:
    """Return the unit direction (3,), up to its sign, from which surface with normals (n, 3) was
    probably measured.

    Rays of even density hit a face in proportion to the cosine between its normal and the direction
    to the sensor, so that the mean square of this cosine is largest along it.
    """
    return np.asarray(np.linalg.eigh(normals.T @ normals)[1][:, -1])


def attempts(
    target: Array, extent_m: float, found: Callable[[], bool]
) -> Iterator[tuple[Array, int]]:
    """Yield what is searched and by which round of the search: the whole scan, its parts, then with
    other starts.

    Args:
        target: (n, 3) the scan without scattered points.
        extent_m: of the model.
        found: whether the first round gave a plausible pose.
    """
    size = bounding_diagonal(target)
    first, next_one = (
        (1, 0) if size < PARTIAL_OF_EXTENT * extent_m else (0, 1)
    )  # a part of the target is not at its centroid
    yield target, first
    small = size <= LARGER * extent_m or found()  # probably the target alone
    if small:
        yield target, next_one
    for part in islice(segments(target, extent_m), MOST_SEGMENTS):
        yield part, 0
    if not small:
        yield target, next_one
    yield target, 2


def segments(points: Array, extent_m: float) -> Iterator[Array]:
    """Yield the parts of a scan (n, 3) that may be the target, the largest first; none if the scan
    is one such part.

    Connected parts of the scan; parts larger than the target are split by leaving out their largest
    planes. What is not part of anything larger comes first as a whole: the visible parts of one
    target need not touch each other.
    """
    least = max(LEAST_PART_POINTS, int(LEAST_PART_SHARE * len(points)))
    parts = sorted(_small_parts(points, extent_m, PLANES_LEFT_OUT), key=len, reverse=True)
    connected = [part for part in parts if len(part) >= STRAY_POINTS]
    if len(connected) > 1:
        together = np.concatenate(connected)
        if bounding_diagonal(together) <= LARGER * extent_m:
            parts.insert(0, together)
    for part in parts:
        if least <= len(part) < 0.95 * len(points):
            yield part


def _small_parts(points: Array, extent_m: float, planes: int) -> Iterator[Array]:
    for part in _connected(points, VOXEL_OF_EXTENT * extent_m):
        if bounding_diagonal(part) <= LARGER * extent_m:
            yield part
        elif planes:
            rest = _without_plane(part, PLANE_OF_EXTENT * extent_m)
            if len(rest) < len(part):
                yield from _small_parts(rest, extent_m, planes - 1)


def _connected(points: Array, voxel_m: float) -> Iterator[Array]:
    """Parts whose occupied voxels touch each other, at a corner at least."""
    if not len(points):
        return
    first, voxel, _ = _voxels(points, voxel_m)
    cells = np.floor((points[first] - points.min(axis=0)) * (1.0 / voxel_m))
    part = kernel_module().PointTree(cells).groups(1.8)[voxel]
    for k in range(int(part.max()) + 1):
        yield points[part == k]


def _without_plane(points: Array, width_m: float) -> Array:
    """The points off the plane that holds most of them; all if no plane holds ``PLANE_SHARE``.

    Seeded RANSAC.
    """
    rng = np.random.Generator(np.random.PCG64(0))
    few = points[:: max(1, len(points) // RANSAC_POINTS)]
    triples = few[rng.integers(len(few), size=(TRIALS, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    good = lengths > 0.0
    normals, anchors = normals[good] / lengths[good, None], triples[good, 0]
    if not len(normals):
        return points
    offsets = np.einsum("ij,ij->i", normals, anchors)
    counts = np.count_nonzero(np.abs(few @ normals.T - offsets) < width_m, axis=0)
    best = int(np.argmax(counts))
    if counts[best] < PLANE_SHARE * len(few):
        return points
    off: Array = points[np.abs(points @ normals[best] - offsets[best]) >= 2.0 * width_m]
    return off


def diameter(points: NDArray[Any], *, trimmed: bool = True) -> float:
    """Return the approximate largest distance between two points, found by two sweeps.

    Args:
        points: (n, 3) coordinates [m].
        trimmed: leave out the 2 % of the points that are farthest from the median.

    Returns:
        The distance [m]; 0 without points.
    """
    points = np.asarray(points, dtype=np.float64)
    if not len(points):
        return 0.0
    away = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    if trimmed:
        points = points[away <= np.quantile(away, 0.98)]
        away = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    first = points[np.argmax(away)]
    second = points[np.argmax(np.linalg.norm(points - first, axis=1))]
    return float(np.linalg.norm(points - second, axis=1).max())


def part_of_size(
    points: NDArray[Any], size_m: float, share: tuple[float, float], gap: float = 0.1
) -> Array | None:
    """Return the largest connected group of points with the size of the model.

    Args:
        points: (n, 3) [m]; about ``GROUPED`` of them are examined.
        size_m: diameter of the model [m].
        share: least and largest diameter of the group over ``size_m``.
        gap: largest distance over ``size_m`` between neighbours of one group.

    Returns:
        The points (k, 3) [m]; None if no group of at least ten points, and of 1 % of them, has the
        size.
    """
    few = np.array(points[:: max(len(points) // GROUPED, 1)], dtype=np.float64, order="C")
    member = kernel_module().PointTree(few).groups(gap * size_m)
    groups = [
        few[member == k] for k in np.flatnonzero(np.bincount(member) >= max(10, len(few) // 100))
    ]
    fitting = [
        group for group in groups if share[0] <= diameter(group, trimmed=False) / size_m <= share[1]
    ]
    return max(fitting, key=len, default=None)


class Rays:
    """The points (n, 3) of a scan in {A} [m] by their directions.

    Attributes:
        points: those that are finite and not at the sensor, whose directions are not known.
        ranges: (n,) [m].
    """

    def __init__(self, points: Array) -> None:
        """Take the points that have a direction; one at the sensor has none."""
        ranges = np.linalg.norm(points, axis=1)
        known = np.isfinite(ranges) & (ranges > 0.0)
        self.points: Array = points if (every := bool(known.all())) else points[known]
        self.ranges: Array = ranges if every else ranges[known]

    @cached_property
    def tree(self) -> Any:
        """Return the tree of the directions; None with too few."""
        directions = self.points / self.ranges[:, None]
        return kernel_module().PointTree(directions) if len(directions) > NEIGHBOUR else None

    @cached_property
    def spacing(self) -> float:
        """Return the angle between neighbouring rays [rad]; infinite with too few."""
        if self.tree is None:
            return np.inf
        stride = max(1, len(self.points) // SPACED)
        apart = self.tree.query(
            self.points[::stride] / self.ranges[::stride, None], k=NEIGHBOUR + 1
        )[0][:, -1]
        return float(np.median(apart) * np.sqrt(np.pi / NEIGHBOUR))
