"""Paths of the robot, and the motion of the goal sampled on a grid.

A path of least time follows from the costate (eq:u): the primer vector is p(tau) = c2 - c1 tau and
the thrust is u = -a_max p / |p|; both integrals of u are known in closed form. A path under
constraints has constant thrust over equal intervals.
"""

from __future__ import annotations

import math
from dataclasses import field, replace
from typing import Protocol

import numpy as np

from avsreplay.errors import value_class
from avsreplay.geometry import Array, frozen
from avsreplay.outcome import Plan
from avsreplay.plan.reachable_set import integrals
from avsreplay.records import Trajectory

# bounds on the goal's motion: this factor times the largest difference quotient on the grid
MOTION_FACTOR = 1.5
RESOLVED = 0.1  # largest turn of the goal from one sample to the next [rad]
PROBED = 48  # intervals at the begin of a trajectory by which the spacing of samples is chosen
MOST_HALVINGS = 12  # of the spacing
INVISIBLE_M = 1e-9  # a difference below it is rounding
_HERMITE = 1.0 / 384.0  # position error of a cubic Hermite interval in units of d^4 |d4 rho|
_HERMITE_RATE = math.sqrt(3.0) / 216.0  # its velocity error in units of d^3 |d4 rho|


class RobotPath(Protocol):
    """A path that the robot can fly. Times are seconds after the instant of planning."""

    @property
    def t_go_s(self) -> float:
        """Duration [s after the instant of planning]."""

    def at(self, times: Array) -> tuple[Array, Array]:
        """Return positions [m] and velocities [m/s], each (n, 3) in {A}.

        Args:
            times: (n,) [s after the instant of planning].
        """

    def thrust(self, times: Array) -> Array:
        """Return the acceleration (n, 3) in {A} [m/s2].

        Args:
            times: (n,) [s after the instant of planning].
        """

    def u_max(self) -> float:
        """Return the largest |u| [m/s2]."""


@value_class
class CostatePath:
    """The robot coasts during the latency and then thrusts along the primer vector (eq:u).

    Attributes:
        r0, v0: (3,) position [m] and velocity [m/s] of the robot in {A} at the instant of planning.
        a_max: Magnitude of the thrust [m/s2].
        latency_s: Coasting time before the thrust [s].
        t_go_s: End of the thrust [s after the instant of planning].
        costate: (6,) [c1, c2] of p(tau) = c2 - c1 tau, tau from the instant of planning, of unit
            norm.
    """

    r0: Array
    v0: Array
    a_max: float
    latency_s: float
    t_go_s: float
    costate: Array

    def __post_init__(self) -> None:
        for name, size in (("r0", 3), ("v0", 3), ("costate", 6)):
            object.__setattr__(self, name, frozen(getattr(self, name), size))

    @classmethod
    def from_normal(
        cls,
        r0: Array,
        v0: Array,
        a_max: float,
        latency_s: float,
        thrust_s: float,
        P0: Array,
        P1: Array,
    ) -> CostatePath:
        """Return the path whose primer vector is -P, P changing linearly from P0 to P1 over the
        thrust time (eq:u).

        Args:
            r0: (3,) position of the robot in {A} at the instant of planning [m].
            v0: (3,) its velocity [m/s].
            a_max: Magnitude of the thrust [m/s2].
            latency_s: Coasting time before the thrust [s].
            thrust_s: Duration of the thrust, above 0 [s].
            P0: (3,) P at the begin of the thrust in {A}; a common factor of P0 and P1 has no
                effect.
            P1: (3,) P at its end.
        """
        c1 = (P1 - P0) / thrust_s
        c = np.concatenate([c1, c1 * latency_s - P0])
        return cls(r0, v0, a_max, latency_s, latency_s + thrust_s, c / np.linalg.norm(c))

    @classmethod
    def of(cls, plan: Plan, r0: Array, v0: Array) -> CostatePath:
        """Return the path of an unconstrained plan.

        Args:
            plan: A plan that was found.
            r0: (3,) position of the robot in {A} for which the plan was made [m].
            v0: (3,) its velocity [m/s].
        """
        return cls(r0, v0, plan.a_max, plan.latency_s, plan.t_go_s, plan.costate)

    def p(self, times: Array) -> Array:
        """Return the primer vector (n, 3) in {A}, c2 - c1 tau, without unit.

        Args:
            times: (n,) [s after the instant of planning].
        """
        out: Array = self.costate[None, 3:] - self.costate[None, :3] * times[:, None]
        return out

    def thrust(self, times: Array) -> Array:
        """Return the acceleration (n, 3) in {A} [m/s2] (eq:u); it is zero outside [latency_s,
        t_go_s].

        Args:
            times: (n,) [s after the instant of planning].
        """
        p = self.p(times)
        norm = np.linalg.norm(p, axis=1, keepdims=True)
        u: Array = -self.a_max * p / np.where(norm > 0.0, norm, 1.0)
        on = (times >= self.latency_s) & (times <= self.t_go_s)
        return np.where(on[:, None], u, 0.0)

    def at(self, times: Array) -> tuple[Array, Array]:
        """Return positions [m] and velocities [m/s], each (n, 3) in {A}; after the end the robot
        coasts.

        Args:
            times: (n,) [s after the instant of planning].
        """
        burn = np.clip(times, self.latency_s, self.t_go_s) - self.latency_s
        start = self.p(np.full(len(times), self.latency_s))
        first, second = integrals(-start, -self.p(burn + self.latency_s))
        dv = self.a_max * burn[:, None] * first
        after = np.maximum(times - self.t_go_s, 0.0)[:, None]
        dr = self.a_max * burn[:, None] ** 2 * second + dv * after
        return self.r0 + self.v0 * times[:, None] + dr, self.v0 + dv

    def terminal_errors(self, goal: Trajectory) -> tuple[float, float]:
        """Return the distance [m] and the relative speed [m/s] to the goal at the end
        (eq:terminal).

        Args:
            goal: Trajectory of the grasp point in {A}, in seconds after the instant of planning.
        """
        return _terminal_errors(self, goal)

    def u_max(self, nodes: int = 65) -> float:
        """Return the largest |u| [m/s2] at instants of the thrust; NaN where the end is infinite.

        Args:
            nodes: Number of equally spaced instants.
        """
        times = np.linspace(self.latency_s, self.t_go_s, nodes)
        return (
            float(np.max(np.linalg.norm(self.thrust(times), axis=1)))
            if math.isfinite(self.t_go_s)
            else math.nan
        )


