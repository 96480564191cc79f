"""Batch refinement of the poses of the key scans, and fusion of all scans into one surface."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from avsreplay.geometry import Array, Pose
from avsreplay.reconstruct.tracking import (
    KEEP_RATIO,
    MOST_POINTS,
    SAME_SIDE,
    ReconstructionParams,
    Tracked,
    between,
    moved,
    patchwork,
    registered,
)
from avsreplay.reconstruct.views import (
    ScanView,
    Survey,
    Twist,
    averaged,
    depth_behind,
    full_cloud,
    normals_of,
    sight_lines,
    thinned,
    turn,
)
from avsreplay.records import Scan
from avsreplay.register import global_search

PAIR_TURN_RAD = np.radians(60.0)  # key scans seen from directions closer than this are compared in the refinement
PAIRS = 8  # most key scans with which one is compared
MOST_SIGHTS = 60  # scans that are asked whether they saw through a point
SPREAD_RAD = np.radians(30.0)  # a direction counts as covered if a scan was taken from within this angle of it


def refined(
    views: Sequence[ScanView], tracked: Tracked, p: ReconstructionParams, extent: float
) -> tuple[dict[int, Pose], float, float]:
    """Poses of the key views that minimise the distances between all overlapping pairs.

    Returns:
        T_ac by number of the view, the rms of the distances that is left, and the gate that was used for them [m].
    """
    keys = tracked.keys
    poses = [tracked.poses[k].inverse() for k in keys]
    trees = [cKDTree(views[k].points) for k in keys]
    gate, rms = 0.03 * extent, 0.0
    scale = np.tile(np.array([1.0 / extent] * 3 + [1.0] * 3), len(keys))
    for _ in range(p.refinements):
        N, g, every = _normal_equations(views, keys, trees, poses, gate)
        N[:6, :6] += np.eye(6) * max(np.trace(N), 1.0)  # the first view defines the frame
        N = N * np.outer(scale, scale)
        N[np.diag_indices_from(N)] += 1e-6 * np.trace(N) / len(N)
        step = np.linalg.solve(N, g * scale) * scale
        poses = [moved(T, step[6 * i : 6 * i + 6]) for i, T in enumerate(poses)]
        rms = float(np.sqrt(np.mean(every**2)))
        tighter = max(3.0 * 1.4826 * float(np.median(np.abs(every))), 0.006 * extent)
        small = np.abs(step / scale).max() < 1e-4 * extent
        if small and tighter > 0.98 * gate:
            break
        gate = min(gate, tighter)
    return {k: T.inverse() for k, T in zip(keys, poses, strict=True)}, rms, gate


def pair_rms(views: Sequence[ScanView], poses: dict[int, Pose], gate: float) -> float:
    """Rms of the distances between all overlapping pairs of views at poses T_ac [m]."""
    keys = sorted(poses)
    trees = [cKDTree(views[k].points) for k in keys]
    _, _, every = _normal_equations(views, keys, trees, [poses[k].inverse() for k in keys], gate)
    return float(np.sqrt(np.mean(every**2)))


def _normal_equations(
    views: Sequence[ScanView], keys: Sequence[int], trees: Sequence[cKDTree], poses: Sequence[Pose], gate: float
) -> tuple[Array, Array, Array]:
    """Normal matrix (6n, 6n) and right side (6n,) of the steps of all poses T_ca, and the distances [m]."""
    N, g, distances = np.zeros((6 * len(keys), 6 * len(keys))), np.zeros(6 * len(keys)), [np.zeros(1)]
    for i, j in _pairs(sight_lines([views[k] for k in keys], poses)):
        distances.append(_pair_terms(views[keys[i]], views[keys[j]], trees[j], poses, (i, j), gate, N, g))
    return N, g, np.concatenate(distances)


def _pairs(directions: Array) -> list[tuple[int, int]]:
    """Ordered pairs of key views whose directions of view differ by less than PAIR_TURN_RAD; the nearest PAIRS each."""
    found = []
    for i, at in enumerate(directions):
        cosine = directions @ at
        order = [int(j) for j in np.argsort(-cosine, kind="stable") if j != i and cosine[j] > np.cos(PAIR_TURN_RAD)]
        found += [(i, j) for j in order[:PAIRS]]
    return found


def _pair_terms(
    a: ScanView, b: ScanView, tree: cKDTree, poses: Sequence[Pose], ij: tuple[int, int], gate: float, N: Array, g: Array
) -> Array:
    """Add the distances of the points of view i to the planes of view j to the normal equations of both poses."""
    i, j = ij
    every = max(1, len(a.points) // MOST_POINTS)
    points, normals, weight = a.points[::every], a.normals[::every], a.weight[::every]
    p_c = poses[i].apply(points)
    p_b = poses[j].inverse().apply(p_c)
    d, index = tree.query(p_b, distance_upper_bound=gate)
    near = np.isfinite(d)
    index = np.where(near, index, 0)
    n_c = b.normals[index] @ poses[j].R.T
    n_a = normals @ poses[i].R.T
    near &= np.einsum("ni,ni->n", n_a, n_c) > SAME_SIDE
    p, n = p_c[near], between(n_a[near], n_c[near])
    q = poses[j].apply(b.points[index[near]])
    e = np.einsum("ni,ni->n", n, q - p)
    if len(e) < 30:
        return np.zeros(0)
    w = np.maximum(1.0 - (e / gate) ** 2, 0.0) ** 2 * weight[near] * b.weight[index[near]]
    J = np.hstack([np.cross(p, n), n])
    M, r = (J * w[:, None]).T @ J, J.T @ (w * e)
    u, v = slice(6 * i, 6 * i + 6), slice(6 * j, 6 * j + 6)
    N[u, u] += M
    N[v, v] += M
    N[u, v] -= M
    N[v, u] -= M
    g[u] += r
    g[v] -= r
    return np.asarray(e)


def all_poses(
    views: Sequence[ScanView], tracked: Tracked, keys: dict[int, Pose], p: ReconstructionParams, extent: float
) -> dict[int, Pose]:
    """Every tracked view registered once more, on the refined model of the key views."""
    model = patchwork(views, replace(tracked, poses=keys), 0.6 * p.thin * extent)
    found = dict(keys)
    for k, T in sorted(tracked.poses.items()):
        if k in keys:
            continue
        nearest = max((j for j in keys if j <= k), default=0)
        guess = keys[nearest] @ (tracked.poses[nearest].inverse() @ T)
        match = registered(views[k], model, guess, 0.03 * extent, extent)
        if match.ratio >= KEEP_RATIO:
            found[k] = match.T_ac
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """What a scan saw: points (n, 3) and position of the camera in {A} [m], and its pose."""

    points: Array
    camera: Array
    T_ac: Pose

    def seen_through(self, p_c: Array, spacing_m: float) -> Array:
        """How far behind points (m, 3) of {C} this scan measured a surface in the same direction [m]; 0: nothing."""
        return depth_behind(self.T_ac.apply(p_c), self.points, self.camera, spacing_m)


def fused(
    scans: Iterable[Scan], survey: Survey, twist: dict[int, Twist], size_m: float
) -> tuple[Array, Array, Array, NDArray[np.int64], list[Sight]]:
    """Surface points, normals, standard errors along the normal, numbers of scans, and sights; one scan at a time.

    Points seen once only, or seen through by more than a third as many scans as have seen them, are left out.
    """
    points, normals, owner, sights = [], [], [], list[Sight]()
    apart = max(1, len(twist) // MOST_SIGHTS)
    for k, scan in enumerate(scans):
        if k not in twist:
            continue
        full = full_cloud(scan, twist[k])
        fine, T_ca = thinned(full, 0.7 * size_m), twist[k].T_ac.inverse()
        points.append(T_ca.apply(fine).astype(np.float32))
        normals.append((normals_of(fine, full, survey.camera) @ T_ca.R.T).astype(np.float32))
        owner.append(np.full(len(fine), k))
        if (len(owner) - 1) % apart == 0:
            sights.append(Sight(fine, survey.camera, twist[k].T_ac))
    p, n, who = np.vstack(points).astype(np.float64), np.vstack(normals).astype(np.float64), np.concatenate(owner)
    mean, normal, cell = averaged(p, n, size_m)
    count = np.bincount(cell)
    seen = np.bincount(np.unique(np.column_stack([cell, who]), axis=0)[:, 0], minlength=len(count))
    height = np.einsum("ni,ni->n", p - mean[cell], normal[cell])
    scatter = np.sqrt(np.bincount(cell, height**2) / np.maximum(count - 1, 1))
    through = sum((s.seen_through(mean, 1.5 * size_m) > 6.0 * size_m).astype(np.float64) for s in sights)
    keep = np.asarray(through) * (len(twist) / len(sights)) <= 0.34 * seen
    keep &= (seen >= 2) | (len(twist) < 12)
    sigma = scatter / np.sqrt(np.maximum(count, 1))
    return mean[keep], normal[keep], np.maximum(sigma, 1e-3 * size_m)[keep], seen[keep], sights


def turn_and_coverage(views: Sequence[ScanView], poses: Sequence[Pose]) -> tuple[float, float]:
    """Largest turn between two poses [rad], and the share of all directions in {C} from which a scan was taken."""
    turns = [turn(poses[0], T) for T in poses]
    seen = sight_lines(views, [T.inverse() for T in poses])
    near = (global_search.directions(1000) @ seen.T).max(axis=1) > np.cos(SPREAD_RAD)
    return max(turns), float(near.mean())
