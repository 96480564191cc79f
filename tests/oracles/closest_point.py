"""Closest points, the ICP loop and the normal equations in numpy and scipy: the oracle for the C++
extension.

Closest point on a mesh: the distance to a triangle is at least |q - centroid| - radius, so every
triangle whose bound is below the exact distance of the triangle with the smallest bound is
measured, and no other.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.records import Surface
from avsreplay.register.surface_index import Closest, IcpParams, IcpResult, NormalEquations

NORMAL_NEIGHBOURS = 10
_CHUNK_PAIRS = 2_000_000
_MIN_INLIERS = 6

_Search = Callable[[Array], tuple[Array, Array, NDArray[np.int32]]]


class OracleIndex:
    """The methods of ``SurfaceIndex``, one plain line of numpy after the other."""

    def __init__(self, surface: Surface, reach_m: float) -> None:
        self.reach_m, self.extent_m = reach_m, surface.extent
        vertices, faces = surface.vertices, surface.faces
        if len(faces):
            corners = vertices[faces]
            normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            area2 = np.linalg.norm(normals, axis=1)
            kept = np.flatnonzero(area2 > 0.0)
            self._normals = normals[kept] / area2[kept, None]
            self._corners: Array | None = corners[kept]
            self._tie = 1e-10 * (float(np.linalg.norm(np.ptp(vertices, axis=0))) + reach_m)
            self._search: _Search = _MeshSearch(corners[kept], self._normals, self._tie)
            self._ids = kept
        else:
            self._corners = None
            self._normals = cloud_normals(vertices)
            self._search = _CloudSearch(vertices)
            self._ids = np.arange(len(vertices))

    def closest(self, points: NDArray[Any], *, camera_c: ArrayLike | None = None) -> Closest:
        """Closest points, as ``SurfaceIndex.closest``."""
        n = len(points)
        foot, normal = np.full((n, 3), np.nan), np.full((n, 3), np.nan)
        d2, ids = np.full(n, np.inf), np.full(n, -1, dtype=np.int32)
        good = np.flatnonzero(np.isfinite(points).all(axis=1))
        f, d, i = self._near(
            points[good].astype(np.float64), None if camera_c is None else np.asarray(camera_c)
        )
        near = np.flatnonzero(i >= 0)
        rows = good[near]
        foot[rows], d2[rows], ids[rows], normal[rows] = (
            f[near],
            d[near],
            self._ids[i[near]],
            self._normals[i[near]],
        )
        return Closest(foot, d2, ids, normal)

    def icp(self, points: NDArray[Any], T_ca: Pose, params: IcpParams | None = None) -> IcpResult:
        """The loop of ``SurfaceIndex.icp``."""
        rule = params or IcpParams()
        gate = min(self.reach_m, self.reach_m if rule.gate_m is None else rule.gate_m)
        floor = self.extent_m / 500.0 if rule.floor_m is None else rule.floor_m
        eps_m = 1e-6 * self.extent_m if rule.eps_m is None else rule.eps_m
        scan = points[np.isfinite(points).all(axis=1)].astype(np.float64)
        T, plane, done, passes = T_ca.matrix.copy(), rule.n_plane > 0, False, 0
        inliers, rms, turn, move = 0, float("nan"), float("inf"), float("inf")
        while passes < rule.n_max and not done:
            p, foot, normal, d2 = self._matched(scan, T, gate, rule.facing)
            passes += 1
            inliers = len(p)
            rms = float(np.sqrt(np.mean(d2))) if inliers else float("nan")
            if inliers < _MIN_INLIERS:
                break
            D, turn, move = _plane_step(p, foot, normal) if plane else _horn_step(p, foot)
            tighter = min(gate, max(floor, rule.tighten * rms)) if rule.tighten > 0.0 else gate
            small = turn < rule.eps_rad and move < eps_m and tighter >= 0.99 * gate
            done = small and not plane
            if not done:  # a converged pose is that at which the step was measured
                T, gate = D @ T, tighter
            plane = plane and passes < rule.n_plane and not small
        ignored, searched = len(points) - len(scan), passes * len(scan)
        return IcpResult(T, passes, done, inliers, rms, gate, turn, move, ignored, searched)

    def normal_equations(
        self,
        points: NDArray[Any],
        T_ca: ArrayLike | Pose,
        gate_m: float | None = None,
        *,
        facing: bool = False,
    ) -> NormalEquations:
        """Sums of ``SurfaceIndex.normal_equations``."""
        T = T_ca.matrix if isinstance(T_ca, Pose) else np.asarray(T_ca)
        gate = self.reach_m if gate_m is None else min(gate_m, self.reach_m)
        scan = points[np.isfinite(points).all(axis=1)].astype(np.float64)
        p, foot, normal, d2 = self._matched(scan, T, gate, facing)
        J, e = np.hstack([np.cross(p, normal), normal]), np.sum((foot - p) * normal, axis=1)
        ignored = len(points) - len(scan)
        return NormalEquations(
            J.T @ J, J.T @ e, len(p), float(e @ e), float(np.sum(d2)), len(scan), ignored
        )

    def _near(self, p: Array, camera_c: Array | None) -> tuple[Array, Array, NDArray[np.int32]]:
        """Closest point, squared distance and index into the primitives; -1 at the reach or
        farther.
        """
        if camera_c is None or self._corners is None:
            foot, d2, i = self._search(p)
        else:
            seen = np.flatnonzero(
                np.sum((camera_c - self._corners[:, 0]) * self._normals, axis=1) > 0.0
            )
            if not len(seen):
                return (
                    np.zeros_like(p),
                    np.full(len(p), np.inf),
                    np.full(len(p), -1, dtype=np.int32),
                )
            foot, d2, i = _MeshSearch(self._corners[seen], self._normals[seen], self._tie)(p)
            i = seen[i].astype(np.int32)
        return foot, d2, np.where(d2 < self.reach_m**2, i, -1).astype(np.int32)

    def _matched(
        self, scan: Array, T_ca: Array, gate: float, facing: bool
    ) -> tuple[Array, Array, Array, Array]:
        p = scan @ T_ca[:3, :3].T + T_ca[:3, 3]
        foot, d2, i = self._near(p, T_ca[:3, 3] if facing else None)
        take = (i >= 0) & (d2 < gate**2)
        return p[take], foot[take], self._normals[i[take]], d2[take]


class _CloudSearch:
    def __init__(self, vertices: Array) -> None:
        from scipy.spatial import cKDTree

        self._points, self._tree = vertices, cKDTree(vertices)

    def __call__(self, p: Array) -> tuple[Array, Array, NDArray[np.int32]]:
        i = np.asarray(self._tree.query(p)[1], dtype=np.int32)
        foot = self._points[i]
        return foot, np.sum((foot - p) ** 2, axis=1), i


class _MeshSearch:
    def __init__(self, corners: Array, normals: Array, tie_m: float) -> None:
        self._corners, self._normals, self._tie = corners, normals, tie_m
        self._centroids = corners.mean(axis=1)
        self._radius = np.linalg.norm(corners - self._centroids[:, None], axis=2).max(axis=1)

    def __call__(self, p: Array) -> tuple[Array, Array, NDArray[np.int32]]:
        step = max(1, _CHUNK_PAIRS // len(self._corners))
        parts = [self._chunk(p[k : k + step]) for k in range(0, len(p), step)] or [self._chunk(p)]
        foot, d2, i = zip(*parts, strict=True)
        return np.concatenate(foot), np.concatenate(d2), np.concatenate(i)

    def _chunk(self, p: Array) -> tuple[Array, Array, NDArray[np.int32]]:
        from scipy.spatial.distance import cdist

        bound = np.maximum(cdist(p, self._centroids) - self._radius, 0.0)
        first = np.argmin(bound, axis=1)
        reach = np.sqrt(np.sum((foot_on_triangles(p, self._corners[first]) - p) ** 2, axis=1))
        row, tri = np.nonzero(bound <= reach[:, None] * (1.0 + 1e-9))
        foot = foot_on_triangles(p[row], self._corners[tri])
        d2 = np.sum((foot - p[row]) ** 2, axis=1)
        least = np.full(len(p), np.inf)
        np.minimum.at(least, row, d2)
        farther = d2 > least[row] * (1.0 + 1e-10) + self._tie**2
        height = np.abs(np.sum((p[row] - self._corners[tri, 0]) * self._normals[tri], axis=1))
        order = np.lexsort((tri, -np.round(height / self._tie), farther, row))
        _, starts = np.unique(row[order], return_index=True)
        best = order[starts]
        return foot[best], d2[best], tri[best].astype(np.int32)


def foot_on_triangles(p: Array, corners: Array) -> Array:
    """Nearest point of triangle k to p[k]. (n, 3) x (n, 3, 3) -> (n, 3).

    The projection onto the plane where it falls inside, else the nearest of the closest points on
    the three edges.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    n = np.cross(b - a, c - a)
    n = n / np.linalg.norm(n, axis=1, keepdims=True)
    plane = p - np.sum((p - a) * n, axis=1, keepdims=True) * n
    sides = [
        np.sum(np.cross(v - u, plane - u) * n, axis=1) >= 0.0 for u, v in ((a, b), (b, c), (c, a))
    ]
    feet = np.stack([_foot_on_edge(p, u, v) for u, v in ((a, b), (b, c), (c, a))])
    nearest = feet[np.argmin(np.sum((feet - p) ** 2, axis=2), axis=0), np.arange(len(p))]
    foot: Array = np.where(np.logical_and.reduce(sides)[:, None], plane, nearest)
    return foot


