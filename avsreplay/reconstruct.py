"""Reconstruct the model of an unknown target from the scans of a log, without a model and without an initial guess.

Three steps. (1) Tracking: each scan is registered against the model so far by point-to-plane ICP with an M-estimator,
from a constant-twist prediction; where that fails, a global search finds the pose. (2) Batch refinement: the poses of
the key scans minimise the point-to-plane distances between all pairs of key scans that overlap, including pairs that
see the same side again after a turn (loop closure). (3) Fusion: points and normals are averaged over the scans in a
voxel grid; a voxel through which rays of other scans have passed is removed (free-space carving by vote).

The frame {C} of the model is fixed to the target. Its axes are those of {A} at the first scan that is used, and its
origin is the centroid of that scan. Ground truth is never read.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from avsreplay import geometry
from avsreplay.errors import UnreadableInput
from avsreplay.geometry import Array, Pose
from avsreplay.records import Scan
from avsreplay.register import starts

NEIGHBOURS = 12  # nearest points from which a normal is estimated
SAME_SIDE = 0.5  # least cosine between the normals of two corresponding points
ISOLATED = 4.0  # a point is isolated if its fourth neighbour is farther than this many times the median
KEEP_RATIO = 0.4  # share of the points of a scan that must lie on the model so far
MOST_VIOLATING = 0.12  # share of points that may lie in the free space in front of what another view has measured
FAR_OF_EXTENT = 0.6  # a scan whose centroid is farther than this from the origin of {A} was taken from the origin
SEARCH_EVERY = 6  # while the target is lost, all attitudes are searched for two scans of this many
KEY_TURN_RAD = np.radians(7.0)  # a scan seen from a direction that differs by this from all key scans becomes one
PAIR_TURN_RAD = np.radians(60.0)  # key scans seen from directions closer than this are compared in the refinement
SPREAD_RAD = np.radians(15.0)  # a direction counts as covered if a scan was taken from within this angle of it


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
class View:
    """A scan thinned for registration.

    Attributes:
        t_ns: instant.  camera: (3,) position of the camera in {A} [m].
        points: (n, 3) thinned points in {A} [m].  normals: (n, 3) unit normals toward the camera.
        weight: (n,) cosine of the inclination to the line of sight: grazing points are the least accurate.
        full: (m, 3) all points in {A} [m].
    """

    t_ns: int
    camera: Array
    points: Array
    normals: Array
    weight: Array
    full: NDArray[np.float32]


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


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """A model made from scans.

    Attributes:
        points: (n, 3) surface points in {C} [m].  normals: (n, 3) outward unit normals in {C}.
        one_sigma_m: (n,) standard error of each point along its normal [m].  scans: (n,) scans that saw each point.
        poses: instant and pose T_ac of every scan that was used.
        used, offered: scans used, and scans in the log.  searches: scans whose pose a global search found.
        coverage: share of all directions from which the target was seen.  turn_deg: largest angle between two views.
        rms_m: of the point-to-plane distances after the refinement [m].
        notes: what limits the result, in sentences.
    """

    points: Array
    normals: Array
    one_sigma_m: Array
    scans: NDArray[np.int64]
    poses: Sequence[tuple[int, Pose]]
    used: int
    offered: int
    searches: int
    coverage: float
    turn_deg: float
    rms_m: float
    notes: tuple[str, ...]


def reconstruct(scans: Iterable[Scan], params: ReconstructionParams | None = None) -> Reconstruction:
    """Build a model of the target from its scans.

    Args:
        scans: in order of time; their ground truth, if any, is not used.
        params: resolution and effort.

    Returns:
        The model in {C}, with poses of the scans that were used.

    Raises:
        UnreadableInput: fewer than three usable scans, or a target that did not turn or has no shape that fixes its
            pose; the message says which.
    """
    p = params or ReconstructionParams()
    offered = list(scans)
    step = max(1, -(-len(offered) // p.n_scans))
    usable = [s for s in offered[::step] if len(s.points) >= p.fewest_points]
    if len(usable) < 3:
        raise UnreadableInput(
            f"only {len(usable)} scans with {p.fewest_points} points or more", hint="a model needs three at least"
        )
    extent = float(np.linalg.norm(np.ptp(np.asarray(usable[0].points, dtype=np.float64), axis=0)))
    views = _views(usable, p.thin * extent)
    tracked = _track(views, p, extent)
    if len(tracked.poses) < 3:
        hint = "smaller steps between scans, or fewer occluded scans, are needed"
        raise UnreadableInput(
            f"only {len(tracked.poses)} of {len(views)} scans could be registered to one another", hint=hint
        )
    keys, rms = _refined(views, tracked, p, extent)
    poses = _all_poses(views, tracked, keys, p, extent)
    turn, coverage = _directions([views[k] for k in poses], list(poses.values()))
    _refuse_still(turn, tracked.weakest)
    fused = _fused(views, poses, p.voxel * extent)
    notes = _notes(len(poses), len(views), coverage)
    found = tuple((views[k].t_ns, T) for k, T in sorted(poses.items()))
    return Reconstruction(
        *fused, found, len(found), len(offered), tracked.searches, coverage, np.degrees(turn), rms, notes
    )


# --- Views -----------------------------------------------------------------------------------------------------------


def _views(scans: Sequence[Scan], size_m: float) -> list[View]:
    clouds = [_connected(np.asarray(scan.points, dtype=np.float64)) for scan in scans]
    camera = _camera(clouds)
    views = []
    for scan, full in zip(scans, clouds, strict=True):
        points = _thinned(full, size_m)
        normals, lines = _normals(points, full, camera), camera - points
        weight = np.einsum("ni,ni->n", normals, lines) / np.linalg.norm(lines, axis=1)
        views.append(View(scan.t_ns, camera, points, normals, weight, full.astype(np.float32)))
    return views


def _connected(points: Array) -> Array:
    """The points without isolated ones: the fourth neighbour is farther away than ISOLATED times the median."""
    distance = cKDTree(points).query(points, k=5)[0][:, 4]
    return np.asarray(points[distance < ISOLATED * np.median(distance)])


def _camera(clouds: Sequence[Array]) -> Array:
    """Position of the camera in {A} [m]: the origin, unless the scans surround it or lie close to it.

    Scans that were moved toward the origin do not show where the camera was, only that it is the same place for all
    of them. It is then taken as far away along one line of sight: a surface is sampled in proportion to the cosine of
    its inclination to that line, so the mean square of the cosine is largest along it. Of the two ends of the line the
    one is chosen from which the surfaces are convex on average, because a camera sees the outside of the target.
    """
    extents = [float(np.linalg.norm(np.ptp(points, axis=0))) for points in clouds]
    distances = [float(np.linalg.norm(points.mean(axis=0))) for points in clouds]
    if np.median(distances) > FAR_OF_EXTENT * np.median(extents):
        return np.zeros(3)
    scatter, sides = np.zeros((3, 3)), []
    for points, extent in zip(clouds, extents, strict=True):
        thin = _thinned(points, extent / 40.0)
        normals = _normals(thin, points, points.mean(axis=0))
        scatter += normals.T @ normals
        sides.append((thin - points.mean(axis=0), normals))
    towards = np.linalg.eigh(scatter)[1][:, 2]
    bulge = sum(float(np.einsum("ni,ni->", n * np.sign(n @ towards)[:, None], p)) for p, n in sides)
    return np.asarray(np.copysign(100.0 * max(extents), bulge) * towards)


def _thinned(points: Array, size_m: float) -> Array:
    """The point nearest to the mean of each voxel: a measured point, because a mean lies inside a curved surface."""
    _, inverse = np.unique(np.floor(points / size_m).astype(np.int64), axis=0, return_inverse=True)
    cell = inverse.ravel()
    off = np.linalg.norm(points - _means(points, cell)[cell], axis=1)
    order = np.lexsort((np.arange(len(points)), off, cell))
    first = np.flatnonzero(np.diff(cell[order], prepend=-1))
    return np.asarray(points[order[first]])


def _means(values: Array, cell: NDArray[np.intp]) -> Array:
    """Mean (m, k) of the rows of ``values`` (n, k) that share a cell."""
    count = np.bincount(cell)
    return np.stack([np.bincount(cell, column) / count for column in values.T], axis=1)


def _normals(points: Array, full: Array, camera: Array) -> Array:
    """Unit normals (n, 3) toward the camera: smallest principal direction of the nearest points of the whole scan."""
    _, index = cKDTree(full).query(points, k=min(NEIGHBOURS, len(full)))
    near = full[index] - full[index].mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))
    normals = vectors[:, :, 0]
    away = np.einsum("ni,ni->n", normals, points - camera) > 0.0
    normals[away] *= -1.0
    return np.asarray(normals)


# --- Tracking --------------------------------------------------------------------------------------------------------


@dataclass(slots=True, eq=False)
class _Tracked:
    """Poses by number of the view, key views, searches made, scans lost in a row, weakest direction of every match."""

    poses: dict[int, Pose]
    keys: list[int]
    searches: int
    lost: int
    weakest: list[float]


def _track(views: Sequence[View], p: ReconstructionParams, extent: float) -> _Tracked:
    origin = views[0].points.mean(axis=0)
    found = _Tracked({0: Pose(geometry.IDENTITY_QUAT, origin)}, [0], 0, 0, [])
    model = _patchwork(views, found, p.thin * extent)
    for k in range(1, len(views)):
        guess = _predicted(views, found, k)
        match = _registered(views[k], model, guess, p.reach * extent, extent)
        if not _accepted(match, views, found, k, extent):
            found.searches += 1
            match = _searched(views, found, k, model, guess, p, extent)
        if not _accepted(match, views, found, k, extent):
            found.lost += 1
            continue
        found.lost = 0
        found.poses[k] = match.T_ac
        found.weakest.append(match.weakest)
        if _new_side([found.poses[j] for j in found.keys], match.T_ac):
            found.keys.append(k)
            model = _patchwork(views, found, p.thin * extent)
    return found


def _accepted(match: Match, views: Sequence[View], found: _Tracked, k: int, extent: float) -> bool:
    """Whether enough of the scan lies on the model and no measured ray passes through a surface of the other."""
    if match.ratio < KEEP_RATIO or match.rms_m > 0.01 * extent:
        return False
    near = sorted(found.keys, key=lambda j: _turn(found.poses[j], match.T_ac))[:3]
    return all(_violation(views, found.poses[j], match.T_ac, j, k, extent) < MOST_VIOLATING for j in near)


def _violation(views: Sequence[View], T_j: Pose, T_k: Pose, j: int, k: int, extent: float) -> float:
    """Share of the points of each of two views that lie in front of the surface which the other has measured."""
    shares = []
    for a, T_a, b, T_b in ((views[k], T_k, views[j], T_j), (views[j], T_j, views[k], T_k)):
        p = (T_b @ T_a.inverse()).apply(a.points)  # in {A} at the instant of b
        in_front = _depth_behind(p, b.points, b.camera, 0.03 * extent) > 0.03 * extent
        shares.append(float(in_front.mean()))
    return max(shares)


def _depth_behind(p: Array, measured: Array, camera: Array, spacing_m: float) -> Array:
    """How far the surface that was measured in the direction of each point p lies behind it [m]; 0 where none was."""
    rays, own = measured - camera, p - camera
    far, r = np.linalg.norm(rays, axis=1), np.linalg.norm(own, axis=1)
    d, index = cKDTree(rays / far[:, None]).query(own / r[:, None], k=3)
    hit = d[:, 2] < spacing_m / r
    return np.where(hit, far[index].min(axis=1) - r, 0.0)


def _searched(
    views: Sequence[View],
    found: _Tracked,
    k: int,
    model: Patchwork,
    guess: Pose,
    p: ReconstructionParams,
    extent: float,
) -> Match:
    """The best acceptable match from turned guesses: first about the prediction, then over all attitudes."""
    v = views[k]
    coarse = replace(v, points=v.points[::6], normals=v.normals[::6], weight=v.weight[::6])
    wide = starts.attitudes(400) if found.lost % SEARCH_EVERY < 2 else ()
    for attitudes in (_near_attitudes(guess.q), wide):
        tried = []
        for q in attitudes:
            start = _through_centroid(views[k], model, q)
            match = _registered(coarse, model, start, 2.0 * p.reach * extent, extent, passes=8)
            tried.append((match.ratio, len(tried), match))
        for _, _, match in sorted(tried, key=lambda t: (-t[0], t[1]))[:6]:
            fine = _registered(views[k], model, match.T_ac, p.reach * extent, extent)
            if _accepted(fine, views, found, k, extent):
                return fine
    return Match(guess, 0.0, float("inf"), 0.0)


def _near_attitudes(q_ac: Array) -> list[Array]:
    """The attitude and those 12, 24, 36 and 50 degrees from it about 13 axes, both ways."""
    turns = [geometry.exp(np.radians(deg) * axis) for deg in (12, 24, 36, 50) for axis in _axes()]
    return [q_ac] + [geometry.multiply(q_ac, turn) for turn in turns]


def _axes() -> list[Array]:
    every = [np.array((x, y, z), dtype=np.float64) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]
    return [a / np.linalg.norm(a) for a in every if a.any()]


def _through_centroid(view: View, model: Patchwork, q_ac: Array) -> Pose:
    """The pose of attitude ``q_ac`` that puts the visible side of the model where the scan is."""
    R = geometry.matrix(q_ac)
    towards = view.camera - view.points.mean(axis=0)
    facing = model.normals @ (R.T @ towards) > 0.0
    side = model.points[facing] if facing.sum() > 30 else model.points
    return Pose(q_ac, view.points.mean(axis=0) - R @ side.mean(axis=0))


def _turn(a: Pose, b: Pose) -> float:
    return float(geometry.angle(geometry.multiply(geometry.conjugate(a.q), b.q)))


def _new_side(keys: Sequence[Pose], T_ac: Pose) -> bool:
    """Whether the camera sees the target from a direction that no key view has."""
    return min(_turn(key, T_ac) for key in keys) > KEY_TURN_RAD


def _patchwork(views: Sequence[View], found: _Tracked, size_m: float) -> Patchwork:
    points, normals = [], []
    for k in found.keys:
        T_ca = found.poses[k].inverse()
        points.append(T_ca.apply(views[k].points))
        normals.append(views[k].normals @ T_ca.R.T)
    return _grid(np.vstack(points), np.vstack(normals), size_m)


def _grid(points: Array, normals: Array, size_m: float) -> Patchwork:
    """Averages over voxels, apart for the two sides of a thin wall."""
    side = np.sign(normals @ np.array([0.61, 0.53, 0.59]))
    cells = np.column_stack([np.floor(points / size_m), side]).astype(np.int64)
    _, inverse = np.unique(cells, axis=0, return_inverse=True)
    p, n = _means(points, inverse.ravel()), _means(normals, inverse.ravel())
    n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-12)
    return Patchwork(p, n, cKDTree(p))


def _predicted(views: Sequence[View], found: _Tracked, k: int) -> Pose:
    """The pose at view k by the constant twist, in {C}, of the last poses."""
    known = sorted(j for j in found.poses if j < k)
    last = known[-1]
    if len(known) < 2:
        return found.poses[last]
    before = known[max(-4, -len(known))]
    span = (views[last].t_ns - views[before].t_ns) * 1e-9
    ahead = (views[k].t_ns - views[last].t_ns) * 1e-9
    a, b = found.poses[before], found.poses[last]
    turn = geometry.log(geometry.multiply(geometry.conjugate(a.q), b.q)) * (ahead / span)
    return Pose(geometry.multiply(b.q, geometry.exp(turn)), b.t + (b.t - a.t) * (ahead / span))


def _registered(view: View, model: Patchwork, guess: Pose, reach_m: float, extent: float, passes: int = 40) -> Match:
    """Point-to-plane ICP of a view on the model, with Tukey's weights whose scale follows the residuals."""
    T_ca, gate = guess.inverse(), reach_m
    ratio = rms = weakest = 0.0
    for _ in range(passes):
        N, g, distances, ratio = _normal_equations(view, model, T_ca, gate)
        if len(distances) < 12:
            return Match(guess, 0.0, float("inf"), 0.0)
        rms = float(np.sqrt(np.mean(distances**2)))
        step, weakest = _solved(N, g, extent)
        T_ca = _moved(T_ca, step)
        small = np.linalg.norm(step[:3]) * extent + np.linalg.norm(step[3:]) < 1e-5 * extent
        tighter = max(3.0 * 1.4826 * float(np.median(np.abs(distances))), 0.01 * extent)
        if small and tighter > 0.98 * gate:
            break
        gate = min(gate, tighter)
    return Match(T_ca.inverse(), ratio, rms, weakest)


