"""Torque-free motion in the inertia ratios (eq:dot_omega, Eq:F, Eq:G): state, Phi and Q_d over a whole step.

Rate, attitude, their derivatives and their noise come from one Taylor series, in the extension ``_motion``. Rotation
leaves in Phi's attitude block, which is A(q_rel)' exactly. The three sigma are carried apart and joined by
sigma3(sigma1, sigma2) in ``transition``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avsreplay.errors import UsageError
from avsreplay.estimate import _motion
from avsreplay.estimate.layout import DIM, DMU, DQ, RHO, SIGMA, VARRHO, VEL, W, hamilton
from avsreplay.geometry import IDENTITY_QUAT, Array, skew
from avsreplay.records import Belief, State

__all__ = [
    "MOST_RAD",
    "Flow",
    "advance",
    "disturbance",
    "flow",
    "grasp_rows",
    "moved",
    "process_noise",
    "propagate",
    "push",
    "ratios",
    "sigma3",
    "sigma_join",
    "transition",
]

Triple = tuple[float, float, float]

MOST_RAD = 2e4  # turn a single step may have: some seconds of work
_I3, _I20 = np.eye(3), np.eye(DIM)


def _diagonal(rows: slice, columns: slice) -> slice:
    """The diagonal of a 3x3 block of a (20, 20) matrix, in its 400 entries."""
    first = DIM * rows.start + columns.start
    return slice(first, first + 2 * DIM + 3, DIM + 1)


_PLACE, _MIXED, _SPEED = _diagonal(RHO, RHO), _diagonal(RHO, VEL), _diagonal(VEL, VEL)
_MIXED_MIRROR = _diagonal(VEL, RHO)


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
    """Rotation over h seconds (either sign) from rate ``w`` (3,); ``torque``: root density of eps_tau [rad/s^1.5].

    Raises:
        ValueError: a rate or time that is not finite, or a step of more than a million radians.
    """
    q, w, S, Q = _motion.follow(IDENTITY_QUAT, w, ratios(sigma), push(sigma, torque), np.array((h,)))
    return Flow(w[0], q[0], S[0], Q[0])


def ratios(sigma: Array) -> Triple:
    """(s1, s2, s3) of the two that are states."""
    return float(sigma[0]), float(sigma[1]), sigma3(sigma)


def push(sigma: Array, torque: float) -> Triple:
    """Variance the disturbance torque adds to the rate in a second [rad2/s3]: the diagonal of torque^2 B B'."""
    if torque == 0.0:
        return 0.0, 0.0, 0.0
    x, y, z = disturbance(sigma)
    return (torque * x) ** 2, (torque * y) ** 2, (torque * z) ** 2


def transition(step: Flow, sigma: Array, h: float) -> Array:
    """Phi (20, 20) of a step of h seconds from a state with ``sigma``."""
    Phi = _I20.copy()
    Phi[:6, :6] = step.S[:, :6]
    Phi[:6, SIGMA] = step.S[:, 6:] @ sigma_join(sigma)
    Phi.reshape(-1)[_MIXED] = h
    return Phi


def process_noise(step: Flow, h: float, force: float) -> Array:
    """Q_d (20, 20) of a step; ``force`` is the root density of eps_f [m/s^1.5]."""
    Q = np.zeros((DIM, DIM))
    Q[:6, :6] = step.Q
    density, h = force * force, abs(h)
    entries = Q.reshape(-1)
    entries[_PLACE] = density * h**3 / 3.0
    entries[_MIXED] = entries[_MIXED_MIRROR] = density * h**2 / 2.0
    entries[_SPEED] = density * h
    return Q


def advance(x: State, step: Flow, h: float) -> State:
    """The state after a step."""
    q_ab = np.array(hamilton(x.q_ab.tolist(), step.q.tolist()))
    return State(q_ab, step.w, x.r_a + h * x.v_a, x.v_a, x.sigma, x.c_b, x.q_bc)


def moved(x: State, h: float) -> tuple[State, Array]:
    """The state h seconds on (either sign) without disturbance, and Phi (20, 20) of the way."""
    step = flow(x.w_b, x.sigma, h)
    return advance(x, step, h), transition(step, x.sigma, h)


def propagate(belief: Belief, t_ns: int, torque: float, force: float) -> tuple[Belief, Array]:
    """Belief at t_ns and the step's Phi (eq:state-prop, eq:cov-prop). A step back in time adds no noise.

    Raises:
        UsageError: the step turns the target more than ``MOST_RAD``.
    """
    h = (t_ns - belief.t_ns) * 1e-9
    x = belief.x
    if abs(h) * max(map(abs, x.w_b.tolist())) > MOST_RAD:
        what = f"a scan comes {h:.4g} s after the one before, too far to predict its pose"
        raise UsageError(what, where=f"stamp {t_ns}", hint="leave out what is beyond the gap with --start or --end")
    step = flow(x.w_b, x.sigma, h, torque)
    Phi = transition(step, x.sigma, h)
    P = Phi @ belief.P @ Phi.T
    if h > 0.0:
        P += process_noise(step, h, force)
    return Belief(t_ns, advance(x, step, h), 0.5 * (P + P.T)), Phi


def grasp_rows(A_ab: Array, w_b: Array, c_b: Array) -> Array:
    """Derivative (n, 9, 20) of the grasp point's position [m], velocity [m/s] and half-angle attitude (section 8).

    Args:
        A_ab: (n, 3, 3) attitudes.
        w_b: (n, 3) rates [rad/s].
        c_b: (3,) the fixture in {B} [m].
    """
    turning, arm = skew(w_b), skew(c_b)
    J = np.zeros((len(A_ab), 9, DIM))
    J[:, :3, VARRHO] = A_ab
    J[:, 3:6, VARRHO] = A_ab @ turning
    J[:, 3:6, W] = -A_ab @ arm
    J[:, :3, DQ] = 2.0 * J[:, 3:6, W]
    J[:, 3:6, DQ] = -2.0 * A_ab @ skew(turning @ c_b)
    J[:, :3, RHO] = J[:, 3:6, VEL] = J[:, 6:, DQ] = J[:, 6:, DMU] = _I3
    return J