@value_class
class StepPath:
    """The robot thrusts with constant acceleration over each of n equal intervals, as constrained
    plans do.

    Attributes:
        r0, v0: (3,) position [m] and velocity [m/s] of the robot in {A} at the instant of planning.
        u: (n, 3) acceleration of each interval in {A} [m/s2].
        latency_s: Coasting time before the first interval [s].
        t_go_s: End of the last interval [s after the instant of planning].
        escapes: (m, 4) begins of ranges of its instants [s after the instant of planning],
            ascending, and the direction in {A} in which the robot withdraws in each; None: not
            planned.
        short_m: By how much withdrawals miss what is required of them [m].
    """

    r0: Array
    v0: Array
    u: Array
    latency_s: float
    t_go_s: float
    escapes: Array | None = None
    short_m: float = 0.0
    _nodes: tuple[Array, Array] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "r0", frozen(self.r0, 3))
        object.__setattr__(self, "v0", frozen(self.v0, 3))
        object.__setattr__(self, "u", frozen(self.u, -1, 3))
        h, zero = self.step_s, np.zeros((1, 3))
        v = self.v0 + np.concatenate([zero, h * np.cumsum(self.u, axis=0)])
        start = self.r0 + self.latency_s * self.v0
        r = start + np.concatenate([zero, np.cumsum(h * v[:-1] + 0.5 * h * h * self.u, axis=0)])
        object.__setattr__(self, "_nodes", (r, v))

    @property
    def step_s(self) -> float:
        """Length of one interval [s]."""
        return (self.t_go_s - self.latency_s) / len(self.u)

    def nodes(self) -> tuple[Array, Array]:
        """Return positions [m] and velocities [m/s], each (n + 1, 3) in {A}, at the ends of the
        intervals.
        """
        return self._nodes

    def _interval(self, times: Array) -> tuple[Array, Array]:
        since = np.clip(times - self.latency_s, 0.0, self.t_go_s - self.latency_s)
        k = np.minimum((since / self.step_s).astype(np.int64), len(self.u) - 1)
        return k, since - k * self.step_s

    def thrust(self, times: Array) -> Array:
        """Return the acceleration (n, 3) in {A} [m/s2]; it is zero outside [latency_s, t_go_s].

        Args:
            times: (n,) [s after the instant of planning].
        """
        on = (times >= self.latency_s) & (times <= self.t_go_s)
        return np.where(on[:, None], self.u[self._interval(times)[0]], 0.0)

    def at(self, times: Array) -> tuple[Array, Array]:
        """Return positions [m] and velocities [m/s], each (n, 3) in {A}; the robot coasts before
        and after the thrust.

        Args:
            times: (n,) [s after the instant of planning].
        """
        r, v = self._nodes
        k, s = self._interval(times)
        early = np.minimum(times - self.latency_s, 0.0)[:, None]
        late = np.maximum(times - self.t_go_s, 0.0)[:, None]
        velocity = v[k] + s[:, None] * self.u[k]
        position = r[k] + s[:, None] * v[k] + 0.5 * s[:, None] ** 2 * self.u[k]
        return position + early * self.v0 + late * velocity, velocity

    def terminal_errors(self, goal: Trajectory) -> tuple[float, float]:
        """Return the distance [m] and the relative speed [m/s] to the goal at the end
        (eq:terminal).

        Args:
            goal: Trajectory of the grasp point in {A}, in seconds after the instant of planning.
        """
        return _terminal_errors(self, goal)

    def ending_at(self, goal: Trajectory) -> StepPath:
        """Return the path without terminal errors: its thrust with the correction of least norm.

        Args:
            goal: Trajectory of the grasp point in {A}, in seconds after the instant of planning.
        """
        n, h = len(self.u), self.step_s
        rho, rate = goal(np.array([self.t_go_s]))
        rows = np.stack(
            [h * h * (n - np.arange(n) - 0.5), np.full(n, h)]
        )  # effect of u_k on the last position and velocity
        errors = np.stack([rho[0] - self._nodes[0][-1], rate[0] - self._nodes[1][-1]])
        return replace(self, u=self.u + rows.T @ np.linalg.solve(rows @ rows.T, errors))

    def u_max(self) -> float:
        """Return the largest |u| [m/s2]."""
        return float(np.max(np.linalg.norm(self.u, axis=1)))


