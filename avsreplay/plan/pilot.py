"""The robot that flies: supervisor, planner and flight in one fold over the scans.

``step`` takes what is known after a scan (never the truth) and gives the decision, the plan in force and where the
robot is. The robot follows its flight exactly; what it does not know is the target.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from avsreplay.geometry import Array
from avsreplay.plan.flight import Path, path_of
from avsreplay.plan.rendezvous import PlanParams, rendezvous
from avsreplay.plan.supervisor import Action, Decision, Facts, Supervisor, SupervisorMemory
from avsreplay.records import Forecast, Plan, Trajectory

__all__ = ["Leg", "Pilot", "PilotMemory", "Sight"]

_CLOSING = (Action.APPROACH, Action.APPROACH_ON_PREDICTION, Action.CAPTURE)


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """What is known after a scan.

    Attributes:
        t_ns: the scan.  gamma: was it healthy.  converged: may the planner rely on the estimate.
        goal: the grasp point after t_ns.  forecast: its 1 sigma at times after t_ns, without more vision.
        standoff: the approach point after t_ns, turning with the target; None: a hold brakes to rest.
        margin: robot's position and velocity (3,) -> least margin of the planner's limits, below 0 where one is broken.
    """

    t_ns: int
    gamma: int
    converged: bool
    goal: Trajectory
    forecast: Callable[[Array], Forecast]
    standoff: Trajectory | None = None
    margin: Callable[[Array, Array], float] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Leg:
    """A flight begun at ``t_ns`` from r0, v0 (None: coasting); until then the leg ``before`` is flown."""

    t_ns: int
    r0: Array
    v0: Array
    flight: Path | None = None
    before: Leg | None = None

    def at(self, t_ns: int) -> tuple[Array, Array]:
        """Robot's position [m] and velocity [m/s] (3,) at an instant."""
        if self.before is not None and t_ns < self.t_ns:
            return self.before.at(t_ns)
        span = (t_ns - self.t_ns) * 1e-9
        if self.flight is None:
            return self.r0 + span * self.v0, self.v0
        position, velocity = self.flight.at(np.array([span]))
        return position[0], velocity[0]

    @property
    def end_ns(self) -> int:
        """When the thrust ends."""
        return self.t_ns + (round(self.flight.t_go_s * 1e9) if self.flight else 0)


@dataclass(frozen=True, slots=True, eq=False)
class PilotMemory:
    """What is carried from scan to scan.

    Attributes:
        leg: what the robot flies now.  plan: the last capture plan made, its ``t_ns`` the instant of planning.
        made_ns: when the last leg of a hold or retreat was made.  captured_ns: when the gripper closed.
    """

    leg: Leg
    supervisor: SupervisorMemory = field(default_factory=SupervisorMemory)
    plan: Plan | None = None
    decision: Decision = field(default_factory=lambda: Decision(Action.STAND_STILL, ""))
    made_ns: int | None = None
    captured_ns: int | None = None


