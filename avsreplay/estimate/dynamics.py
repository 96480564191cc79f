"""Torque-free motion in the inertia ratios (eq:dot_omega, Eq:F, Eq:G): state, transition matrix,
noise, forecast.

Rate, attitude, their derivatives and their noise come from one Taylor series, in the extension
``_motion``. The attitude block of the state transition matrix Phi is A(q_rel)' exactly. The
extension differentiates by three independent sigma; ``transition`` applies the chain rule for
sigma3(sigma1, sigma2).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from avsreplay import geometry
from avsreplay.errors import UsageError, value_class
from avsreplay.estimate import _motion
from avsreplay.estimate.error_state import DIM, DMU, DQ, RHO, SIGMA, VARRHO, VEL, W, hamilton
from avsreplay.estimate.relative_orbit import OrbitArc, RelativeOrbit
from avsreplay.geometry import IDENTITY_QUAT, Array, skew
from avsreplay.records import Belief, Forecast, Possible, State, Trajectory

Triple = tuple[float, float, float]

MOST_RAD = 2e4  # largest rotation of a single step [rad]; it takes a few seconds of processor time
_I3 = np.eye(3)
_I20 = np.eye(DIM)
NO_DRIVE = (0.0, 0.0, 0.0)  # no angular acceleration


def _diagonal(rows: slice, columns: slice) -> slice:
    """The diagonal of a 3x3 block of a (20, 20) matrix, as a slice of its 400 entries."""
    first = DIM * rows.start + columns.start
    return slice(first, first + 2 * DIM + 3, DIM + 1)


_POSITION = _diagonal(RHO, RHO)
_MIXED = _diagonal(RHO, VEL)
_VELOCITY = _diagonal(VEL, VEL)
_MIXED_MIRROR = _diagonal(VEL, RHO)
_TRANSLATION = slice(RHO.start, VEL.stop)


def sigma3(sigma: Array) -> float:
    """The dependent inertia ratio, -(s1 + s2) / (1 + s1 s2) (eq:sigma_constraint)."""
    s1, s2 = float(sigma[0]), float(sigma[1])
    return -(s1 + s2) / (1.0 + s1 * s2)


def sigma_join(sigma: Array) -> Array:
    """(3, 2) Jacobian of (s1, s2, s3) with respect to (s1, s2)."""
    s1, s2 = float(sigma[0]), float(sigma[1])
    d = (1.0 + s1 * s2) ** 2
    return np.array([[1.0, 0.0], [0.0, 1.0], [(s2 * s2 - 1.0) / d, (s1 * s1 - 1.0) / d]])


def disturbance(sigma: Array) -> Triple:
    """Diagonal of B(sigma) = tr I / (Ixx, Iyy, Izz), as printed."""
    s1, s2 = float(sigma[0]), float(sigma[1])
    return (
        1.0 + (2.0 + s1 * s2 + s1) / (1.0 - s2),
        1.0 + (2.0 + s1 * s2 - s2) / (1.0 + s1),
        1.0 + (2.0 + s1 - s2) / (1.0 + s1 * s2),
    )


@value_class
class Flow:
    """The rotational part of a step.

    Attributes:
        w: (3,) rate at the end, in {B} [rad/s].
        q: (4,) attitude of {B} at the end relative to {B} at the start.
        S: (6, 9) derivative of (dq_v, w) at the end with respect to (dq_v, w, s1, s2, s3) at the
            start.
        Q: (6, 6) covariance that the disturbance torque adds to (dq_v, w).
    """

    w: Array
    q: Array
    S: Array
    Q: Array


def flow(w: Array, sigma: Array, h: float, torque: float = 0.0, drive: Triple = NO_DRIVE) -> Flow:
    """Rotation over h seconds (either sign) from rate ``w`` (3,); ``torque``: root density of
    eps_tau [rad/s^1.5].

    ``drive`` is the angular acceleration in {B} by a constant torque [rad/s2].

    Raises:
        ValueError: an inertia ratio beyond -1 to 1, a rate or time that is not finite, or more than
            a million radians.
    """
    q, w, S, Q = flows(w, sigma, np.array((h,)), torque, drive)
    return Flow(w[0], q[0], S[0], Q[0])


def flows(
    w: Array, sigma: Array, times_s: Array, torque: float = 0.0, drive: Triple = NO_DRIVE
) -> tuple[Array, Array, Array, Array]:
    """Return q (n, 4), w (n, 3), S (n, 6, 9) and Q (n, 6, 6) of ``flow`` to each of ``times_s``
    (n,) [s] in turn.

    Raises:
        ValueError: as ``flow``.
    """
    return _motion.follow(
        IDENTITY_QUAT, w, ratios(sigma), torque_density(sigma, torque), times_s, drive
    )


def ratios(sigma: Array) -> Triple:
    """(s1, s2, s3) from the two that are states."""
    return float(sigma[0]), float(sigma[1]), sigma3(sigma)


def torque_density(sigma: Array, torque: float) -> Triple:
    """Variance that the disturbance torque adds to the rate per second [rad2/s3]: the
    diagonal of torque^2 B B'.
    """
    if torque == 0.0:
        return 0.0, 0.0, 0.0
    x, y, z = disturbance(sigma)
    return (torque * x) ** 2, (torque * y) ** 2, (torque * z) ** 2


def transition(step: Flow, sigma: Array, h: float, arc: OrbitArc | None = None) -> Array:
    """State transition matrix Phi (20, 20) of a step of h seconds from a state with
    ``sigma``; ``arc``: the orbit.
    """
    Phi = _I20.copy()
    Phi[:6, :6] = step.S[:, :6]
    Phi[:6, SIGMA] = step.S[:, 6:] @ sigma_join(sigma)
    if arc is None:
        Phi.reshape(-1)[_MIXED] = h
    else:
        Phi[_TRANSLATION, _TRANSLATION] = arc.transitions(np.array([h]))[0]
    return Phi


def process_noise(Q: Array, times_s: Array, force: float) -> Array:
    """Process noise Q_d (n, 20, 20) over ``times_s`` (n,), from that of the rotations (n, 6, 6).

    ``force`` is the root density of eps_f [m/s^1.5].
    """
    out, density, h = np.zeros((len(Q), DIM, DIM)), force * force, np.abs(times_s[:, None])
    out[:, :6, :6] = Q
    entries = out.reshape(-1, DIM * DIM)
    entries[:, _POSITION] = density * h**3 / 3.0
    entries[:, _MIXED] = entries[:, _MIXED_MIRROR] = density * h**2 / 2.0
    entries[:, _VELOCITY] = density * h
    return out


def translation(h: float, arc: OrbitArc | None = None) -> Array:
    """(6, 6) position and velocity of the centre of mass h seconds later, by those now: free,
    or on an orbit.
    """
    if arc is not None:
        return np.ascontiguousarray(arc.transitions(np.array([h]))[0])
    path = np.eye(6)
    path.reshape(-1)[3:18:7] = h  # (0, 3), (1, 4), (2, 5)
    return path


def translated(x: State, times_s: Array, arc: OrbitArc | None = None) -> tuple[Array, Array]:
    """Centre of mass and its velocity, (n, 3) each, ``times_s`` (n,) [s] after ``x``: free,
    or on an orbit.
    """
    if arc is None:
        return x.r_a + times_s[:, None] * x.v_a, np.broadcast_to(x.v_a, (len(times_s), 3))
    found = arc.transitions(times_s) @ np.concatenate([x.r_a, x.v_a])
    return found[:, :3], found[:, 3:]


def advance(x: State, step: Flow, h: float, arc: OrbitArc | None = None) -> State:
    """The state after a step of h seconds; ``arc``: the orbit from the instant of ``x`` on,
    None for free motion.
    """
    q_ab = hamilton(x.q_ab.tolist(), step.q.tolist())
    centre, velocity = translated(x, np.array([h]), arc)
    return State.of(np.concatenate([q_ab, step.w, centre[0], velocity[0], x.sigma, x.c_b, x.q_bc]))


def propagate_state(x: State, h: float, arc: OrbitArc | None = None) -> tuple[State, Array]:
    """The state h seconds later (either sign) without disturbance, and Phi (20, 20) of the step."""
    step = flow(x.w_b, x.sigma, h)
    return advance(x, step, h, arc), transition(step, x.sigma, h, arc)


def propagate(
    belief: Belief, t_ns: int, torque: float, force: float, orbit: RelativeOrbit | None = None
) -> tuple[Belief, Array]:
    """Belief at t_ns and Phi of the step (eq:state-prop, eq:cov-prop). A step back in time adds no
    noise.

    Raises:
        UsageError: the step turns the target by more than ``MOST_RAD``.
    """
    h, x = seconds_to(belief, t_ns), belief.x
    path = translation(h, None if orbit is None else orbit.at(belief.t_ns))
    density = torque_density(x.sigma, torque)
    there, Phi, P = _motion.propagate(x.flat, belief.P, h, path, density, force**2)
    return Belief(t_ns, State.of(there), P), Phi


def seconds_to(belief: Belief, t_ns: int) -> float:
    """Time from a belief to another instant [s].

    Raises:
        UsageError: the target turns by more than ``MOST_RAD`` in between.
    """
    h = (t_ns - belief.t_ns) * 1e-9
    if (turn := abs(h) * max(map(abs, belief.x.w_b.tolist()))) > MOST_RAD:
        what = (
            f"a scan comes {h:.4g} s after the one before, and the target turns {turn:.3g} rad: too"
            " far to predict"
        )
        raise UsageError(
            what,
            where=f"stamp {t_ns}",
            hint="check the stamps (--clock log), or use --start or --end",
        )
    return h


@value_class
class RotationHistory:
    """Rotation at n instants from one initial state.

    Attributes:
        q: (n, 4) attitude q_ab.
        w: (n, 3) rate in {B} [rad/s].
        S: (n, 6, 8) derivative of (dq_v, w) at each instant with respect to (dq_v, w, sigma) at the
            start.
    """

    q: Array
    w: Array
    S: Array


def rotation_history(x: State, times_s: Array, drive: Triple = NO_DRIVE) -> RotationHistory:
    """Rotation from ``x`` at 0 to each of ``times_s`` (n,) [s], of either sign; each is reached
    from the one before.

    ``drive`` is the angular acceleration in {B} by a constant torque [rad/s2].
    """
    times = np.asarray(times_s, dtype=np.float64)
    q, w, S, _ = _motion.follow(x.q_ab, x.w_b, ratios(x.sigma), NO_DRIVE, times, drive)
    return RotationHistory(
        q, w, np.concatenate([S[:, :, :6], S[:, :, 6:] @ sigma_join(x.sigma)], axis=2)
    )


def rotation_path(x: State, drive: Triple = NO_DRIVE) -> _motion.Path:
    """Rotation from ``x`` at arbitrary instants; intermediate states are kept, so repeated queries
    are cheap.

    ``drive`` is the angular acceleration in {B} by a constant torque [rad/s2].

    Returns:
        An object whose ``at(times_s)`` (n,) [s] gives attitude q_ab (n, 4) and rate in {B} (n, 3)
        [rad/s]. It raises ValueError for a time that is not finite or more than a million radians
        away.
    """
    return _motion.Path(x.q_ab, x.w_b, ratios(x.sigma), drive)


def grasp_trajectory(x: State, arc: OrbitArc | None = None, drive: Triple = NO_DRIVE) -> Trajectory:
    """Positions and velocities of the undisturbed grasp point.

    Args:
        x: the state now.
        arc: the orbit from now on; None for free motion.
        drive: angular acceleration in {B} by a constant torque [rad/s2].

    Returns:
        Function of times (n,) >= 0 [s after now]: positions (n, 3) [m] and velocities (n, 3) [m/s]
        in {A}.

    Raises:
        ValueError: by the returned function, for a time that is negative or not finite.
    """
    path = rotation_path(x, drive)

    def at(times: Array) -> tuple[Array, Array]:
        times = np.asarray(times, dtype=np.float64)
        if times.size and not (float(times.min()) >= 0.0 and float(times.max()) < np.inf):
            raise ValueError("times must be finite and not before now")
        place, moving = path.point(times, x.c_b)
        centre, speed = translated(x, times, arc)
        return centre + place, speed + moving

    return at


def fixture_attitude(x: State, drive: Triple = NO_DRIVE) -> Callable[[Array], Array]:
    """Times (n,) >= 0 [s after now] -> attitudes q_ac (n, 4) of the fixture; ``drive`` as in
    ``grasp_trajectory``.
    """
    path = rotation_path(x, drive)
    return lambda times: geometry.multiply(path.at(np.asarray(times, dtype=np.float64))[0], x.q_bc)


def grasp_forecast(belief: Belief, times_s: Array, torque: float, force: float) -> Forecast:
    """Predicted 1 sigma of the grasp point at ``times_s`` (n,) >= 0, ascending [s after now]
    (section 8).

    The values are infinite where the target would turn by more than ``MOST_RAD``.

    Raises:
        ValueError: times that do not ascend from 0.
    """
    times, x = ascending(times_s), belief.x
    if max(map(abs, x.w_b.tolist())) * float(times.max(initial=0.0)) > MOST_RAD:
        return Forecast(times, *np.full((3, len(times)), np.inf))
    P, density = np.ascontiguousarray(belief.P), torque_density(x.sigma, torque)
    return forecast_of(times, _motion.forecast(x.flat, P, density, force**2, times))


def after_change(belief: Belief, times_s: Array, probability: float, P: Array) -> Possible | None:
    """What a possible change of the motion means for the grasp point; None where none is possible.

    Args:
        belief: now.
        times_s: (n,) >= 0, ascending [s after now].
        probability: of the change.
        P: (20, 20) second moments of the error that it has caused by now, times its probability.
    """
    if not (probability > 0.0 and P.any()):
        return None
    changed = Belief(belief.t_ns, belief.x, P / probability)
    return Possible(probability, grasp_forecast(changed, times_s, 0.0, 0.0))


def ascending(times_s: Array) -> Array:
    """Return times (n,) [s] as numbers. Raises ValueError where they do not ascend from 0."""
    times = np.asarray(times_s, dtype=np.float64)
    if times.ndim != 1 or (times[:1] < 0.0).any() or (times[1:] < times[:-1]).any():
        raise ValueError("times must ascend from 0")
    return times


def forecast_of(times_s: Array, variances: Array) -> Forecast:
    """Return the 1 sigma of variances (n, 3) of position [m], velocity [m/s] and half angle;
    rounding below 0 is 0.
    """
    position, velocity, half_angle = np.sqrt(np.maximum(variances, 0.0)).T
    return Forecast(times_s, position, velocity, 2.0 * half_angle)


def pose_rows(x: State, times_s: Array, arc: OrbitArc | None = None) -> Array:
    """H Phi (n, 6, 20) of a pose measured at each of ``times_s`` (n,) [s], with respect to the
    error states at 0.
    """
    path = rotation_history(x, times_s)
    J = grasp_jacobian(geometry.matrix(path.q), path.w, x.c_b)[:, [0, 1, 2, 6, 7, 8]]
    rows, rotational = J.copy(), J[:, :, :6]
    rows[:, :, :6], rows[:, :, SIGMA] = rotational @ path.S[:, :, :6], rotational @ path.S[:, :, 6:]
    if arc is None:
        rows[:, :, VEL] += np.asarray(times_s)[:, None, None] * J[:, :, RHO]
    else:
        rows[:, :, _TRANSLATION] = J[:, :, RHO] @ arc.transitions(np.asarray(times_s))[:, :3]
    return rows


def grasp_jacobian(A_ab: Array, w_b: Array, c_b: Array) -> Array:
    """Jacobian (n, 9, 20) of the grasp point's position [m], velocity [m/s] and half-angle attitude
    (section 8).

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
