"""Normal points: few poses that carry the information of many, for fits whose cost does not grow with the log."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.estimate.batch import Poses, Prior, Problem
from avsreplay.estimate.chart import Chart, to_state
from avsreplay.estimate.dynamics import rotation_path, translated
from avsreplay.estimate.error_state import DIM
from avsreplay.estimate.measurement import GATE
from avsreplay.geometry import Array

_POINTS, _SPAN_RAD = 128, 0.25  # most normal points, and least rotation over which poses are joined [rad]
_FEW = 48  # poses up to which none are joined
_NEIGHBOURS = 5  # poses with whose median a pose is compared
_GROSS = 100.0  # squared difference of a gross error over the median of all poses, or over its expectation


def normal_points(poses: Poses, reference: Chart, factors: Array, most: int = _POINTS) -> Poses:
    """At most some hundred poses that carry the information of many: weighted means about a reference motion.

    Neighbouring poses, over a turn of a fraction of a radian, are replaced by one: the reference's pose at their mean
    instant, corrected by the mean of their differences from it. Its covariance is the inverse of the sum of their
    information. The difference of two solutions of the motion changes little over such a turn, so the fit to the
    normal points is the fit to the poses. Satellite laser ranging reduces its observations to normal points in the same
    way.

    Args:
        poses: the measurements.
        reference: initial values of a motion close to them.
        factors: (2,) noise factors of attitude and position, for the weights of outliers.
        most: largest number of normal points. A gap in the poses may add one point.
    """
    n, rate = len(poses), float(np.linalg.norm(reference.w_c))
    if n <= min(most, _FEW):
        return poses
    first = _parts(rate * (poses.times_s - poses.times_s[0]), most)
    d = poses.residuals(Problem(poses, Prior(reference, np.eye(DIM)), factors), reference)
    white = (poses.root @ (d / np.repeat(factors, 3))[:, :, None])[:, :, 0]
    weights = 1.0 / np.maximum((white * white).sum(axis=1) / GATE, 1.0)
    sizes = np.diff(first, append=n)
    counts = sizes if poses.counts is None else np.add.reduceat(poses.counts, first)
    shifted = np.add.reduceat(weights, first) < 0.5 * sizes  # the reference is off, not the poses
    weights = np.where(np.repeat(shifted, sizes), 1.0, weights)
    info = weights[:, None, None] * (np.swapaxes(poses.root, 1, 2) @ poses.root)
    C = np.linalg.inv(np.add.reduceat(info, first))
    mean = (C @ np.add.reduceat(info @ d[:, :, None], first))[:, :, 0]
    within = _within(poses, d, weights, first, sizes)
    shares = None if poses.shares is None else np.add.reduceat(poses.shares, first) / sizes
    times = np.add.reduceat(weights * poses.times_s, first) / np.add.reduceat(weights, first)
    x = to_state(reference)
    q_ab = rotation_path(x).at(times)[0]
    q = geometry.multiply(geometry.multiply(q_ab, x.q_bc), geometry.exp(-mean[:, :3]))
    t = translated(x, times, poses.arc)[0] + geometry.matrix(q_ab) @ x.c_b
    return Poses(
        times,
        q,
        t - (geometry.matrix(q) @ mean[:, 3:, None])[:, :, 0],
        0.5 * (C + np.swapaxes(C, 1, 2)),
        counts,
        shares,
        within,
        poses.arc,
    )


def gross_errors(poses: Poses, d: Array, factors: Array) -> NDArray[np.bool_]:
    """Return which poses lie apart from their neighbours; disturbances move neighbours alike.

    Args:
        poses: the n poses.
        d: (n, 6) residuals.
        factors: (2,) noise factors of attitude and position.
    """
    first = np.clip(np.arange(len(d)) - _NEIGHBOURS // 2, 0, max(0, len(d) - _NEIGHBOURS))
    around = d[np.minimum(first[:, None] + np.arange(_NEIGHBOURS), len(d) - 1)]
    white = (poses.root @ ((d - np.median(around, axis=1)) / np.repeat(factors, 3))[:, :, None])[:, :, 0]
    squares = (white * white).sum(axis=1)
    return np.asarray(squares > _GROSS * max(float(np.median(squares)), 6.0))


def _parts(turned: Array, most: int) -> NDArray[np.int64]:
    """Index of the first pose of each normal point: it ends after a share of the rotation, or of the poses.

    Args:
        turned: (n,) rotation of the poses since the first [rad].
        most: number of normal points.
    """
    n = len(turned)
    span, size = max(_SPAN_RAD, float(turned[-1]) / most), -(-n // min(most, _FEW))
    out = [0]
    while (next_ := min(int(np.searchsorted(turned, turned[out[-1]] + span)), out[-1] + size)) < n:
        out.append(next_)
    return np.array(out)


def _within(
    poses: Poses, d: Array, weights: Array, first: NDArray[np.int64], counts: NDArray[np.int64]
) -> tuple[tuple[float, float], float]:
    """Squared whitened residuals d (n, 6) about a straight line through each normal point, and degrees of freedom.

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
    rhs = np.stack([np.add.reduceat(a[:, None] * white, first, axis=0) for a in (one, late)], axis=1)[some]
    lines = np.linalg.solve(A, rhs)
    kept = np.repeat(some, counts)
    left = white[kept] - np.repeat(lines[:, 0], counts[some], axis=0) * one[kept, None]
    left -= np.repeat(lines[:, 1], counts[some], axis=0) * late[kept, None]
    dof = 3.0 * max(float(weights[kept].sum()) - 2.0 * int(some.sum()), 0.0)
    return (float((left[:, :3] ** 2).sum()), float((left[:, 3:] ** 2).sum())), dof
