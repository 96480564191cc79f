"""Errors of single scans: scans that are wrong, and poses with larger errors.

Their density is that of the doubtful innovations given the accepted ones, with more noise on each.
A noise level that rises without a larger covariance from the registration or the tracker gives
large innovations that contradict one another. With the covariance of its poses enlarged the scans
can be used.
"""

from __future__ import annotations

import math
from itertools import product

import numpy as np

from avsreplay.estimate import _motion
from avsreplay.estimate.pose_noise import cholesky_root
from avsreplay.estimate.scan_window import (
    OFFSETS,
    PRIOR_ODDS,
    ChangePriors,
    Explanation,
    Hypothesis,
    Window,
    log_mean,
    offsets,
)
from avsreplay.geometry import Array, frozen

_PER_BAD_SCAN = math.log(1e-2)
_WIDTHS = (1.0, 0.1)  # factors on the prior 1 sigma of an error of a bad scan
_RISES = np.logspace(
    math.log10(2.0), 1.0, 5
)  # factors on the standard deviation of the poses that are compared
_RISEN = (slice(0, 6), slice(0, 3), slice(3, 6))  # of the pose, of its position or of its attitude


def noisier(window: Window, white: Array, first: int) -> Explanation:
    """The errors of all doubtful poses are larger than their covariance by one factor, in position,
    attitude or both.

    Args:
        window: the scans.
        white: (6p,) its whitened innovations.
        first: index of the first doubtful scan.
    """
    value, y, S = _given_accepted(window, white, first)
    R = _diagonal(window.R[first:])
    tried = list(product(_RISEN, _RISES.tolist()))
    factors = np.ones((len(tried), 6))
    for row, (part, rise) in zip(factors, tried, strict=True):
        row[part] = rise
    more = np.tile(np.sqrt(factors * factors - 1.0), (1, len(window.R) - first))
    odds, chi2 = _densities(y, S + more[:, :, None] * R * more[:, None, :])
    k, dof, accepted = int(np.argmax(odds)), len(white), white[: 6 * window.points.before(first)]
    left = float(chi2[k]) + float(accepted @ accepted)
    left = max(
        left, float(chi2[k]) * dof / len(y)
    )  # it must explain the doubtful scans by themselves as well
    total = value + log_mean(odds.tolist()) + PRIOR_ODDS
    return Explanation(Hypothesis.NOISIER, total, left, dof, first, size=frozen(factors[k]))


def bad_scans(window: Window, white: Array, priors: ChangePriors, first: int) -> Explanation:
    """The doubtful scans, or all but the last, have an error of their own: of range, position or
    pose, large or small.

    Args:
        window: the scans.
        white: (6p,) its whitened innovations.
        priors: 1 sigma of the errors.
        first: index of the first doubtful scan.
    """
    value, y, S = _given_accepted(window, white, first)
    M, scale = offsets(window, priors)
    n, accepted, errors = len(window.R), white[: 6 * window.points.before(first)], []
    for kind, width in product(OFFSETS, _WIDTHS):
        columns = width * scale[kind] * M[first:, :, kind]
        errors.append(_diagonal(columns @ columns.mT))
    odds, chi2 = _densities(y, S + np.array(errors))
    odds += _PER_BAD_SCAN * (n - first)
    if n - first > 1:
        errors = [np.pad(each[:-6, :-6], (0, 6)) for each in errors]
        others, chi2_others = _densities(y, S + np.array(errors))
        odds = np.concatenate([odds, others + _PER_BAD_SCAN * (n - first - 1)])
        chi2 = np.concatenate([chi2, chi2_others])
    left = float(chi2[int(np.argmax(odds))]) + float(accepted @ accepted)
    return Explanation(
        Hypothesis.BAD_SCANS, value + log_mean(odds.tolist()) + PRIOR_ODDS, left, len(white), first
    )


def _given_accepted(window: Window, white: Array, first: int) -> tuple[float, Array, Array]:
    """Log density of the accepted innovations; the doubtful ones less their mean given these,
    and their covariance.
    """
    a = 6 * window.points.before(first)
    value = -0.5 * float(white[:a] @ white[:a]) + float(
        np.log(np.diagonal(window.whiten)[:a]).sum()
    )
    root = _motion.lower_inverse(np.ascontiguousarray(window.whiten[a:, a:]))
    return value, root @ white[a:], root @ root.T


def _densities(y: Array, C: Array) -> tuple[Array, Array]:
    """(k,) log densities of N(0, C) at y without their constant, and squared whitened norms, for C
    (k, m, m).
    """
    root = cholesky_root(C)
    left = np.linalg.solve(root, np.broadcast_to(y[:, None], (len(C), len(y), 1)))[:, :, 0]
    chi2 = (left * left).sum(axis=1)
    return -0.5 * chi2 - np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1), chi2


def _diagonal(blocks: Array | tuple[Array, ...]) -> Array:
    """(6m, 6m) with m blocks (6, 6) on its diagonal."""
    m = len(blocks)
    out = np.zeros((m, 6, m, 6))
    out[np.arange(m), :, np.arange(m)] = np.array(blocks)
    return out.reshape(6 * m, 6 * m)
