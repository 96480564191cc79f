"""Batch refinement of the poses of the key scans, and fusion of all scans into one surface."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import comb

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.estimate.chart import to_chart, to_state
from avsreplay.geometry import Array, Pose
from avsreplay.reconstruct.registration import (
    PAIR_POINTS,
    SAME_SIDE_COSINE,
    Pairing,
    moved,
    registered,
)
from avsreplay.reconstruct.tracking import (
    LEAST_ON_MODEL_SHARE,
    FreeMotion,
    ReconstructionParams,
    Tracked,
    patchwork,
)
from avsreplay.reconstruct.views import (
    ScanView,
    Survey,
    Twist,
    averaged,
    camera_of,
    central_points,
    depth_behind,
    full_cloud,
    normals_of,
    point_tree,
    sight_lines,
    spacings,
    turn,
)
from avsreplay.records import Scan
from avsreplay.register import sampling

MOTION_POINTS = 1500  # points of a scan in one comparison for the fit of the motion
LEAST_KEY_SCANS = 40  # in a log with fewer key scans, every scan is a key scan in the refinement
# share of the spacing of the points up to which a moved pair of views keeps its corresponding
# points
KEPT_PAIRS_SHIFT_RATIO = 0.1
NORMAL_POINTS = 30  # nearest points of all key scans from which a normal is estimated
NORMAL_REACH_OF_EXTENT = 0.03  # their largest distance as a share of the extent
LEAST_VARIANCE_RATIO = 0.1  # least variance of a point along its normal, in units of the median
LONELY_POINT_WEIGHT = 0.25  # weight of a point with too few neighbours for a variance
MAX_RAY_SCANS = 60  # scans that are tested for rays through a point
# scans that face a point without a return there; with more, a point from one scan is left out
MAX_EMPTY_SCANS = 3
# points that so many scans have measured are compared with a third of the scans at first
OFTEN_MEASURED_SCANS = 6
MAX_COMPARED_POINTS = 3000  # points of the model that are compared with one view
# share of the model's visible points that a view must show, in units of the median of all views
LEAST_SHOWN_RATIO = 0.8
# share of the surface in its direction that a view of a right model seldom contradicts
MISSED_SHARE = 0.05
MISSED_PROBABILITY = 0.1  # largest probability that it does
SIGNIFICANCE_LEVEL = 0.01  # of the test of all views
MAX_MOTION_STEPS = 10  # evaluations of the motion that minimises the distances between views
LEAST_DAMPING = 1e-3
LEAST_RMS_IMPROVEMENT = 1e-4  # relative; a smaller one ends the steps
# least number of the ten nearest points that continue the surface of a point from one scan
LEAST_SUPPORT_POINTS = 5
SPREAD_RAD = np.radians(
    30.0
)  # a direction counts as covered if a scan was taken from within this angle of it


def refined(
    views: Sequence[ScanView], tracked: Tracked, p: ReconstructionParams, extent: float
) -> tuple[list[ScanView], dict[int, Pose], float, float]:
    """Poses of the key views that minimise the distances between overlapping pairs.

    The pairs of one view are spread evenly over the angles up to 90 degrees: pairs of views of
    nearly the same side do not show a common displacement of all scans along the line of sight.
    After a first adjustment the normals are estimated again, from the points of all key scans
    together. The weights of the result are inverse variances of the points about the planes of
    their neighbours. They serve the fit of the motion only: a wrong pose makes the surface rough
    where it lies, and with such weights in the adjustment of the poses it would stay there.

    Args:
        views: the views, in order of time.
        tracked: the poses so far.
        p: the parameters of the reconstruction.
        extent: diameter of the target [m].

    Returns:
        The views with the better normals and these weights, T_ac by number of the key view, the rms
        of the distances that is left, and the gate that was used for them [m].
    """
    keys, known = list(tracked.keys), sorted(tracked.poses)
    if len(keys) < LEAST_KEY_SCANS:
        others = [k for k in known if k not in tracked.keys]
        keys = sorted(keys + others[:: max(1, -(-len(others) // (LEAST_KEY_SCANS - len(keys))))])
    poses, better = {k: tracked.poses[k] for k in keys}, list(views)
    gate, rms = 0.03 * extent, 0.0
    for last in (False, True):
        poses, rms, gate = _adjusted(better, poses, p, extent, gate)
        for k, view in _with_merged_normals(better, poses, extent, last).items():
            better[k] = view
    return better, poses, rms, gate


def _adjusted(
    views: Sequence[ScanView],
    start: dict[int, Pose],
    p: ReconstructionParams,
    extent: float,
    gate: float,
) -> tuple[dict[int, Pose], float, float]:
    """Gauss-Newton iterations of the poses of all key views; the gate [m] follows the distances."""
    keys = sorted(start)
    poses, rms = [start[k].inverse() for k in keys], 0.0
    pairing = Pairing(
        [views[k] for k in keys], poses, PAIR_POINTS, KEPT_PAIRS_SHIFT_RATIO * p.thin * extent
    )
    scale = np.tile(np.array([1.0 / extent] * 3 + [1.0] * 3), len(keys))
    for _ in range(p.refinements):
        N, g, every, _ = pairing.equations(poses, gate)
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


def _with_merged_normals(
    views: Sequence[ScanView] | dict[int, ScanView],
    poses: dict[int, Pose],
    extent: float,
    weighted: bool,
) -> dict[int, ScanView]:
    """The key views with normals from the nearest points of all of them that lie on the same side
    of the target.

    If ``weighted``, the weight of a point is the inverse of the variance of these points along the
    normal, in units of the median variance: points at edges and of thin parts, whose neighbours lie
    on different faces, count little.
    """
    keys = sorted(poses)
    p = np.vstack([poses[k].inverse().apply(views[k].points) for k in keys])
    n = np.vstack([views[k].normals @ poses[k].R for k in keys])
    normals, squares, count = point_tree(p).planes(
        p, n, p, n, NORMAL_POINTS, NORMAL_REACH_OF_EXTENT * extent, SAME_SIDE_COSINE
    )
    good = count >= sampling.NORMAL_NEIGHBOURS
    normals *= np.where(np.einsum("ni,ni->n", normals, n) < 0.0, -1.0, 1.0)[:, None]
    normals = np.where(good[:, None], normals, n)
    weight = np.concatenate([views[k].weight for k in keys])
    if weighted and good.any():
        variance = squares / np.maximum(count - 3, 1)
        typical = float(np.median(variance[good]))
        weight = np.where(
            good,
            typical / np.maximum(variance, LEAST_VARIANCE_RATIO * typical),
            LONELY_POINT_WEIGHT,
        )
    ends = np.cumsum([len(views[k].points) for k in keys])[:-1]
    split = zip(keys, np.split(normals, ends), np.split(weight, ends), strict=True)
    return {k: replace(views[k], normals=m @ poses[k].R.T, weight=w) for k, m, w in split}


def joint_motion(
    views: Sequence[ScanView],
    fine: dict[int, ScanView],
    start: FreeMotion,
    gate: float,
    thin_m: float,
    extent: float,
) -> FreeMotion:
    """The free motion that minimises the distances between overlapping pairs of key views.

    The distances determine some directions of a pose much better than others: the turn of a
    cylinder about its axis is hardly seen. A motion that is fitted to the poses with equal weights
    spreads the errors of the bad directions over the good ones; fitted to the distances it uses the
    information of all scans about each direction. Normals and weights depend on the poses and are
    estimated again from the first result, for more points of each scan.

    Args:
        views: of the log, with the normals of all key views together.
        fine: the key views with more points.
        start: the motion fitted to the poses, whose covariance is kept.
        gate: largest distance that counts [m].
        thin_m: spacing of the points of a view [m].
        extent: of the target [m].

    Returns:
        The motion after Levenberg-Marquardt steps in the 20 initial values.
    """
    motion = _least_distances([views[k] for k in fine], start, gate, thin_m, extent)
    better = _with_merged_normals(
        fine, {k: motion.at(view.t_ns) for k, view in fine.items()}, extent, True
    )
    return _least_distances([better[k] for k in fine], motion, gate, thin_m, extent)


def _least_distances(
    views: Sequence[ScanView], start: FreeMotion, gate: float, thin_m: float, extent: float
) -> FreeMotion:
    instants, chart, damping = [view.t_ns for view in views], to_chart(start.state), LEAST_DAMPING
    pairing = Pairing(
        views,
        [start.at(t_ns).inverse() for t_ns in instants],
        MOTION_POINTS,
        KEPT_PAIRS_SHIFT_RATIO * thin_m,
    )
    best, best_rms = start, np.inf
    for _ in range(MAX_MOTION_STEPS):
        tried = replace(start, state=to_state(chart))
        poses = [tried.at(t_ns) for t_ns in instants]
        T_ca = [T.inverse() for T in poses]
        N, g, _, rms = pairing.equations(T_ca, gate)
        if rms < best_rms:
            small = rms > (1.0 - LEAST_RMS_IMPROVEMENT) * best_rms
            best, best_rms, damping = tried, rms, max(0.1 * damping, LEAST_DAMPING)
            J, prior = start.pose_jacobian(chart, instants, poses, extent)
            A, b = J.T @ N @ J / rms**2 + prior, -J.T @ g / rms**2
            if small:
                break
        else:
            damping *= 30.0
        step = np.linalg.solve(A + damping * np.diag(np.diagonal(A)), b)
        chart = to_chart(best.state).moved(np.asarray(step))
    return best


def all_poses(
    views: Sequence[ScanView],
    tracked: Tracked,
    keys: dict[int, Pose],
    p: ReconstructionParams,
    extent: float,
) -> dict[int, Pose]:
    """Every tracked view registered once more, on the refined model of the key views.

    Args:
        views: the views, in order of time.
        tracked: the poses so far.
        keys: refined T_ac by number of the key view.
        p: the parameters of the reconstruction.
        extent: diameter of the target [m].
    """
    model = patchwork(views, replace(tracked, poses=keys), 0.6 * p.thin * extent)
    found = dict(keys)
    for k, T in sorted(tracked.poses.items()):
        if k in keys:
            continue
        nearest = max((j for j in keys if j <= k), default=min(keys))
        guess = keys[nearest] @ (tracked.poses[nearest].inverse() @ T)
        match = registered(views[k], model, guess, 0.03 * extent, extent)
        if match.ratio >= LEAST_ON_MODEL_SHARE:
            found[k] = match.T_ac
    return found


def contradicting(
    views: Sequence[ScanView], poses: dict[int, Pose], p: ReconstructionParams, extent: float
) -> tuple[list[int], Array]:
    """Views without the surface that faces them by all other views: their poses are wrong, or they
    show another object.

    Points of the joint model that face a view and that nothing hides must be in it. A pose that is
    wrong puts the surfaces of other views where this one has measured something farther away, or
    nothing. The share of the points that are there is compared with the median over all views,
    because a scanner may lose returns everywhere.

    Args:
        views: of the log.
        poses: T_ac by number of the view.
        p: resolution.
        extent: of the target [m].

    Returns:
        The numbers of the views with less than LEAST_SHOWN_RATIO of the median share, and for every
        view (n, 2) the share of the points in its direction that it has seen through, with a return
        from farther away, and the share that it has seen through or where it has no return. A
        surface without a return contradicts poses that nothing else confirms; materials that return
        no light, and the limits of the field of view, also cause it.
    """
    model = patchwork(views, Tracked(poses, sorted(poses), [], 0, []), p.thin * extent)
    every, reach = max(1, len(model.points) // MAX_COMPARED_POINTS), 0.03 * extent
    shown, missed = [], []
    for k in sorted(poses):
        q, n = poses[k].apply(model.points[::every]), model.normals[::every] @ poses[k].R.T
        lines, measured = (
            views[k].camera - q,
            np.linalg.norm(views[k].points - views[k].camera, axis=1),
        )
        far = np.linalg.norm(lines, axis=1)
        facing = np.einsum("ni,ni->n", n, lines) > 0.5 * far
        off, nearest = views[k].rays.query(-lines[facing] / far[facing, None])
        behind = measured[nearest[:, 0]] - far[facing]
        hit = off[:, 0] * far[facing] <= reach
        hidden, there, seen = (
            int((hit & where).sum())
            for where in (behind < -reach, abs(behind) <= reach, behind > reach)
        )
        shown.append(there / max(len(hit) - hidden, 1))
        missed.append((seen / max(seen + there, 1), 1.0 - shown[-1]))
    least = LEAST_SHOWN_RATIO * float(np.median(shown))
    wrong = [k for k, share in zip(sorted(poses), shown, strict=True) if share < least]
    return wrong, np.array(missed)


def refuted(missed: Array) -> bool:
    """Whether more views contradict a model than are expected of a right one, by a binomial test.

    A view of a right model misses more than the share MISSED_SHARE of the surface in its direction
    with a probability of at most MISSED_PROBABILITY. The model is refuted if as many views as have
    missed more have a probability below SIGNIFICANCE_LEVEL.

    Args:
        missed: (n,) shares of the surface in the direction of each view.
    """
    n, count = len(missed), int((missed > MISSED_SHARE).sum())
    tail = sum(
        comb(n, k) * MISSED_PROBABILITY**k * (1.0 - MISSED_PROBABILITY) ** (n - k)
        for k in range(count, n + 1)
    )
    return tail < SIGNIFICANCE_LEVEL


@value_class
class Sight:
    """The view of a scan: points (n, 3) and position of the camera in {A} [m], and its pose."""

    points: Array
    camera: Array
    T_ac: Pose

    def seen_through(self, p_c: Array, spacing_m: float) -> Array:
        """How far behind points (m, 3) of {C} this scan measured a surface in the same direction
        [m]; 0: nothing.

        Args:
            p_c: points (m, 3) in {C} [m].
            spacing_m: distance between two directions that are the same, at the points [m].
        """
        return depth_behind(self.T_ac.apply(p_c), self.points, self.camera, spacing_m)

    def without_return(self, p_c: Array, normals: Array, reach_m: float) -> NDArray[np.bool_]:
        """Whether points (m, 3) of {C} on surfaces inclined by less than 60 degrees lie where this
        scan has no points.

        The nearest line of sight with a return must pass farther away than ``reach_m`` and three
        times the spacing of the points of the scan, so that something in front of a point also
        counts as a return.

        Args:
            p_c: points (m, 3) in {C} [m].
            normals: unit normals (m, 3) in {C}.
            reach_m: least distance of a line of sight with a return [m].
        """
        p, rays = self.T_ac.apply(p_c) - self.camera, self.points - self.camera
        far = np.linalg.norm(p, axis=1)
        tree = point_tree(rays / np.linalg.norm(rays, axis=1, keepdims=True))
        spacing = float(np.median(spacings(point_tree(self.points), self.points)))
        facing = np.abs(np.einsum("ni,ni->n", normals @ self.T_ac.R.T, p)) > 0.5 * far
        return np.asarray(
            facing & (tree.query(p / far[:, None])[0][:, 0] * far > max(reach_m, 3.0 * spacing))
        )


def fused(
    scans: Iterable[Scan], survey: Survey, twist: dict[int, Twist], size_m: float, rms_m: float
) -> tuple[Array, Array, Array, NDArray[np.int64], list[Sight]]:
    """Surface points, normals, standard errors along the normal, numbers of scans, and sights; one
    scan at a time.

    Points are left out if the scans whose rays pass through them are more than a third of those
    that have measured them. Points that only one scan has measured are left out if they do not
    continue the surface of their neighbours, or if more than MAX_EMPTY_SCANS scans that face them
    have no return from their direction: they belong to something else. Where voxels hold few
    points, their scatter is joined with one square of the noise of a point: half the mean square
    ``rms_m`` of the distances between two scans.

    Args:
        scans: the scans in order.
        survey: which scans are used, and their frame.
        twist: motion of the target by number of the view.
        size_m: edge of a voxel [m].
        rms_m: rms of the distances between two scans [m].
    """
    points, normals, owner, sights = [], [], [], list[Sight]()
    apart = max(1, len(twist) // MAX_RAY_SCANS)
    for k, scan in enumerate(scans):
        if k not in twist:
            continue
        full = full_cloud(scan, twist[k])
        fine, T_ca = central_points(full, 0.7 * size_m), twist[k].T_ac.inverse()
        points.append(T_ca.apply(fine).astype(np.float32))
        normals.append(
            (normals_of(fine, full, camera_of(scan, survey)) @ T_ca.R.T).astype(np.float32)
        )
        owner.append(np.full(len(fine), k))
        if (len(owner) - 1) % apart == 0:
            sights.append(Sight(fine, camera_of(scan, survey), twist[k].T_ac))
    p, n, who = (
        np.vstack(points).astype(np.float64),
        np.vstack(normals).astype(np.float64),
        np.concatenate(owner),
    )
    mean, normal, cell = averaged(p, n, size_m)
    count = np.bincount(cell)
    seen = np.bincount(
        np.unique(cell * (who.max() + 1) + who) // (who.max() + 1), minlength=len(count)
    )
    height = np.einsum("ni,ni->n", p - mean[cell], normal[cell])
    wide = 1.5 * size_m  # rays of one scan are farther apart than points of all scans
    keep = _seen_through(mean, seen, sights, wide) * (len(twist) / len(sights)) <= 0.34 * seen
    keep &= (seen >= 2) | (len(twist) < 12) | continues(mean, normal, size_m)
    once = np.flatnonzero(keep & (seen == 1))
    empty = sum(
        s.without_return(mean[once], normal[once], 2.0 * wide).astype(np.float64) for s in sights
    )
    keep[once] = np.asarray(empty) * (len(twist) / len(sights)) <= MAX_EMPTY_SCANS
    sigma = np.sqrt(np.bincount(cell, height**2) + 0.5 * rms_m**2) / count
    return mean[keep], normal[keep], np.maximum(sigma, 1e-3 * size_m)[keep], seen[keep], sights


def _seen_through(p: Array, seen: NDArray[np.int64], sights: Sequence[Sight], wide: float) -> Array:
    """Number of sights (n,) that have measured something behind each point; a point seen
    OFTEN_MEASURED_SCANS needs several.
    """
    through, tested = np.zeros(len(p)), np.arange(len(p))
    for part in (sights[::3], sights[1::3], sights[2::3]):
        for sight in part:
            through[tested] += sight.seen_through(p[tested], 1.5 * wide) > 6.0 * wide
        tested = np.flatnonzero((seen < OFTEN_MEASURED_SCANS) | (through > 0.0))
    return through


def continues(p: Array, n: Array, size_m: float) -> NDArray[np.bool_]:
    """Whether at least LEAST_SUPPORT_POINTS of the ten points nearest to each (n, 3) have a similar
    normal and are in its plane.

    Args:
        p: points (n, 3) [m].
        n: their unit normals (n, 3).
        size_m: edge of a voxel [m].
    """
    distances, nearest = point_tree(p).query(p, k=2 * LEAST_SUPPORT_POINTS + 1, most_m=3.0 * size_m)
    d = distances[:, 1:]
    index = np.where(np.isfinite(d), nearest[:, 1:], 0)
    near = np.isfinite(d) & (np.einsum("ni,nki->nk", n, n[index]) > SAME_SIDE_COSINE)
    near &= np.abs(np.einsum("ni,nki->nk", n, p[index] - p[:, None])) < size_m
    return np.asarray(near.sum(axis=1) >= LEAST_SUPPORT_POINTS)


def turn_and_coverage(views: Sequence[ScanView], poses: Sequence[Pose]) -> tuple[float, float]:
    """Largest turn between two poses [rad], and the share of all directions in {C} from which a
    scan was taken.

    Args:
        views: the views, in order of time.
        poses: T_ac of each view.
    """
    turns = [turn(poses[0], T) for T in poses]
    seen = sight_lines(views, [T.inverse() for T in poses])
    near = (sampling.directions(1000) @ seen.T).max(axis=1) > np.cos(SPREAD_RAD)
    return max(turns), float(near.mean())
