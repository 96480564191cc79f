"""Evenly distributed points of a surface or of a scan, without random numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Array
from avsreplay.records import Surface

EVEN_ROUNDS, EVEN_WITHIN = 10, (0.85, 1.2)
STRAY_SHARE, STRAY_VOXELS, STRAY_POINTS = 0.15, 150, 10
R2 = np.array([0.7548776662466927, 0.5698402909980532])  # plastic-number sequence: low discrepancy in the unit square


def sample(surface: Surface, count: int) -> tuple[Array, Array]:
    """Return about ``count`` points, uniform by area, and their face normals, (n, 3) each.

    A point cloud is returned as it is, with zero normals.
    """
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
    """Return the first point of every occupied voxel of this size, in scan order. (n, 3) -> (k, 3)."""
    if len(points) == 0:
        return points
    cells = np.floor(points / voxel_m).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    return points[np.sort(first)]


def thin_to(points: Array, count: int) -> Array:
    """Return about ``count`` of the points: the first of every voxel, whose size is found iteratively."""
    if len(points) <= count:
        return points
    voxel = max(3.0 * _spread(points) / np.sqrt(count), np.finfo(float).tiny)
    for _ in range(EVEN_ROUNDS):
        first = _voxels(points, voxel)[0]
        if EVEN_WITHIN[0] * count <= len(first) <= EVEN_WITHIN[1] * count:
            break
        voxel *= float(np.clip(np.sqrt(len(first) / count), 0.5, 2.0))
    return points[np.sort(first)]


def without_sparse_points(points: Array) -> Array:
    """Return the points in voxels that hold at least 0.15 of the number that the median point has in its voxel.

    A single outlier far from everything would occupy a voxel of its own and, after thinning by voxels, weigh as much as
    a piece of surface. About 150 voxels cover the scan; a scan with fewer than ten points per voxel is not changed.
    """
    if len(points) < STRAY_VOXELS * STRAY_POINTS:
        return points
    _, voxel, counts = _voxels(points, 3.0 * _spread(points) / np.sqrt(STRAY_VOXELS))
    around = counts[voxel]
    return points[around >= max(2.0, STRAY_SHARE * float(np.median(around)))]


def _spread(points: Array) -> float:
    return float(np.sqrt(np.median(np.sum((points - np.median(points, axis=0)) ** 2, axis=1))))


def _voxels(points: Array, voxel_m: float) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """First point of every occupied voxel, the voxel of every point, and the number of points in each voxel."""
    cells = np.floor((points - points.min(axis=0)) / max(voxel_m, np.finfo(float).tiny)).astype(np.int64)
    shape = cells.max(axis=0) + 1
    keys = (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]
    _, first, voxel, counts = np.unique(keys, return_index=True, return_inverse=True, return_counts=True)
    return first, voxel.reshape(-1), counts