@value_class
class BurnPath:
    """The robot thrusts with constant acceleration over each of a few intervals, then it coasts.

    Attributes:
        r0, v0: (3,) position [m] and velocity [m/s] of the robot in {A} at the begin.
        u: (n, 3) acceleration of each interval in {A} [m/s2].
        ends: (n,) end of each interval, ascending [s after the begin].
    """

    r0: Array
    v0: Array
    u: Array
    ends: Array

    @property
    def t_go_s(self) -> float:
        """End of the last interval [s after the begin]."""
        return float(self.ends[-1]) if len(self.ends) else 0.0

    def u_max(self) -> float:
        """Return the largest |u| [m/s2]."""
        return float(np.linalg.norm(self.u, axis=1).max(initial=0.0))

    def after(self, since_s: float) -> BurnPath:
        """Return the rest of the path from ``since_s`` after its begin on."""
        (r,), (v,) = self.at(np.array([since_s]))
        left = self.ends > since_s
        return BurnPath(r, v, self.u[left], self.ends[left] - since_s)

    def at(self, times: Array) -> tuple[Array, Array]:
        """Return positions [m] and velocities [m/s], each (n, 3) in {A}.

        Args:
            times: (n,) [s after the begin].
        """
        r, v = self.r0 + times[:, None] * self.v0, np.tile(self.v0, (len(times), 1))
        for u, begin, end in zip(self.u, np.r_[0.0, self.ends][:-1], self.ends, strict=True):
            on = np.clip(times, begin, end)[:, None] - begin
            v = v + on * u
            r = r + (0.5 * on + np.maximum(times - end, 0.0)[:, None]) * on * u
        return r, v

    def thrust(self, times: Array) -> Array:
        """Return the acceleration (n, 3) in {A} [m/s2]; it is zero outside the intervals.

        Args:
            times: (n,) [s after the begin].
        """
        k = np.searchsorted(self.ends, times, side="left")
        on = (times >= 0.0) & (k < len(self.u))
        return np.where(on[:, None], np.r_[self.u, np.zeros((1, 3))][k], 0.0)


def path_of(plan: Plan, r0: Array, v0: Array) -> RobotPath:
    """Return the path of a plan.

    Args:
        plan: A plan that was found.
        r0: (3,) position of the robot in {A} for which the plan was made [m].
        v0: (3,) its velocity [m/s].
    """
    if plan.thrust is not None:
        return StepPath(r0, v0, plan.thrust, plan.latency_s, plan.t_go_s, plan.escapes)
    return CostatePath.of(plan, r0, v0)


def _terminal_errors(path: RobotPath, goal: Trajectory) -> tuple[float, float]:
    end = np.array([path.t_go_s])
    r, v = path.at(end)
    rho, rate = goal(end)
    return float(np.linalg.norm(rho[0] - r[0])), float(np.linalg.norm(rate[0] - v[0]))


