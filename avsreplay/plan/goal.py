"""A moving goal as the planner sees it: sampled once over the horizon, with bounds on its motion.

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


@dataclass(frozen=True, slots=True, eq=False)
class SampledGoal:
    """Residuals that thrust has to make good, on a grid of thrust times from 0.

    Attributes:
        step: grid step [s].  times: (n,) [s].
        dr: (n, 3) goal minus coasting robot [m].  dv: (n, 3) its velocity [m/s].
        acceleration, jerk: bounds on the goal's |d2 rho| [m/s2] and |d3 rho| [m/s3] over the horizon.
    """

    step: float
    times: Array
    dr: Array
    dv: Array
    acceleration: float
    jerk: float

    def at(self, t: float) -> tuple[Array, Array, Array]:
        """Cubic Hermite (dr, dv, ddv) at thrust time t; dv is taken from the samples of dv alone, linear in ddv."""
        k = min(max(int(t / self.step), 0), len(self.times) - 2)
        d, s = self.step, t / self.step - k
        r0, r1, v0, v1 = self.dr[k], self.dr[k + 1], self.dv[k], self.dv[k + 1]
        rise = r1 - r0 - d * v0
        bend = d * (v1 - v0)
        c2, c3 = 3.0 * rise - bend, bend - 2.0 * rise
        dr = r0 + s * (d * v0 + s * (c2 + s * c3))
        dv = v0 + s * (2.0 * c2 + 3.0 * s * c3) / d
        return dr, dv, (2.0 * c2 + 6.0 * s * c3) / (d * d)

    def curvature(self, n0: float, n1: float, t: Array) -> Array:
        """Bound on |d2/dt2| of P0.dr + P1.(t dv - dr) for |P0 - P1| = n0, |P1| = n1 (robot coasting)."""
        return (n0 + 2.0 * n1) * self.acceleration + n1 * t * self.jerk


def sample(goal: Trajectory, r0: Array, v0: Array, delay_s: float, horizon_s: float, step_s: float) -> SampledGoal:
    """Call ``goal`` once on the grid. Thrust time t is instant ``delay_s + t`` of the goal.

    Raises ValueError where the goal is not finite or not of shape (n, 3).
    """
    n = max(math.ceil((horizon_s - delay_s) / step_s), 4) + 1
    times = np.linspace(0.0, horizon_s - delay_s, n)
    rho, rate = goal(times + delay_s)
    if rho.shape != (n, 3) or rate.shape != (n, 3):
        raise ValueError(f"goal trajectory gave shapes {rho.shape} and {rate.shape}, expected {(n, 3)} twice")
    if not (np.isfinite(rho).all() and np.isfinite(rate).all()):
        raise ValueError("goal trajectory is not finite")
    dv = rate - v0
    dr = rho - r0 - v0 * (times + delay_s)[:, None]
    step = float(times[1])
    acc = np.diff(rate, axis=0) / step
    jerk = np.diff(acc, axis=0) / step
    bound_j = MOTION_FACTOR * math.sqrt(float(np.max(np.einsum("ij,ij->i", jerk, jerk))))
    bound_a = math.sqrt(float(np.max(np.einsum("ij,ij->i", acc, acc)))) + step * bound_j
    return SampledGoal(step, times, dr, dv, bound_a, bound_j)
