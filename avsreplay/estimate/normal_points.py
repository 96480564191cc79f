"""Normal points: few poses that carry the information of many, for fits whose cost does not
grow with the log.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.estimate import _motion
from avsreplay.estimate.batch import Poses, Prior, Problem
from avsreplay.estimate.chart import Chart, to_state
from avsreplay.estimate.dynamics import rotation_path, translated
from avsreplay.estimate.error_state import DIM
from avsreplay.estimate.measurement import GATE
from avsreplay.estimate.pose_noise import cholesky_root
from avsreplay.geometry import Array
from avsreplay.records import Manoeuvre

# most normal points, and least rotation over which poses are joined [rad]
_POINTS = 128
_SPAN_RAD = 0.25
_MOST_UNJOINED = 48  # poses up to which none are joined
_NEIGHBOURS = 5  # poses with whose median a pose is compared
# squared difference of a gross error over the median of all poses, or over its expectation
_GROSS_RATIO = 100.0
_VIEW_RAD = 0.5  # 1 sigma of the correlation of the common errors over the direction of view
_FREE = (1e2, 1e3, 1e1)  # 1 sigma of arm [m], position [m] and velocity [m/s] before the positions
_LEAST_M = 1e-6  # least 1 sigma of a displacement [m]
_ANY_PRIOR = Prior(Chart(np.zeros(34)), np.eye(DIM))  # of residuals, which do not depend on it


@value_class
class PositionRows:
    """Positions of many poses as n points that are linear in the motion of the mass centre,
    whatever the rotation.

    Rows are whitened and ordered by axis of {C}, and for each axis by point.

    Attributes:
        e: (3n,) positions.
        J: (3n, m) of arm in {C}, position, velocity, and changes of them.
        info: (m, m) information of these unknowns before the positions.
        white, common: (n, n) covariance of the independent and of the common errors, the same for
            three axes.
        force: (3n, 3(n - 1)) of impulses of the force between the points, of unit density.
    """

    e: Array
    J: Array
    info: Array
    white: Array
    common: Array
    force: Array


def position_rows(
    poses: Poses,
    weights: Array,
    arm: Array,
    most: int,
    epoch_ns: int = 0,
    changes: Sequence[Manoeuvre] = (),
) -> PositionRows:
    """Weighted means of the positions over equal shares of the time.

    The position is r + v t + R c with the measured rotation R, so that a mean of positions belongs
    to the mean of R.

    Args:
        poses: n poses, in free motion apart from disturbances.
        weights: (n,) of the poses as measurements.
        arm: (3,) approximate c [m], with which errors of R displace R c.
        most: largest number of points.
        epoch_ns: instant of the first pose.
        changes: manoeuvres; an error of the instant of one displaces the later positions.
    """
    t = poses.times_s - poses.times_s[0]
    cells = np.minimum((t / (t[-1] * (1.0 + 1e-9)) * most).astype(int), most - 1)
    first = np.flatnonzero(np.diff(cells, prepend=-1))
    moved = np.hstack([geometry.skew(arm), np.eye(3)])
    C = moved @ poses.C @ moved.T
    w = weights / np.trace(C, axis1=1, axis2=2)
    w /= np.repeat(np.add.reduceat(w, first), np.diff(first, append=len(t)))
    R, middle = geometry.matrix(poses.q), (first + np.append(first[1:], len(t))) // 2
    placed = poses.t - (R @ poses.shifts[:, 3:, None])[:, :, 0]
    seen, turns, times = (
        np.add.reduceat(w.reshape(-1, *[1] * (a.ndim - 1)) * a, first) for a in (placed, R, t)
    )
    noise = np.add.reduceat((w * w)[:, None, None] * (R @ C @ np.swapaxes(R, 1, 2)), first)
    root = np.linalg.inv(cholesky_root(np.swapaxes(R[middle], 1, 2) @ noise @ R[middle]))
    root = root @ np.swapaxes(R[middle], 1, 2)
    late = np.maximum(times[:, None] - 0.5 * (times[1:] + times[:-1]), 0.0) * np.sqrt(
        np.diff(times)
    )
    counts = 1.0 / np.add.reduceat(w * w, first)
    shares = None if poses.shares is None else np.add.reduceat(w * poses.shares, first)
    points = Poses(times, poses.q[middle], poses.t[middle], poses.C[middle], counts, shares)
    white, common = error_parts(points)
    changes = [m for m in changes if m.t_ns > epoch_ns]
    since = [np.maximum(times - (m.t_ns - epoch_ns) * 1e-9, 0.0) for m in changes]
    effects = [np.ones(len(times)), times, *(a for b in since for a in (b, b > 0.0))]
    shifts = [max(_LEAST_M, m.t_1s_s * float(np.linalg.norm(m.velocity))) for m in changes]
    J = np.concatenate([root @ turns, *(a[:, None, None] * root for a in effects)], axis=2)
    sizes = np.repeat([*_FREE, *(a for size in shifts for a in (_FREE[2], size))], 3)
    force = (late[:, None, :, None] * root[:, :, None, :]).reshape(len(times), 3, -1)
    e = (root @ (seen - seen[0])[:, :, None])[:, :, 0]
    rows = [
        np.ascontiguousarray(a.transpose(1, 0, 2)).reshape(3 * len(times), -1) for a in (J, force)
    ]
    return PositionRows(
        np.ascontiguousarray(e.T).reshape(-1),
        rows[0],
        np.diag(sizes**-2.0),
        white,
        common,
        rows[1],
    )


def view_correlation(poses: Poses) -> Array:
    """(n, n) correlation of the common errors of poses, by the direction from the target to the
    camera in {C}.
    """
    u = (poses.t[:, None, :] @ geometry.matrix(poses.q))[:, 0]
    u /= np.maximum(np.linalg.norm(u, axis=1), 1e-300)[:, None]
    angle = np.arccos(np.clip(u @ u.T, -1.0, 1.0))
    return np.asarray(np.exp(-0.5 * (angle / _VIEW_RAD) ** 2))


def error_parts(points: Poses) -> tuple[Array, Array]:
    """Covariances (n, n) of the independent and of the common errors of whitened poses at unit
    factors.
    """
    n = len(points)
    share = np.zeros(n) if points.shares is None else points.shares
    amplitude = np.sqrt(share * (np.ones(n) if points.counts is None else points.counts))
    return np.diag(1.0 - share), amplitude[:, None] * view_correlation(points) * amplitude


def normal_points(
    poses: Poses, reference: Chart, factors: Array, most: int = _POINTS, scatter: bool = False
) -> Poses:
    """At most some hundred poses that carry the information of many: weighted means about a
    reference motion.

    Neighbouring poses, over a turn of a fraction of a radian, are replaced by one: the reference's
    pose at their mean instant, corrected by their mean difference from it. The mean weighted by
    their information may be far from there along directions that none of them determines; the
    difference of the two is the ``shift``. The covariance is the inverse of the sum of their
    information. The difference of two solutions of the motion changes little over such a turn, so
    the fit to the normal points is the fit to the poses. Satellite laser ranging reduces its
    observations to normal points in the same way.

    Args:
        poses: the measurements.
        reference: initial values of a motion close to them.
        factors: (2,) noise factors of attitude and position, for the weights of outliers.
        most: largest number of normal points. A gap in the poses may add one point.
        scatter: with the scatter of the poses about their normal points (``Poses.within``).
    """
    n, rate = len(poses), float(np.linalg.norm(reference.w_c))
    if n <= min(most, _MOST_UNJOINED):
        return poses
    first = _parts(rate * (poses.times_s - poses.times_s[0]), most)
    d = poses.residuals(Problem(poses, _ANY_PRIOR, factors), reference)
    white = poses.whitened(d, factors)
    weights = 1.0 / np.maximum((white * white).sum(axis=1) / GATE, 1.0)
    sizes = np.diff(first, append=n)
    counts = sizes if poses.counts is None else np.add.reduceat(poses.counts, first)
    shifted = np.add.reduceat(weights, first) < 0.5 * sizes  # the reference is off, not the poses
    weights = np.where(np.repeat(shifted, sizes), 1.0, weights)
    info = weights[:, None, None] * (np.swapaxes(poses.root, 1, 2) @ poses.root)
    C = np.linalg.inv(np.add.reduceat(info, first))
    mean = (C @ np.add.reduceat(info @ d[:, :, None], first))[:, :, 0]
    within = _within(poses, d, weights, first, sizes) if scatter else None
    shares = None if poses.shares is None else np.add.reduceat(poses.shares, first) / sizes
    times = np.add.reduceat(weights * poses.times_s, first) / np.add.reduceat(weights, first)
    x = to_state(reference)
    q_ab, centre = rotation_path(x).at(times)[0], translated(x, times, poses.arc)[0]
    off = np.add.reduceat(weights[:, None] * d, first) / np.add.reduceat(weights, first)[:, None]
    q, t = _motion.corrected_poses(x.flat, q_ab, centre, geometry.exp(-off[:, :3]), off[:, 3:])
    C = 0.5 * (C + np.swapaxes(C, 1, 2))
    return Poses(times, q, t, C, counts, shares, within, poses.arc, mean - off)


def gross_errors(poses: Poses, d: Array, factors: Array) -> NDArray[np.bool_]:
    """Return which poses lie apart from their neighbours; disturbances move neighbours alike.

    Args:
        poses: the n poses.
        d: (n, 6) residuals.
        factors: (2,) noise factors of attitude and position.
    """
    first = np.clip(np.arange(len(d)) - _NEIGHBOURS // 2, 0, max(0, len(d) - _NEIGHBOURS))
    around = d[np.minimum(first[:, None] + np.arange(_NEIGHBOURS), len(d) - 1)]
    white = poses.whitened(d - np.median(around, axis=1), factors)
    squares = (white * white).sum(axis=1)
    return np.asarray(squares > _GROSS_RATIO * max(float(np.median(squares)), 6.0))


def _parts(turned: Array, most: int) -> NDArray[np.int64]:
    """Index of the first pose of each normal point: it ends after a share of the rotation, or of
    the poses.

    Args:
        turned: (n,) rotation of the poses since the first [rad].
        most: number of normal points.
    """
    n = len(turned)
    span, size = max(_SPAN_RAD, float(turned[-1]) / most), -(-n // min(most, _MOST_UNJOINED))
    out, angles = [0], turned.tolist()
    while (next_ := min(bisect_left(angles, angles[out[-1]] + span), out[-1] + size)) < n:
        out.append(next_)
    return np.array(out)


def _within(
    poses: Poses, d: Array, weights: Array, first: NDArray[np.int64], counts: NDArray[np.int64]
) -> tuple[tuple[float, float], float]:
    """Squared whitened residuals d (n, 6) about a straight line through each normal point, and
    degrees of freedom.

    The line takes what is left of the difference between the motion and its reference.
    """
    white = np.sqrt(weights)[:, None] * (poses.root @ d[:, :, None])[:, :, 0]
    one = np.sqrt(weights)
    late = one * (poses.times_s - np.repeat(np.add.reduceat(poses.times_s, first) / counts, counts))
    sums = [[np.add.reduceat(a * b, first) for b in (one, late)] for a in (one, late)]
    some = (counts > 3) & (sums[1][1] > 0.0)
    if not np.any(some):
        return (0.0, 0.0), 0.0
    A: Array = np.moveaxis(np.array(sums), 2, 0)[some]
    rhs = np.stack(
        [np.add.reduceat(a[:, None] * white, first, axis=0) for a in (one, late)], axis=1
    )[some]
    lines = np.linalg.solve(A, rhs)
    kept = np.repeat(some, counts)
    left = white[kept] - np.repeat(lines[:, 0], counts[some], axis=0) * one[kept, None]
    left -= np.repeat(lines[:, 1], counts[some], axis=0) * late[kept, None]
    dof = 3.0 * max(float(weights[kept].sum()) - 2.0 * int(some.sum()), 0.0)
    return (float((left[:, :3] ** 2).sum()), float((left[:, 3:] ** 2).sum())), dof
