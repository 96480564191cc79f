"""The supervisor: a table of rules that selects the action of the robot after each scan.

The paper requires "the most appropriate control action if partial or complete failure of the vision
system in the short term occurs" and leaves the choice open. Here the rules are data: the table is
read from the top, the first rule whose conditions all hold determines the action, and its name is
written to the row.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from enum import Enum
from types import MappingProxyType

from avsreplay.errors import value_class
from avsreplay.settings import Settings, setting


class Action(Enum):
    """Actions of the robot."""

    STAND_STILL = "stand_still"  # remain at rest: the estimate has not converged
    APPROACH = "approach"  # fly the plan with healthy measurements
    APPROACH_ON_PREDICTION = (  # fly the plan without measurements, the prediction suffices
        "approach_on_prediction"
    )
    HOLD = "hold"  # stop the approach and keep the approach point
    RETREAT = "retreat"  # increase the distance to the target
    CAPTURE = "capture"  # fly the last plan to its end and close the gripper
    ABORT = "abort"  # retreat and end the approach


@dataclass(frozen=True, slots=True)
class SupervisorParams(Settings):
    """Capture tolerances and time limits of the supervisor."""

    capture_pos_m: float | None = setting(
        None, "Capture tolerance on position.", unit="m", above=0.0, of_extent=0.0025
    )
    capture_speed_mps: float | None = setting(
        None, "Capture tolerance on relative speed.", unit="m/s", above=0.0, of_extent=0.00125
    )
    capture_angle_deg: float = setting(
        2.0, "Capture tolerance on the gripper's angle.", unit="deg", above=0.0
    )
    sigmas: float = setting(
        3.0,
        "The predicted 1 sigma (root of the trace) times this must be within the tolerances. A"
        " larger value captures only with more precise predictions.",
        above=0.0,
    )
    commit_s: float = setting(
        0.5,
        "The last plan is flown to its end if the time to go is less than this.",
        unit="s",
        above=0.0,
    )
    patience_s: float = setting(
        1.5,
        "Time without a healthy scan after which the approach continues only if the prediction"
        " is within the tolerances. A hold that is not longer ends no attempt.",
        unit="s",
        above=0.0,
    )
    recover_scans: int = setting(2, "Number of consecutive healthy scans that ends a hold.", low=1)
    hold_limit_s: float = setting(
        60.0, "A hold or retreat that lasts longer becomes an abort.", unit="s", above=0.0
    )
    attempts_max: int = setting(
        5, "Number of approaches after which the next withdrawal becomes an abort.", low=1
    )
    approach_limit_s: float = setting(
        600.0,
        "Time since the first approach after which the robot aborts unless it captures.",
        unit="s",
        above=0.0,
    )
    standoff_m: float | None = setting(
        None,
        "Distance that a hold keeps from the sphere which contains the target in every attitude.",
        unit="m",
        above=0.0,
        of_extent=0.125,
    )
    retreat_m: float | None = setting(
        None,
        "Distance that a retreat or an abort keeps from that sphere.",
        unit="m",
        above=0.0,
        of_extent=0.5,
    )


@value_class(kw_only=True, eq=True)
class Facts:
    """Input of the supervisor after one scan.

    Attributes:
        t_s: Time of the scan [s].
        gamma: 1 if the scan is healthy, else 0.
        converged: Whether the estimate may be used for planning.
        planned: Whether a capture plan exists.
        t_go_s: Time to the end of the plan [s], NaN without a plan.
        pos_1s_m, vel_1s_mps, rot_1s_deg: 1 sigma of the grasp point predicted for that end without
            measurements.
        distance_m: Distance of the robot to the grasp point [m].
        now_1s_m: 1 sigma of the grasp point's position now [m].
        margin: Smallest margin of the constraints now, negative if one is violated (1 without
            constraints).
        withdrawal_m: Smallest margin of a withdrawal from now if no further measurement arrives
            [m]; infinite with a healthy scan.
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
    withdrawal_m: float = math.inf


