"""What to do now, chosen by a table of rules: data, not code.

The paper promises "the most appropriate control action if partial or complete failure of the vision system in the
short term occurs" and leaves the choice open. Here it is a list, read from the top: the first rule whose every test
holds gives the action, and its name goes into the row.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from enum import Enum
from types import MappingProxyType

__all__ = ["RULES", "Action", "Decision", "Facts", "Rule", "Supervisor", "SupervisorMemory", "SupervisorParams", "Test"]


class Action(Enum):
    """What the robot is told."""

    STAND_STILL = "stand_still"  # the estimate is not to be relied on yet
    APPROACH = "approach"  # fly the plan, vision healthy
    APPROACH_ON_PREDICTION = "approach_on_prediction"  # vision lost, prediction good enough to the end
    HOLD = "hold"  # stop closing, keep the approach point
    RETREAT = "retreat"  # move away: too near for what is known
    CAPTURE = "capture"  # fly the last plan to its end and close the gripper
    ABORT = "abort"  # move away and stay there


@dataclass(frozen=True, slots=True)
class SupervisorParams:
    """Tolerances of a capture and patience of the supervisor. None: taken from the target's extent."""

    # capture tolerance on position [m]; auto: 0.0025 of the extent
    capture_pos_m: float | None = None
    # capture tolerance on relative speed [m/s]; auto: 0.00125 of the extent a second
    capture_speed_mps: float | None = None
    # capture tolerance on the gripper's angle [deg]
    capture_angle_deg: float = 2.0
    # predicted 1 sigma (root of the trace) times this must be inside the tolerances
    sigmas: float = 3.0
    # the last plan is flown to its end from this time to go on
    commit_s: float = 0.5
    # vision may be lost for this long before the prediction has to be good enough to the end
    patience_s: float = 1.5
    # healthy scans in a row that end a hold
    recover_scans: int = 2
    # a hold or retreat longer than this is an abort
    hold_limit_s: float = 60.0
    # distance of the approach point from the grasp point along the fixture's axis [m]; auto: 0.125 of the extent
    standoff_m: float | None = None
    # how far away a retreat goes [m]; auto: 0.5 of the extent
    retreat_m: float | None = None

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{f.name} is {value}, must be a finite number above 0")

    def resolved(self, extent_m: float) -> SupervisorParams:
        """With every length taken from the target's extent [m] where it was left out."""
        shares = {"capture_pos_m": 0.0025, "capture_speed_mps": 0.00125, "standoff_m": 0.125, "retreat_m": 0.5}
        left_out = {name: share * extent_m for name, share in shares.items() if getattr(self, name) is None}
        return replace(self, **left_out)  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True, kw_only=True)
class Facts:
    """What is known at one scan.

    Attributes:
        t_s: time [s].  gamma: of this scan.  converged: may the planner rely on the estimate.
        planned: is there a capture to fly.  t_go_s: to its end (NaN without).
        pos_1s_m, vel_1s_mps, rot_1s_deg: 1 sigma of the grasp point predicted at that end, without more vision.
        distance_m: robot to grasp point.  now_1s_m: 1 sigma of the grasp point's position now.
        margin: least margin of the planner's constraints now, below 0 where one is broken (1 without constraints).
    """

    t_s: float
    gamma: int
    converged: bool
    planned: bool
    t_go_s: float
    pos_1s_m: float
    vel_1s_mps: float
    rot_1s_deg: float
    distance_m: float
    now_1s_m: float
    margin: float = 1.0


@dataclass(frozen=True, slots=True)
class SupervisorMemory:
    """What is carried from scan to scan. ``held_since_s`` is the begin of a hold or retreat that has not ended."""

    action: Action = Action.STAND_STILL
    rule: str = ""
    seen_s: float | None = None
    healthy_run: int = 0
    held_since_s: float | None = None
    moving: bool = False


@dataclass(frozen=True, slots=True)
class Decision:
    """The action and the name of the rule that fired."""

    action: Action
    rule: str


@dataclass(frozen=True, slots=True)
class Test:
    """``measure compare bound``; a bound that is a text names a parameter."""

    measure: str
    compare: str
    bound: float | str


@dataclass(frozen=True, slots=True)
class Rule:
    """An action and every test that must hold for it. ``why`` is for people."""

    name: str
    action: Action
    tests: tuple[Test, ...]
    why: str


