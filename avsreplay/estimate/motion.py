"""Torque-free motion in the inertia ratios (eq:dot_omega, Eq:F, Eq:G): state, Phi and Q_d over a whole step.

One Taylor series gives all of it. With time scaled to the step, u = w h, the rate obeys u' = phi(u, sigma), a
quadratic equation whose coefficients follow from Cauchy products; attitude error, rate error and their process
noise obey linear equations with u as coefficient. The order is chosen so that the tail is below 1e-12, and a
long step is cut where |w| h passes ``SUBSTEP_RAD``. Rotation leaves in Phi's attitude block, which is
A(q_rel)' exactly. The three sigma are carried apart and joined by sigma3(sigma1, sigma2) in ``transition``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from avsreplay.errors import UsageError
from avsreplay.estimate.layout import DIM, DQ, RHO, SIGMA, VEL, W, hamilton
from avsreplay.geometry import Array, matrix
from avsreplay.records import Belief, State

__all__ = [
    "GENERATORS",
    "SUBSTEP_RAD",
    "Flow",
    "advance",
    "disturbance",
    "flow",
    "grasp_rows",
    "process_noise",
    "propagate",
    "rate_series",
    "series_order",
    "sigma3",
    "sigma_join",
    "transition",
]

SUBSTEP_RAD = 0.2
TAIL = 1e-12
MOST_RAD = 2e4  # turn a single step may have: some seconds of work
_POLE = 1.5  # the solutions are elliptic functions: no pole nearer than |w| h = pi / 2
_I6 = np.eye(6)
_I9 = np.eye(9)
_I20 = np.eye(DIM)


def _pattern(rows: slice, columns: slice) -> Array:
    """(20, 20) ones on the diagonal of a 3x3 block and of its mirror."""
    out = np.zeros((DIM, DIM))
    out[rows, columns] = out[columns, rows] = np.eye(3)
    return out


_PLACE, _MIXED, _SPEED = _pattern(RHO, RHO), _pattern(RHO, VEL), _pattern(VEL, VEL)


def sigma3(sigma: Array) -> float:
    """The dependent ratio, -(s1 + s2) / (1 + s1 s2) (eq:sigma_constraint)."""
    s1, s2 = float(sigma[0]), float(sigma[1])
    return -(s1 + s2) / (1.0 + s1 * s2)


def sigma_join(sigma: Array) -> Array:
    """(3, 2) derivative of (s1, s2, s3) by (s1, s2)."""
    s1, s2 = float(sigma[0]), float(sigma[1])
    d = (1.0 + s1 * s2) ** 2
    return np.array([[1.0, 0.0], [0.0, 1.0], [(s2 * s2 - 1.0) / d, (s1 * s1 - 1.0) / d]])


def disturbance(sigma: Array) -> tuple[float, float, float]:
    """Diagonal of B(sigma) = tr I / (Ixx, Iyy, Izz), as printed."""
    s1, s2 = float(sigma[0]), float(sigma[1])
    return (
        1.0 + (2.0 + s1 * s2 + s1) / (1.0 - s2),
        1.0 + (2.0 + s1 * s2 - s2) / (1.0 + s1),
        1.0 + (2.0 + s1 - s2) / (1.0 + s1 * s2),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Flow:
    """What a step does to rotation.

    Attributes:
        w: (3,) rate at its end, in {B} [rad/s].  q: (4,) attitude of {B} at its end seen from {B} at its start.
        S: (6, 9) derivative of (dq_v, w) at the end by (dq_v, w, s1, s2, s3) at the start.
        Q: (6, 6) covariance the disturbance torque adds to (dq_v, w).
    """

    w: Array
    q: Array
    S: Array
    Q: Array


def flow(w: Array, sigma: Array, h: float, torque: float = 0.0) -> Flow:
    """Rotation over h seconds (either sign) from rate ``w`` (3,); ``torque``: root density of eps_tau [rad/s^1.5]."""
    if h == 0.0:
        return Flow(w, np.array([0.0, 0.0, 0.0, 1.0]), _I9[:6].copy(), np.zeros((6, 6)))
    ratios = (float(sigma[0]), float(sigma[1]), sigma3(sigma))
    push = tuple(abs(h) * (torque * b) ** 2 for b in disturbance(sigma))
    rate = tuple(w.tolist())
    pieces = max(1, math.ceil(math.sqrt(sum(c * c for c in rate)) * abs(h) / SUBSTEP_RAD))
    out = _piece(rate, ratios, h / pieces, tuple(p / pieces for p in push))
    for _ in range(pieces - 1):
        out = _join(out, _piece(tuple(out.w.tolist()), ratios, h / pieces, tuple(p / pieces for p in push)))
    return out


def _join(first: Flow, then: Flow) -> Flow:
    """Two steps in a row: newest factor on the left."""
    lower = _I9.copy()
    lower[:6] = first.S
    move = then.S[:, :6]
    return Flow(then.w, np.array(hamilton(first.q, then.q)), then.S @ lower, move @ first.Q @ move.T + then.Q)


def _piece(w: tuple[float, ...], ratios: tuple[float, ...], h: float, push: tuple[float, ...]) -> Flow:
    """One sub-step: ``push`` is the rate variance it gets from the torque [rad2/s2]."""
    u = (w[0] * h, w[1] * h, w[2] * h)
    order = series_order(math.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2]))
    rates, products = rate_series(u, ratios, order)
    Y = _linear_series(np.array(rates), np.array(products), ratios, np.array(push) * (h * h))
    S, Q = Y[:, :9], Y[:, 9:]
    _unscale(S, Q, h)
    end = np.array([math.fsum(c) / h for c in zip(*rates, strict=True)])
    return Flow(end, _relative(S), S, 0.5 * (Q + Q.T))


def series_order(theta: float) -> int:
    """Terms needed for a tail below TAIL; four at least, which the noise of a body at rest needs."""
    return 4 if theta < 1e-3 else max(4, math.ceil(math.log(TAIL) / math.log(theta / _POLE)))


def rate_series(
    u: tuple[float, float, float], ratios: tuple[float, ...], order: int
) -> tuple[list[tuple[float, float, float]], list[tuple[float, float, float]]]:
    """Taylor coefficients of u' = phi(u), orders 0..order, and of (uy uz, ux uz, ux uy), orders 0..order-1."""
    s1, s2, s3 = ratios
    xs, ys, zs = [u[0]], [u[1]], [u[2]]
    products = []
    for k in range(order):
        yz = xz = xy = 0.0
        for x, y, z_back, y_back in zip(xs, ys, reversed(zs), reversed(ys), strict=True):
            yz += y * z_back
            xz += x * z_back
            xy += x * y_back
        products.append((yz, xz, xy))
        n = k + 1.0
        xs.append(s1 * yz / n)
        ys.append(s2 * xz / n)
        zs.append(s3 * xy / n)
    return list(zip(xs, ys, zs, strict=True)), products