def _normal_equations(view: View, model: Patchwork, T_ca: Pose, gate: float) -> tuple[Array, Array, Array, float]:
    """Sums J'WJ (6, 6) and J'We (6,) over corresponding points, their distances to the planes [m], and their share."""
    p, n_view = T_ca.apply(view.points), view.normals @ T_ca.R.T
    d, index = model.tree.query(p, distance_upper_bound=gate)
    near = np.isfinite(d)
    index = np.where(near, index, 0)
    near &= np.einsum("ni,ni->n", n_view, model.normals[index]) > SAME_SIDE
    p, q, n = p[near], model.points[index[near]], model.normals[index[near]]
    e = np.einsum("ni,ni->n", n, q - p)
    w = np.maximum(1.0 - (e / gate) ** 2, 0.0) ** 2
    J = np.hstack([np.cross(p, n), n])
    return (J * w[:, None]).T @ J, J.T @ (w * e), e, float(near.mean())


def _solved(N: Array, g: Array, extent: float) -> tuple[Array, float]:
    """The step d = [theta; v] in {C}; directions that the surface does not determine are left out."""
    scale = np.array([1.0 / extent] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(N * np.outer(scale, scale))
    good = values > 1e-4 * values[-1]
    step = vectors[:, good] @ ((vectors[:, good].T @ (g * scale)) / values[good])
    return np.asarray(step * scale), float(values[0] / values[-1])


def _moved(T_ca: Pose, step: Array) -> Pose:
    q = geometry.exp(step[:3])
    return Pose(q, step[3:]) @ T_ca


# --- Batch refinement ------------------------------------------------------------------------------------------------


def _refined(
    views: Sequence[View], tracked: _Tracked, p: ReconstructionParams, extent: float
) -> tuple[dict[int, Pose], float]:
    """Poses of the key views that minimise the distances between all overlapping pairs, and the rms that is left."""
    keys = tracked.keys
    poses = [tracked.poses[k].inverse() for k in keys]
    trees = [cKDTree(views[k].points) for k in keys]
    gate, rms = 0.03 * extent, 0.0
    for _ in range(p.refinements):
        N = np.zeros((6 * len(keys), 6 * len(keys)))
        g, distances = np.zeros(6 * len(keys)), [np.zeros(1)]
        for i, j in _pairs(_sight_lines([views[k] for k in keys], poses)):
            e = _pair_terms(views[keys[i]], views[keys[j]], trees[j], poses, (i, j), gate, N, g)
            distances.append(e)
        N[:6, :6] += np.eye(6) * max(np.trace(N), 1.0)  # the first view defines the frame
        scale = np.tile(np.array([1.0 / extent] * 3 + [1.0] * 3), len(keys))
        N = N * np.outer(scale, scale)
        N[np.diag_indices_from(N)] += 1e-6 * np.trace(N) / len(N)
        step = np.linalg.solve(N, g * scale) * scale
        poses = [_moved(T, step[6 * i : 6 * i + 6]) for i, T in enumerate(poses)]
        every = np.concatenate(distances)
        rms = float(np.sqrt(np.mean(every**2)))
        gate = min(gate, max(3.0 * 1.4826 * float(np.median(np.abs(every))), 0.006 * extent))
        if np.abs(step / scale).max() < 1e-5 * extent:
            break
    return {k: T.inverse() for k, T in zip(keys, poses, strict=True)}, rms


def _sight_lines(views: Sequence[View], T_ca: Sequence[Pose]) -> Array:
    """(n, 3) unit vectors in {C} from the scanned surface to the camera."""
    lines = [T.R @ (v.camera - v.points.mean(axis=0)) for v, T in zip(views, T_ca, strict=True)]
    return np.array([line / np.linalg.norm(line) for line in lines])


def _pairs(directions: Array) -> list[tuple[int, int]]:
    """Ordered pairs of key views whose directions of view differ by less than PAIR_TURN_RAD; the nearest 12 each."""
    found = []
    for i, at in enumerate(directions):
        cosine = directions @ at
        order = [int(j) for j in np.argsort(-cosine, kind="stable") if j != i and cosine[j] > np.cos(PAIR_TURN_RAD)]
        found += [(i, j) for j in order[:12]]
    return found


def _pair_terms(
    a: View, b: View, tree: cKDTree, poses: Sequence[Pose], ij: tuple[int, int], gate: float, N: Array, g: Array
) -> Array:
    """Add the distances of the points of view i to the planes of view j to the normal equations of both poses."""
    i, j = ij
    p_c = poses[i].apply(a.points)
    p_b = poses[j].inverse().apply(p_c)
    d, index = tree.query(p_b, distance_upper_bound=gate)
    near = np.isfinite(d)
    index = np.where(near, index, 0)
    n_c = b.normals[index] @ poses[j].R.T
    near &= np.einsum("ni,ni->n", a.normals @ poses[i].R.T, n_c) > SAME_SIDE
    p, n = p_c[near], n_c[near]
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


def _all_poses(
    views: Sequence[View], tracked: _Tracked, keys: dict[int, Pose], p: ReconstructionParams, extent: float
) -> dict[int, Pose]:
    """Every tracked view registered once more, on the refined model of the key views."""
    model = _patchwork(views, replace_poses(tracked, keys), 0.6 * p.thin * extent)
    found = dict(keys)
    for k, T in sorted(tracked.poses.items()):
        if k in keys:
            continue
        nearest = max((j for j in keys if j <= k), default=0)
        guess = keys[nearest] @ (tracked.poses[nearest].inverse() @ T)
        match = _registered(views[k], model, guess, 0.03 * extent, extent)
        if match.ratio >= KEEP_RATIO:
            found[k] = match.T_ac
    return found


def replace_poses(tracked: _Tracked, poses: dict[int, Pose]) -> _Tracked:
    """The same track with other poses."""
    return replace(tracked, poses=poses)


# --- Fusion ----------------------------------------------------------------------------------------------------------


def _fused(
    views: Sequence[View], poses: dict[int, Pose], size_m: float
) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Surface points, normals, standard errors along the normal and numbers of scans, without carved voxels."""
    points, normals, owner = [], [], []
    for k, T_ac in sorted(poses.items()):
        full = np.asarray(views[k].full, dtype=np.float64)
        fine = _thinned(full, 0.7 * size_m)
        T_ca = T_ac.inverse()
        points.append(T_ca.apply(fine))
        normals.append(_normals(fine, full, views[k].camera) @ T_ca.R.T)
        owner.append(np.full(len(fine), k))
    p, n, who = np.vstack(points), np.vstack(normals), np.concatenate(owner)
    side = np.sign(n @ np.array([0.61, 0.53, 0.59]))
    cells = np.column_stack([np.floor(p / size_m), side]).astype(np.int64)
    _, inverse = np.unique(cells, axis=0, return_inverse=True)
    cell = inverse.ravel()
    mean, normal = _means(p, cell), _means(n, cell)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    count = np.bincount(cell)
    seen = np.bincount(np.unique(np.column_stack([cell, who]), axis=0)[:, 0], minlength=len(count))
    height = np.einsum("ni,ni->n", p - mean[cell], normal[cell])
    scatter = np.sqrt(np.bincount(cell, height**2) / np.maximum(count - 1, 1))
    keep = _solid(mean, seen, views, poses, size_m) & ((seen >= 2) | (len(poses) < 12))
    sigma = scatter / np.sqrt(np.maximum(count, 1))
    return mean[keep], normal[keep], np.maximum(sigma, 1e-3 * size_m)[keep], seen[keep]


def _solid(
    points: Array, seen: NDArray[np.int64], views: Sequence[View], poses: dict[int, Pose], size_m: float
) -> NDArray[np.bool_]:
    """Which points no more than a third as many scans have looked through as have seen them."""
    numbers = sorted(poses)
    asked = numbers[:: max(1, len(numbers) // 60)]
    through = np.zeros(len(points))
    for k in asked:
        full = np.asarray(views[k].full, dtype=np.float64)
        behind = _depth_behind(poses[k].apply(points), full, views[k].camera, 1.5 * size_m)
        through += behind > 6.0 * size_m
    return np.asarray(through * (len(numbers) / len(asked)) <= 0.34 * seen)


def _directions(views: Sequence[View], poses: Sequence[Pose]) -> tuple[float, float]:
    """Largest turn between two poses [rad], and the share of all directions in {C} from which a scan was taken."""
    turns = [_turn(poses[0], T) for T in poses]
    seen = _sight_lines(views, [T.inverse() for T in poses])
    near = (starts.directions(1000) @ seen.T).max(axis=1) > np.cos(SPREAD_RAD)
    return max(turns), float(near.mean())


def _refuse_still(turn: float, weakest: Sequence[float]) -> None:
    if float(np.median(weakest)) < 1e-5:
        raise UnreadableInput("the surface does not determine the attitude (a sphere or a plane)", hint="give a model")
    if turn < np.radians(5.0):
        raise UnreadableInput(
            f"the target turned by {np.degrees(turn):.1f} deg only", hint="a model needs several sides"
        )


def _notes(used: int, offered: int, coverage: float) -> tuple[str, ...]:
    notes = []
    if used < 0.8 * offered:
        notes.append(f"{offered - used} of {offered} scans could not be registered and are not part of the model")
    if coverage < 0.5:
        notes.append(f"the target was seen from {100.0 * coverage:.0f} % of all directions only")
    return tuple(notes)