_COMPARE: Mapping[str, Callable[[float, float], bool]] = MappingProxyType(
    {"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge, "==": operator.eq}
)

_MOVING, _AT_REST = Test("moving", "==", 1), Test("moving", "==", 0)
_SEEN, _BLIND = Test("gamma", "==", 1), Test("gamma", "==", 0)
_AT_END, _SURE, _UNSURE = Test("t_go_s", "<=", "commit_s"), Test("doubt", "<=", 1.0), Test("doubt", ">", 1.0)
_HOLDING = Test("holding", "==", 1)

RULES: tuple[Rule, ...] = (
    Rule("aborted", Action.ABORT, (Test("aborted", "==", 1),), "an abort stands"),
    Rule("captured", Action.CAPTURE, (Test("captured", "==", 1),), "a capture once begun is flown to its end"),
    Rule("held_too_long", Action.ABORT, (Test("held_s", ">", "hold_limit_s"),), "nothing has become better"),
    Rule("constraint_broken", Action.RETREAT, (_MOVING, Test("margin", "<", 0.0)), "outside what the plan allows"),
    Rule("too_close_unsure", Action.RETREAT, (_MOVING, _UNSURE, Test("clearance_m", "<", 0.0)), "could touch unawares"),
    Rule("not_converged", Action.STAND_STILL, (_AT_REST, Test("converged", "==", 0)), "the paper's stand-still"),
    Rule("convergence_lost", Action.HOLD, (Test("converged", "==", 0),), "the estimate was withdrawn on the way"),
    Rule("no_plan_yet", Action.STAND_STILL, (_AT_REST, Test("planned", "==", 0)), "no capture within the horizon"),
    Rule("plan_lost", Action.HOLD, (Test("planned", "==", 0),), "no capture within the horizon any more"),
    Rule("blind_at_rest", Action.STAND_STILL, (_AT_REST, _BLIND), "no reason to set out without sight"),
    Rule(
        "recovering",
        Action.HOLD,
        (_SEEN, _HOLDING, Test("healthy_run", "<", "recover_scans")),
        "sight is back, not yet trusted",
    ),
    Rule("arrived_sure", Action.CAPTURE, (_AT_END, _SURE), "the end is near and inside the tolerances"),
    Rule("arrived_unsure", Action.HOLD, (_AT_END, _UNSURE), "the end is near and not inside the tolerances"),
    Rule("healthy", Action.APPROACH, (_SEEN,), "sight is good: what is not known yet will be"),
    Rule("prediction_good", Action.APPROACH_ON_PREDICTION, (_SURE,), "inside the tolerances to the end, unseen"),
    Rule("blind_holding", Action.HOLD, (_HOLDING,), "still no sight"),
    Rule("short_gap", Action.APPROACH_ON_PREDICTION, (Test("blind_s", "<=", "patience_s"),), "a scan or two may fail"),
    Rule("prediction_poor", Action.HOLD, (), "unseen, and not inside the tolerances at the end"),
)
"""Read from the top; the last rule has no test, so one always fires."""


class Supervisor:
    """Chooses one action a scan. ``params`` must be resolved (no None left)."""

    def __init__(self, params: SupervisorParams, rules: tuple[Rule, ...] = RULES) -> None:
        for f in fields(params):
            if getattr(params, f.name) is None:
                raise ValueError(f"{f.name} is None, resolve the parameters with the target's extent first")
        if not rules or rules[-1].tests:
            raise ValueError("the last rule must have no test, so that one rule always fires")
        self.params = params
        self.rules = rules

    def decide(self, memory: SupervisorMemory, facts: Facts) -> tuple[SupervisorMemory, Decision]:
        """The action for this scan and what to remember of it."""
        seen_s = facts.t_s if facts.gamma else memory.seen_s
        run = memory.healthy_run + 1 if facts.gamma else 0
        now = replace(memory, seen_s=seen_s, healthy_run=run)
        measures = self._measures(now, facts)
        rule = next(rule for rule in self.rules if all(self._holds(test, measures) for test in rule.tests))
        holding = rule.action in (Action.HOLD, Action.RETREAT)
        since = (memory.held_since_s if memory.held_since_s is not None else facts.t_s) if holding else None
        moving = memory.moving or rule.action is not Action.STAND_STILL
        after = replace(now, action=rule.action, rule=rule.name, held_since_s=since, moving=moving)
        return after, Decision(rule.action, rule.name)

    def doubt(self, facts: Facts) -> float:
        """Predicted error at the end in units of the tolerances, at most 1 is good enough; infinite where unknown."""
        p = self.params
        parts = (
            facts.pos_1s_m / (p.capture_pos_m or math.nan),
            facts.vel_1s_mps / (p.capture_speed_mps or math.nan),
            facts.rot_1s_deg / p.capture_angle_deg,
        )
        return p.sigmas * max(parts) if all(math.isfinite(v) for v in parts) else math.inf

    def _measures(self, memory: SupervisorMemory, facts: Facts) -> dict[str, float]:
        held = 0.0 if memory.held_since_s is None else facts.t_s - memory.held_since_s
        return {
            "gamma": float(facts.gamma),
            "converged": float(facts.converged),
            "planned": float(facts.planned),
            "moving": float(memory.moving),
            "holding": float(memory.action in (Action.HOLD, Action.RETREAT)),
            "aborted": float(memory.action is Action.ABORT),
            "captured": float(memory.action is Action.CAPTURE),
            "t_go_s": facts.t_go_s if facts.planned else math.inf,
            "doubt": self.doubt(facts),
            "held_s": held,
            "blind_s": math.inf if memory.seen_s is None else facts.t_s - memory.seen_s,
            "healthy_run": float(memory.healthy_run),
            "clearance_m": facts.distance_m - self.params.sigmas * facts.now_1s_m,
            "margin": facts.margin,
        }

    def _holds(self, test: Test, measures: Mapping[str, float]) -> bool:
        bound = float(getattr(self.params, test.bound)) if isinstance(test.bound, str) else test.bound
        return _COMPARE[test.compare](measures[test.measure], bound)
