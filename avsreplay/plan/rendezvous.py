"""The least time to meet a moving goal with |u| <= a_max: the first root of a*(t_f) = a_max, certified.

For a fixed t_f the least thrust a* is the gauge of one convex body (``reach``). A normal P of that body that keeps
the goal out at t, G(t) = P.b(t) - a_max t^2 h(P) > 0, keeps it out for as long as G stays positive: so the search
steps from one instant to the next root of G and never passes a feasible time. P is optimal where it was found, so G
touches a* to first order and the steps end quadratically at the first root, from below.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from avsreplay.geometry import Array
from avsreplay.plan.flight import Flight
from avsreplay.plan.goal import SampledGoal, sample
from avsreplay.plan.reach import Touch, touch
from avsreplay.records import Plan, PlanStatus, Trajectory

__all__ = ["PlanParams", "rendezvous"]

MAX_STEPS = 400
STRETCH_S = 30.0  # the goal is sampled this far at a time: most captures need no more
NEAR_ROOT = 1e-2  # a_max short by less than this part: Newton ends the search, and G closes the gap behind it
GAP_LIMIT_S = 1e-6  # t_f less its bound above this: step instead
RESIDUAL_LIMIT = 1e-8  # terminal errors above this, in metres or metres a second, are not a solution


@dataclass(frozen=True, slots=True)
class PlanParams:
    """What the robot can do and how it is asked to plan."""

    a_max_mps2: float = 0.05  # largest acceleration of the robot's end-effector
    horizon_s: float = 120.0  # latest capture looked for, after the instant of planning
    latency_s: float = 0.0  # the robot coasts for this long before the plan's thrust begins
    replan_period_s: float = 1.0  # a new plan is made at the first scan this long after the last one
    grid_s: float = 0.2  # spacing of the samples of the goal
    robot_position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # end-effector in {A} when planning
    robot_velocity_mps: tuple[float, float, float] = (0.0, 0.0, 0.0)  # its velocity in {A}

    def __post_init__(self) -> None:
        _positive("a_max_mps2", self.a_max_mps2)
        _positive("horizon_s", self.horizon_s)
        _positive("replan_period_s", self.replan_period_s)
        _positive("grid_s", self.grid_s)
        if not 0.0 <= self.latency_s < self.horizon_s:
            raise ValueError(f"latency_s is {self.latency_s}, must be in [0, horizon_s = {self.horizon_s})")
        for name in ("robot_position_m", "robot_velocity_mps"):
            if not all(math.isfinite(v) for v in getattr(self, name)):
                raise ValueError(f"{name} is {getattr(self, name)}, must be finite")


def _positive(name: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0.0):
        raise ValueError(f"{name} is {value}, must be a finite number above 0")


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    """Where certified stepping ended: no capture before ``t``, and, if ``reached``, one at ``t`` to rounding."""

    t: float
    reached: bool
    normal: Touch | None
    steps: int


def rendezvous(goal: Trajectory, r0: Array, v0: Array, params: PlanParams | None = None, t_ns: int = 0) -> Plan:
    """Least-time plan from the robot's position and velocity to the goal's.

    Args:
        goal: times (n,) [s after t_ns] -> positions (n, 3) [m], velocities (n, 3) [m/s] in {A}.
        r0: (3,) robot in {A} at t_ns [m].
        v0: (3,) its velocity [m/s].
        params: see PlanParams.
        t_ns: instant of planning.

    Returns:
        Plan with status ``optimal`` (first feasible time, certified down to ``lower_bound_s``),
        ``infeasible_within_horizon`` (``lower_bound_s`` is the horizon) or ``no_convergence``.

    Raises:
        ValueError: naming a start or a goal that is not finite.
    """
    params = params or PlanParams()
    r0, v0 = _finite("r0", r0), _finite("v0", v0)
    search, sampled = _first_feasible(goal, r0, v0, params, near=True)
    if search.reached and search.normal is None:
        here = np.array([1.0, 0.0, 0.0])  # nothing to make good: no thrust time, so its direction does not matter
        wait = params.latency_s
        return _grade(
            Flight(r0, v0, params.a_max_mps2, wait, wait, np.concatenate([0.0 * here, here])), goal, t_ns, search
        )
    if not search.reached or search.normal is None:
        return _no_plan(t_ns, params, search)
    t, found, bound = _polish(goal, r0, v0, params, sampled, search, search.normal)
    if t - bound > GAP_LIMIT_S:  # the thrust needed all but touches the limit: step on to the very root
        search, sampled = _first_feasible(goal, r0, v0, params, near=False)
        if not search.reached or search.normal is None:
            return _no_plan(t_ns, params, search)
        t, found, bound = _polish(goal, r0, v0, params, sampled, search, search.normal)
    flight = Flight.from_normal(r0, v0, params.a_max_mps2, params.latency_s, t, found.P0, found.P1)
    return _grade(flight, goal, t_ns, replace(search, t=bound))


def _finite(name: str, value: Array) -> Array:
    array = np.asarray(value, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise ValueError(f"{name} is {array.tolist()}, must be three finite numbers")
    return array


def _no_plan(t_ns: int, params: PlanParams, search: _Search) -> Plan:
    ended = search.t >= params.horizon_s - params.latency_s
    status = PlanStatus.INFEASIBLE if ended else PlanStatus.NO_CONVERGENCE
    nan, bound = math.nan, params.latency_s + search.t
    return Plan(t_ns, status, nan, np.full(6, nan), params.a_max_mps2, bound, nan, nan, nan, {"steps": search.steps})


def _grade(flight: Flight, goal: Trajectory, t_ns: int, search: _Search) -> Plan:
    """The plan with what its own propagation says of it."""
    position, velocity = flight.terminal_errors(goal)
    solved = position <= RESIDUAL_LIMIT and velocity <= RESIDUAL_LIMIT
    bound = min(flight.latency_s + search.t, flight.t_go_s)
    extras = {"latency_s": flight.latency_s, "gap_s": flight.t_go_s - bound, "steps": search.steps}
    return Plan(
        t_ns,
        PlanStatus.OPTIMAL if solved else PlanStatus.NO_CONVERGENCE,
        flight.t_go_s,
        flight.costate,
        flight.a_max,
        bound,
        position,
        velocity,
        flight.u_max(),
        extras,
    )


def _first_feasible(
    goal: Trajectory, r0: Array, v0: Array, params: PlanParams, near: bool
) -> tuple[_Search, SampledGoal]:
    """Step from one certified bound to the next, stretch by stretch, until thrust suffices (``near``: all but)."""
    end, t, found = params.horizon_s - params.latency_s, 0.0, None
    begin, steps = 0.0, 0
    while True:
        stretch = min(begin + STRETCH_S, end)
        sampled = sample(goal, r0, v0, params.latency_s, begin, stretch, params.grid_s)
        if begin == 0.0:
            if _met(sampled):
                return _Search(0.0, True, None, 0), sampled
            t = _first_bound(sampled, params.a_max_mps2)
        search = _search_stretch(sampled, params.a_max_mps2, t, found, steps, near)
        if search.reached or search.steps >= MAX_STEPS or stretch >= end:
            return search, sampled
        t, found, steps, begin = search.t, search.normal, search.steps, stretch


def _search_stretch(goal: SampledGoal, a_max: float, t: float, found: Touch | None, steps: int, near: bool) -> _Search:
    """Certified steps within one stretch of samples, from thrust time t on."""
    excess = 1.0
    for count in range(steps, MAX_STEPS):
        if t >= goal.end:
            return _Search(goal.end, False, found, count)
        dr, dv, ddv = goal.at(t)
        # a rough normal is as good a certificate while far from the root; G's error is the square of the residual
        tolerance = max(1e-15, 1e-2 * min(excess * excess, 1.0))
        found = touch(dr, t * dv - dr, (found.P0, found.P1) if found else None, tolerance)
        margin = found.gauge - a_max * t * t  # G(t), with h(P) = 1
        ahead = _Ahead.of(found, t, dv, ddv, a_max)
        if margin <= 1e-12 * found.gauge:
            if tolerance <= 1e-15:
                return _Search(ahead.before(goal, t), True, found, count)
            excess = 0.0
            continue
        excess = margin / found.gauge
        if near and excess < NEAR_ROOT and margin < 0.25 * ahead.slope * ahead.slope / ahead.bend(goal, t, a_max):
            return _Search(t, True, found, count)
        t_new = ahead.step(goal, found, t, margin, a_max)
        if t_new - t <= 1e-10 * t:
            return _Search(ahead.before(goal, t), True, found, count)
        t = t_new
    return _Search(t, False, found, MAX_STEPS)


def _met(goal: SampledGoal) -> bool:
    """Is there nothing to make good at the start?"""
    return float(np.linalg.norm(goal.dr[0])) <= RESIDUAL_LIMIT and float(np.linalg.norm(goal.dv[0])) <= RESIDUAL_LIMIT


def _first_bound(goal: SampledGoal, a_max: float) -> float:
    """A time before which the distance or the speed cannot be made good."""
    distance, speed = float(np.linalg.norm(goal.dr[0])), float(np.linalg.norm(goal.dv[0]))
    pull = a_max + goal.acceleration
    by_distance = 2.0 * distance / (speed + math.sqrt(speed * speed + 2.0 * pull * distance))
    return min(max(by_distance, speed / pull), goal.end)


@dataclass(frozen=True, slots=True)
class _Ahead:
    """G of one normal seen from t: |P0 - P1|, |P1|, and dG/dt."""

    n0: float
    n1: float
    slope: float

    @classmethod
    def of(cls, found: Touch, t: float, dv: Array, ddv: Array, a_max: float) -> _Ahead:
        across = found.P0 - found.P1
        slope = float(across @ dv + found.P1 @ (dv + t * ddv)) - 2.0 * a_max * t
        return cls(math.sqrt(float(across @ across)), math.sqrt(float(found.P1 @ found.P1)), slope)

    def before(self, goal: SampledGoal, t: float) -> float:
        """The bound t, taken back by what interpolating the goal may have moved the root."""
        return max(t - goal.blur(self.n0, self.n1, t) / max(-self.slope, 1e-9), 0.0)

    def bend(self, goal: SampledGoal, t: float, a_max: float) -> float:
        """Bound on |d2G/dt2| up to t."""
        return float(goal.curvature(self.n0, self.n1, t)) + 2.0 * a_max

    def joined(self, goal: SampledGoal, t: float, margin: float, bound: float, a_max: float) -> float:
        """The bound moved up to the root t where G, falling through it, is positive all the way back to ``bound``."""
        if self.slope < 0.0 and t - bound < -self.slope / self.bend(goal, t, a_max):
            return max(bound, t - 2.0 * margin / -self.slope)
        return bound

    def step(self, goal: SampledGoal, found: Touch, t: float, margin: float, a_max: float) -> float:
        """The latest instant up to which G is certainly positive: by nodes and sag, or by Taylor within a cell."""
        sag = 0.125 * goal.step**2
        near = self.bend(goal, t + goal.step, a_max)
        taylor = 2.0 * margin / (math.sqrt(self.slope * self.slope + 2.0 * near * margin) - self.slope)
        reach = t + min(taylor, goal.step)
        first = int((t - goal.begin) / goal.step) + 1
        if first >= len(goal.times) or margin <= near * sag:
            return reach
        times = goal.times[first:]
        bend = goal.curvature(self.n0, self.n1, times + goal.step) + 2.0 * a_max  # of the cell after each node
        along = goal.dr[first:] @ (found.P0 - found.P1) + times * (goal.dv[first:] @ found.P1)
        positive = along - a_max * times * times > sag * bend
        stop = int(positive.argmin())
        if positive[stop]:
            return goal.end
        return max(reach, float(times[stop - 1])) if stop > 0 else reach


def _polish(
    goal: Trajectory, r0: Array, v0: Array, params: PlanParams, sampled: SampledGoal, search: _Search, found: Touch
) -> tuple[float, Touch, float]:
    """Newton on G(t) = 0 with the goal itself in place of its interpolation. Returns t, the normal and the bound."""
    t, a_max = search.t, params.a_max_mps2
    best = (math.inf, t, found, search.t)
    for _ in range(6):
        rho, rate = goal(np.array([params.latency_s + t]))
        dv = rate[0] - v0
        dr = rho[0] - r0 - v0 * (params.latency_s + t)
        found = touch(dr, t * dv - dr, (found.P0, found.P1))
        margin = found.gauge - a_max * t * t
        ahead = _Ahead.of(found, t, dv, sampled.at(t)[2], a_max)
        if abs(margin) < best[0]:
            best = (abs(margin), t, found, ahead.joined(sampled, t, abs(margin), search.t, a_max))
        if ahead.slope >= 0.0 or abs(margin) <= 1e-13 * found.gauge:
            break
        t -= margin / ahead.slope
    return best[1:]
