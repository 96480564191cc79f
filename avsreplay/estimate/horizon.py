"""The grasp point after now: its path for the planner, its predicted 1 sigma for the convergence test (section 8)."""

from __future__ import annotations

import numpy as np

from avsreplay import geometry
from avsreplay.estimate import _motion
from avsreplay.estimate.arc import Path
from avsreplay.estimate.layout import RHO, SIGMA, VEL, rotation
from avsreplay.estimate.motion import MOST_RAD, grasp_rows, push, ratios, sigma_join
from avsreplay.geometry import Array
from avsreplay.records import Belief, Forecast, State, Trajectory

__all__ = ["forecast", "trajectory"]


def trajectory(x: State) -> Trajectory:
    """Times (n,) >= 0 [s after now] -> positions and velocities (n, 3) of the grasp point in {A}, undisturbed."""
    path, arm = Path(x), geometry.skew(x.c_b)  # w x c = w' [c x]

    def at(times: Array) -> tuple[Array, Array]:
        times = np.asarray(times, dtype=np.float64)
        if times.size and not (float(times.min()) >= 0.0 and float(times.max()) < np.inf):
            raise ValueError("times must be finite and not before now")
        q, w = path.at(times)
        A = geometry.matrix(q)
        position = x.r_a + times[:, None] * x.v_a + A @ x.c_b
        velocity = x.v_a + (A @ (w @ arm)[:, :, None])[:, :, 0]
        return position, velocity

    return at


def forecast(belief: Belief, times_s: Array, torque: float, force: float) -> Forecast:
    """Predicted 1 sigma of the grasp point at ``times_s`` (n,) >= 0, ascending [s after now].

    Infinite where the target would turn more than ``MOST_RAD`` on the way.
    """
    times = np.asarray(times_s, dtype=np.float64)
    if times.ndim != 1 or np.any(times[:1] < 0.0) or np.any(times[1:] < times[:-1]):
        raise ValueError("times must ascend from 0")
    x = belief.x
    if float(np.abs(x.w_b).max()) * float(times.max(initial=0.0)) > MOST_RAD:
        return Forecast(times, *np.full((3, len(times)), np.inf))
    _, w, S, Q = _motion.follow(x.q_ab, x.w_b, ratios(x.sigma), push(x.sigma, torque), times)
    A_ab = rotation(x.q_ab) @ np.swapaxes(S[:, :3, :3], 1, 2)  # S's attitude block is A(q_rel)'
    J = grasp_rows(A_ab, w, x.c_b)
    turning = J[:, :, :6]
    moved = J.copy()  # J Phi
    moved[:, :, :6] = turning @ S[:, :, :6]
    moved[:, :, SIGMA] = turning @ (S[:, :, 6:] @ sigma_join(x.sigma))
    moved[:, :, VEL] += times[:, None, None] * J[:, :, RHO]
    rows = np.sum((moved @ belief.P) * moved, axis=2) + np.sum((turning @ Q) * turning, axis=2)
    variances = rows.reshape(-1, 3, 3).sum(axis=2)
    variances[:, 0] += 3.0 * force**2 * times**3 / 3.0
    variances[:, 1] += 3.0 * force**2 * times
    pos, vel, half = np.sqrt(np.maximum(variances, 0.0)).T
    return Forecast(times, pos, vel, 2.0 * half)
