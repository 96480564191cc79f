"""Batch refinement of the poses of the key scans, and fusion of all scans into one surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from avsreplay.geometry import Array, Pose
from avsreplay.reconstruct.tracking import (
    KEEP_RATIO,
    SAME_SIDE,
    ReconstructionParams,
    Tracked,
    between,
    moved,
    patchwork,
    registered,
)
from avsreplay.reconstruct.views import ScanView, averaged, depth_behind, normals_of, sight_lines, thinned, turn
from avsreplay.register import global_search

PAIR_TURN_RAD = np.radians(60.0)  # key scans seen from directions closer than this are compared in the refinement
SPREAD_RAD = np.radians(30.0)  # a direction counts as covered if a scan was taken from within this angle of it


def refined(
    views: Sequence[ScanView], tracked: Tracked, p: ReconstructionParams, extent: float
) -> tuple[dict[int, Pose], float]:
    """Poses of the key views that minimise the distances between all overlapping pairs, and the rms that is left."""
    keys = tracked.keys
    poses = [tracked.poses[k].inverse() for k in keys]
    trees = [cKDTree(views[k].points) for k in keys]
    gate, rms = 0.03 * extent, 0.0
    for _ in range(p.refinements):
        N = np.zeros((6 * len(keys), 6 * len(keys)))
        g, distances = np.zeros(6 * len(keys)), [np.zeros(1)]
        for i, j in _pairs(sight_lines([views[k] for k in keys], poses)):
            e = _pair_terms(views[keys[i]], views[keys[j]], trees[j], poses, (i, j), gate, N, g)
            distances.append(e)
        N[:6, :6] += np.eye(6) * max(np.trace(N), 1.0)  # the first view defines the frame
        scale = np.tile(np.array([1.0 / extent] * 3 + [1.0] * 3), len(keys))
        N = N * np.outer(scale, scale)
        N[np.diag_indices_from(N)] += 1e-6 * np.trace(N) / len(N)
        step = np.linalg.solve(N, g * scale) * scale
        poses = [moved(T, step[6 * i : 6 * i + 6]) for i, T in enumerate(poses)]
        every = np.concatenate(distances)
        rms = float(np.sqrt(np.mean(every**2)))
        gate = min(gate, max(3.0 * 1.4826 * float(np.median(np.abs(every))), 0.006 * extent))
        if np.abs(step / scale).max() < 1e-5 * extent:
            break
    return {k: T.inverse() for k, T in zip(keys, poses, strict=True)}, rms


def _pairs(directions: Array) -> list[tuple[int, int]]:
    """Ordered pairs of key views whose directions of view differ by less than PAIR_TURN_RAD; the nearest 12 each."""
    found = []
    for i, at in enumerate(directions):
        cosine = directions @ at
        order = [int(j) for j in np.argsort(-cosine, kind="stable") if j != i and cosine[j] > np.cos(PAIR_TURN_RAD)]
        found += [(i, j) for j in order[:12]]
    return found


def _pair_terms(
    a: ScanView, b: ScanView, tree: cKDTree, poses: Sequence[Pose], ij: tuple[int, int], gate: float, N: Array, g: Array
) -> Array:
    """Add the distances of the points of view i to the planes of view j to the normal equations of both poses."""
    i, j = ij
    p_c = poses[i].apply(a.points)
    p_b = poses[j].inverse().apply(p_c)
    d, index = tree.query(p_b, distance_upper_bound=gate)
    near = np.isfinite(d)
    index = np.where(near, index, 0)
    n_c = b.normals[index] @ poses[j].R.T
    n_a = a.normals @ poses[i].R.T
    near &= np.einsum("ni,ni->n", n_a, n_c) > SAME_SIDE
    p, n = p_c[near], between(n_a[near], n_c[near])
    q = poses[j].apply(b.points[index[near]])
    e = np.einsum("ni,ni->n", n, q - p)
    if len(e) < 30:
        return np.zeros(0)
    w = np.maximum(1.0 - (e / gate) ** 2, 0.0) ** 2 * a.weight[near] * b.weight[index[near]]
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


def fused(
    views: Sequence[ScanView], poses: dict[int, Pose], size_m: float
) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Surface points, normals, standard errors along the normal and numbers of scans, without carved voxels."""
    points, normals, owner = [], [], []
    for k, T_ac in sorted(poses.items()):
        full = np.asarray(views[k].full, dtype=np.float64)
        fine = thinned(full, 0.7 * size_m)
        T_ca = T_ac.inverse()
        points.append(T_ca.apply(fine))
        normals.append(normals_of(fine, full, views[k].camera) @ T_ca.R.T)
        owner.append(np.full(len(fine), k))
    p, n, who = np.vstack(points), np.vstack(normals), np.concatenate(owner)
    mean, normal, cell = averaged(p, n, size_m)
    count = np.bincount(cell)
    seen = np.bincount(np.unique(np.column_stack([cell, who]), axis=0)[:, 0], minlength=len(count))
    height = np.einsum("ni,ni->n", p - mean[cell], normal[cell])
    scatter = np.sqrt(np.bincount(cell, height**2) / np.maximum(count - 1, 1))
    keep = _solid(mean, seen, views, poses, size_m) & ((seen >= 2) | (len(poses) < 12))
    sigma = scatter / np.sqrt(np.maximum(count, 1))
    return mean[keep], normal[keep], np.maximum(sigma, 1e-3 * size_m)[keep], seen[keep]


def _solid(
    points: Array, seen: NDArray[np.int64], views: Sequence[ScanView], poses: dict[int, Pose], size_m: float
) -> NDArray[np.bool_]:
    """Return which points are solid: at most a third as many scans measured through them as measured them."""
    numbers = sorted(poses)
    asked = numbers[:: max(1, len(numbers) // 60)]
    through = np.zeros(len(points))
    for k in asked:
        full = np.asarray(views[k].full, dtype=np.float64)
        behind = depth_behind(poses[k].apply(points), full, views[k].camera, 1.5 * size_m)
        through += behind > 6.0 * size_m
    return np.asarray(through * (len(numbers) / len(asked)) <= 0.34 * seen)


def turn_and_coverage(views: Sequence[ScanView], poses: Sequence[Pose]) -> tuple[float, float]:
    """Largest turn between two poses [rad], and the share of all directions in {C} from which a scan was taken."""
    turns = [turn(poses[0], T) for T in poses]
    seen = sight_lines(views, [T.inverse() for T in poses])
    near = (global_search.directions(1000) @ seen.T).max(axis=1) > np.cos(SPREAD_RAD)
    return max(turns), float(near.mean())
