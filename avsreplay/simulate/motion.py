"""The true motion of a rigid body, integrated with its full inertia tensor in the axes of {C} (not
with sigma).

    I dw/dt = -w x (I w) + torque,   dq/dt = 1/2 q o [w; 0]   (Hamilton product, w in body axes)
    d2r/dt2 = force + gravity gradient of the camera's orbit, where there is one

The right-hand sides are quadratic, or linear with known coefficients, so the Taylor coefficients of
the solution follow by recurrence. A step covers at most 0.25 rad with 22 terms (truncation error
below 1e-13); the polynomial is also the dense output. The arithmetic uses Python floats only: the
same bits on any machine, except for the sine and cosine of the orbit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from avsreplay import geometry
from avsreplay.errors import UsageError, value_class
from avsreplay.geometry import Array, Pose
from avsreplay.records import State
from avsreplay.settings import Settings, are_orthonormal, is_unit, setting
from avsreplay.simulate.inertia import Body

TAYLOR_ORDER = 22
STEP_TURN_RAD = 0.25
# largest number of steps of the integration, 2 kB each: at least 4000 turns
MAX_INTEGRATION_STEPS = 100_000
Vector = tuple[float, ...]
Rows = Sequence[Sequence[float]]


@dataclass(frozen=True, slots=True)
class Push(Settings):
    """One table [[motion.push]]: a sudden change of the target's velocity and angular rate."""

    at_s: float = setting(doc="Its instant after the begin of the log.", unit="s", low=0.0)
    velocity_mps: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), "Change of the velocity of the mass centre in {A}.", unit="m/s"
    )
    rate_radps: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), "Change of the angular rate, in the axes of {C}.", unit="rad/s"
    )


@dataclass(frozen=True, slots=True)
class Load(Settings):
    """One table [[motion.load]]: a constant torque and force on the target."""

    start_s: float = setting(
        0.0, "Time from which it acts, after the begin of the log.", unit="s", low=0.0
    )
    duration_s: float | None = setting(
        None, "Time for which it acts.", unit="s", above=0.0, unset="to the end of the log"
    )
    torque_radps2: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0),
        "Torque over the trace of the inertia, in the axes of {C}.",
        unit="rad/s^2",
    )
    force_mps2: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), "Force per unit mass in {A}.", unit="m/s^2"
    )

    @property
    def end_s(self) -> float:
        """Time at which it ends [s after the begin]."""
        return math.inf if self.duration_s is None else self.start_s + self.duration_s


@dataclass(frozen=True, slots=True)
class MotionParams(Settings):
    """The table [motion]: the target's initial state, and its disturbances."""

    attitude_xyzw: tuple[float, float, float, float] = setting(
        (0.0, 0.0, 0.0, 1.0), "q_ac, initial attitude of the fixture in the camera frame."
    )
    rate_radps: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.1), "Initial angular rate of the target, in the axes of {C}.", unit="rad/s"
    )
    position_m: tuple[float, float, float] = setting(
        (0.0, 0.0, 5.0), "Initial position of the mass centre in {A}.", unit="m"
    )
    velocity_mps: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), "Initial velocity of the mass centre in {A}.", unit="m/s"
    )
    orbit_rate_radps: float = setting(
        0.0,
        "Mean motion of the camera's circular orbit, whose gravity gradient acts on the relative"
        " motion (Clohessy-Wiltshire); 0 means no orbit.",
        unit="rad/s",
        low=0.0,
        high=0.1,
    )
    radial_a: tuple[float, float, float] = setting(
        (1.0, 0.0, 0.0),
        "Unit vector from the centre of the Earth to the camera in {A}, at the start.",
    )
    orbit_normal_a: tuple[float, float, float] = setting(
        (0.0, 1.0, 0.0), "Unit normal of the orbit in {A}."
    )
    torque_std_radps2: float = setting(
        0.0,
        "1 sigma of the disturbance torque over the trace of the inertia, each axis of {C}.",
        unit="rad/s^2",
        low=0.0,
    )
    force_std_mps2: float = setting(
        0.0,
        "1 sigma of the disturbance force per unit mass, each axis of {A}.",
        unit="m/s^2",
        low=0.0,
    )
    disturbance_step_s: float = setting(
        1.0, "Time for which a disturbance is constant.", unit="s", above=0.0
    )
    push: tuple[Push, ...] = setting((), "Sudden changes of the motion, one table each.")
    load: tuple[Load, ...] = setting((), "Constant torques and forces, one table each.")

    def check(self) -> None:
        """Raise ValueError where the attitude is not a unit quaternion."""
        if not is_unit(self.attitude_xyzw):
            raise ValueError(f"attitude_xyzw = {list(self.attitude_xyzw)} is not a unit quaternion")
        if not are_orthonormal(self.radial_a, self.orbit_normal_a):
            raise ValueError(
                "radial_a and orbit_normal_a must be unit vectors at right angles to each other"
            )


