"""Time-optimal rendezvous with a moving goal under |u| <= a_max: the first root of a*(t_f) = a_max,
with a certificate.

For a fixed t_f the least thrust a* is the gauge of one convex set (``reachable_set``). A normal P
of this set separates the goal from it at time t if G(t) = P.b(t) - a_max t^2 h(P) > 0. The goal
then remains unreachable for as long as G stays positive. The search therefore advances from t to
the next root of G and cannot skip a feasible time. P is optimal at the instant for which it was
computed, so G is tangent to the true margin there and the steps converge quadratically to the first
root from below.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from avsreplay.errors import value_class
from avsreplay.geometry import Array
from avsreplay.outcome import Plan, PlanStatus
from avsreplay.plan.path import CostatePath, SampledGoal, resolved_step, sample_goal
from avsreplay.plan.reachable_set import Gauge, gauge
from avsreplay.records import Trajectory
from avsreplay.settings import Settings, setting

MAX_STEPS = 4000  # of the search, about 0.3 ms each: its work is bounded, not its horizon
# the goal is sampled over this time span at once, then over ever longer ones; most captures need
# no more
STRETCH_S = 30.0
# where a* exceeds a_max by less than this fraction, Newton's method finishes the search
NEAR_ROOT = 1e-2
# where t_f exceeds its lower bound by more, the certified steps continue to the root
GAP_LIMIT_S = 1e-6
RESIDUAL_LIMIT = 1e-8  # largest terminal error of a solution, in metres and in metres per second


@dataclass(frozen=True, slots=True)
class PlanParams(Settings):
    """Capability of the robot, and how it plans."""

    a_max_mps2: float = setting(
        0.05, "Largest acceleration of the end-effector.", unit="m/s2", above=0.0
    )
    horizon_s: float = setting(
        120.0,
        "Latest time of capture that is considered, after the instant of planning.",
        unit="s",
        above=0.0,
    )
    latency_s: float = setting(
        0.0,
        "Time between planning and the first thrust, during which the robot coasts.",
        unit="s",
        low=0.0,
    )
    replan_period_s: float = setting(
        1.0,
        "A new plan is made at the first scan this long after the previous plan.",
        unit="s",
        above=0.0,
    )
    grid_s: float = setting(
        0.2,
        "Spacing of the samples of the goal trajectory. A larger value takes less time and"
        " interpolates the trajectory less accurately.",
        unit="s",
        above=0.0,
    )
    robot_position_m: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), "Position of the end-effector in {A} when planning.", unit="m"
    )
    robot_velocity_mps: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), "Velocity of the end-effector in {A} when planning.", unit="m/s"
    )
    enabled: bool = setting(
        True,
        "Plan and fly an approach. Without it no capture is assessed, and a run under constraints"
        " takes about half of the time.",
    )

    def check(self) -> None:
        """Raise ValueError where the latency is not below the horizon."""
        if self.latency_s >= self.horizon_s:
            raise ValueError(
                f"latency_s is {self.latency_s}, must be below horizon_s = {self.horizon_s}"
            )

    @property
    def start(self) -> tuple[Array, Array]:
        """Position (3,) [m] and velocity (3,) [m/s] of the end-effector in {A} when planning."""
        return np.array(self.robot_position_m), np.array(self.robot_velocity_mps)


def finer(params: PlanParams, goal: Trajectory) -> PlanParams:
    """Return the parameters with a spacing of the samples that resolves the motion of a goal.

    Args:
        params: As configured; ``grid_s`` is the largest spacing.
        goal: Trajectory of the grasp point.
    """
    grid_s = resolved_step(goal, params.grid_s, params.horizon_s)
    return params if grid_s == params.grid_s else replace(params, grid_s=grid_s)


@value_class
class _Search:
    """End of the certified steps: no capture before ``t``; if ``reached``, a capture at ``t``
    to rounding.
    """

    t: float
    reached: bool
    normal: Gauge | None
    steps: int


def rendezvous(
    goal: Trajectory,
    r0: Array,
    v0: Array,
    params: PlanParams | None = None,
    t_ns: int = 0,
    earliest_s: float = 0.0,
) -> Plan:
    """Plan the time-optimal rendezvous without constraints other than |u| <= a_max (eq:terminal,
    eq:a_max).

    Args:
        goal: Function of times (n,) [s after t_ns]: positions (n, 3) [m] and velocities (n, 3)
            [m/s] in {A}.
        r0: (3,) position of the robot in {A} at t_ns [m].
        v0: (3,) its velocity [m/s].
        params: Thrust, horizon, latency and grid; the defaults where None.
        t_ns: Instant of planning.
        earliest_s: Earliest capture allowed [s after t_ns]; the thrust is smaller than the bound
            where it decides.

    Returns:
        A plan with status ``optimal`` (the first feasible time, certified by ``lower_bound_s``),
        ``infeasible_within_horizon`` (``lower_bound_s`` is the horizon) or ``no_convergence``.

    Raises:
        ValueError: The start or the goal is not finite.
    """
    params = finer(params or PlanParams(), goal)
    r0, v0 = _finite("r0", r0), _finite("v0", v0)
    plan = _earliest(goal, r0, v0, params, t_ns)
    return (
        _not_before(goal, r0, v0, params, plan, earliest_s)
        if plan.found and plan.t_go_s < earliest_s
        else plan
    )


def _not_before(
    goal: Trajectory, r0: Array, v0: Array, params: PlanParams, plan: Plan, earliest_s: float
) -> Plan:
    """Return the plan that ends at the first grid time from ``earliest_s`` on at which the thrust
    suffices.

    For a fixed time the least thrust has constant magnitude a*, so a later capture needs less than
    the bound.
    """
    for end in np.arange(earliest_s, params.horizon_s, params.grid_s):
        t = float(end) - params.latency_s
        rho, rate = goal(np.array([params.latency_s + t]))
        dr, dv = rho[0] - r0 - v0 * (params.latency_s + t), rate[0] - v0
        found = gauge(dr, t * dv - dr)
        least = found.value / (t * t)
        if least <= params.a_max_mps2:
            path = CostatePath.from_normal(r0, v0, least, params.latency_s, t, found.P0, found.P1)
            first = float(end) == earliest_s
            graded = _grade(
                path,
                goal,
                plan.t_ns,
                _Search(earliest_s - params.latency_s, True, found, plan.steps),
            )
            return (
                graded if first or not graded.found else replace(graded, status=PlanStatus.FEASIBLE)
            )
    return no_plan(
        plan.t_ns, PlanStatus.NOT_FOUND, params.a_max_mps2, params.latency_s + earliest_s
    )


def _earliest(goal: Trajectory, r0: Array, v0: Array, params: PlanParams, t_ns: int) -> Plan:
    """Return the plan of the first feasible time."""
    search, sampled = _first_feasible(goal, r0, v0, params, near=True)
    if search.reached and search.normal is None:
        here = np.array(
            [1.0, 0.0, 0.0]
        )  # already at the goal: the thrust time is 0 and its direction has no effect
        wait = params.latency_s
        return _grade(
            CostatePath(r0, v0, params.a_max_mps2, wait, wait, np.concatenate([0.0 * here, here])),
            goal,
            t_ns,
            search,
        )
    if not search.reached or search.normal is None:
        return _unreached(t_ns, params, search)
    t, found, bound = _polish(goal, r0, v0, params, sampled, search, search.normal)
    if t - bound > GAP_LIMIT_S:  # a* is nearly tangent to a_max: take certified steps to the root
        search, sampled = _first_feasible(goal, r0, v0, params, near=False)
        if not search.reached or search.normal is None:
            return _unreached(t_ns, params, search)
        t, found, bound = _polish(goal, r0, v0, params, sampled, search, search.normal)
    path = CostatePath.from_normal(
        r0, v0, params.a_max_mps2, params.latency_s, t, found.P0, found.P1
    )
    return _grade(path, goal, t_ns, replace(search, t=bound))


def _finite(name: str, value: Array) -> Array:
    array = np.asarray(value, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise ValueError(f"{name} is {array.tolist()}, must be three finite numbers")
    return array


def no_plan(t_ns: int, status: PlanStatus, a_max: float, lower_bound_s: float) -> Plan:
    """Return the answer that there is no plan to fly.

    Args:
        t_ns: Instant of planning.
        status: Why there is none.
        a_max: Bound on the thrust [m/s2].
        lower_bound_s: Certified lower bound of the time to go [s].
    """
    nan = math.nan
    return Plan(t_ns, status, nan, np.full(6, nan), a_max, lower_bound_s, nan, nan, nan)


def _unreached(t_ns: int, params: PlanParams, search: _Search) -> Plan:
    """Return the answer of a search that found no feasible time."""
    ended = search.t >= params.horizon_s - params.latency_s
    status = PlanStatus.INFEASIBLE if ended else PlanStatus.NO_CONVERGENCE
    return replace(
        no_plan(t_ns, status, params.a_max_mps2, params.latency_s + search.t), steps=search.steps
    )


def _grade(path: CostatePath, goal: Trajectory, t_ns: int, search: _Search) -> Plan:
    """Return the plan with the terminal errors and the thrust of its own propagation."""
    position, velocity = path.terminal_errors(goal)
    solved = position <= RESIDUAL_LIMIT and velocity <= RESIDUAL_LIMIT
    return Plan(
        t_ns=t_ns,
        status=PlanStatus.OPTIMAL if solved else PlanStatus.NO_CONVERGENCE,
        t_go_s=path.t_go_s,
        costate=path.costate,
        a_max=path.a_max,
        lower_bound_s=min(path.latency_s + search.t, path.t_go_s),
        position_error_m=position,
        velocity_error_mps=velocity,
        u_max=path.u_max(),
        latency_s=path.latency_s,
        steps=search.steps,
    )


def _first_feasible(
    goal: Trajectory, r0: Array, v0: Array, params: PlanParams, near: bool
) -> tuple[_Search, SampledGoal]:
    """Advance the certified bound, time span by time span, until a_max suffices (``near``:
    nearly suffices).
    """
    end, t, found = params.horizon_s - params.latency_s, 0.0, None
    begin, steps = 0.0, 0
    while True:
        stretch = min(max(begin + STRETCH_S, 2.0 * begin), end)
        sampled = sample_goal(goal, r0, v0, params.latency_s, begin, stretch, params.grid_s)
        if begin == 0.0:
            if _met(sampled):
                return _Search(0.0, True, None, 0), sampled
            t = _first_bound(sampled, params.a_max_mps2)
        search = _search_stretch(sampled, params.a_max_mps2, t, found, steps, near)
        if search.reached or search.steps >= MAX_STEPS or stretch >= end:
            return search, sampled
        t, found, steps, begin = search.t, search.normal, search.steps, stretch


def _search_stretch(
    goal: SampledGoal, a_max: float, t: float, found: Gauge | None, steps: int, near: bool
) -> _Search:
    """Take certified steps within one sampled time span, from thrust time t on."""
    excess = 1.0
    for count in range(steps, MAX_STEPS):
        if t >= goal.end:
            return _Search(goal.end, False, found, count)
        dr, dv, ddv = goal.at(t)
        # far from the root an approximate normal is still a valid certificate; G's error is the
        # residual squared
        tolerance = max(1e-15, 1e-2 * min(excess * excess, 1.0))
        found = gauge(dr, t * dv - dr, (found.P0, found.P1) if found else None, tolerance)
        margin = found.value - a_max * t * t  # G(t), with h(P) = 1
        local = Margin.of(found, t, dv, ddv, a_max)
        if margin <= 1e-12 * found.value:
            if tolerance <= 1e-15:
                return _Search(local.before(goal, t), True, found, count)
            excess = 0.0
            continue
        excess = margin / found.value
        if (
            near
            and excess < NEAR_ROOT
            and margin < 0.25 * local.slope * local.slope / local.bend(goal, t, a_max)
        ):
            return _Search(t, True, found, count)
        t_new = local.step(goal, found, t, margin, a_max)
        if t_new - t <= 1e-10 * t:
            return _Search(local.before(goal, t), True, found, count)
        t = t_new
    return _Search(t, False, found, MAX_STEPS)


def _met(goal: SampledGoal) -> bool:
    """Return whether the coasting robot already meets the goal at the start."""
    return (
        float(np.linalg.norm(goal.dr[0])) <= RESIDUAL_LIMIT
        and float(np.linalg.norm(goal.dv[0])) <= RESIDUAL_LIMIT
    )


def _first_bound(goal: SampledGoal, a_max: float) -> float:
    """Return a time before which neither the distance nor the relative speed can be removed."""
    distance, speed = float(np.linalg.norm(goal.dr[0])), float(np.linalg.norm(goal.dv[0]))
    pull = a_max + goal.acceleration
    by_distance = 2.0 * distance / (speed + math.sqrt(speed * speed + 2.0 * pull * distance))
    return min(max(by_distance, speed / pull), goal.end)


@value_class(eq=True)
class Margin:
    """Local behaviour of G for one normal (P0, P1) of the reachable set.

    Attributes:
        n0, n1: |P0 - P1| and |P1|.
        slope: dG/dt.
    """

    n0: float
    n1: float
    slope: float

    @classmethod
    def of(cls, found: Gauge, t: float, dv: Array, ddv: Array, a_max: float) -> Margin:
        """Return it for the normal ``found`` at t [s], where the goal has the velocity dv [m/s] and
        the acceleration ddv [m/s^2] relative to the robot, with thrust up to a_max [m/s^2].
        """
        across = found.P0 - found.P1
        slope = float(across @ dv + found.P1 @ (dv + t * ddv)) - 2.0 * a_max * t
        return cls(math.sqrt(float(across @ across)), math.sqrt(float(found.P1 @ found.P1)), slope)

    def before(self, goal: SampledGoal, t: float) -> float:
        """Return t reduced by the largest shift of the root that the interpolation of the goal can
        cause.
        """
        return max(t - goal.interpolation_error(self.n0, self.n1, t) / max(-self.slope, 1e-9), 0.0)

    def bend(self, goal: SampledGoal, t: float, a_max: float) -> float:
        """Return a bound on |d2G/dt2| up to t."""
        return float(goal.curvature(self.n0, self.n1, t)) + 2.0 * a_max

    def joined(
        self, goal: SampledGoal, t: float, margin: float, bound: float, a_max: float
    ) -> float:
        """Return the bound moved to the root t if G decreases through t and is positive from
        ``bound`` up to t.
        """
        if self.slope < 0.0 and t - bound < -self.slope / self.bend(goal, t, a_max):
            return max(bound, t - 2.0 * margin / -self.slope)
        return bound

    def step(self, goal: SampledGoal, found: Gauge, t: float, margin: float, a_max: float) -> float:
        """Return the latest instant up to which G is certainly positive.

        Over several grid intervals the nodes and the chord error bound G; within one interval a
        Taylor bound does.
        """
        sag = 0.125 * goal.step**2
        near = self.bend(goal, t + goal.step, a_max)
        rest = math.sqrt(self.slope * self.slope + 2.0 * near * margin) - self.slope
        reach = t + (min(2.0 * margin / rest, goal.step) if rest > 0.0 else goal.step)
        first = int((t - goal.begin) / goal.step) + 1
        if first >= len(goal.times) or margin <= near * sag:
            return reach
        times = goal.times[first:]
        bend = (
            goal.curvature(self.n0, self.n1, times + goal.step) + 2.0 * a_max
        )  # for the interval after each node
        along = goal.dr[first:] @ (found.P0 - found.P1) + times * (goal.dv[first:] @ found.P1)
        positive = along - a_max * times * times > sag * bend
        stop = int(positive.argmin())
        if positive[stop]:
            return goal.end
        return max(reach, float(times[stop - 1])) if stop > 0 else reach


def _polish(
    goal: Trajectory,
    r0: Array,
    v0: Array,
    params: PlanParams,
    sampled: SampledGoal,
    search: _Search,
    found: Gauge,
) -> tuple[float, Gauge, float]:
    """Solve G(t) = 0 by Newton's method on the exact goal, from the certified bound on: where G is
    nearly tangent to 0 a step would go below it.

    Returns t, the normal and the lower bound.
    """
    t, a_max = search.t, params.a_max_mps2
    best = (math.inf, t, found, search.t)
    for _ in range(6):
        rho, rate = goal(np.array([params.latency_s + t]))
        dv = rate[0] - v0
        dr = rho[0] - r0 - v0 * (params.latency_s + t)
        found = gauge(dr, t * dv - dr, (found.P0, found.P1))
        margin = found.value - a_max * t * t
        local = Margin.of(found, t, dv, sampled.at(t)[2], a_max)
        if abs(margin) < best[0]:
            best = (abs(margin), t, found, local.joined(sampled, t, abs(margin), search.t, a_max))
        if local.slope >= 0.0 or abs(margin) <= 1e-13 * found.value:
            break
        t = max(t - margin / local.slope, search.t)
    return best[1:]