@value_class(eq=True)
class SupervisorMemory:
    """State of the supervisor carried from scan to scan.

    Attributes:
        action, rule: Latest decision.
        seen_s: Time of the latest healthy scan [s], None before the first.
        healthy_run: Number of consecutive healthy scans.
        held_since_s: Begin of the current hold or retreat [s], None outside one.
        moving: Whether the robot has left its initial position.
        began_s: Time of the first approach [s], None before it.
        attempts: Number of approaches begun.
    """

    action: Action = Action.STAND_STILL
    rule: str = ""
    seen_s: float | None = None
    healthy_run: int = 0
    held_since_s: float | None = None
    moving: bool = False
    began_s: float | None = None
    attempts: int = 0


@value_class(eq=True)
class Decision:
    """The selected action and the name of the rule that selected it."""

    action: Action
    rule: str


@value_class(eq=True)
class Condition:
    """``measure compare bound``; a bound given as text is the name of a parameter."""

    measure: str
    compare: str
    bound: float | str


@value_class(eq=True)
class Rule:
    """An action, the conditions that must all hold for it, and the reason in words."""

    name: str
    action: Action
    conditions: tuple[Condition, ...]
    why: str


_COMPARE: Mapping[str, Callable[[float, float], bool]] = MappingProxyType(
    {"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge, "==": operator.eq}
)

CLOSING = (Action.APPROACH, Action.APPROACH_ON_PREDICTION, Action.CAPTURE)  # the robot comes nearer
_MOVING = Condition("moving", "==", 1)
_AT_REST = Condition("moving", "==", 0)
_HEALTHY = Condition("gamma", "==", 1)
_FAULTY = Condition("gamma", "==", 0)
_AT_END = Condition("t_go_s", "<=", "commit_s")
_HOLDING = Condition("holding", "==", 1)
_ACCURATE = Condition("error_ratio", "<=", 1.0)
_INACCURATE = Condition("error_ratio", ">", 1.0)

RULES: tuple[Rule, ...] = (
    Rule("aborted", Action.ABORT, (Condition("aborted", "==", 1),), "an abort is final"),
    Rule(
        "captured",
        Action.CAPTURE,
        (Condition("captured", "==", 1),),
        "a capture is flown to its end",
    ),
    Rule(
        "held_too_long",
        Action.ABORT,
        (Condition("held_s", ">", "hold_limit_s"),),
        "the time limit is exceeded",
    ),
    Rule(
        "too_long",
        Action.ABORT,
        (Condition("approach_s", ">", "approach_limit_s"),),
        "the approach takes too long",
    ),
    Rule(
        "too_many_attempts",
        Action.ABORT,
        (_HOLDING, Condition("attempts", ">=", "attempts_max")),
        "every attempt was withdrawn",
    ),
    Rule(
        "constraint_broken",
        Action.RETREAT,
        (_MOVING, Condition("margin", "<", 0.0)),
        "a constraint is violated",
    ),
    Rule(
        "too_close_unsure",
        Action.RETREAT,
        (_MOVING, _INACCURATE, Condition("distance_margin_m", "<", 0.0)),
        "contact is possible",
    ),
    Rule(
        "not_converged",
        Action.STAND_STILL,
        (_AT_REST, Condition("converged", "==", 0)),
        "at rest until convergence (paper)",
    ),
    Rule(
        "convergence_lost", Action.HOLD, (Condition("converged", "==", 0),), "convergence was lost"
    ),
    Rule(
        "no_plan_yet",
        Action.STAND_STILL,
        (_AT_REST, Condition("planned", "==", 0)),
        "no capture within the horizon",
    ),
    Rule(
        "plan_lost",
        Action.HOLD,
        (Condition("planned", "==", 0),),
        "no capture within the horizon any more",
    ),
    Rule(
        "blind_at_rest",
        Action.STAND_STILL,
        (_AT_REST, _FAULTY),
        "the approach does not begin without measurements",
    ),
    Rule(
        "recovering",
        Action.HOLD,
        (_HEALTHY, _HOLDING, Condition("healthy_run", "<", "recover_scans")),
        "too few healthy scans so far",
    ),
    Rule("arrived_sure", Action.CAPTURE, (_AT_END, _ACCURATE), "accurate enough at the end"),
    Rule("arrived_unsure", Action.HOLD, (_AT_END, _INACCURATE), "not accurate enough at the end"),
    Rule("healthy", Action.APPROACH, (_HEALTHY,), "measurements improve the estimate"),
    Rule(
        "prediction_good",
        Action.APPROACH_ON_PREDICTION,
        (_ACCURATE,),
        "accurate enough without measurements",
    ),
    Rule("blind_holding", Action.HOLD, (_HOLDING,), "still no healthy measurement"),
    Rule(
        "short_gap",
        Action.APPROACH_ON_PREDICTION,
        (Condition("blind_s", "<=", "patience_s"), Condition("withdrawal_m", ">=", 0.0)),
        "short gaps are bridged while a withdrawal remains safe",
    ),
    Rule("prediction_poor", Action.HOLD, (), "not accurate enough without measurements"),
)
"""The rules in order of precedence; the last rule has no condition, so one rule always applies."""


class Supervisor:
    """Selects one action per scan."""

    def __init__(self, params: SupervisorParams, rules: tuple[Rule, ...] = RULES) -> None:
        """Create a supervisor.

        Args:
            params: Resolved parameters (``SupervisorParams.resolved``).
            rules: Rules in order of precedence; the last one must have no condition.

        Raises:
            ValueError: A parameter is None, or the last rule has a condition.
        """
        for f in fields(params):
            if getattr(params, f.name) is None:
                raise ValueError(
                    f"{f.name} is None, resolve the parameters with the target's extent first"
                )
        if not rules or rules[-1].conditions:
            raise ValueError(
                "the last rule must have no condition, so that one rule always applies"
            )
        self.params = params
        self.rules = rules

    def decide(self, memory: SupervisorMemory, facts: Facts) -> tuple[SupervisorMemory, Decision]:
        """Select the action for one scan.

        Args:
            memory: State after the previous scan.
            facts: What is known after this scan.

        Returns:
            The new state and the decision.
        """
        seen_s = facts.t_s if facts.gamma else memory.seen_s
        run = memory.healthy_run + 1 if facts.gamma else 0
        now = replace(memory, seen_s=seen_s, healthy_run=run)
        measures = self._measures(now, facts)
        rule = next(
            rule
            for rule in self.rules
            if all(self._holds(condition, measures) for condition in rule.conditions)
        )
        holding = rule.action in (Action.HOLD, Action.RETREAT)
        since = (
            (memory.held_since_s if memory.held_since_s is not None else facts.t_s)
            if holding
            else None
        )
        moving = memory.moving or rule.action is not Action.STAND_STILL
        begins = rule.action in CLOSING and memory.action not in CLOSING
        since_s = memory.held_since_s  # a hold as short as a gap that is bridged ends no attempt
        if since_s is not None and facts.t_s - since_s <= self.params.patience_s:
            begins = False
        after = replace(
            now,
            action=rule.action,
            rule=rule.name,
            held_since_s=since,
            moving=moving,
            began_s=facts.t_s if begins and memory.began_s is None else memory.began_s,
            attempts=memory.attempts + begins,
        )
        return after, Decision(rule.action, rule.name)

    def error_ratio(self, facts: Facts) -> float:
        """Return the predicted error at the end of the plan over the tolerance; infinite where it
        is unknown.

        Args:
            facts: What is known after a scan.

        Returns:
            ``sigmas`` times the largest of the three ratios 1 sigma / tolerance (position, speed,
            attitude).
        """
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
            "error_ratio": self.error_ratio(facts),
            "held_s": held,
            "approach_s": 0.0 if memory.began_s is None else facts.t_s - memory.began_s,
            "attempts": float(memory.attempts),
            "blind_s": math.inf if memory.seen_s is None else facts.t_s - memory.seen_s,
            "healthy_run": float(memory.healthy_run),
            "distance_margin_m": facts.distance_m - self.params.sigmas * facts.now_1s_m,
            "margin": facts.margin,
            "withdrawal_m": facts.withdrawal_m,
        }

    def _holds(self, condition: Condition, measures: Mapping[str, float]) -> bool:
        bound = (
            float(getattr(self.params, condition.bound))
            if isinstance(condition.bound, str)
            else condition.bound
        )
        return _COMPARE[condition.compare](measures[condition.measure], bound)
