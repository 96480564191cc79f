"""Scans as the reconstruction uses them: thinned, with normals, weights and the camera."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.geometry import Array, Pose
from avsreplay.records import Scan
from avsreplay.register.sampling import at_instant, fitted_normals, line_of_sight
from avsreplay.register.surface_index import kernel_module

SURVEYED_SCANS = 24  # most scans from which extent and position of the camera are determined
# a point is isolated if its fourth neighbour is farther than this many times the median
ISOLATED_DISTANCE_RATIO = 4.0
# points closer than this many times the typical distance of the fourth neighbour belong together
LINK_DISTANCE_RATIO = 2.0
SMALL_GROUP_SHARE = 0.02  # a group with a smaller share of the points does not count for the extent
SIDES = np.array(
    [0.61, 0.53, 0.59]
)  # the two sides of a thin wall have normals of opposite sign along this direction
# a scan whose centroid is farther than this from the origin of {A} was taken from the origin
ORIGIN_DISTANCE_OF_EXTENT = 0.6


@value_class
class ScanView:
    """A scan thinned for registration.

    Attributes:
        t_ns: instant.
        camera: (3,) position of the camera in {A} [m].
        points: (n, 3) thinned points in {A} [m].
        normals: (n, 3) unit normals toward the camera.
        weight: (n,) cosine of the inclination to the line of sight: grazing points are the least
            accurate.
        tree: ``PointTree`` over the points.
        rays: over the directions from the camera to the points.
    """

    t_ns: int
    camera: Array
    points: Array
    normals: Array
    weight: Array
    tree: Any
    rays: Any


@value_class
class Survey:
    """Result of one pass over a log.

    Attributes:
        chosen: positions in the log of the scans that are used.
        offered: number of scans in the log.
        extent: typical diagonal of the box around the target in one scan [m].
        camera: (3,) position of the camera in {A} [m].
        timed: the points of the scans have times of their own.
    """

    chosen: tuple[int, ...]
    offered: int
    extent: float
    camera: Array
    timed: bool


@value_class
class Twist:
    """Motion of the target during a scan: pose at the stamp, rate w_c (3,) [rad/s], velocity
    v_a (3,) [m/s] of {C}.
    """

    T_ac: Pose
    w_c: Array
    v_a: Array


def surveyed(scans: Callable[[], Iterable[Scan]], fewest_points: int, n_scans: int) -> Survey:
    """Read all scans once; at most SURVEYED_SCANS of them are in memory at a time.

    Args:
        scans: gives the scans of the log from its begin each time it is called.
        fewest_points: scans with fewer points are not used.
        n_scans: most scans that are used; more are thinned evenly.
    """
    usable: list[int] = []
    kept: list[Scan] = []
    stride, offered = 1, 0
    for scan in scans():
        offered += 1
        if len(scan.points) < fewest_points:
            continue
        if len(usable) % stride == 0:
            kept.append(scan)
        if len(kept) > SURVEYED_SCANS:
            kept, stride = kept[::2], 2 * stride
        usable.append(offered - 1)
    chosen = tuple(usable[:: max(1, -(-len(usable) // n_scans))])
    if not kept:
        return Survey(chosen, offered, 0.0, np.zeros(3), False)
    clouds = [_connected(np.asarray(scan.points, dtype=np.float64)) for scan in kept]
    extent = float(
        np.median([extent_of(points[:: max(1, len(points) // 3000)]) for points in clouds])
    )
    return Survey(
        chosen, offered, extent, _camera(clouds), any(scan.times_s is not None for scan in kept)
    )


def surveyed_scans(scans: Callable[[], Iterable[Scan]], survey: Survey) -> Iterator[Scan]:
    """The scans that are used, in order.

    Args:
        scans: gives all scans of the log anew.
        survey: which of them are used.
    """
    chosen = frozenset(survey.chosen)
    return (scan for place, scan in enumerate(scans()) if place in chosen)


def full_cloud(scan: Scan, twist: Twist | None) -> Array:
    """All points (n, 3) in {A} [m] of a scan without isolated ones, as if measured at its stamp.

    Args:
        scan: the scan.
        twist: motion of the target during it; None for a target at rest.
    """
    points = np.asarray(scan.points, dtype=np.float64)
    return _connected(
        points if twist is None or scan.times_s is None else _deskewed(points, scan.times_s, twist)
    )


def camera_of(scan: Scan, survey: Survey) -> Array:
    """Return the position (3,) of the camera in {A} [m] at a scan: of the sensor, or as the
    survey found it.
    """
    return survey.camera if scan.sensor is None else scan.sensor.t


def thinned_view(scan: Scan, survey: Survey, size_m: float, twist: Twist | None = None) -> ScanView:
    """A scan thinned to voxels of the given size, with normals and weights.

    Args:
        scan: as read.
        survey: of the log.
        size_m: edge of the voxels [m].
        twist: motion of the target during the scan; None does not correct for it.
    """
    full = full_cloud(scan, twist)
    points = central_points(full, size_m)
    camera = camera_of(scan, survey)
    points = points[
        np.linalg.norm(camera - points, axis=1) > 0.0
    ]  # the sensor itself has no direction
    normals, lines = normals_of(points, full, camera), camera - points
    weight = np.einsum("ni,ni->n", normals, lines) / np.linalg.norm(lines, axis=1)
    rays = -lines / np.linalg.norm(lines, axis=1, keepdims=True)
    return ScanView(
        scan.t_ns, camera, points, normals, weight, point_tree(points), point_tree(rays)
    )


def point_tree(points: Array) -> Any:
    """The search tree ``PointTree`` of the extension over points (n, 3)."""
    return kernel_module().PointTree(np.ascontiguousarray(points, dtype=np.float64))


def spacings(tree: Any, points: Array) -> Array:
    """Distance of each point (n, 3) of a tree to its fourth neighbour (n,) [m].

    Args:
        tree: k-d tree of the points.
        points: (n, 3) [m].
    """
    return np.asarray(tree.query(points, k=5)[0][:, 4])


def _deskewed(points: Array, times_s: NDArray[Any], twist: Twist) -> Array:
    """Points (n, 3) in {A} moved to the stamp: p(0) = T_ac(0) T_ac(t)^-1 p(t), with constant
    rate and velocity.
    """
    p_c = (points - twist.T_ac.t) @ twist.T_ac.R
    return np.asarray(
        twist.T_ac.apply(at_instant(p_c, times_s, twist.w_c, twist.v_a @ twist.T_ac.R))
    )


def _connected(points: Array) -> Array:
    """The points without isolated ones: the fourth neighbour is farther away than
    ISOLATED_DISTANCE_RATIO times the median.
    """
    distance = spacings(point_tree(points), points)
    return np.asarray(points[distance < ISOLATED_DISTANCE_RATIO * np.median(distance)])


def extent_of(points: Array) -> float:
    """Return the diagonal [m] of the box around a target, from one scan of it that may contain
    scattered outliers.

    Points are grouped where they lie closer together than LINK_DISTANCE_RATIO times the typical
    spacing; groups of less than SMALL_GROUP_SHARE of all points are left out. A box around all
    points would grow to the range limits of the scanner.
    """
    tree = point_tree(points)
    group = tree.groups(LINK_DISTANCE_RATIO * max(float(np.median(spacings(tree, points))), 1e-9))
    large = np.bincount(group)[group] >= SMALL_GROUP_SHARE * len(points)
    return geometry.bounding_diagonal(points[large] if large.any() else points)


def _camera(clouds: Sequence[Array]) -> Array:
    """Position of the camera in {A} [m]: the origin, unless the scans surround it or lie close to
    it.

    Scans that were moved toward the origin do not show where the camera was, only that it is the
    same place for all of them. It is then taken as far away along one line of sight, at the end
    from which the surfaces are convex on average, because it sees the outside of the target.
    """
    extents = [extent_of(points) for points in clouds]
    distances = [float(np.linalg.norm(points.mean(axis=0))) for points in clouds]
    if np.median(distances) > ORIGIN_DISTANCE_OF_EXTENT * np.median(extents):
        return np.zeros(3)
    sides = []
    for points, extent in zip(clouds, extents, strict=True):
        thin = central_points(points, extent / 40.0)
        sides.append((thin - points.mean(axis=0), fitted_normals(thin, points)))
    towards = line_of_sight(np.concatenate([normals for _, normals in sides]))
    bulge = sum(float(np.einsum("ni,ni->", n * np.sign(n @ towards)[:, None], p)) for p, n in sides)
    return np.asarray(np.copysign(100.0 * max(extents), bulge) * towards)


def central_points(points: Array, size_m: float) -> Array:
    """The point nearest to the mean of each voxel: a measured point, because a mean lies
    inside a curved surface.

    Args:
        points: (n, 3) [m].
        size_m: edge of a voxel [m].
    """
    cell = cell_of(points, size_m)
    off = np.linalg.norm(points - means(points, cell)[cell], axis=1)
    order = np.lexsort((np.arange(len(points)), off, cell))
    first = np.flatnonzero(np.diff(cell[order], prepend=-1))
    return np.asarray(points[order[first]])


def cell_of(points: Array, size_m: float, normals: Array | None = None) -> NDArray[np.intp]:
    """Number (n,) of the occupied voxel of every point; with normals the two sides of a thin
    wall are distinguished.

    Args:
        points: (n, 3) [m].
        size_m: edge of a voxel [m].
        normals: unit normals (n, 3).
    """
    place = np.floor(points / size_m).astype(np.int64)
    place -= place.min(axis=0)
    x, y, z = place.T
    width = place.max(axis=0) + 1
    side = (
        np.zeros(len(points), dtype=np.int64)
        if normals is None
        else (normals @ SIDES > 0.0).astype(np.int64)
    )
    return np.asarray(
        np.unique(((x * width[1] + y) * width[2] + z) * 2 + side, return_inverse=True)[1].ravel()
    )


def means(values: Array, cell: NDArray[np.intp]) -> Array:
    """Mean (m, k) of the rows of ``values`` (n, k) that share a cell."""
    count = np.bincount(cell)
    return np.stack([np.bincount(cell, column) / count for column in values.T], axis=1)


def averaged(points: Array, normals: Array, size_m: float) -> tuple[Array, Array, NDArray[np.intp]]:
    """Return mean points and unit normals (m, 3) of the voxels, and the voxel (n,) of every point.

    The two sides of a thin wall, which have opposite normals, are averaged separately.

    Args:
        points: (n, 3) [m].
        normals: unit normals (n, 3).
        size_m: edge of a voxel [m].
    """
    cell = cell_of(points, size_m, normals)
    mean, normal = means(points, cell), means(normals, cell)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return mean, normal, cell


def normals_of(points: Array, full: Array, camera: Array) -> Array:
    """Unit normals (n, 3) toward the camera: smallest principal direction of the nearest
    points of the whole scan.

    Args:
        points: (n, 3) in {A} [m].
        full: all points (m, 3) of the scan in {A} [m].
        camera: position (3,) of the camera in {A} [m].
    """
    normals = fitted_normals(points, full)
    away = np.einsum("ni,ni->n", normals, points - camera) > 0.0
    normals[away] *= -1.0
    return normals


def sight_lines(views: Sequence[ScanView], T_ca: Sequence[Pose]) -> Array:
    """(n, 3) unit vectors in {C} from the scanned surface to the camera.

    Args:
        views: the views, in order of time.
        T_ca: pose of {A} in {C} at each view.
    """
    lines = [T.R @ (v.camera - v.points.mean(axis=0)) for v, T in zip(views, T_ca, strict=True)]
    return np.array([line / np.linalg.norm(line) for line in lines])


def turn(a: Pose, b: Pose) -> float:
    """Angle between two attitudes [rad]."""
    return float(geometry.angle_between(a.q, b.q))


def depth_behind(
    p: Array, measured: Array, camera: Array, spacing_m: float, tree: Any = None
) -> Array:
    """How far the surface that was measured in the direction of each point p lies behind it [m]; 0
    where none was.

    ``tree`` is that over the directions of the measured points, if it is known.

    Args:
        p: points (m, 3) [m].
        measured: measured points (n, 3) [m].
        camera: position (3,) of the camera [m].
        spacing_m: distance between two directions that are the same, at the points [m].
        tree: k-d tree of the directions of the measured points, if it is known.
    """
    if not len(p):
        return np.zeros(0)
    rays, own = measured - camera, p - camera
    far, r = np.linalg.norm(rays, axis=1), np.linalg.norm(own, axis=1)
    tree = tree or point_tree(
        rays / np.maximum(far, 1e-300)[:, None]
    )  # a point at the camera has no direction
    d, index = tree.query(own / r[:, None], k=3, most_m=spacing_m / r.min())
    hit = d[:, 2] < spacing_m / r
    return np.where(hit, far[np.where(hit[:, None], index, 0)].min(axis=1) - r, 0.0)
