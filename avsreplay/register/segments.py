"""Parts of a scan that may be the target: free of scattered points and of surfaces larger than the target."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from avsreplay.geometry import Array

NEIGHBOUR = 8
SCATTERED = 2.0  # distance to neighbour NEIGHBOUR of a scattered point over that in the denser part, at least
DENSE_QUANTILE = 0.2  # the scan has at least this share of surface points
BIMODAL = 2.5  # ratio of the upper to the lower quartile of that distance in a scan with scattered points
LARGER = 1.2  # a connected part larger than this many extents is not the target alone
VOXEL_OF_EXTENT = 0.04
LEAST_SHARE, LEAST_POINTS = 0.05, 60  # least size of a part: share of the scan, and points
PLANES, TRIALS, PLANE_OF_EXTENT, PLANE_SHARE = 3, 200, 0.01, 0.2


def without_scattered_points(points: Array) -> Array:
    """Return the points that lie on a surface, if the scan has many that do not; (n, 3) -> (k, 3).

    The distance to the eighth neighbour is small on a surface and large among outliers spread over a volume.
    """
    from scipy.spatial import cKDTree

    if len(points) < 10 * NEIGHBOUR:
        return points
    distance = np.asarray(cKDTree(points).query(points, k=NEIGHBOUR + 1)[0])[:, -1]
    low, high = np.quantile(distance, [0.25, 0.75])
    if high < BIMODAL * low:
        return points
    return points[distance < SCATTERED * float(np.quantile(distance, DENSE_QUANTILE))]


def segments(points: Array, extent_m: float) -> Iterator[Array]:
    """Yield the parts of a scan (n, 3) that may be the target, the largest first; none if the scan is one such part.

    Connected parts of the scan; parts larger than the target are split by leaving out their largest planes.
    """
    least = max(LEAST_POINTS, int(LEAST_SHARE * len(points)))
    parts = list(_small_parts(points, extent_m, least, PLANES))
    for part in sorted(parts, key=len, reverse=True):
        if len(part) < 0.95 * len(points):
            yield part


def _small_parts(points: Array, extent_m: float, least: int, planes: int) -> Iterator[Array]:
    for part in _connected(points, VOXEL_OF_EXTENT * extent_m):
        if len(part) < least:
            continue
        if float(np.linalg.norm(np.ptp(part, axis=0))) <= LARGER * extent_m:
            yield part
        elif planes:
            rest = _without_plane(part, PLANE_OF_EXTENT * extent_m)
            if len(rest) < len(part):
                yield from _small_parts(rest, extent_m, least, planes - 1)


def _connected(points: Array, voxel_m: float) -> Iterator[Array]:
    """Parts whose occupied voxels touch each other, at a corner at least."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    if not len(points):
        return
    cells, voxel = np.unique(np.floor(points / voxel_m).astype(np.int64), axis=0, return_inverse=True)
    pairs = cKDTree(cells.astype(np.float64)).query_pairs(1.8, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
    count, label = connected_components(graph, directed=False)
    part = label[voxel.reshape(-1)]
    for k in range(count):
        yield points[part == k]


def _without_plane(points: Array, width_m: float) -> Array:
    """The points off the plane that holds most of them; all if no plane holds ``PLANE_SHARE``. Seeded RANSAC."""
    rng = np.random.Generator(np.random.PCG64(0))
    few = points[:: max(1, len(points) // 1000)]
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
