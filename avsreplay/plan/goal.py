"""A moving goal as the planner sees it: sampled over a stretch of time, with bounds on its motion.

The planner asks for the goal at many instants; a trajectory may be costly to call (it integrates a tumbling body),
so it is called once on a grid and interpolated by cubic Hermite pieces, and called again only to polish.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from avsreplay.geometry import Array
from avsreplay.records import Trajectory

__all__ = ["SampledGoal", "sample"]

MOTION_FACTOR = 1.5  # bounds are this many times the largest difference quotient found on the grid
_HERMITE = 1.0 / 384.0  # position error of a cubic Hermite piece in units of d^4 |d4 rho|
_HERMITE_RATE = math.sqrt(3.0) / 216.0  # its velocity's, in units of d^3 |d4 rho|


@dataclass(frozen=True, slots=True, eq=False)
class SampledGoal:
    """Residuals that thrust has to make good, on a grid of thrust times.

    Attributes:
        begin, step, end: first node, grid step and last node [s of thrust time].  times: (n,) the nodes.
        dr: (n, 3) goal minus coasting robot [m].  dv: (n, 3) its velocity [m/s].
        pieces: (n - 1, 4, 3) coefficients of each cubic Hermite cell in powers of its share, 0 to 1.
        acceleration, jerk, snap: bounds on the goal's |d2 rho|, |d3 rho|, |d4 rho| in this stretch [SI].
    """

    begin: float
    step: float
    end: float
    times: Array
    dr: Array
    dv: Array
    pieces: Array
    acceleration: float
    jerk: float
    snap: float

    def at(self, t: float) -> tuple[Array, Array, Array]:
        """Cubic Hermite (dr, dv, ddv) at thrust time t, each the derivative of the one before."""
        d = self.step
        k = min(max(int((t - self.begin) / d), 0), len(self.pieces) - 1)
        s = (t - self.times.item(k)) / d
        powers = ((1.0, s, s * s, s**3), (0.0, 1.0 / d, 2.0 * s / d, 3.0 * s * s / d), (0.0, 0.0, 2.0, 6.0 * s))
        dr, dv, ddv = np.array(powers) @ self.pieces[k]
        return dr, dv, ddv / (d * d)

    def curvature(self, n0: float, n1: float, t: Array | float) -> Array | float:
        """Bound on |d2/dt2| of P0.dr + P1.(t dv - dr) for |P0 - P1| = n0, |P1| = n1."""
        return (n0 + 2.0 * n1) * self.acceleration + n1 * t * self.jerk

    def blur(self, n0: float, n1: float, t: float) -> float:
        """Bound on the error that interpolation puts into P0.dr + P1.(t dv - dr)."""
        d3 = self.step**3 * self.snap
        return n0 * _HERMITE * self.step * d3 + n1 * t * _HERMITE_RATE * d3


def sample(
    goal: Trajectory, r0: Array, v0: Array, delay_s: float, begin: float, end: float, step_s: float
) -> SampledGoal:
    """Call ``goal`` once on a grid of thrust times from begin to end; thrust time t is its instant ``delay_s + t``.

    Raises ValueError where the goal is not finite or not of shape (n, 3).
    """
    n = max(math.ceil((end - begin) / step_s), 4) + 1
    times = np.linspace(begin, end, n)
    rho, rate = goal(times + delay_s)
    if rho.shape != (n, 3) or rate.shape != (n, 3):
        raise ValueError(f"goal trajectory gave shapes {rho.shape} and {rate.shape}, expected {(n, 3)} twice")
    dr = rho - r0 - v0 * (times + delay_s)[:, None]
    dv = rate - v0
    step = (end - begin) / (n - 1)
    acc = (rate[1:] - rate[:-1]) / step
    jerk = (acc[1:] - acc[:-1]) / step
    snap = (jerk[1:] - jerk[:-1]) / step
    a, j, s = (_largest(x) for x in (acc, jerk, snap))
    if not math.isfinite(a + float(dr.sum())):
        raise ValueError("goal trajectory is not finite")
    return SampledGoal(
        begin,
        step,
        end,
        times,
        dr,
        dv,
        _hermite(dr, dv, step),
        a + step * MOTION_FACTOR * j,
        MOTION_FACTOR * j,
        MOTION_FACTOR * s,
    )


def _hermite(dr: Array, dv: Array, step: float) -> Array:
    rise = dr[1:] - dr[:-1] - step * dv[:-1]
    bend = step * (dv[1:] - dv[:-1])
    return np.stack([dr[:-1], step * dv[:-1], 3.0 * rise - bend, bend - 2.0 * rise], axis=1)


def _largest(vectors: Array) -> float:
    return math.sqrt(float((vectors * vectors).sum(axis=1).max()))