class Motion:
    """The motion of a body over [0, span_s].

    Attributes:
        step_starts_s: (k,) begin of each step of the integration [s].
    """

    def __init__(
        self, body: Body, params: MotionParams, span_s: float, rng: np.random.Generator
    ) -> None:
        """Integrate the motion.

        Args:
            body: Its mass properties.
            params: Initial state and disturbances.
            span_s: Length [s].
            rng: Generator of the disturbances.
        """
        self._body = body
        self.step_starts_s, self._coefficients = _integrate(body, params, span_s, rng)

    def states(self, times_s: ArrayLike) -> tuple[Array, Array, Array, Array]:
        """Return attitude, angular rate, position and velocity.

        Args:
            times_s: (n,) [s after the begin].

        Returns:
            q_ac (n, 4), rate in {C} (n, 3) [rad/s], mass centre (n, 3) [m] and its velocity (n, 3)
            [m/s] in {A}.
        """
        times = np.asarray(times_s, dtype=np.float64)
        step = np.clip(
            np.searchsorted(self.step_starts_s, times, side="right") - 1,
            0,
            len(self.step_starts_s) - 1,
        )
        tau = (times - self.step_starts_s[step])[:, None]
        value = np.zeros((len(times), 13))
        # ``take`` copies the column of all steps that it is given: those of one scan are few.
        first, last = (step.min(), step.max()) if len(step) else (0, 0)
        near = self._coefficients[first : last + 1]
        for term in range(TAYLOR_ORDER, -1, -1):
            value = value * tau + near[:, term].take(step - first, axis=0)
        return geometry.normalise(value[:, :4]), value[:, 4:7], value[:, 7:10], value[:, 10:]

    def poses(self, times_s: ArrayLike) -> tuple[Array, Array]:
        """Return the poses of the fixture.

        Args:
            times_s: (n,) [s after the begin].

        Returns:
            Rotations R_ac (n, 3, 3) and positions of the fixture (n, 3) in {A} [m].
        """
        q_ac, _, centre, _ = self.states(times_s)
        R_ac = geometry.matrix(q_ac)
        return R_ac, centre - geometry.rotate(R_ac, self._body.centre_c)

    def pose(self, t_s: float) -> Pose:
        """Return T_ac.

        Args:
            t_s: Instant [s after the begin].
        """
        return self.state(t_s).T_ac

    def state(self, t_s: float) -> State:
        """Return the full true state.

        Args:
            t_s: Instant [s after the begin].
        """
        q_ac, w_c, centre, velocity = (value[0] for value in self.states([t_s]))
        body = self._body
        return State(
            q_ab=geometry.normalise(geometry.multiply(q_ac, geometry.conjugate(body.q_bc))),
            w_b=geometry.rotate(geometry.matrix(body.q_bc), w_c),
            r_a=centre,
            v_a=velocity,
            sigma=body.sigma,
            c_b=body.c_b,
            q_bc=body.q_bc,
        )


@value_class(eq=True)
class _Instant:
    """State at the start of a step: q_ac, w_c, r_a, v_a."""

    q: Vector
    w: Vector
    r: Vector
    v: Vector


