"""A constant torque and a constant force as a part of the motion: its prediction, correction and
forecast.

The torque gives a constant angular acceleration of the body, in {C} because the fixture is known
and the principal axes are not, and the force one of the centre of mass in {A}. The six are constant
unknowns beside the 20 states. Their covariance with the states is propagated, so that the
prediction contains their uncertainty and each pose corrects them (Bar-Shalom, Li, Kirubarajan,
Estimation with Applications to Tracking and Navigation, 2001, section 4).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.estimate import _motion
from avsreplay.estimate.chart import Chart, to_chart, to_errors, to_state
from avsreplay.estimate.dynamics import (
    MOST_RAD,
    NO_DRIVE,
    Triple,
    advance,
    ascending,
    flow,
    flows,
    forecast_of,
    grasp_forecast,
    grasp_jacobian,
    process_noise,
    propagate,
    propagate_state,
    ratios,
    rotation_history,
    seconds_to,
    sigma_join,
    transition,
    translated,
)
from avsreplay.estimate.error_state import DIM, DMU, RHO, SIGMA, VEL, W, hamilton
from avsreplay.estimate.relative_orbit import OrbitArc, RelativeOrbit
from avsreplay.geometry import Array
from avsreplay.records import Belief, Forecast, State

_STEP_RAD = 0.1  # step of the integral in drift_equivalents


@value_class
class DrivenBelief(Belief):
    """A belief about a body on which a constant torque or force acts.

    Attributes:
        u: (6,) acceleration: rad/s2 in {C}, m/s2 in {A}.
        P_u: (6, 6) its covariance.
        cross: (20, 6) covariance of the error states with that of u.
    """

    u: Array
    P_u: Array
    cross: Array


@value_class
class DrivenHistory:
    """The motion with a constant acceleration at n instants.

    Attributes:
        q: (n, 4) attitude q_ab.
        w: (n, 3) rate in {B} [rad/s].
        r, v: (n, 3) centre of mass [m] and its velocity [m/s].
        Phi: (n, 20, 20) derivative of the error states by those at the start.
        by_u: (n, 20, 6) by the acceleration.
    """

    q: Array
    w: Array
    r: Array
    v: Array
    Phi: Array
    by_u: Array


def drive_of(x: State, u: Array) -> Triple:
    """The angular acceleration in {B} [rad/s2] of u (6,)."""
    x_b, y_b, z_b = (geometry.matrix(x.q_bc) @ u[:3]).tolist()
    return x_b, y_b, z_b


def drive_in(belief: Belief) -> Triple:
    """The angular acceleration in {B} [rad/s2] that a belief contains, zero without a torque."""
    return drive_of(belief.x, belief.u) if isinstance(belief, DrivenBelief) else NO_DRIVE


def propagated(
    belief: Belief, t_ns: int, torque: float, force: float, orbit: RelativeOrbit | None = None
) -> tuple[Belief, Array]:
    """``dynamics.propagate`` of a belief that may contain a constant acceleration.

    Raises:
        UsageError: the step turns the target by more than ``MOST_RAD``.
    """
    if not isinstance(belief, DrivenBelief):
        return propagate(belief, t_ns, torque, force, orbit)
    h, x, u = seconds_to(belief, t_ns), belief.x, belief.u
    arc = None if orbit is None else orbit.at(belief.t_ns)
    step = flow(x.w_b, x.sigma, h, torque, drive_of(x, u))
    Phi, by_u = (
        M[0] for M in _derivatives(x, u, np.array([h]), [transition(step, x.sigma, h, arc)])
    )
    P = _covariance(belief, Phi, by_u)
    if h > 0.0:
        P += process_noise(step.Q[None], np.array([h]), force)[0]
    cross = Phi @ belief.cross + by_u @ belief.P_u
    there = _pushed(advance(x, step, h, arc), u, h)
    return replace(belief, t_ns=t_ns, x=there, P=0.5 * (P + P.T), cross=cross), Phi


def driven_steps(
    belief: Belief, times_s: Array, torque: float, arc: OrbitArc | None
) -> tuple[list[State], Array, Array, Array]:
    """The motion of a belief to ``times_s`` (n,) [s], with the disturbance torque of this root
    density.

    Returns:
        The states, Phi (n, 20, 20), the derivative (n, 20, 6) by a constant acceleration, 0 where
        the belief has none, and the covariance (n, 6, 6) that the torque adds to (dq_v, w).
    """
    x, u = belief.x, belief.u if isinstance(belief, DrivenBelief) else None
    q, w, S, Q = flows(x.w_b, x.sigma, times_s, torque, drive_in(belief))
    q_ab, (centre, velocity) = np.array(hamilton(x.q_ab, q.T)).T, translated(x, times_s, arc)
    fixed = np.tile(x.flat[13:], (len(times_s), 1))
    if u is not None:
        centre, velocity = (
            centre + 0.5 * times_s[:, None] ** 2 * u[3:],
            velocity + times_s[:, None] * u[3:],
        )
    states = [State.of(flat) for flat in np.hstack([q_ab, w, centre, velocity, fixed])]
    Phi = _transitions(
        np.concatenate([S[:, :, :6], S[:, :, 6:] @ sigma_join(x.sigma)], axis=2), times_s, arc
    )
    if u is None:
        return states, Phi, np.zeros((len(times_s), DIM, 6)), Q
    return states, *_derivatives(x, u, times_s, Phi), Q


def _transitions(S: Array, times_s: Array, arc: OrbitArc | None) -> Array:
    """Phi (n, 20, 20) from the derivatives S (n, 6, 8) of (dq_v, w) by (dq_v, w, sigma)."""
    Phi = np.zeros((len(times_s), DIM, DIM))
    Phi[:] = np.eye(DIM)
    Phi[:, :6, :6], Phi[:, :6, SIGMA] = S[:, :, :6], S[:, :, 6:]
    if arc is None:
        Phi[:, RHO, VEL] = times_s[:, None, None] * np.eye(3)
    else:
        Phi[:, RHO.start : VEL.stop, RHO.start : VEL.stop] = arc.transitions(times_s)
    return Phi


def driven_history(
    x: State, u: Array | None, times_s: Array, arc: OrbitArc | None
) -> DrivenHistory:
    """The motion from ``x`` with a constant acceleration u (6,), or free motion, to ``times_s``
    (n,) [s], ascending.
    """
    path = rotation_history(x, times_s, NO_DRIVE if u is None else drive_of(x, u))
    centre, velocity = translated(x, times_s, arc)
    Phi = _transitions(path.S, times_s, arc)
    if u is None:
        return DrivenHistory(
            path.q, path.w, centre, velocity, Phi, np.zeros((len(times_s), DIM, 6))
        )
    pushed = centre + 0.5 * times_s[:, None] ** 2 * u[3:], velocity + times_s[:, None] * u[3:]
    return DrivenHistory(path.q, path.w, *pushed, *_derivatives(x, u, times_s, Phi))


def _pushed(x: State, u: Array, h: float) -> State:
    """A state of which the centre of mass has in addition been accelerated for h seconds."""
    return replace(x, r_a=x.r_a + 0.5 * h * h * u[3:], v_a=x.v_a + h * u[3:])


def _covariance(belief: DrivenBelief, Phi: Array, by_u: Array) -> Array:
    """Covariance (20, 20) of the states without process noise."""
    across = Phi @ belief.cross @ by_u.T
    return np.asarray(Phi @ belief.P @ Phi.T + across + across.T + by_u @ belief.P_u @ by_u.T)


def _derivatives(
    x: State, u: Array, times_s: Array, Phi: list[Array] | Array
) -> tuple[Array, Array]:
    """Phi (n, 20, 20), completed by the effect of mu, and the derivative (n, 20, 6) of the states
    by u.

    u is given in {C} and acts in {B}: R(mu) u, with R(dmu mu) = (1 + 2 [dmu x]) R(mu).

    Args:
        x: state now.
        u: (6,) acceleration.
        times_s: (n,) [s after now], each reached from the one before.
        Phi: (20, 20) along the motion with u, of each instant, without that effect.
    """
    drive = drive_of(x, u)
    turned = _motion.by_drive(x.q_ab, x.w_b, ratios(x.sigma), times_s, drive)
    full, by_u = np.array(Phi), np.zeros((len(times_s), DIM, 6))
    full[:, :6, DMU] += -2.0 * turned @ geometry.skew(np.array(drive))
    by_u[:, :6, :3] = turned @ geometry.matrix(x.q_bc)
    by_u[:, RHO, 3:] = 0.5 * (times_s**2)[:, None, None] * np.eye(3)
    by_u[:, VEL, 3:] = times_s[:, None, None] * np.eye(3)
    return full, by_u


def corrected(prior: DrivenBelief, then: Belief, H: Array, S: Array, alpha: Array) -> DrivenBelief:
    """A posterior of the states, with that of the constant acceleration.

    Args:
        prior: before the pose.
        then: posterior mean and covariance of the states.
        H: (6, 20) measurement Jacobian.
        S: (6, 6) covariance of the innovation that the gain was computed with.
        alpha: (6,) innovation.
    """
    seen = H @ prior.cross
    K = np.linalg.solve(S, np.hstack([H @ prior.P, seen])).T
    cross = prior.cross - K[:DIM] @ seen
    P_u = prior.P_u - K[DIM:] @ seen
    moved = to_errors(to_chart(then.x)) @ np.linalg.solve(to_errors(to_chart(prior.x)), cross)
    u = prior.u + K[DIM:] @ alpha
    return DrivenBelief(then.t_ns, then.x, then.P, u, 0.5 * (P_u + P_u.T), np.asarray(moved))


def driven_moments(parts: Sequence[tuple[float, DrivenBelief]]) -> DrivenBelief:
    """Mean and covariance of a mixture of beliefs at one instant, given by weight and belief, the
    heaviest first.
    """
    first, here = parts[0][1], to_chart(parts[0][1].x)
    if len(parts) == 1:
        return first
    T, P, mean = to_errors(here), np.zeros((DIM + 6, DIM + 6)), np.zeros(DIM + 6)
    off = [
        np.concatenate([T @ to_chart(each.x).minus(here), each.u - first.u]) for _, each in parts
    ]
    for (weight, _), d in zip(parts, off, strict=True):
        mean += weight * d
    for (weight, each), d in zip(parts, off, strict=True):
        own = np.block([[each.P, each.cross], [each.cross.T, each.P_u]])
        P += weight * (own + np.outer(d - mean, d - mean))
    x = to_state(here.moved(np.asarray(np.linalg.solve(T, mean[:DIM]), dtype=np.float64)))
    return DrivenBelief(
        first.t_ns, x, P[:DIM, :DIM], first.u + mean[DIM:], P[DIM:, DIM:], P[:DIM, DIM:]
    )


def driven_forecast(belief: Belief, times_s: Array, torque: float, force: float) -> Forecast:
    """``dynamics.grasp_forecast`` of a belief that may contain a constant acceleration.

    Raises:
        ValueError: times that do not ascend from 0.
    """
    if not isinstance(belief, DrivenBelief):
        return grasp_forecast(belief, times_s, torque, force)
    times_s = ascending(times_s)
    most = max(map(abs, belief.x.w_b.tolist())) * float(times_s.max(initial=0.0))
    if most > MOST_RAD or not len(times_s):
        return grasp_forecast(belief, times_s, torque, force)
    states, Phi, by_u, Q = driven_steps(belief, times_s, torque, None)
    rotations = geometry.matrix(np.array([x.q_ab for x in states]))
    J = grasp_jacobian(rotations, np.array([x.w_b for x in states]), belief.x.c_b)
    variances, noise = np.empty((len(times_s), 9)), process_noise(Q, times_s, force)
    for k in range(len(times_s)):
        variances[k] = np.diagonal(
            J[k] @ (_covariance(belief, Phi[k], by_u[k]) + noise[k]) @ J[k].T
        )
    return forecast_of(times_s, variances.reshape(-1, 3, 3).sum(axis=2))


def impulses(x: State, times_s: Array, drive: Triple = NO_DRIVE) -> Array:
    """Errors (n, 6, 3) of (dq_v, w) at 0 that equal a unit of rate in {B} at each of ``times_s``
    (n,) [s].

    ``drive`` is the angular acceleration in {B} by a constant torque [rad/s2].

    Raises:
        LinAlgError: an unstable spin over so long a time that its motion cannot be inverted.
    """
    found = _motion.impulses(x.q_ab, x.w_b, ratios(x.sigma), times_s, drive)
    if not np.isfinite(found).all():
        raise np.linalg.LinAlgError("the motion cannot be inverted")
    return found


def drift_equivalents(
    x: State, times_s: Array, onset_s: float = 0.0, drive: Triple = NO_DRIVE
) -> Array:
    """Errors of attitude to velocity at the epoch that equal a constant unit acceleration since.

    Args:
        x: state at the epoch.
        times_s: (n,) >= 0, since the epoch [s].
        onset_s: since then the motion has an angular acceleration [s].
        drive: that acceleration in {B} [rad/s2].

    Returns:
        B (n, 12, 6): the integral of Phi(s, 0)^-1 G ds, of the angular acceleration in {B} and the
        acceleration in {A}.
    """
    last = float(times_s.max())
    count = max(100, math.ceil(float(np.linalg.norm(x.w_b)) * last / _STEP_RAD))
    grid = np.linspace(0.0, last, count + 1)
    early = int(np.searchsorted(grid, onset_s, side="right")) if any(drive) else count + 1
    rate = impulses(x, grid[:early])
    if early <= count:
        at, Phi = propagate_state(x, onset_s)
        later = impulses(at, grid[early:] - onset_s, drive)
        rate = np.concatenate([rate, np.linalg.solve(Phi[:6, :6], later)])
    total = np.zeros((count + 1, 6, 3))
    np.cumsum(0.5 * (rate[1:] + rate[:-1]) * (last / count), axis=0, out=total[1:])
    B = np.zeros((len(times_s), 12, 6))
    place = np.clip(times_s / (last / count), 0.0, count)
    low = np.minimum(place.astype(int), count - 1)
    part = (place - low)[:, None, None]
    B[:, :6, :3] = (1.0 - part) * total[low] + part * total[low + 1]
    B[:, 6:9, 3:] = -0.5 * (times_s**2)[:, None, None] * np.eye(3)
    B[:, 9:12, 3:] = times_s[:, None, None] * np.eye(3)
    return B


def followed(
    chart: Chart, u: Array, onset_s: float, times_s: Array, arc: OrbitArc | None
) -> tuple[DrivenHistory, Array]:
    """The motion from initial values with an acceleration since an instant, and its derivatives.

    Args:
        chart: initial values.
        u: (6,) acceleration.
        onset_s: since then [s].
        times_s: (n,) [s], ascending.
        arc: the orbit; None for free motion.

    Returns:
        The motion at these instants, and its derivatives (n, 20, 27) by chart steps, acceleration
        and onset.
    """
    first, T, x = (
        int(np.searchsorted(times_s, onset_s, side="right")),
        to_errors(chart),
        to_state(chart),
    )
    D = np.zeros((len(times_s), DIM, DIM + 7))
    free = driven_history(x, None, np.append(times_s[:first], onset_s), arc)
    D[:first, :, :DIM], until = free.Phi[:-1] @ T, free.Phi[-1] @ T
    if first == len(times_s):
        return free, D
    at = replace(x, q_ab=free.q[-1], w_b=free.w[-1], r_a=free.r[-1], v_a=free.v[-1])
    late = driven_history(
        at, u, times_s[first:] - onset_s, None if arc is None else arc.shifted(onset_s)
    )
    missed = np.zeros(DIM)  # per second by which the onset is later
    missed[W], missed[VEL] = -np.array(drive_of(at, u)), -u[3:]
    D[first:, :, :DIM], D[first:, :, DIM:-1], D[first:, :, -1] = (
        late.Phi @ until,
        late.by_u,
        late.Phi @ missed,
    )
    parts = zip(*((p.q, p.w, p.r, p.v, p.Phi, p.by_u) for p in (free, late)), strict=True)
    return DrivenHistory(*(np.concatenate([a[:-1], b]) for a, b in parts)), D
