"""The grasp point after now: its path for the planner, its predicted 1 sigma for the convergence test (section 8)."""

from __future__ import annotations

import numpy as np

from avsreplay import geometry
from avsreplay.estimate.arc import Path
from avsreplay.estimate.layout import DIM, SIGMA
from avsreplay.estimate.motion import disturbance, grasp_rows
from avsreplay.geometry import Array
from avsreplay.records import Belief, Forecast, State, Trajectory

__all__ = ["forecast", "trajectory"]

_FIRST_S = 64.0
_CELL_RAD = 0.5  # turn per cell of the disturbance's quadrature
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(3)


def trajectory(x: State) -> Trajectory:
    """Times (n,) >= 0 [s after now] -> positions and velocities (n, 3) of the grasp point in {A}, without disturbance.

    The path is laid out when it is first asked for, and again to twice the time when later ones are.
    """
    laid: list[Path] = []

    def at(times: Array) -> tuple[Array, Array]:
        times = np.asarray(times, dtype=np.float64)
        last = float(times.max(initial=0.0))
        if times.size and not (float(times.min()) >= 0.0 and last < np.inf):
            raise ValueError("times must be finite and not before now")
        if not laid or laid[-1].end_s < last:
            laid[:] = [Path(x, _FIRST_S if last <= _FIRST_S else 2.0 * last)]
        here = laid[-1].at(times)
        A = geometry.matrix(here.q)
        position = x.r_a + times[:, None] * x.v_a + A @ x.c_b
        velocity = x.v_a + np.einsum("nij,nj->ni", A, np.cross(here.w, x.c_b))
        return position, velocity

    return at


def forecast(belief: Belief, times_s: Array, torque: float, force: float) -> Forecast:
    """Predicted 1 sigma of the grasp point at ``times_s`` (n,) >= 0, ascending [s after now].

    The disturbance torque's share is summed by Gauss-Legendre over cells of half a radian of turn.
    """
    times = np.asarray(times_s, dtype=np.float64)
    if times.ndim != 1 or np.any(np.diff(times, prepend=0.0) < 0.0):
        raise ValueError("times must ascend from 0")
    x = belief.x
    path = Path(x, float(times.max(initial=0.0)))
    here = path.at(times)
    Phi = np.zeros((len(times), DIM, DIM))
    Phi[:, range(DIM), range(DIM)] = 1.0
    Phi[:, :6, :6], Phi[:, :6, SIGMA] = here.S[:, :, :6], here.S[:, :, 6:]
    Phi[:, (6, 7, 8), (9, 10, 11)] = times[:, None]
    P = Phi @ belief.P @ np.swapaxes(Phi, 1, 2)
    move = here.S[:, :, :6]
    P[:, :6, :6] += move @ _pushed(x, path, times, torque) @ np.swapaxes(move, 1, 2)
    variances = np.empty((len(times), 3))
    for i, t in enumerate(times.tolist()):
        J = grasp_rows(State(here.q[i], here.w[i], x.r_a, x.v_a, x.sigma, x.c_b, x.q_bc))
        variances[i] = np.sum((J @ P[i]) * J, axis=1).reshape(3, 3).sum(axis=1)
        variances[i, :2] += 3.0 * force**2 * np.array([t**3 / 3.0, t])
    pos, vel, half = np.sqrt(np.maximum(variances, 0.0)).T
    return Forecast(times, pos, vel, 2.0 * half)


def _pushed(x: State, path: Path, times: Array, torque: float) -> Array:
    """(n, 6, 6) covariance the torque has added by each time, carried back to now: sum of Phi^-1 G G' Phi^-1'."""
    rate = float(np.linalg.norm(x.w_b))
    starts = np.concatenate([[0.0], times[:-1]])
    cells = np.maximum(1, np.ceil(rate * (times - starts) / _CELL_RAD)).astype(int)
    edges = [np.linspace(a, b, n + 1) for a, b, n in zip(starts, times, cells, strict=True)]
    low, high = np.concatenate([e[:-1] for e in edges]), np.concatenate([e[1:] for e in edges])
    half = 0.5 * (high - low)
    nodes = (low[:, None] + half[:, None] * (1.0 + _NODES)).ravel()
    G = np.zeros((6, 3))
    G[3:] = np.diag(np.array(disturbance(x.sigma)) * torque)
    back = np.linalg.solve(path.at(nodes).S[:, :, :6], np.broadcast_to(G, (len(nodes), 6, 3)))
    parts = (half[:, None] * _WEIGHTS).ravel()[:, None, None] * (back @ np.swapaxes(back, 1, 2))
    return np.asarray(np.cumsum(parts, axis=0)[3 * np.cumsum(cells) - 1])
