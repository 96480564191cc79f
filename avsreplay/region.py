"""A region that moves with the target: ground, walls and neighbours are removed around it.

A target that approaches from ten times its size to half of it cannot be kept by a fixed crop. The
region begins at a given point. It follows the points of the target from scan to scan with a locally
constant velocity, and an accepted pose replaces this where there is one. From the points around it
are removed, in this order: planes that continue beyond the size of the target (ground, walls),
parts that are not connected with it, and, where its pose is known, what is outside its box.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.geometry import Array, Pose

# radius in which planes are searched, over the diagonal of the model
_PLANE_RADIUS_OF_DIAGONAL = 1.5
# radius in which the target is searched: its centre may be anywhere on it
_TARGET_RADIUS_OF_DIAGONAL = 1.0
_BOX_MARGIN_OF_DIAGONAL = 0.1  # around the box of a known pose, over the diagonal
# distance of the middle of a part from that of the target, over the diagonal
_PART_DISTANCE_OF_DIAGONAL = 0.3
_CELL_OF_DIAGONAL = 0.065  # points nearer than about this, over the diagonal, are connected
_SPACING_POINTS = 300  # points whose spacing is measured
_CELL_SPACINGS = 2.0  # size of a cell over the median spacing
_PLANE_HALF_OF_DIAGONAL = 0.03  # half the thickness of a plane, over the diagonal
_MAX_PLANES = 3  # that are removed
_PLANE_TRIPLES = 128  # tries for each plane
_PLANE_SEED = 7  # of the random triples
_LEAST_PLANE_SHARE = 0.15  # least share of the points around that a plane has
_LEAST_BEYOND_SHARE = 0.35  # least share of its points outside of the target's reach: it continues
_LEAST_TARGET_POINTS = 8  # fewest points that are a target
_POSITION_GAIN = 0.6  # of the follower
_VELOCITY_GAIN = 0.2  # of the follower


@value_class
class Followed:
    """The motion of the points of the target from scan to scan.

    Attributes:
        t_ns: instant of the last scan in which its points were found [ns].
        centre: (3,) mean of its points in {A} [m].
        velocity: (3,) velocity of this mean in {A} [m/s].
        scans: number of scans in which its points were found.
    """

    t_ns: int
    centre: Array
    velocity: Array
    scans: int = 0


@value_class
class Region:
    """The region of one target.

    Attributes:
        start: (3,) a point on the target at the first scan, in {A} [m].
        low: (3,) corner of the model's box in {C} [m].
        high: (3,) the opposite corner.
    """

    start: Array
    low: Array
    high: Array

    @property
    def extent_m(self) -> float:
        """Diagonal of the model's box [m]."""
        return float(np.linalg.norm(self.high - self.low))

    def cut(
        self, points: NDArray[Any], t_ns: int, before: Followed | None, pose: Pose | None
    ) -> tuple[NDArray[np.bool_], Followed]:
        """Return which points of a scan are kept, and where the target is followed to.

        Args:
            points: (n, 3) in {A} [m].
            t_ns: instant of the scan.
            before: as returned for the last scan; None: this is the first one.
            pose: T_ac as predicted from accepted poses, None where none is known.
        """
        at = before or Followed(t_ns, self.start, np.zeros(3))
        dt = (t_ns - at.t_ns) * 1e-9
        centre = at.centre + dt * at.velocity
        p = points.astype(np.float64)
        away = np.linalg.norm(p - centre, axis=1)
        wide = np.flatnonzero(away < _PLANE_RADIUS_OF_DIAGONAL * self.extent_m)
        near = wide[~_on_planes(p[wide], away[wide], self.extent_m)]
        near = near[away[near] < _TARGET_RADIUS_OF_DIAGONAL * self.extent_m]
        on_target = _connected(
            p[near] - centre,
            _CELL_OF_DIAGONAL * self.extent_m,
            _PART_DISTANCE_OF_DIAGONAL * self.extent_m,
        )
        chosen = near[on_target]
        if pose is not None:
            local = pose.inverse().apply(p[near])
            margin = _BOX_MARGIN_OF_DIAGONAL * self.extent_m
            inside = ((local > self.low - margin) & (local < self.high + margin)).all(axis=1)
            if 2 * np.count_nonzero(inside) > len(chosen):  # else the prediction is not used
                chosen = near[inside]
        kept = np.zeros(len(points), bool)
        if len(chosen) < _LEAST_TARGET_POINTS:
            return kept, at
        kept[chosen] = True
        seen = p[chosen].mean(axis=0)
        gain, rate_gain = (max(g, 1.0 / max(at.scans, 1)) for g in (_POSITION_GAIN, _VELOCITY_GAIN))
        off = seen - centre
        velocity = at.velocity + rate_gain * off / dt if at.scans and dt > 0.0 else at.velocity
        return kept, Followed(t_ns, centre + gain * off, velocity, at.scans + 1)


