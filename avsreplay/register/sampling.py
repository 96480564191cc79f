"""Points drawn evenly over a surface, for the back ends that know only clouds; no random numbers."""

from __future__ import annotations

import numpy as np

from avsreplay.geometry import Array
from avsreplay.records import Surface

__all__ = ["sample", "thin"]

R2 = np.array([0.7548776662466927, 0.5698402909980532])  # plastic-number sequence: even over the unit square


def sample(surface: Surface, count: int) -> tuple[Array, Array]:
    """About ``count`` points by area with their face normals, (n, 3) each; a bare cloud as it is, with zero normals."""
    if len(surface.faces) == 0:
        return np.array(surface.vertices), np.zeros_like(surface.vertices)
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    twice_area = np.linalg.norm(cross, axis=1)
    edges = np.cumsum(twice_area)
    face = np.searchsorted(edges, (np.arange(count) + 0.5) * (edges[-1] / count), side="right")
    face = np.minimum(face, len(edges) - 1)
    u, v = ((np.arange(1, count + 1)[:, None] * R2) % 1.0).T
    fold = u + v > 1.0
    u, v = np.where(fold, 1.0 - u, u)[:, None], np.where(fold, 1.0 - v, v)[:, None]
    points = a[face] + u * (b - a)[face] + v * (c - a)[face]
    return points, cross[face] / np.maximum(twice_area[face], np.finfo(float).tiny)[:, None]


def thin(points: Array, voxel_m: float) -> Array:
    """The first point of every occupied voxel of this size, in scan order. (n, 3) -> (k, 3)."""
    if len(points) == 0:
        return points
    cells = np.floor(points / voxel_m).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    return points[np.sort(first)]