class Pilot:
    """Flies the rendezvous under a supervisor.

    Args:
        params: of the planner.  supervisor: with resolved parameters.
        planner: makes a capture plan for (goal, r0, v0, params, t_ns); ``rendezvous`` by default.
    """

    def __init__(
        self,
        params: PlanParams,
        supervisor: Supervisor,
        planner: Callable[[Trajectory, Array, Array, PlanParams, int], Plan] = rendezvous,
    ) -> None:
        self.params, self.supervisor, self.planner = params, supervisor, planner

    def initial(self, t_ns: int) -> PilotMemory:
        """The robot where its parameters say."""
        r0, v0 = np.array(self.params.robot_position_m), np.array(self.params.robot_velocity_mps)
        return PilotMemory(Leg(t_ns, r0, v0))

    def fly(self, sights: Iterable[Sight]) -> Iterator[tuple[Sight, PilotMemory]]:
        """Fold ``step`` over the sights."""
        memory: PilotMemory | None = None
        for sight in sights:
            memory = self.step(memory or self.initial(sight.t_ns), sight)
            yield sight, memory

    def step(self, memory: PilotMemory, sight: Sight) -> PilotMemory:
        """One scan on."""
        if memory.captured_ns is not None:  # the gripper has closed: nothing is left to decide
            return memory
        if self._closed(memory, sight.t_ns):
            memory = replace(memory, captured_ns=memory.leg.end_ns)
        plan, leg = self._replan(memory, sight)
        facts = self._facts(memory, sight, plan, leg)
        supervisor, decision = self.supervisor.decide(memory.supervisor, facts)
        memory = replace(memory, supervisor=supervisor, decision=decision, plan=plan)
        if decision.action not in _CLOSING:
            return self._withdraw(memory, sight)
        if leg is None:  # setting out again between two periods
            plan, leg = self._plan(memory.leg, sight.goal, sight.t_ns, self.planner)
        return replace(memory, plan=plan, leg=leg or memory.leg, made_ns=None)

    def _closed(self, memory: PilotMemory, t_ns: int) -> bool:
        return memory.decision.action is Action.CAPTURE and t_ns >= memory.leg.end_ns

    def _replan(self, memory: PilotMemory, sight: Sight) -> tuple[Plan | None, Leg | None]:
        """The capture plan in force, made anew where it is due, and the leg that flies it (None: none does)."""
        closing = memory.decision.action in _CLOSING
        flown = memory.leg if closing else None
        if not sight.converged or memory.decision.action in (Action.CAPTURE, Action.ABORT):
            return memory.plan, flown
        age_s = math.inf if memory.plan is None else (sight.t_ns - memory.plan.t_ns) * 1e-9
        left_s = (memory.leg.end_ns - sight.t_ns) * 1e-9 if closing else math.inf
        if not self._due(age_s, left_s):
            return memory.plan, flown
        plan, leg = self._plan(memory.leg, sight.goal, sight.t_ns, self.planner)
        return plan, leg or flown

    def _due(self, age_s: float, left_s: float) -> bool:
        """At the period, at every scan when the end is near, and no more once a plan would come too late."""
        near = left_s <= 2.0 * self.supervisor.params.commit_s
        return (age_s >= self.params.replan_period_s - 1e-6 or near) and left_s > self.params.latency_s

    def _plan(
        self,
        leg: Leg,
        goal: Trajectory,
        t_ns: int,
        planner: Callable[[Trajectory, Array, Array, PlanParams, int], Plan],
    ) -> tuple[Plan, Leg | None]:
        """A plan from where the present leg will have brought the robot once computing is over."""
        wait_s = self.params.latency_s
        r0, v0 = leg.at(t_ns + round(wait_s * 1e9))
        # the latency is flown on the old leg, so the planner is asked from its end: times count from t_ns again after
        late = replace(self.params, latency_s=0.0)
        plan = planner(lambda t: goal(t + wait_s), r0, v0, late, t_ns)
        if not plan.found:
            return plan, None
        begin_ns = t_ns + round(wait_s * 1e9)
        before = leg if t_ns < leg.t_ns else replace(leg, before=None)
        flown = Leg(begin_ns, r0, v0, path_of(plan, r0, v0), before)
        return _later(plan, wait_s), flown

    def _facts(self, memory: PilotMemory, sight: Sight, plan: Plan | None, leg: Leg | None) -> Facts:
        planned = plan is not None and plan.found
        t_go = _left_s(plan, leg, sight.t_ns)
        times = np.array([0.0, t_go]) if planned else np.array([0.0])
        sigma = sight.forecast(times)
        here, speed = memory.leg.at(sight.t_ns)
        return Facts(
            t_s=sight.t_ns * 1e-9,
            gamma=sight.gamma,
            converged=sight.converged,
            planned=planned,
            t_go_s=t_go,
            pos_1s_m=float(sigma.pos_1s_m[-1]),
            vel_1s_mps=float(sigma.vel_1s_mps[-1]),
            rot_1s_deg=math.degrees(float(sigma.rot_1s_rad[-1])),
            distance_m=float(np.linalg.norm(sight.goal(np.zeros(1))[0][0] - here)),
            now_1s_m=float(sigma.pos_1s_m[0]),
            margin=sight.margin(here, speed) if sight.margin else 1.0,
        )

    def _withdraw(self, memory: PilotMemory, sight: Sight) -> PilotMemory:
        """Stand still, hold, retreat or abort: a leg of its own, renewed at the replanning period while it matters."""
        action = memory.decision.action
        due = memory.made_ns is None or (sight.t_ns - memory.made_ns) * 1e-9 >= self.params.replan_period_s - 1e-6
        if action is Action.STAND_STILL or not due or (action is Action.ABORT and memory.made_ns is not None):
            return memory
        goal = self._refuge(memory, sight)
        _, leg = self._plan(memory.leg, goal, sight.t_ns, rendezvous)
        return replace(memory, leg=leg or memory.leg, made_ns=sight.t_ns)

    def _refuge(self, memory: PilotMemory, sight: Sight) -> Trajectory:
        """Where to go instead of closing: the approach point, a brake to rest, or a rest point further away."""
        here, speed = memory.leg.at(sight.t_ns)
        if memory.decision.action is Action.HOLD:
            return sight.standoff or _rest(here + speed * np.linalg.norm(speed) / (2.0 * self.params.a_max_mps2))
        target = sight.goal(np.zeros(1))[0][0]
        away = here - target
        distance = float(np.linalg.norm(away))
        if distance <= 0.0:
            away, distance = np.array([1.0, 0.0, 0.0]), 1.0
        return _rest(target + away / distance * max(distance, self.supervisor.params.retreat_m or 0.0))


def _left_s(plan: Plan | None, leg: Leg | None, t_ns: int) -> float:
    """To the end of the leg, else of the plan [s], not below 0; NaN where there is no plan."""
    if plan is None or not plan.found:
        return math.nan
    return max((leg.end_ns - t_ns) * 1e-9 if leg else plan.t_go_s - (t_ns - plan.t_ns) * 1e-9, 0.0)


def _later(plan: Plan, wait_s: float) -> Plan:
    """The plan with its times, and its costate's, counted from ``wait_s`` earlier."""
    c = np.concatenate([plan.costate[:3], plan.costate[3:] + wait_s * plan.costate[:3]])
    return replace(
        plan,
        t_go_s=plan.t_go_s + wait_s,
        lower_bound_s=plan.lower_bound_s + wait_s,
        costate=c / np.linalg.norm(c),
        extras={**plan.extras, "latency_s": wait_s},
    )


def _rest(point: Array) -> Trajectory:
    return lambda t: (np.tile(point, (len(t), 1)), np.zeros((len(t), 3)))
