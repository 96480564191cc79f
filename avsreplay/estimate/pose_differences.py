"""Disturbances that the differences of registered poses show without a model of the motion, as of a
part on a cable.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from avsreplay.estimate.batch_covariance import SPHERE
from avsreplay.estimate.initialise import PoseFix
from avsreplay.estimate.scan_window import PRIOR_ODDS, log_mean
from avsreplay.geometry import Array, conjugate, log, multiply

# poses from which disturbances are estimated without a model of the motion
FEWEST_DISTURBED = 5
MOST_DISTURBED = 8
# compared; errors over the claimed ones
_DENSITIES = np.logspace(-6.0, 2.0, 81)
_ERRORS = np.logspace(0.0, 4.0, 41)
_LONGEST = 3.0  # interval between two of them over the median
# change of the step between poses: angle [rad], and length over the extent
_MOST_TURN = 0.35
_MOST_MOVE = 0.1


def disturbance_levels(fixes: Sequence[PoseFix], extent_m: float) -> tuple[float, float] | None:
    """Root densities of white disturbances that explain the differences of poses, without a model
    of the motion.

    Two hypotheses explain a velocity between poses that changes: the poses have independent errors
    larger than claimed, or the velocity is a random walk. Errors give consecutive changes of the
    velocity a correlation of -2/3, a random walk 1/4, and smooth motion one near 1. Their
    likelihoods are marginal over the size of the errors and the density of the walk, and their odds
    include the prior of every hypothesis.

    Args:
        fixes: registered poses in the order of time, none of them used.
        extent_m: the target's bounding diagonal [m].

    Returns:
        Of the torque over the trace of the inertia tensor [rad/s^1.5], and of the force per unit
        mass [m/s^1.5]; None where the poses are too few, or contradict one another, or the steps
        between them are too large to be followed.
    """
    if len(fixes) < FEWEST_DISTURBED:
        return None
    h = np.diff(np.array([f.t_ns for f in fixes], dtype=np.float64) * 1e-9)
    if h.min() <= 0.0 or h.max() > _LONGEST * np.median(h):
        return None
    turns = np.array([log(multiply(conjugate(a.T_ac.q), b.T_ac.q)) for a, b in pairwise(fixes)])
    moves = np.diff(np.array([f.T_ac.t for f in fixes]), axis=0)
    found, odds = [], PRIOR_ODDS
    for step, most, block in (
        (turns, _MOST_TURN, slice(0, 3)),
        (moves, _MOST_MOVE * extent_m, slice(3, 6)),
    ):
        if np.sqrt((np.diff(step, axis=0) ** 2).sum(axis=1)).max() > most:
            return None
        claimed = float(np.mean([np.trace(f.C[block, block]) / 3.0 for f in fixes]))
        errors, walk = _explained_changes(np.diff(step / h[:, None], axis=0), h, claimed)
        odds += log_mean(walk.tolist()) - log_mean(errors.tolist())
        weight = np.exp(walk - walk.max())
        found.append(float(weight @ _DENSITIES**1.5 / weight.sum()) ** (2.0 / 3.0))
    return (found[0] / SPHERE, found[1]) if odds > 0.0 else None


def _explained_changes(changes: Array, h: Array, claimed: float) -> tuple[Array, Array]:
    """Log likelihoods of changes (m, 3) of the velocity between poses at intervals h (m + 1,) [s].

    Args:
        changes: of the mean velocity from one interval to the next.
        h: intervals between the poses.
        claimed: variance of each component of a pose.

    Returns:
        (k,) by independent errors of the poses of the sizes ``_ERRORS`` over the claimed one, and
        (n,) by a random walk of the velocity of the root densities ``_DENSITIES`` with errors as
        claimed.
    """
    second = np.diff(np.diff(np.eye(len(h) + 1), axis=0) / h[:, None], axis=0)
    noise = claimed * second @ second.T
    walk = np.diag((h[1:] + h[:-1]) / 3.0) + np.diag(h[1:-1] / 6.0, 1) + np.diag(h[1:-1] / 6.0, -1)
    out = []
    for C in (_ERRORS[:, None, None] ** 2 * noise, noise + _DENSITIES[:, None, None] ** 2 * walk):
        left = np.einsum(
            "mi,kmi->k",
            changes,
            np.linalg.solve(C, np.broadcast_to(changes, (len(C), *changes.shape))),
        )
        out.append(-0.5 * left - 1.5 * np.linalg.slogdet(C)[1])
    return out[0], out[1]
