"""The fit's word with the motion's disturbances: what small pushes since leave of what old poses say.

The fit takes the motion as deterministic. About its path the problem is linear, so one pass of a Kalman filter over the
poses, with the disturbance's covariance between them, is the maximum likelihood with process noise. The errors are
carried back to the epoch, where the transition is 1, and stand in the chart's coordinates.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avsreplay.estimate import _motion
from avsreplay.estimate.chart import to_errors
from avsreplay.estimate.fit import FitParams, Poses, Prior, linearised
from avsreplay.estimate.layout import RHO, VEL
from avsreplay.estimate.motion import push, ratios
from avsreplay.estimate.spread import Bend, Node, Spread
from avsreplay.geometry import Array
from avsreplay.records import State

__all__ = ["disturbed", "memory_s"]

_STRAY_RAD = 0.05  # how far pushes may turn the body from the fitted path: beyond, the problem about it is not linear
_MOVING = 12  # error states a push reaches: attitude, rate, position, velocity
_SPHERE = 3.0  # tr I / I


def memory_s(torque: float) -> float:
    """How long [s] a fit may look back: a torque of root density ``torque`` turns by its square T^3 / 3 in variance."""
    return float(np.cbrt(3.0 * (_STRAY_RAD / (_SPHERE * torque)) ** 2))


def disturbed(found: Spread, poses: Poses, prior: Prior, rules: FitParams, torque: float, force: float) -> Spread:
    """The same fit as it bears on the last pose's instant; ``torque``, ``force``: root densities as in the filter."""
    fitted = found.fitted
    rows, J = linearised(poses, fitted.chart, prior, rules, fitted.effective)
    into = np.linalg.inv(to_errors(fitted.chart))[:, :_MOVING]
    Q = into @ _added(fitted.x, poses.times_s, torque, force) @ into.T
    y, P = _motion.filter(-fitted.chart.minus(prior.mean), prior.P, rows, J, Q)
    more = P - fitted.P_chart
    moved = [[Node(node.chart.moved(y), node.P + more) for node in bend.sides] for bend in found.bends]
    bends = tuple(Bend(bend.ray, (low, high)) for bend, (low, high) in zip(found.bends, moved, strict=True))
    return Spread(replace(fitted, chart=fitted.chart.moved(y), P_chart=P), bends)


def _added(x: State, times_s: Array, torque: float, force: float) -> Array:
    """(n, 12, 12) covariance of attitude to velocity that comes in before each pose, carried back to the epoch."""
    _, _, S, pushed = _motion.follow(x.q_ab, x.w_b, ratios(x.sigma), push(x.sigma, torque), times_s)
    back = np.linalg.inv(S[:, :, :6])
    total = np.zeros((len(times_s), _MOVING, _MOVING))
    total[:, :6, :6] = back @ pushed @ np.swapaxes(back, 1, 2)
    t, one = times_s[:, None, None], force**2 * np.eye(3)
    total[:, RHO, RHO], total[:, VEL, VEL] = one * t**3 / 3.0, one * t
    total[:, RHO, VEL] = total[:, VEL, RHO] = -one * t**2 / 2.0
    total[1:] -= total[:-1].copy()
    return total