def _on_planes(p: Array, away: Array, extent: float) -> NDArray[np.bool_]:
    """Which points (n, 3) are on planes that continue beyond the target.

    Args:
        p: the points [m].
        away: (n,) their distance from the centre of the target [m].
        extent: size of the target [m].
    """
    out, rng = np.zeros(len(p), bool), np.random.Generator(np.random.PCG64(_PLANE_SEED))
    for _ in range(_MAX_PLANES):
        left = np.flatnonzero(~out)
        if len(left) < 3 * _LEAST_TARGET_POINTS:
            break
        on = left[_best_plane(p[left], extent, rng)]
        beyond = np.count_nonzero(away[on] > 0.5 * extent)
        if len(on) < _LEAST_PLANE_SHARE * len(p) or beyond < _LEAST_BEYOND_SHARE * len(on):
            break
        out[on] = True
    return out


def _best_plane(p: Array, extent: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Which points are on the plane that has most of them, fitted to them."""
    a, b, c = (p[rng.integers(len(p), size=_PLANE_TRIPLES)] for _ in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    valid = length > 1e-3 * extent**2  # of triples that are no line
    if not valid.any():
        return np.zeros(len(p), bool)
    normals, a = normals[valid] / length[valid, None], a[valid]
    off = np.abs(p @ normals.T - np.einsum("ij,ij->i", normals, a))
    on = (
        off[:, np.argmax((off < _PLANE_HALF_OF_DIAGONAL * extent).sum(axis=0))]
        < _PLANE_HALF_OF_DIAGONAL * extent
    )
    for _ in range(2):
        middle = p[on].mean(axis=0)
        normal = np.linalg.svd(p[on] - middle, full_matrices=False)[2][2]
        on = np.abs((p - middle) @ normal) < _PLANE_HALF_OF_DIAGONAL * extent
    return np.asarray(on)


def _connected(p: Array, cell: float, reach: float) -> NDArray[np.bool_]:
    """Which points (n, 3) belong to connected parts whose middle is within reach of the origin, or
    to the nearest one.

    Points are connected where their cells touch. The cells have the given size [m], or the spacing
    of the points where these are farther apart.
    """
    if len(p) < _LEAST_TARGET_POINTS:
        return np.ones(len(p), bool)
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    apart: Array = np.asarray(cKDTree(p).query(p[:: max(len(p) // _SPACING_POINTS, 1)], k=2)[0])[
        :, 1
    ]
    cell = max(cell, _CELL_SPACINGS * float(np.median(apart)))
    cells, of = np.unique(np.floor(p / cell).astype(np.int64), axis=0, return_inverse=True)
    of = of.reshape(-1)
    pairs = cKDTree(cells).query_pairs(1.8, output_type="ndarray")
    graph = coo_array(
        (np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), (len(cells), len(cells))
    )
    labels = connected_components(graph, directed=False)[1][of]
    sizes = np.bincount(labels)
    middles = np.stack([np.bincount(labels, p[:, k]) for k in range(3)], axis=1) / sizes[:, None]
    distance = np.linalg.norm(middles, axis=1)
    parts = distance < reach
    parts[np.argmin(np.where(sizes >= _LEAST_TARGET_POINTS, distance, np.inf))] = True
    return np.asarray(parts[labels])
