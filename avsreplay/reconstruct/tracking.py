"""Tracking of the scans of an unknown target: each is registered against the model that the scans before it give."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.reconstruct.free_motion import free_motion
from avsreplay.reconstruct.views import ScanView, averaged, depth_behind, turn
from avsreplay.register import global_search

SAME_SIDE = 0.5  # least cosine between the normals of two corresponding points
KEEP_RATIO = 0.4  # share of the points of a scan that must lie on the model so far
MOST_SHIFT = 0.4  # largest distance of the target's centre from its prediction, as a share of the extent
SHIFT_PER_LOST = 0.01  # by which that share grows with every scan that was lost before
LEAST_EXPLAINED = 0.15  # share of the model's visible side that a scan must show
MOST_VIOLATING = 0.12  # share of points that may lie in the free space in front of what another view has measured
GRAZING = np.cos(np.radians(70.0))  # least cosine of the inclination to a line of sight for a test of free space
MOST_POINTS = 1500  # of a scan in one registration
MOST_TESTED = 600  # of a scan in one test of free space
SEARCH_EVERY = 6  # while the target is lost, all attitudes are searched for two scans of this many
MOST_RETRIES = 20  # lost scans that are tried again at the end
KEY_TURN_RAD = np.radians(7.0)  # a scan seen from a direction that differs by this from all key scans becomes one


@dataclass(frozen=True, slots=True)
class ReconstructionParams:
    """Resolution and effort of a reconstruction; lengths are fractions of the extent of the first scan.

    Attributes:
        voxel: edge of the voxels of the fused model.
        thin: edge of the voxels to which scans are thinned for registration.
        reach: largest distance of corresponding points at the first iteration.
        fewest_points: scans with fewer points are not used.
        n_scans: most scans that are used; a longer log is thinned evenly.
        refinements: Gauss-Newton iterations of the batch refinement.
    """

    voxel: float = 1.0 / 200.0
    thin: float = 1.0 / 120.0
    reach: float = 0.06
    fewest_points: int = 100
    n_scans: int = 400
    refinements: int = 12


@dataclass(frozen=True, slots=True, eq=False)
class Patchwork:
    """The model so far: points (n, 3) [m] and unit normals (n, 3) in {C}, with a search tree over the points."""

    points: Array
    normals: Array
    tree: cKDTree


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """A registered scan.

    Attributes:
        T_ac: pose of the model in the camera frame.
        ratio: share of the points that lie on the model.
        rms_m: root mean square of their point-to-plane distances [m].
        weakest: smallest eigenvalue of the normal equations over the largest, in units of the extent; near 0 where the
            surface does not determine the pose (a sphere, a plane).
    """

    T_ac: Pose
    ratio: float
    rms_m: float
    weakest: float


@dataclass(slots=True, eq=False)
class Tracked:
    """Poses by number of the view, key views, searches made, scans lost in a row, weakest direction of every match."""

    poses: dict[int, Pose]
    keys: list[int]
    searches: int
    lost: int
    weakest: list[float]


def track(views: Sequence[ScanView], p: ReconstructionParams, extent: float) -> Tracked:
    """Register every view against the model that the key views before it give; then try the lost ones once more."""
    origin = views[0].points.mean(axis=0)
    found = Tracked({0: Pose(geometry.IDENTITY_QUAT, origin)}, [0], 0, 0, [])
    model = patchwork(views, found, p.thin * extent)
    for k in range(1, len(views)):
        model = _tracked(views, found, k, model, p, extent)
    lost = [k for k in range(len(views)) if k not in found.poses]
    found.lost = 0
    for k in lost[:: max(1, -(-len(lost) // MOST_RETRIES))]:
        model = _tracked(views, found, k, model, p, extent)
    return found


def _tracked(
    views: Sequence[ScanView], found: Tracked, k: int, model: Patchwork, p: ReconstructionParams, extent: float
) -> Patchwork:
    """Register view k from its prediction, else by a search, note the result, and return the model that it gives."""
    guess = _predicted(views, found, k, extent)
    match = registered(views[k], model, guess, p.reach * extent, extent)
    if not _accepted(match, guess, views, found, k, model, extent):
        found.searches += 1
        match = _searched(views, found, k, model, guess, p, extent)
    if not _accepted(match, guess, views, found, k, model, extent):
        found.lost += 1
        return model
    found.lost = 0
    found.poses[k] = match.T_ac
    found.weakest.append(match.weakest)
    if not _new_side([found.poses[j] for j in found.keys], match.T_ac):
        return model
    found.keys.append(k)
    return patchwork(views, found, p.thin * extent)


def _accepted(
    match: Match, guess: Pose, views: Sequence[ScanView], found: Tracked, k: int, model: Patchwork, extent: float
) -> bool:
    """Whether scan and model explain each other and no measured ray passes through a surface of the other.

    The target must also be near its predicted position: something else in front of it fits somewhere on a flat side.
    """
    if match.ratio < KEEP_RATIO or match.rms_m > 0.01 * extent:
        return False
    centre = model.points.mean(axis=0)
    shift = float(np.linalg.norm(match.T_ac.apply(centre) - guess.apply(centre)))
    if shift > (MOST_SHIFT + SHIFT_PER_LOST * found.lost) * extent:
        return False
    if _explained(views[k], model, match.T_ac, extent) < LEAST_EXPLAINED:
        return False
    near = sorted(found.keys, key=lambda j: turn(found.poses[j], match.T_ac))[:3]
    return all(_violation(views, found.poses[j], match.T_ac, j, k, extent) < MOST_VIOLATING for j in near)


def _explained(view: ScanView, model: Patchwork, T_ac: Pose, extent: float) -> float:
    """Share of the model's side toward the camera that a scan shows; small for a scan of something else."""
    every = max(1, len(model.points) // 1500)
    p, n = T_ac.apply(model.points[::every]), model.normals[::every] @ T_ac.R.T
    lines = view.camera - p
    facing = np.einsum("ni,ni->n", n, lines) > GRAZING * np.linalg.norm(lines, axis=1)
    if not facing.any():
        return 0.0
    near, _ = view.tree.query(p[facing], distance_upper_bound=0.03 * extent)
    return float(np.isfinite(near).mean())


def _violation(views: Sequence[ScanView], T_j: Pose, T_k: Pose, j: int, k: int, extent: float) -> float:
    """Share of the points of each of two views that lie in front of the surface which the other has measured.

    Points whose surface is inclined to the other line of sight by more than 70 degrees are left out: the depth of such
    a surface changes by more than the tolerance between neighbouring rays.
    """
    shares = []
    for a, T_a, b, T_b in ((views[k], T_k, views[j], T_j), (views[j], T_j, views[k], T_k)):
        T_ba = T_b @ T_a.inverse()
        every = max(1, len(a.points) // MOST_TESTED)
        p, n = T_ba.apply(a.points[::every]), a.normals[::every] @ T_ba.R.T  # in {A} at the instant of b
        lines = b.camera - p
        facing = np.einsum("ni,ni->n", n, lines) > GRAZING * np.linalg.norm(lines, axis=1)
        in_front = depth_behind(p[facing], b.points, b.camera, 0.03 * extent, b.rays) > 0.03 * extent
        shares.append(float(in_front.sum()) / max(len(p), 1))
    return max(shares)


def _searched(
    views: Sequence[ScanView],
    found: Tracked,
    k: int,
    model: Patchwork,
    guess: Pose,
    p: ReconstructionParams,
    extent: float,
) -> Match:
    """The best acceptable match from turned guesses: first about the prediction, then over all attitudes."""
    v = views[k]
    coarse = replace(v, points=v.points[::6], normals=v.normals[::6], weight=v.weight[::6])
    wide = global_search.attitudes(400) if found.lost % SEARCH_EVERY < 2 else ()
    for attitudes in (_near_attitudes(guess.q), wide):
        tried: list[tuple[float, int, Match]] = []
        for q in attitudes:
            start = _through_centroid(views[k], model, q)
            match = registered(coarse, model, start, 2.0 * p.reach * extent, extent, passes=8)
            tried.append((match.ratio, len(tried), match))
        for _, _, match in sorted(tried, key=lambda t: (-t[0], t[1]))[:6]:
            fine = registered(views[k], model, match.T_ac, p.reach * extent, extent)
            if _accepted(fine, guess, views, found, k, model, extent):
                return fine
    return Match(guess, 0.0, float("inf"), 0.0)


def _near_attitudes(q_ac: Array) -> list[Array]:
    """The attitude and those 12, 24, 36 and 50 degrees from it about 13 axes, both ways."""
    turns = [geometry.exp(np.radians(deg) * axis) for deg in (12, 24, 36, 50) for axis in _axes()]
    return [q_ac] + [geometry.multiply(q_ac, turn) for turn in turns]


def _axes() -> list[Array]:
    every = [np.array((x, y, z), dtype=np.float64) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]
    return [a / np.linalg.norm(a) for a in every if a.any()]


def _through_centroid(view: ScanView, model: Patchwork, q_ac: Array) -> Pose:
    """The pose of attitude ``q_ac`` that puts the visible side of the model where the scan is."""
    R = geometry.matrix(q_ac)
    towards = view.camera - view.points.mean(axis=0)
    facing = model.normals @ (R.T @ towards) > 0.0
    side = model.points[facing] if facing.sum() > 30 else model.points
    return Pose(q_ac, view.points.mean(axis=0) - R @ side.mean(axis=0))


def _new_side(keys: Sequence[Pose], T_ac: Pose) -> bool:
    """Whether the camera sees the target from a direction that no key view has."""
    return bool(min(turn(key, T_ac) for key in keys) > KEY_TURN_RAD)


def patchwork(views: Sequence[ScanView], found: Tracked, size_m: float) -> Patchwork:
    """The model that the key views give, averaged over voxels of the given size."""
    points, normals = [], []
    for k in found.keys:
        T_ca = found.poses[k].inverse()
        points.append(T_ca.apply(views[k].points))
        normals.append(views[k].normals @ T_ca.R.T)
    mean, normal, _ = averaged(np.vstack(points), np.vstack(normals), size_m)
    return Patchwork(mean, normal, cKDTree(mean))


def _predicted(views: Sequence[ScanView], found: Tracked, k: int, extent: float) -> Pose:
    """The pose at view k by the constant twist, in {C}, of the last poses; after a gap by free motion if it fits."""
    known = sorted(found.poses)
    before = [j for j in known if j < k] or known[:1]
    last = before[-1]
    intervals = np.diff([views[j].t_ns for j in known])
    if k - last > 1 and len(intervals) and views[k].t_ns - views[last].t_ns > 2.0 * np.median(intervals):
        motion = free_motion([views[j].t_ns for j in known], [found.poses[j] for j in known], extent)
        if motion is not None:
            return motion.at(views[k].t_ns)
    if len(before) < 2:
        return found.poses[last]
    first = before[max(-4, -len(before))]
    span = (views[last].t_ns - views[first].t_ns) * 1e-9
    ahead = (views[k].t_ns - views[last].t_ns) * 1e-9
    a, b = found.poses[first], found.poses[last]
    turn = geometry.log(geometry.multiply(geometry.conjugate(a.q), b.q)) * (ahead / span)
    return Pose(geometry.multiply(b.q, geometry.exp(turn)), b.t + (b.t - a.t) * (ahead / span))


def registered(view: ScanView, model: Patchwork, guess: Pose, reach_m: float, extent: float, passes: int = 40) -> Match:
    """Point-to-plane ICP of a view on the model, with Tukey's weights whose scale follows the residuals."""
    T_ca, gate = guess.inverse(), reach_m
    ratio = rms = weakest = 0.0
    for _ in range(passes):
        N, g, distances, ratio = _normal_equations(view, model, T_ca, gate)
        if len(distances) < 12:
            return Match(guess, 0.0, float("inf"), 0.0)
        rms = float(np.sqrt(np.mean(distances**2)))
        step, weakest = _solved(N, g, extent)
        T_ca = moved(T_ca, step)
        small = np.linalg.norm(step[:3]) * extent + np.linalg.norm(step[3:]) < 1e-5 * extent
        tighter = max(3.0 * 1.4826 * float(np.median(np.abs(distances))), 0.01 * extent)
        if small and tighter > 0.98 * gate:
            break
        gate = min(gate, tighter)
    return Match(T_ca.inverse(), ratio, rms, weakest)


def _normal_equations(view: ScanView, model: Patchwork, T_ca: Pose, gate: float) -> tuple[Array, Array, Array, float]:
    """Sums J'WJ (6, 6) and J'We (6,) over corresponding points, their distances to the planes [m], and their share."""
    every = max(1, len(view.points) // MOST_POINTS)
    p, n_view = T_ca.apply(view.points[::every]), view.normals[::every] @ T_ca.R.T
    d, index = model.tree.query(p, distance_upper_bound=gate)
    near = np.isfinite(d)
    index = np.where(near, index, 0)
    near &= np.einsum("ni,ni->n", n_view, model.normals[index]) > SAME_SIDE
    p, q, n = p[near], model.points[index[near]], between(n_view[near], model.normals[index[near]])
    e = np.einsum("ni,ni->n", n, q - p)
    w = np.maximum(1.0 - (e / gate) ** 2, 0.0) ** 2
    J = np.hstack([np.cross(p, n), n])
    return (J * w[:, None]).T @ J, J.T @ (w * e), e, float(near.mean())


def between(a: Array, b: Array) -> Array:
    """Unit vectors halfway between unit normals a and b (n, 3).

    The distance along them is zero for two points of one circle, so that the curvature of a surface gives no bias
    (S. Rusinkiewicz, A symmetric objective function for ICP, ACM Transactions on Graphics 38(4), 2019).
    """
    both = a + b
    return np.asarray(both / np.linalg.norm(both, axis=1, keepdims=True))


def _solved(N: Array, g: Array, extent: float) -> tuple[Array, float]:
    """The step d = [theta; v] in {C}; directions that the surface does not determine are left out."""
    scale = np.array([1.0 / extent] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(N * np.outer(scale, scale))
    good = values > 1e-4 * values[-1]
    step = vectors[:, good] @ ((vectors[:, good].T @ (g * scale)) / values[good])
    return np.asarray(step * scale), float(values[0] / values[-1])


def moved(T_ca: Pose, step: Array) -> Pose:
    """The pose after a step [theta; v] in {C} [rad, m]."""
    return Pose(geometry.exp(step[:3]), step[3:]) @ T_ca
