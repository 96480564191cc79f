"""What ``avsreplay plan`` prints: tables, or one JSON document."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from avsreplay.errors import value_class

if TYPE_CHECKING:
    from avsreplay.assessment import Assessment
    from avsreplay.outcome import Plan
    from avsreplay.plan.flights import Decided, Miss
    from avsreplay.plan.joint_path import JointPath
    from avsreplay.plan.uncertainty import Spread
    from avsreplay.replan import Replanning
    from avsreplay.report.table import Table


@value_class
class PossibleChange:
    """One change of the problem with which a plan is found.

    Attributes:
        setting: the key that is changed, or ``--at``.
        option: the option that makes the change.
        at_s: instant of planning with it [s after the first scan].
        plan: the plan with it.
    """

    setting: str
    option: str
    at_s: float
    plan: Plan

    @property
    def capture_s(self) -> float:
        """Instant of the capture [s after the first scan]."""
        return self.at_s + self.plan.t_go_s


@value_class
class Answer:
    """Everything that planning from a saved result found.

    Attributes:
        planning: the planner with its settings.
        at_s: instant of planning [s after the first scan].
        made: the plan.
        assessment: whether the robot would capture, by the whole flight.
        spread: the plan flown without replanning, over draws from the belief; None without a plan.
        joints: joints of an arm during the last metres; None without an arm.
        hindsight: plans at regular intervals with their errors.
        actions: the changes of the supervisor's decision during the flight.
        changes: single changes with which a plan is found, where there is none.
    """

    planning: Replanning
    at_s: float
    made: Plan
    assessment: Assessment
    spread: Spread | None
    joints: JointPath | None
    hindsight: list[tuple[float, Plan, Miss | None]]
    actions: tuple[Decided, ...]
    changes: list[PossibleChange]


def document(answer: Answer) -> str:
    """Return the answer as one JSON document."""
    import json

    from avsreplay import settings

    planning, spread, joints = answer.planning, answer.spread, answer.joints
    document = {
        "capture": answer.assessment.record(),
        "made_at_s": answer.at_s,
        "plan": _plan_record(answer.made, answer.at_s),
        "changes": [{"option": c.option, "capture_time_s": c.capture_s} for c in answer.changes],
        "limits": settings.dump(planning.limits),
        "params": settings.dump(planning.params),
        "robot": settings.dump(planning.robot),
        "robot_line": planning.robot_line,
        "tolerance": settings.dump(planning.tolerance),
        "spread": settings.dump(spread) if spread else None,
        "arm": joints.record() if joints else None,
        "hindsight": [
            {"made_at_s": at_s, **_plan_record(p, at_s), "miss": settings.dump(m) if m else None}
            for at_s, p, m in answer.hindsight
        ],
        "actions": [{"t_s": t, "action": a, "rule": r} for t, a, r in answer.actions],
    }
    return json.dumps(_without_nan(document), indent=1, allow_nan=False) + "\n"


def _plan_record(made: Plan, since_s: float) -> dict[str, Any]:
    return {
        "status": made.status.value,
        "t_go_s": made.t_go_s,
        "capture_time_s": since_s + made.t_go_s,
        "lower_bound_s": made.lower_bound_s,
        "a_max_mps2": made.a_max,
        "u_max_mps2": made.u_max,
        "position_error_m": made.position_error_m,
        "velocity_error_mps": made.velocity_error_mps,
        "costate": made.costate.tolist(),
        "violation_m": made.violation_m,
        "margin_m": made.margin_m,
        "limit": made.binding or None,
        "abort_margin_m": made.abort_margin_m,
        "passive_margin_m": made.passive_margin_m,
        "passive_safe_s": made.passive_safe_s,
        "attitude_s": made.attitude_s,
        "delayed_by": made.delayed_by or None,
    }


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_nan(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_without_nan(v) for v in value]
    return None if isinstance(value, float) and not abs(value) < float("inf") else value


def print_answer(answer: Answer) -> None:
    """Print the answer as tables."""
    from avsreplay.report.table import facts_table, make_console, print_line, print_table

    console = make_console()
    print_line(console, f"{answer.assessment.sentence}.")
    console.print()
    print_table(console, facts_table("Capture", answer.assessment.described()))
    facts = plan_facts(answer.planning, answer.at_s, answer.made)
    for found in (answer.joints, answer.spread):
        facts += found.described() if found else []
    if not answer.made.found:
        if (
            start := answer.planning.start_margin(answer.planning.saved.index_at(answer.at_s))
        ) < 0.0:
            facts.append(
                (
                    "start",
                    (
                        f"violates a limit by {-start:.2f}: inside the target or its clearance, or"
                        " too fast"
                    ),
                )
            )
        facts.append(("what prevents it", prevented(answer.changes)))
        facts.append(("spread over belief", "not computed, because there is no plan"))
    print_table(console, facts_table(f"Plan made at {answer.at_s:.2f} s", facts))
    print_table(console, _hindsight_table(answer.hindsight))
    print_table(console, _actions_table(answer.actions))


def prevented(changes: list[PossibleChange]) -> str:
    """Return in one sentence which settings prevent a plan and with which changes one is found."""
    if not changes:
        return (
            "not found: no change of a single limit, of the robot or of --at that was tried gives a"
            " plan"
        )
    names = [c.setting for c in changes if c.setting != "--at"] or ["the estimate at this instant"]
    together = f"{' and '.join(names)} together" if len(names) > 1 else names[0]
    found = " or ".join(f"{c.option} (at {c.capture_s:.2f} s)" for c in changes)
    return f"{together}; a capture is found with {found}"


def plan_facts(planning: Replanning, at_s: float, made: Plan) -> list[tuple[str, str]]:
    """Return the figures of a plan as names and texts."""
    facts = [("robot", planning.robot_line), ("status", _status(made))]
    if made.found:
        facts += [
            ("capture", f"at {at_s + made.t_go_s:.3f} s, {made.t_go_s:.4f} s after planning"),
            (
                "terminal errors",
                f"{made.position_error_m:.1e} m, {made.velocity_error_mps:.1e} m/s",
            ),
            ("largest |u|", f"{made.u_max:.6g} of {made.a_max:.6g} m/s2"),
        ]
    if abs(made.attitude_s) < float("inf"):
        facts.append(("gripper", f"attitude and rate of the fixture after {made.attitude_s:.3f} s"))
    if made.found and made.delayed_by:
        facts.append(("delayed by", _DELAYED[made.delayed_by]))
    basis = "certified without the limits" if planning.limits.any else "certified"
    facts.append(("no capture before", f"{made.lower_bound_s:.4f} s after planning ({basis})"))
    if made.binding:
        facts.append(
            (
                "smallest margin",
                f"{made.margin_m:.4f} m ({made.binding}); excess {made.violation_m:.1e} m",
            )
        )
    if made.found:
        facts += _safety(made)
    return facts


def _safety(made: Plan) -> list[tuple[str, str]]:
    """Active safety, that of a withdrawal, and passive safety, that of coasting."""
    active = coasts = "not checked: no clearance to the body is set (limits.clearance_m)"
    if abs(made.abort_margin_m) < float("inf"):
        active = f"withdrawal from any instant: margin {made.abort_margin_m:.4f} m of the clearance"
    if abs(made.passive_margin_m) < float("inf"):
        coasts = f"coasting after a cut of the thrust: margin {made.passive_margin_m:.4f} m"
        if made.passive_margin_m < 0.0:
            coasts += f"; not safe from {made.passive_safe_s:.2f} s after planning on"
    return [("active safety", active), ("passive safety", coasts)]


_DELAYED = {
    "attitude": "the turn of the gripper: its end-effector alone could be there earlier",
    "arm": "the joints of the arm: an earlier or faster capture exceeds their limits",
}


_TURN = {
    "none_found": "none found: no turn of the gripper to the fixture; a capture may exist",
    "infeasible_within_horizon": (
        "proven impossible: the gripper cannot reach the fixture's angular rate in time"
    ),
}


def _status(made: Plan) -> str:
    """Return what is known about the plan, in words."""
    if made.delayed_by == "attitude" and not made.found:
        return _TURN[made.status.value]
    gap = f"; no capture is earlier by more than {made.gap_s:.0e} s" if made.gap_s > 0.0 else ""
    words = {
        "optimal": f"optimal{gap}",
        "feasible": f"found; at most {made.gap_s:.2f} s later than the earliest possible capture",
        "none_found": (
            f"none found{' for this arm' if made.delayed_by == 'arm' else ''}; a capture may exist"
        ),
        "infeasible_within_horizon": "proven impossible within the horizon",
    }
    return words.get(made.status.value, made.status.value)


def _hindsight_table(hindsight: list[tuple[float, Plan, Miss | None]]) -> Table:
    from avsreplay.report.table import Table

    rows = tuple(
        (
            f"{at_s:.2f}",
            made.status.value,
            f"{at_s + made.t_go_s:.2f}",
            f"{found.lead_s:.2f}",
            f"{1e3 * found.distance_m:.2f}",
            f"{1e3 * found.speed_mps:.2f}",
            f"{found.angle_deg:.3f}",
        )
        for at_s, made, found in hindsight
        if found is not None
    )
    left_out = len(hindsight) - len(rows)
    return Table(
        "Plans against ground truth at their planned end",
        (
            "made at\n[s]",
            "status",
            "capture\n[s]",
            "time to\ngo [s]",
            "miss\n[mm]",
            "speed\n[mm/s]",
            "angle\n[deg]",
        ),
        rows,
        align="rlr",
        note=f"{left_out} further plans end after the log or were not found" if left_out else "",
    )


def _actions_table(actions: tuple[Decided, ...]) -> Table:
    from avsreplay.report.table import Table

    rows = tuple((f"{t_s:.2f}", action, rule) for t_s, action, rule in actions)
    return Table(
        "The approach under the supervisor", ("from\n[s]", "action", "rule"), rows, align="rl"
    )
