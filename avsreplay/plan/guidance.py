"""The robot under guidance: supervisor, planner and path in one state, advanced scan by scan.

``Guidance.step`` receives the estimate after a scan, never the ground truth, and returns the
decision, the plan in force and the motion of the robot. The robot follows its path exactly; only
the target is uncertain.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.geometry import Array
from avsreplay.outcome import Plan
from avsreplay.plan.arm import Arm
from avsreplay.plan.attitude import Turn, next_turn, with_turn, without_turn
from avsreplay.plan.constrained import constrained, with_safety
from avsreplay.plan.limits import SampledScene, Scene, margin
from avsreplay.plan.path import BurnPath, RobotPath, StepPath, path_of
from avsreplay.plan.rendezvous import PlanParams, finer
from avsreplay.plan.robot import Limits, slowed
from avsreplay.plan.supervisor import (
    CLOSING,
    Action,
    Decision,
    Facts,
    Supervisor,
    SupervisorMemory,
)
from avsreplay.plan.withdrawal import COAST_S, Space, Withdrawal, escapes_at, withdrawal
from avsreplay.records import Forecast

# ratio to the time to go of the latest full search from which on all initial paths are searched
SEARCH_AGAIN = 1.1
# share of the capture tolerance: without a measurement, a plan whose end moved by less is not
# renewed
UNCHANGED_OF_TOLERANCE = 0.01


@value_class
class PlannerInput:
    """Input of guidance after a scan.

    Attributes:
        t_ns: Instant of the scan.
        gamma: 1 if it is healthy, else 0.
        converged: Whether the estimate may be used for planning.
        scene: The target in {A} after t_ns.
        forecast: Times (n,) [s after t_ns] -> 1 sigma of the grasp point if no further measurement
            arrives.
    """

    t_ns: int
    gamma: int
    converged: bool
    scene: Scene
    forecast: Callable[[Array], Forecast]


@value_class
class Segment:
    """A path that begins at ``t_ns`` from r0, v0; before that instant the robot flies the segment
    ``previous``.

    Attributes:
        t_ns: Begin of the segment.
        r0, v0: (3,) position [m] and velocity [m/s] of the robot in {A} at t_ns.
        path: Path from t_ns on; None: the robot coasts.
        previous: Segment flown before t_ns, None where t_ns has passed.
        capture: Whether the segment ends at the grasp point.
        turn: Turn of the gripper; None where its attitude is not planned.
        searched_s: Time to go that the latest search over all initial paths found [s].
    """

    t_ns: int
    r0: Array
    v0: Array
    path: RobotPath | None = None
    previous: Segment | None = None
    capture: bool = False
    turn: Turn | None = None
    searched_s: float = math.inf

    def at(self, t_ns: int) -> tuple[Array, Array]:
        """Return the state of the robot at an instant.

        Args:
            t_ns: Instant on the clock of the scans [ns].

        Returns:
            Position (3,) [m] and velocity (3,) [m/s] in {A}.
        """
        if self.previous is not None and t_ns < self.t_ns:
            return self.previous.at(t_ns)
        span = (t_ns - self.t_ns) * 1e-9
        if self.path is None:
            return self.r0 + span * self.v0, self.v0
        position, velocity = self.path.at(np.array([span]))
        return position[0], velocity[0]

    def positions(self, instants: NDArray[np.int64]) -> Array:
        """Return positions of the robot (n, 3) in {A} [m].

        Args:
            instants: (n,) on the clock of the scans [ns].
        """
        spans: Array = np.asarray((instants - self.t_ns) * 1e-9, np.float64)
        r = self.r0 + spans[:, None] * self.v0 if self.path is None else self.path.at(spans)[0]
        if self.previous is not None:
            early = instants < self.t_ns
            r[early] = self.previous.positions(instants[early])
        return r

    @property
    def end_ns(self) -> int:
        """Instant at which the thrust ends."""
        return self.t_ns + (round(self.path.t_go_s * 1e9) if self.path else 0)


@value_class
class GuidanceState:
    """State of guidance carried from scan to scan.

    Attributes:
        segment: What the robot flies now.
        supervisor: State of the supervisor.
        plan: The latest capture plan; its ``t_ns`` is the instant of planning.
        decision: The latest decision.
        made_ns: When the withdrawal that is flown was last renewed.
        captured_ns: When the gripper closed.
        draft: Segment of the latest capture plan that was found, flown or not; the next plan begins
            with its path.
    """

    segment: Segment
    supervisor: SupervisorMemory = field(default_factory=SupervisorMemory)
    plan: Plan | None = None
    decision: Decision = field(default_factory=lambda: Decision(Action.STAND_STILL, ""))
    made_ns: int | None = None
    captured_ns: int | None = None
    draft: Segment | None = None


class Guidance:
    """Flies the rendezvous under the decisions of a supervisor."""

    def __init__(
        self,
        params: PlanParams,
        supervisor: Supervisor,
        limits: Limits | None = None,
        extent_m: float = 8.0,
        gripper: tuple[Array, float] | None = None,
        arm: Arm | None = None,
    ) -> None:
        """Create the guidance of one run.

        Args:
            params: Parameters of robot and planner.
            supervisor: Supervisor with resolved parameters.
            limits: Constraints of every capture plan; none where None.
            extent_m: Diagonal of the target's bounding box [m].
            gripper: Its attitude q_ag (4,) at the begin and its largest angular acceleration
                [rad/s2]; None: the attitude is not planned.
            arm: Manipulator that must be able to fly the last metres; None without.
        """
        self.gripper, self.arm = gripper, arm
        self.params, self.supervisor = params, supervisor
        self.limits, self.extent_m = (limits or Limits()).resolved(extent_m), extent_m

    def initial(self, t_ns: int) -> GuidanceState:
        """Return the state at the first scan: the robot at its configured position and velocity.

        Args:
            t_ns: Instant of the first scan [ns].
        """
        return GuidanceState(
            Segment(
                t_ns, *self.params.start, turn=Turn(t_ns, self.gripper[0]) if self.gripper else None
            )
        )

    def fly(self, inputs: Iterable[PlannerInput]) -> Iterator[tuple[PlannerInput, GuidanceState]]:
        """Apply ``step`` to one input after the other; yields each input and the state after it.

        Args:
            inputs: What was known after each scan, in the order of the scans.
        """
        state: GuidanceState | None = None
        for known in inputs:
            state = self.step(state or self.initial(known.t_ns), known)
            yield known, state

    def step(self, state: GuidanceState, known: PlannerInput) -> GuidanceState:
        """Advance by one scan.

        Args:
            state: State after the previous scan.
            known: What is known after this scan.

        Returns:
            The new state with decision, plan and segment. After the capture the state stays the
            same.
        """
        if state.captured_ns is not None:
            return state
        if state.decision.action is Action.CAPTURE and known.t_ns >= state.segment.end_ns:
            state = replace(state, captured_ns=state.segment.end_ns)
        plan, segment = self._replan(state, known)
        facts = self._facts(state, known, plan, segment)
        supervisor, decision = self.supervisor.decide(state.supervisor, facts)
        draft = segment if segment is not None and segment is not state.segment else state.draft
        state = replace(state, supervisor=supervisor, decision=decision, plan=plan, draft=draft)
        if decision.action not in CLOSING:
            return self._withdraw(state, known)
        if segment is None:  # the approach resumes between two replanning instants
            plan, segment = self._capture_plan(state, known)
        return replace(
            state,
            plan=plan,
            segment=segment or state.segment,
            made_ns=None,
            draft=segment or state.draft,
        )

    def stated(self, state: GuidanceState, known: PlannerInput) -> GuidanceState:
        """Return the state whose plan has the margins of a robot that withdraws or coasts from any
        of its instants, where it was made after this scan.

        Args:
            state: State after a scan.
            known: What is known after this scan.
        """
        plan, draft = state.plan, state.draft
        if plan is None or plan.t_ns != known.t_ns or draft is None or draft.path is None:
            return state
        after_s = (draft.t_ns - known.t_ns) * 1e-9
        scene = known.scene.after(after_s) if after_s else known.scene
        own = self.params, self.limits, self.extent_m, after_s
        return replace(state, plan=with_safety(scene, plan, draft.path, *own))

    def _replan(
        self, state: GuidanceState, known: PlannerInput
    ) -> tuple[Plan | None, Segment | None]:
        """Return the capture plan in force, renewed where it is due, and the segment that flies it,
        if any.
        """
        closing = state.decision.action in CLOSING
        flown = state.segment if closing else None
        if not known.converged or state.decision.action in (Action.CAPTURE, Action.ABORT):
            return state.plan, flown
        age_s = math.inf if state.plan is None else (known.t_ns - state.plan.t_ns) * 1e-9
        left_s = (state.segment.end_ns - known.t_ns) * 1e-9 if closing else math.inf
        if not self._due(age_s, left_s) or (
            flown is not None and self._unchanged(state, flown, known)
        ):
            return state.plan, flown
        plan, segment = self._capture_plan(state, known)
        if segment is None and flown is not None and self._still_valid(flown, known):
            return state.plan, flown
        return plan, segment or flown

    def _unchanged(self, state: GuidanceState, flown: Segment, known: PlannerInput) -> bool:
        """Return whether no measurement was used since the latest plan and the robot has not left
        its path.
        """
        made_s, seen_s = (
            -math.inf if state.plan is None else state.plan.t_ns * 1e-9,
            state.supervisor.seen_s,
        )
        return (
            known.gamma == 0
            and (seen_s or 0.0) <= made_s
            and self._still_valid(flown, known, UNCHANGED_OF_TOLERANCE)
        )

    def _still_valid(self, flown: Segment, known: PlannerInput, share: float = 1.0) -> bool:
        """Return whether the end of the segment agrees with the estimate within a share of the
        capture tolerance.
        """
        left_s = (flown.end_ns - known.t_ns) * 1e-9
        if left_s <= 0.0:
            return False
        r, v = flown.at(flown.end_ns)
        rho, rate = known.scene.goal(np.array([left_s]))
        p = self.supervisor.params
        near = float(np.linalg.norm(r - rho[0])) <= share * (p.capture_pos_m or 0.0)
        return near and float(np.linalg.norm(v - rate[0])) <= share * (p.capture_speed_mps or 0.0)

    def _due(self, age_s: float, left_s: float) -> bool:
        """Return whether to replan: at the period, at every scan near the end, not where a
        plan would come too late.
        """
        near = left_s <= 2.0 * self.supervisor.params.commit_s
        return (
            age_s >= self.params.replan_period_s - 1e-6 or near
        ) and left_s > self.params.latency_s

    def _capture_plan(
        self, state: GuidanceState, known: PlannerInput
    ) -> tuple[Plan, Segment | None]:
        """Plan the capture under the limits; the path of the latest plan is the first initial path.

        All initial paths are searched where there is none, or where the time to go exceeds that of
        the latest search.
        """
        segment, draft, turn = state.segment, state.draft, self._turn(state.segment, known)
        if isinstance(turn, Plan):
            return turn, None
        earliest_s = 0.0 if turn is None else turn.ready_s(self.params.horizon_s)
        searched_s = math.inf if draft is None else draft.searched_s

        def search(problem: _Problem, earliest_s: float) -> Plan:
            nonlocal searched_s
            if draft is not None and draft.path is not None:
                since_s = (known.t_ns - draft.t_ns) * 1e-9 + self.params.latency_s
                warm = draft.path, max(since_s, 0.0)
                plan = constrained(*problem, warm=warm, earliest_s=earliest_s)
                if plan.found and plan.t_go_s <= SEARCH_AGAIN * searched_s:
                    return plan
            plan = constrained(*problem, earliest_s=earliest_s)
            searched_s = plan.t_go_s
            return plan

        def planner(scene: Scene, r0: Array, v0: Array, params: PlanParams, t_ns: int) -> Plan:
            if self.arm is None:
                return search((scene, r0, v0, params, self.limits, t_ns), earliest_s)
            delayed = (
                draft is not None and state.plan is not None and state.plan.delayed_by == "arm"
            )
            hint_s = (
                (draft.end_ns - t_ns) * 1e-9 - self.params.latency_s if draft and delayed else 0.0
            )

            def make(after_s: float, share: float) -> Plan:
                return search((scene, r0, v0, *slowed(params, self.limits, share), t_ns), after_s)

            path = partial(path_of, r0=r0, v0=v0)
            return self.arm.fitted(
                make, path, scene, self.limits, earliest_s, params.horizon_s, hint_s
            )[0]

        plan, made = self._plan(segment, known.scene, known.t_ns, planner)
        if made is None:
            return plan, None
        made = replace(made, capture=True, turn=turn or made.turn, searched_s=searched_s)
        return (plan if turn is None else with_turn(plan, earliest_s + self.params.latency_s)), made

    def _turn(self, segment: Segment, known: PlannerInput) -> Turn | Plan | None:
        """Return the next turn of the gripper, the answer where none was found, or None where it is
        not planned.
        """
        if self.gripper is None or segment.turn is None or known.scene.attitude is None:
            return None
        problem = (segment.turn, known.scene.attitude, self.gripper[1], self.params, known.t_ns)
        return next_turn(*problem) or without_turn(*problem)

    def _plan(
        self, segment: Segment, scene: Scene, t_ns: int, planner: _Planner
    ) -> tuple[Plan, Segment | None]:
        """Plan from the state that the current segment reaches when the latency is over."""
        wait_s = self.params.latency_s
        begin_ns = t_ns + round(wait_s * 1e9)
        r0, v0 = segment.at(begin_ns)
        # the robot flies the current segment during the latency, so the planner starts at its end
        # without latency
        late = replace(self.params, latency_s=0.0, horizon_s=self.params.horizon_s - wait_s)
        plan = planner(scene.after(wait_s) if wait_s else scene, r0, v0, late, t_ns)
        if not plan.found:
            return replace(plan, lower_bound_s=plan.lower_bound_s + wait_s), None
        previous = segment if t_ns < segment.t_ns else replace(segment, previous=None)
        made = Segment(begin_ns, r0, v0, path_of(plan, r0, v0), previous, turn=segment.turn)
        return _counted_from_planning(plan, wait_s), made

    def _facts(
        self, state: GuidanceState, known: PlannerInput, plan: Plan | None, segment: Segment | None
    ) -> Facts:
        planned = plan is not None and plan.found
        t_go = _left_s(plan, segment, known.t_ns)
        sigma = known.forecast(np.array([0.0, t_go]) if planned else np.array([0.0]))
        position, velocity = state.segment.at(known.t_ns)
        return Facts(
            t_s=known.t_ns * 1e-9,
            gamma=known.gamma,
            converged=known.converged,
            planned=planned,
            t_go_s=t_go,
            pos_1s_m=float(sigma.pos_1s_m[-1]),
            vel_1s_mps=float(sigma.vel_1s_mps[-1]),
            rot_1s_deg=math.degrees(float(sigma.rot_1s_rad[-1])),
            distance_m=float(np.linalg.norm(known.scene.goal(np.zeros(1))[0][0] - position)),
            now_1s_m=float(sigma.pos_1s_m[0]),
            margin=self._margin(state, known.scene, position, velocity),
            withdrawal_m=self._withdrawal_margin(state, known),
        )

    def _withdrawal_margin(self, state: GuidanceState, known: PlannerInput) -> float:
        """Return the margin of a withdrawal from now, which matters while no scan is healthy."""
        if known.gamma or state.decision.action not in CLOSING:
            return math.inf
        p = self.supervisor.params
        return self._withdrawal(state, known, p.standoff_m or 0.0)[0].margin_m

    def _withdraw(self, state: GuidanceState, known: PlannerInput) -> GuidanceState:
        """Fly a hold, a retreat or an abort; it is renewed at the replanning period."""
        action = state.decision.action
        since_s = math.inf if state.made_ns is None else (known.t_ns - state.made_ns) * 1e-9
        if action is Action.STAND_STILL or since_s < self.params.replan_period_s - 1e-6:
            return state
        p = self.supervisor.params
        least_m = (p.standoff_m if action is Action.HOLD else p.retreat_m) or 0.0
        found, made = self._withdrawal(state, known, least_m)
        segment = state.segment if found.continued else made
        return replace(state, segment=segment, made_ns=known.t_ns)

    def _withdrawal(
        self, state: GuidanceState, known: PlannerInput, least_m: float
    ) -> tuple[Withdrawal, Segment]:
        """Return the withdrawal that begins when the latency is over, and the segment that flies
        it.
        """
        segment, wait_s = state.segment, self.params.latency_s
        begin_ns = known.t_ns + round(wait_s * 1e9)
        r, v = segment.at(begin_ns)
        scene = known.scene.after(wait_s) if wait_s else known.scene
        grid_s = finer(self.params, scene.goal).grid_s
        sampled = SampledScene(scene, self.params.horizon_s, grid_s, 1.5 * COAST_S)
        space = Space(sampled, self.limits, self.params.a_max_mps2, self.extent_m)
        path, after_s = segment.path, (begin_ns - segment.t_ns) * 1e-9
        current = planned = None
        if isinstance(path, BurnPath):
            current = path.after(after_s)
        elif isinstance(path, StepPath) and path.escapes is not None:
            (planned,) = escapes_at(path.escapes, np.array([after_s]))
        found = withdrawal(space, r, v, least_m, current, planned)
        previous = segment if known.t_ns < segment.t_ns else replace(segment, previous=None)
        return found, Segment(begin_ns, r, v, found.path, previous, turn=segment.turn)

    def _margin(self, state: GuidanceState, scene: Scene, r: Array, v: Array) -> float:
        """Return the margin of the constraints; what the plan in force itself violates at its
        start is accepted.
        """
        if not self.limits.any:
            return 1.0
        accepted = (
            0.0
            if state.plan is None or math.isnan(state.plan.violation_m)
            else state.plan.violation_m
        )
        return margin(scene, self.limits, r, v) + accepted


_Problem = tuple[Scene, Array, Array, PlanParams, Limits, int]
_Planner = Callable[[Scene, Array, Array, PlanParams, int], Plan]


def _left_s(plan: Plan | None, segment: Segment | None, t_ns: int) -> float:
    """Return the time to the end of the segment, else of the plan [s], at least 0; NaN
    without a plan.
    """
    if plan is None or not plan.found:
        return math.nan
    return max(
        (segment.end_ns - t_ns) * 1e-9 if segment else plan.t_go_s - (t_ns - plan.t_ns) * 1e-9, 0.0
    )


def _counted_from_planning(plan: Plan, wait_s: float) -> Plan:
    """Return the plan with its times and its costate counted from ``wait_s`` earlier."""
    c = np.concatenate([plan.costate[:3], plan.costate[3:] + wait_s * plan.costate[:3]])
    return replace(
        plan,
        t_go_s=plan.t_go_s + wait_s,
        lower_bound_s=plan.lower_bound_s + wait_s,
        costate=c / np.linalg.norm(c),
        latency_s=wait_s,
    )