@value_class
class SampledGoal:
    """Difference between the goal and a coasting robot on a grid of thrust times, interpolated by
    cubic Hermite pieces.

    A trajectory may be costly to evaluate because it integrates a tumbling body, so it is evaluated
    once on a grid.

    Attributes:
        begin, step, end: First node, grid step and last node [s of thrust time].
        times: (n,) nodes.
        dr: (n, 3) goal minus coasting robot [m].
        dv: (n, 3) derivative of dr [m/s].
        pieces: (n - 1, 4, 3) coefficients of each Hermite interval in powers of its local
            coordinate from 0 to 1.
        acceleration, jerk, snap: Bounds on the second, third and fourth derivative of the goal's
            position [SI].
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
        """Return dr, its first and its second derivative (3,) at thrust time t."""
        d = self.step
        k = min(max(int((t - self.begin) / d), 0), len(self.pieces) - 1)
        s = (t - self.times.item(k)) / d
        powers = (
            (1.0, s, s * s, s**3),
            (0.0, 1.0 / d, 2.0 * s / d, 3.0 * s * s / d),
            (0.0, 0.0, 2.0, 6.0 * s),
        )
        dr, dv, ddv = np.array(powers) @ self.pieces[k]
        return dr, dv, ddv / (d * d)

    def curvature(self, n0: float, n1: float, t: Array | float) -> Array | float:
        """Return a bound on |d2/dt2| of P0.dr + P1.(t dv - dr) where |P0 - P1| = n0 and |P1|
        = n1.
        """
        return (n0 + 2.0 * n1) * self.acceleration + n1 * t * self.jerk

    def interpolation_error(self, n0: float, n1: float, t: float) -> float:
        """Return a bound on the interpolation error of P0.dr + P1.(t dv - dr)."""
        d3 = self.step**3 * self.snap
        return n0 * _HERMITE * self.step * d3 + n1 * t * _HERMITE_RATE * d3


def resolved_step(goal: Trajectory, step_s: float, end_s: float) -> float:
    """Return the spacing of samples at which a goal turns little from one to the next: the given
    one, halved as often as needed [s].

    The difference between its way and its mean velocity in an interval grows with the turn; it
    also shows a goal that turns once or more between two samples.

    Args:
        goal: Trajectory of the grasp point.
        step_s: Largest spacing [s].
        end_s: Latest instant that is of interest [s].
    """
    for _ in range(MOST_HALVINGS):
        times = np.linspace(0.0, min(step_s * PROBED, end_s), PROBED + 1)
        step = float(times[1])
        rho, rate = goal(times)
        turned = _largest_norm(np.diff(rho, axis=0) - 0.5 * step * (rate[1:] + rate[:-1]))
        bend = _largest_norm(np.diff(rate, axis=0))
        if not turned > max(step * bend * RESOLVED / 12.0, INVISIBLE_M):
            break
        step_s *= 0.5
    return step_s


def sample_goal(
    goal: Trajectory, r0: Array, v0: Array, delay_s: float, begin: float, end: float, step_s: float
) -> SampledGoal:
    """Evaluate ``goal`` on a grid of thrust times from begin to end; thrust time t is its instant
    ``delay_s + t``.

    Raises:
        ValueError: The goal is not finite or not of shape (n, 3).
    """
    n = max(math.ceil((end - begin) / step_s), 4) + 1
    times = np.linspace(begin, end, n)
    rho, rate = goal(times + delay_s)
    if rho.shape != (n, 3) or rate.shape != (n, 3):
        raise ValueError(
            f"goal trajectory gave shapes {rho.shape} and {rate.shape}, expected {(n, 3)} twice"
        )
    dr = rho - r0 - v0 * (times + delay_s)[:, None]
    dv = rate - v0
    step = (end - begin) / (n - 1)
    acc = (rate[1:] - rate[:-1]) / step
    jerk = (acc[1:] - acc[:-1]) / step
    snap = (jerk[1:] - jerk[:-1]) / step
    a, j, s = (_largest_norm(x) for x in (acc, jerk, snap))
    if not math.isfinite(a + float(dr.sum())):
        raise ValueError("goal trajectory is not finite")
    bounds = (a + step * MOTION_FACTOR * j, MOTION_FACTOR * j, MOTION_FACTOR * s)
    return SampledGoal(begin, step, end, times, dr, dv, _hermite(dr, dv, step), *bounds)


def _hermite(dr: Array, dv: Array, step: float) -> Array:
    rise = dr[1:] - dr[:-1] - step * dv[:-1]
    bend = step * (dv[1:] - dv[:-1])
    return np.stack([dr[:-1], step * dv[:-1], 3.0 * rise - bend, bend - 2.0 * rise], axis=1)


def _largest_norm(vectors: Array) -> float:
    return math.sqrt(float((vectors * vectors).sum(axis=1).max()))
