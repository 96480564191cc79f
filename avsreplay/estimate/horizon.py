"""The grasp point after now: its path for the planner, its predicted 1 sigma for the convergence test (section 8)."""

from __future__ import annotations

import numpy as np

from avsreplay import geometry
from avsreplay.estimate.motion import SUBSTEP_RAD, advance, flow, grasp_rows, process_noise, transition
from avsreplay.geometry import Array
from avsreplay.records import Belief, Forecast, State, Trajectory

__all__ = ["forecast", "trajectory"]


def trajectory(x: State) -> Trajectory:
    """Times (n,) >= 0 [s after now] -> positions and velocities (n, 3) of the grasp point in {A}, without disturbance.

    The path is laid out once, in pieces the rotation's series spans, and grows as later times are asked for.
    """
    knots = [x]
    piece = _piece_s(x)

    def at(times: Array) -> tuple[Array, Array]:
        times = np.asarray(times, dtype=np.float64)
        if times.size and not (float(times.min()) >= 0.0 and float(times.max()) < np.inf):
            raise ValueError("times must be finite and not before now")
        cell = np.floor_divide(times, piece).astype(int)
        while len(knots) <= (int(cell.max()) if times.size else 0):
            knots.append(advance(knots[-1], flow(knots[-1].w_b, x.sigma, piece), piece))
        states = [_within(knots[c], t - c * piece) for c, t in zip(cell.tolist(), times.tolist(), strict=True)]
        return _grasp(x, times, states)

    return at


def _piece_s(x: State) -> float:
    rate = float(np.linalg.norm(x.w_b))
    return SUBSTEP_RAD / rate if rate > 1e-3 * SUBSTEP_RAD else 1e3


def _within(x: State, h: float) -> tuple[Array, Array]:
    """Attitude and rate h seconds on."""
    step = flow(x.w_b, x.sigma, h)
    return geometry.multiply(x.q_ab, step.q), step.w


def _grasp(x: State, times: Array, states: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    if not states:
        return np.zeros((0, 3)), np.zeros((0, 3))
    A = geometry.matrix(np.array([q for q, _ in states]))
    w = np.array([rate for _, rate in states])
    position = x.r_a + times[:, None] * x.v_a + A @ x.c_b
    velocity = x.v_a + np.einsum("nij,nj->ni", A, np.cross(w, x.c_b))
    return position, velocity


def forecast(belief: Belief, times_s: Array, torque: float, force: float) -> Forecast:
    """Predicted 1 sigma of the grasp point at ``times_s`` (n,) >= 0, ascending [s after now]."""
    times = np.asarray(times_s, dtype=np.float64)
    if times.ndim != 1 or np.any(np.diff(times, prepend=0.0) < 0.0):
        raise ValueError("times must ascend from 0")
    x, P = belief.x, belief.P
    variances = np.empty((len(times), 3))
    for i, h in enumerate(np.diff(times, prepend=0.0)):
        x, P = _on(x, P, float(h), torque, force)
        J = grasp_rows(x)
        variances[i] = np.einsum("ij,jk,ik->i", J, P, J).reshape(3, 3).sum(axis=1)
    pos, vel, half = np.sqrt(np.maximum(variances, 0.0)).T
    return Forecast(times, pos, vel, 2.0 * half)


def _on(x: State, P: Array, h: float, torque: float, force: float) -> tuple[State, Array]:
    step = flow(x.w_b, x.sigma, h, torque)
    Phi = transition(step, x.sigma, h)
    return advance(x, step, h), Phi @ P @ Phi.T + process_noise(step, h, force)