def _foot_on_edge(p: Array, u: Array, v: Array) -> Array:
    edge = v - u
    t = np.sum((p - u) * edge, axis=1) / np.sum(edge * edge, axis=1)
    foot: Array = u + np.clip(t, 0.0, 1.0)[:, None] * edge
    return foot


def cloud_normals(points: Array, neighbours: int = NORMAL_NEIGHBOURS) -> Array:
    """Direction of least scatter of the ``neighbours`` nearest points, itself included. (n, 3) ->
    (n, 3), any sign.
    """
    from scipy.spatial import cKDTree

    k = min(neighbours, len(points))
    _, near = cKDTree(points).query(points, k=[*range(1, k + 1)])
    patch = points[near] - points[near].mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", patch, patch))
    return np.ascontiguousarray(vectors[:, :, 0])


def _horn_step(p: Array, foot: Array) -> tuple[Array, float, float]:
    """Horn's closed form, section 6: the best D with D p = foot; its angle [rad] and the
    centroid's move [m].
    """
    pc, fc = p.mean(axis=0), foot.mean(axis=0)
    N = (p - pc).T @ (foot - fc) / len(p)
    M = np.empty((4, 4))  # scalar first [w x y z]
    M[0, 0] = np.trace(N)
    M[0, 1:] = M[1:, 0] = [N[1, 2] - N[2, 1], N[2, 0] - N[0, 2], N[0, 1] - N[1, 0]]
    M[1:, 1:] = N + N.T - np.trace(N) * np.eye(3)
    q = np.linalg.eigh(M)[1][:, -1]
    q_xyzw = geometry.normalise(q[[1, 2, 3, 0]])
    R = geometry.matrix(q_xyzw)
    return _pose(R, fc - R @ pc), float(geometry.angle(q_xyzw)), float(np.linalg.norm(fc - pc))


def _plane_step(p: Array, foot: Array, normal: Array) -> tuple[Array, float, float]:
    """One Gauss-Newton step of sum (n . (foot - D p))^2; the same angle and move as Horn's."""
    c = p.mean(axis=0)
    J, e = np.hstack([np.cross(p - c, normal), normal]), np.sum((foot - p) * normal, axis=1)
    H = J.T @ J
    d = np.linalg.solve(H + np.diag(1e-9 * np.diag(H) + 1e-30), J.T @ e)
    R = geometry.matrix(geometry.exp(d[:3]))
    return _pose(R, c + d[3:] - R @ c), float(np.linalg.norm(d[:3])), float(np.linalg.norm(d[3:]))


def _pose(R: Array, t: Array) -> Array:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = R, t
    return out