def _generators() -> Array:
    """(4, 3, 6, 6): N = sum over (1, s1, s2, s3) and (ux, uy, uz); Eq:F's attitude and rate rows."""
    E = np.zeros((4, 3, 6, 6))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        E[0, i, j, k], E[0, i, k, j] = 1.0, -1.0  # -[u x]
        E[1 + i, j, 3 + i, 3 + k] = E[1 + i, k, 3 + i, 3 + j] = 1.0  # d(u_j u_k)
    return E.reshape(4, 108)


GENERATORS = _generators()


def _linear_series(rates: Array, products: Array, ratios: tuple[float, ...], push: Array) -> Array:
    """(6, 15): the sum of the series of [sensitivity (6, 9) | noise (6, 6)] at the end of a step of length 1."""
    order = len(products)
    E = (np.array((1.0, *ratios)) @ GENERATORS).reshape(3, 36)
    terms = (rates[order - 1 :: -1] @ E).reshape(order, 6, 6)
    terms[-1, :3, 3:] = 0.5 * _I6[:3, :3]
    N = terms.transpose(1, 0, 2).reshape(6, 6 * order)  # newest coefficient first, to meet Y's oldest
    Y = np.zeros((6 * (order + 1), 15))
    Y[:6, :6] = _I6
    drive = np.zeros((order, 3, 3))
    drive[:, (0, 1, 2), (0, 1, 2)] = products
    for k in range(order):
        M = N[:, 6 * (order - 1 - k) :] @ Y[: 6 * (k + 1)]
        M[3:, 6:9] += drive[k]
        M[:, 9:] += M[:, 9:].T.copy()
        if k == 0:
            M[(3, 4, 5), (12, 13, 14)] += push
        Y[6 * (k + 1) : 6 * (k + 2)] = M / (k + 1.0)
    out: Array = Y.reshape(order + 1, 6, 15).sum(axis=0)
    return out


