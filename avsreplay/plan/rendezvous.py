"""The least time to meet a moving goal with |u| <= a_max: the first root of a*(t_f) = a_max, certified.

For a fixed t_f the least thrust a* is the gauge of one convex body (``reach``). A normal P of that body that keeps
the goal out at t, G(t) = P.b(t) - a_max t^2 h(P) > 0, keeps it out for as long as G stays positive: so the search
steps from one instant to the next root of G and never passes a feasible time. P is optimal where it was found, so G
touches a* to first order and the steps end quadratically at the first root, from below.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from avsreplay.geometry import Array
from avsreplay.plan.flight import Flight
from avsreplay.plan.goal import SampledGoal, sample
from avsreplay.plan.reach import Touch, touch
from avsreplay.records import Plan, PlanStatus, Trajectory

__all__ = ["PlanParams", "rendezvous"]

MAX_STEPS = 400
RESIDUAL_LIMIT = 1e-8  # terminal errors above this, in metres or metres a second, are not a solution


@dataclass(frozen=True, slots=True)
class PlanParams:
    """What the robot can do and how it is asked to plan."""

    a_max_mps2: float = 0.05  # largest acceleration of the robot's end-effector
    horizon_s: float = 120.0  # latest capture looked for, after the instant of planning
    latency_s: float = 0.0  # the robot coasts for this long before the plan's thrust begins
    replan_period_s: float = 1.0  # a new plan is made at the first scan this long after the last one
    grid_s: float = 0.1  # spacing of the samples of the goal
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
    sampled = sample(goal, r0, v0, params.latency_s, params.horizon_s, params.grid_s)
    search = _first_feasible(sampled, params.a_max_mps2)
    if search.reached and search.normal is None:
        here = np.array([1.0, 0.0, 0.0])  # nothing to make good: no thrust time, so its direction does not matter
        flight = Flight(
            r0, v0, params.a_max_mps2, params.latency_s, params.latency_s, np.concatenate([0.0 * here, here])
        )
        return _grade(flight, goal, t_ns, search)
    if not search.reached or search.normal is None:
        ended = search.t >= sampled.times[-1]
        status = PlanStatus.INFEASIBLE if ended else PlanStatus.NO_CONVERGENCE
        return _no_plan(t_ns, status, params, search)
    t, found = _polish(goal, r0, v0, params, sampled, search)
    flight = Flight.from_normal(r0, v0, params.a_max_mps2, params.latency_s, t, found.P0, found.P1)
    return _grade(flight, goal, t_ns, search)


def _finite(name: str, value: Array) -> Array:
    array = np.asarray(value, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise ValueError(f"{name} is {array.tolist()}, must be three finite numbers")
    return array


def _no_plan(t_ns: int, status: PlanStatus, params: PlanParams, search: _Search) -> Plan:
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


def _first_feasible(goal: SampledGoal, a_max: float) -> _Search:
    """Step from one certified bound to the next until thrust just suffices."""
    end, t = float(goal.times[-1]), _first_bound(goal, a_max)
    if t is None:
        return _Search(0.0, True, None, 0)
    found: Touch | None = None
    for count in range(MAX_STEPS):
        if t >= end:
            return _Search(end, False, None, count)
        dr, dv, ddv = goal.at(t)
        found = touch(dr, t * dv - dr, (found.P0, found.P1) if found else None)
        margin = found.gauge - a_max * t * t  # G(t), with h(P) = 1
        if margin <= 1e-12 * a_max * t * t:
            return _Search(t, True, found, count)
        t_new = _step(goal, found, t, margin, ddv, dv, a_max)
        if t_new - t <= 1e-10 * t:
            return _Search(t, True, found, count)
        t = t_new
    return _Search(t, False, None, MAX_STEPS)


def _first_bound(goal: SampledGoal, a_max: float) -> float | None:
    """A time before which neither the distance nor the speed can be made good; None where there is nothing to do."""
    distance, speed = float(np.linalg.norm(goal.dr[0])), float(np.linalg.norm(goal.dv[0]))
    if distance <= RESIDUAL_LIMIT and speed <= RESIDUAL_LIMIT:
        return None
    pull = a_max + goal.acceleration
    by_distance = 2.0 * distance / (speed + math.sqrt(speed * speed + 2.0 * pull * distance))
    return max(by_distance, speed / pull)


def _step(goal: SampledGoal, found: Touch, t: float, margin: float, ddv: Array, dv: Array, a_max: float) -> float:
    """The latest instant up to which G of this normal is certainly positive."""
    across = found.P0 - found.P1
    n0, n1 = float(np.linalg.norm(across)), float(np.linalg.norm(found.P1))
    slope = float(across @ dv + found.P1 @ (dv + t * ddv)) - 2.0 * a_max * t
    reach = t
    first = int(t / goal.step) + 1
    if first < len(goal.times):
        times = goal.times[first:]
        bend = goal.curvature(n0, n1, times + goal.step) + 2.0 * a_max  # of the cell after each node
        values = goal.dr[first:] @ across + times * (goal.dv[first:] @ found.P1) - a_max * times**2
        positive = values > bend * (0.125 * goal.step**2)
        stop = int(np.argmin(positive)) if not positive.all() else len(positive)
        # every cell before node ``stop`` has both ends above the sag between nodes; t itself ends the first one
        if stop > 0 and margin > bend[0] * 0.125 * goal.step**2:
            reach = float(times[stop - 1])
    near = float(goal.curvature(n0, n1, np.array(t + goal.step))) + 2.0 * a_max
    taylor = 2.0 * margin / (math.sqrt(slope * slope + 2.0 * near * margin) - slope)
    return max(reach, t + min(taylor, goal.step))


def _polish(
    goal: Trajectory, r0: Array, v0: Array, params: PlanParams, sampled: SampledGoal, search: _Search
) -> tuple[float, Touch]:
    """Newton on G(t) = 0 with the goal itself in place of its interpolation."""
    t, found = search.t, search.normal
    if found is None:
        raise ValueError("there is no normal to polish")
    best: tuple[float, float, Touch] | None = None
    for _ in range(6):
        rho, rate = goal(np.array([params.latency_s + t]))
        dv = rate[0] - v0
        dr = rho[0] - r0 - v0 * (params.latency_s + t)
        found = touch(dr, t * dv - dr, (found.P0, found.P1))
        margin = found.gauge - params.a_max_mps2 * t * t
        if best is None or abs(margin) < best[0]:
            best = (abs(margin), t, found)
        across = found.P0 - found.P1
        slope = float(across @ dv + found.P1 @ (dv + t * sampled.at(t)[2])) - 2.0 * params.a_max_mps2 * t
        if slope >= 0.0 or abs(margin) <= 4e-16 * found.gauge:
            break
        t -= margin / slope
    return (best[1], best[2]) if best else (t, found)