def _integrate(
    body: Body, params: MotionParams, span_s: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Step starts (k,) and Taylor coefficients (k, TAYLOR_ORDER + 1, 13) of [q_ac, w_c, r_a, v_a].

    Raises:
        UsageError: The motion is too fast for its length.
    """
    inertia = [[float(x) for x in row] for row in body.inertia_c]
    least = min(float(m) for m in body.moments)
    now = _Instant(
        _unit(params.attitude_xyzw), params.rate_radps, params.position_m, params.velocity_mps
    )
    fastest = max(math.hypot(*_times(inertia, now.w)) / least, params.orbit_rate_radps)
    if span_s * fastest > MAX_INTEGRATION_STEPS * STEP_TURN_RAD:
        raise _too_long(span_s)
    starts: list[float] = []
    table: list[Array] = []
    trace = sum(inertia[i][i] for i in range(3))
    windows = _windows(params, trace, span_s, rng)
    for begin, until, torque, force in _loaded(windows, params, trace):
        t, now = begin, _pushed(now, params.push, begin)
        while t < until:
            momentum = math.sqrt(sum(x * x for x in _times(inertia, now.w)))
            end = min(until, t + STEP_TURN_RAD * least / momentum) if momentum > 0.0 else until
            if params.orbit_rate_radps > 0.0:
                end = min(end, t + STEP_TURN_RAD / params.orbit_rate_radps)
            terms = _terms(now, inertia, torque, _translation(now, params, t, force))
            starts.append(t)
            table.append(np.array(terms))
            if len(table) > MAX_INTEGRATION_STEPS:
                raise _too_long(span_s)
            now, t = _at_end(terms, end - t), end
    return np.array(starts), np.array(table)


def _too_long(span_s: float) -> UsageError:
    steps = f"{MAX_INTEGRATION_STEPS} steps of {STEP_TURN_RAD} rad"
    what = f"{span_s:g} s of this motion need more than {steps}"
    return UsageError(what, where="motion", hint="record a shorter log, or a slower motion")


def _windows(
    params: MotionParams, trace: float, span_s: float, rng: np.random.Generator
) -> Iterator[tuple[float, float, Vector, Vector]]:
    """Spans of constant disturbance: begin, end [s], torque [m2/s2] in {C}, force [m/s2] in {A}."""
    if params.torque_std_radps2 == 0.0 and params.force_std_mps2 == 0.0:
        yield 0.0, span_s, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        return
    for k in range(math.ceil(span_s / params.disturbance_step_s)):
        torque = tuple(params.torque_std_radps2 * trace * float(x) for x in rng.standard_normal(3))
        force = tuple(params.force_std_mps2 * float(x) for x in rng.standard_normal(3))
        yield k * params.disturbance_step_s, (k + 1) * params.disturbance_step_s, torque, force


def _loaded(
    windows: Iterator[tuple[float, float, Vector, Vector]], params: MotionParams, trace: float
) -> Iterator[tuple[float, float, Vector, Vector]]:
    """The windows, divided where a load begins or ends and at each push, with the loads added."""
    events = {each.at_s for each in params.push}
    events |= {t for load in params.load for t in (load.start_s, load.end_s)}
    for begin, until, torque, force in windows:
        cuts = [begin, *sorted(t for t in events if begin < t < until), until]
        for start, end in pairwise(cuts):
            acting = [each for each in params.load if each.start_s <= start < each.end_s]
            yield (
                start,
                end,
                _sum(torque, [tuple(trace * x for x in each.torque_radps2) for each in acting]),
                _sum(force, [each.force_mps2 for each in acting]),
            )


def _sum(first: Vector, others: Sequence[Vector]) -> Vector:
    for other in others:
        first = tuple(a + b for a, b in zip(first, other, strict=True))
    return first


def _pushed(now: _Instant, pushes: Sequence[Push], t: float) -> _Instant:
    """The state after the pushes at the time t [s]."""
    due = [each for each in pushes if each.at_s == t]
    w, v = _sum(now.w, [p.rate_radps for p in due]), _sum(now.v, [p.velocity_mps for p in due])
    return _Instant(now.q, w, now.r, v)


def _terms(
    now: _Instant, inertia: Rows, torque: Vector, translation: tuple[list[Vector], list[Vector]]
) -> list[Vector]:
    """Taylor coefficients about ``now``, TAYLOR_ORDER + 1 rows of 13."""
    turning = _turning(now, inertia, _inverse(inertia), torque)
    return [(*q, *w, *r, *v) for (q, w), r, v in zip(turning, *translation, strict=True)]


def _translation(
    now: _Instant, params: MotionParams, t: float, force: Vector
) -> tuple[list[Vector], list[Vector]]:
    """Taylor coefficients of mass centre and velocity about the time t [s].

    The axes of {A} are inertial. With the mean motion n and the radial unit vector o(t) the
    relative acceleration is that of Clohessy and Wiltshire, n^2 (3 o o' - 1) r, to first order in
    the distance.
    """
    zero = (0.0, 0.0, 0.0)
    if params.orbit_rate_radps == 0.0:
        centre = [now.r, now.v, tuple(0.5 * f for f in force)] + [zero] * (TAYLOR_ORDER - 2)
        return centre, [now.v, force] + [zero] * (TAYLOR_ORDER - 1)
    gradients = _gravity_gradient(params, t)
    centre, velocity = [now.r], [now.v]
    for k in range(TAYLOR_ORDER):
        rates = list(force) if k == 0 else [0.0, 0.0, 0.0]
        for i in range(k + 1):
            rates = [a + b for a, b in zip(rates, _times(gradients[i], centre[k - i]), strict=True)]
        centre.append(tuple(x / (k + 1) for x in velocity[k]))
        velocity.append(tuple(x / (k + 1) for x in rates))
    return centre, velocity


def _gravity_gradient(params: MotionParams, t: float) -> list[Rows]:
    """Taylor coefficients of n^2 (3 o o' - 1) about the time t [s].

    With the radial vector e and the along-track vector f at the time 0, o = e cos(n t) + f sin(n
    t), so that o o' = (e e' + f f') / 2 + cos(2 n t) (e e' - f f') / 2 + sin(2 n t) (e f' + f e') /
    2.
    """
    n, e, m = params.orbit_rate_radps, params.radial_a, params.orbit_normal_a
    f = (m[1] * e[2] - m[2] * e[1], m[2] * e[0] - m[0] * e[2], m[0] * e[1] - m[1] * e[0])

    def entry(i: int, j: int, one: float, c: float, s: float) -> float:
        dyad = (one + c) * e[i] * e[j] + (one - c) * f[i] * f[j] + s * (e[i] * f[j] + f[i] * e[j])
        return 1.5 * dyad - (one if i == j else 0.0)

    found: list[Rows] = []
    scale = 1.0
    for k in range(TAYLOR_ORDER):
        phase = 2.0 * n * t + 0.5 * math.pi * k
        c, s = scale * math.cos(phase), scale * math.sin(phase)
        one = 1.0 if k == 0 else 0.0
        found.append([[n * n * entry(i, j, one, c, s) for j in range(3)] for i in range(3)])
        scale *= 2.0 * n / (k + 1)
    return found


def _turning(
    now: _Instant, inertia: Rows, inverse: Rows, torque: Vector
) -> list[tuple[Vector, Vector]]:
    """Taylor coefficients of attitude and rate; a product of series is a sum over i of terms
    i and k - i.
    """
    qs, ws, hs = [now.q], [now.w], [_times(inertia, now.w)]
    for k in range(TAYLOR_ORDER):
        load = [torque[i] if k == 0 else 0.0 for i in range(3)]
        turn = [0.0, 0.0, 0.0, 0.0]
        for i in range(k + 1):
            _subtract_cross(load, ws[i], hs[k - i])
            _add_product(turn, qs[i], ws[k - i])
        ws.append(tuple(x / (k + 1) for x in _times(inverse, load)))
        hs.append(_times(inertia, ws[-1]))
        qs.append(tuple(0.5 * x / (k + 1) for x in turn))
    return list(zip(qs, ws, strict=True))


def _subtract_cross(out: list[float], a: Vector, b: Vector) -> None:
    out[0] -= a[1] * b[2] - a[2] * b[1]
    out[1] -= a[2] * b[0] - a[0] * b[2]
    out[2] -= a[0] * b[1] - a[1] * b[0]


def _add_product(out: list[float], q: Vector, w: Vector) -> None:
    """Adds q o [w; 0], Hamilton."""
    out[0] += q[3] * w[0] + q[1] * w[2] - q[2] * w[1]
    out[1] += q[3] * w[1] + q[2] * w[0] - q[0] * w[2]
    out[2] += q[3] * w[2] + q[0] * w[1] - q[1] * w[0]
    out[3] -= q[0] * w[0] + q[1] * w[1] + q[2] * w[2]


def _at_end(terms: list[Vector], tau: float) -> _Instant:
    value = [0.0] * 13
    for row in reversed(terms):
        value = [v * tau + x for v, x in zip(value, row, strict=True)]
    return _Instant(_unit(value[:4]), tuple(value[4:7]), tuple(value[7:10]), tuple(value[10:]))


def _unit(q: Sequence[float]) -> Vector:
    norm = math.sqrt(sum(x * x for x in q))
    return tuple(x / norm for x in q)


def _times(m: Rows, v: Sequence[float]) -> Vector:
    return tuple(row[0] * v[0] + row[1] * v[1] + row[2] * v[2] for row in m)


def _inverse(m: Rows) -> Rows:
    """Inverse of a symmetric 3 x 3 matrix by cofactors."""
    (a, b, c), (_, d, e), (_, _, f) = m
    cofactors = [
        [d * f - e * e, c * e - b * f, b * e - c * d],
        [0.0, a * f - c * c, b * c - a * e],
        [0.0, 0.0, a * d - b * b],
    ]
    det = a * cofactors[0][0] + b * cofactors[0][1] + c * cofactors[0][2]
    return [[cofactors[min(i, j)][max(i, j)] / det for j in range(3)] for i in range(3)]