def _unscale(S: Array, Q: Array, h: float) -> None:
    """From rates times the step back to rates."""
    S[:3, 3:6] *= h
    S[3:, 6:9] /= h
    Q[3:, :] /= h
    Q[:, 3:] /= h


def _relative(S: Array) -> Array:
    """q_rel from the attitude block A(q_rel)' of a rotation well below a half turn."""
    (xx, yx, zx), (xy, yy, zy), (xz, yz, zz) = S[:3, :3].tolist()
    w = 0.5 * math.sqrt(1.0 + xx + yy + zz)
    f = 0.25 / w
    x, y, z = (zy - yz) * f, (xz - zx) * f, (yx - xy) * f
    n = 1.0 / math.sqrt(x * x + y * y + z * z + w * w)
    return np.array((x * n, y * n, z * n, w * n))


def transition(step: Flow, sigma: Array, h: float) -> Array:
    """Phi (20, 20) of a step of h seconds from a state with ``sigma``."""
    Phi = _I20.copy()
    Phi[:6, :6] = step.S[:, :6]
    Phi[:6, SIGMA] = step.S[:, 6:] @ sigma_join(sigma)
    Phi[6, 9] = Phi[7, 10] = Phi[8, 11] = h
    return Phi


def process_noise(step: Flow, h: float, force: float) -> Array:
    """Q_d (20, 20) of a step; ``force`` is the root density of eps_f [m/s^1.5]."""
    density, h = force * force, abs(h)
    Q: Array = (density * h**3 / 3.0) * _PLACE + (density * h**2 / 2.0) * _MIXED + (density * h) * _SPEED
    Q[:6, :6] = step.Q
    return Q


def advance(x: State, step: Flow, h: float) -> State:
    """The state after a step."""
    return State(np.array(hamilton(x.q_ab, step.q)), step.w, x.r_a + h * x.v_a, x.v_a, x.sigma, x.c_b, x.q_bc)


def propagate(belief: Belief, t_ns: int, torque: float, force: float) -> tuple[Belief, Array]:
    """Belief at t_ns and the step's Phi (eq:state-prop, eq:cov-prop). A step back in time adds no noise.

    Raises:
        UsageError: the step turns the target more than ``MOST_RAD``.
    """
    h = (t_ns - belief.t_ns) * 1e-9
    x = belief.x
    if abs(h) * float(np.abs(x.w_b).max()) > MOST_RAD:
        what = f"a scan comes {h:.4g} s after the one before, too far to predict its pose"
        raise UsageError(what, where=f"stamp {t_ns}", hint="leave out what is beyond the gap with --start or --end")
    step = flow(x.w_b, x.sigma, h, torque)
    Phi = transition(step, x.sigma, h)
    P = Phi @ belief.P @ Phi.T
    if h > 0.0:
        P += process_noise(step, h, force)
    return Belief(t_ns, advance(x, step, h), 0.5 * (P + P.T)), Phi


def grasp_rows(x: State) -> Array:
    """(9, 20) derivative of the grasp point's position [m], velocity [m/s] and half-angle attitude (section 8)."""
    A = matrix(x.q_ab)
    c, u = x.c_b, np.cross(x.w_b, x.c_b)
    J = np.zeros((9, DIM))
    J[:3, DQ], J[:3, RHO], J[:3, 14:17] = -2.0 * A @ _cross(c), np.eye(3), A
    J[3:6, DQ], J[3:6, W], J[3:6, VEL] = -2.0 * A @ _cross(u), -A @ _cross(c), np.eye(3)
    J[3:6, 14:17] = A @ _cross(x.w_b)
    J[6:, DQ] = J[6:, 17:] = np.eye(3)
    return J


def _cross(v: Array) -> Array:
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
