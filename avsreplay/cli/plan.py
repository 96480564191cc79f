"""``avsreplay plan``: plan the capture from the saved beliefs of a result."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from avsreplay.cli.config import robot_option, setting_option
from avsreplay.cli.options import Numbers

if TYPE_CHECKING:
    from avsreplay.outcome import Plan
    from avsreplay.plan import Execution, Flights, Limits, Miss, PlanParams, Spread
    from avsreplay.plan.arm import Arm, JointPath
    from avsreplay.replan import Replanning, Saved
    from avsreplay.report.table import Table

PLAN, LIMITS = "avsreplay.plan:PlanParams", "avsreplay.plan:Limits"
EPILOG = """\b
Examples:
  avsreplay plan results/                          from t_1 on, with the run's settings
  avsreplay plan results/ --at 40 --a-max 0.02
  avsreplay plan results/ --cone-deg 30 --final-deg 8 --speed-max 0.4
  avsreplay plan results/ --final-deg 15 --clearance 0.1 --set supervisor.sigmas=2 --set robot.thrust_noise=0.02
  avsreplay plan results/ --robot robot.toml
  avsreplay plan results/ --export plan.csv --json

\b
Exit codes: 0 ok (also where no plan was found; the status says so),
            2 usage, 3 unreadable input."""


@click.command("plan", epilog=EPILOG)
@click.argument("result", type=click.Path(path_type=Path))
@click.option("--at", "at_s", type=float, help="Plan from this time [s]; default: from convergence.")
@setting_option("--a-max", "a_max_mps2", type=float, owner=PLAN)
@setting_option("--horizon", "horizon_s", type=float, owner=PLAN)
@setting_option("--latency", "latency_s", type=float, owner=PLAN)
@setting_option("--period", "replan_period_s", type=float, owner=PLAN)
@setting_option("--from", "robot_position_m", type=Numbers(3), metavar="X,Y,Z", owner=PLAN)
@setting_option("--cone-deg", type=float, owner=LIMITS)
@setting_option("--cone-range", "cone_range_m", type=float, owner=LIMITS)
@setting_option("--final-deg", type=float, owner=LIMITS)
@setting_option("--final-range", "final_range_m", type=float, owner=LIMITS)
@setting_option("--speed-max", "speed_max_mps", type=float, owner=LIMITS)
@setting_option("--contact-accel", "contact_accel_mps2", type=float, owner=LIMITS)
@setting_option("--keepout", "keepout_m", type=float, owner=LIMITS)
@setting_option("--keepout-release", "keepout_release_m", type=float, owner=LIMITS)
@setting_option("--clearance", "clearance_m", type=float, owner=LIMITS)
@robot_option()
@click.option(
    "--set",
    "assignments",
    multiple=True,
    metavar="KEY=VALUE",
    help="Change a setting of plan, limits, robot or supervisor.",
)
@click.option("--samples", type=click.IntRange(1), default=64, show_default=True, help="Draws from the belief.")
@click.option(
    "--flights",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Whole flights with replanning, thrust errors and delay against draws from the belief.",
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of the draws.")
@click.option(
    "--every",
    "every_s",
    type=float,
    help="Interval of the plans compared with ground truth [s]; default: 2, with limits 10.",
)
@click.option("--extent", "extent_m", type=float, help="Extent of the target [m], if the result does not contain it.")
@click.option("--export", type=click.Path(path_type=Path), help="Write t, r, v, u of the plan as CSV.")
@click.option("--overwrite", is_flag=True, help="Replace an existing CSV.")
@click.option("--json", "as_json", is_flag=True, help="One JSON document on stdout and nothing else.")
def plan_command(
    result: Path,
    at_s: float | None,
    samples: int,
    flights: int,
    seed: int,
    every_s: float | None,
    robot_file: Path | None,
    assignments: tuple[str, ...],
    extent_m: float | None,
    export: Path | None,
    overwrite: bool,
    as_json: bool,
    **flags: Any,
) -> None:
    """Plan the capture from RESULT, a directory written by 'avsreplay run -o'.

    The saved beliefs are used and nothing is replayed. The output contains the plan, its distribution over the belief
    and, if the log has ground truth, the errors of plans made at regular intervals and a simulated approach.
    \f
    Raises:
        UsageError: an option or setting is invalid, or --export has no plan.  UnreadableInput: RESULT cannot be read.
    """  # noqa: D301
    from dataclasses import replace

    from avsreplay.config import robot_settings
    from avsreplay.errors import UsageError
    from avsreplay.files import check_output
    from avsreplay.plan.arm import with_arm
    from avsreplay.replan import load_saved, with_settings

    for name, value in (("--every", every_s), ("--extent", extent_m)):
        if value is not None and not 0.0 < value < float("inf"):
            raise UsageError(f"{value} is not above 0", where=name, hint="give a finite number above 0")
    if export:
        check_output(export, overwrite=overwrite)
    of_robot = () if robot_file is None else robot_settings(robot_file)
    saved = with_settings(load_saved(result, extent_m), (*of_robot, *assignments))
    for line in saved.warnings:
        click.echo(f"avsreplay: warning: {line}", err=True)
    robot, arm = with_arm(saved.robot)
    planning = _planning(replace(saved, robot=robot), flags, arm)
    index = saved.index_at(at_s)
    made = _usable(lambda: planning.plan_at(index))
    spread = _usable(lambda: planning.spread_at(index, made, samples, seed)) if made.found else None
    flown = _usable(lambda: planning.flights(index, flights, seed)) if made.found and flights else None
    joints = _usable(lambda: planning.joints(index, made))
    period_s = every_s or (10.0 if planning.limits.any else 2.0)
    hindsight = _usable(lambda: planning.hindsight(period_s))
    execution = _usable(planning.execute)
    if export:
        _export(planning, made, export)
    if as_json:
        click.echo(_document(planning, index, made, spread, hindsight, execution, flown, joints), nl=False)
    else:
        _print(planning, index, made, spread, hindsight, execution, flown, joints)


def _usable(action: Any) -> Any:
    """Return the result of an action; a value that the planner refuses is an error of the user."""
    from avsreplay.errors import UsageError

    try:
        return action()
    except ValueError as error:
        raise UsageError(str(error), hint="correct the option, or the setting in run.json") from None


def _planning(saved: Saved, flags: dict[str, Any], arm: Arm | None) -> Replanning:
    from dataclasses import fields, replace

    from avsreplay.plan import PlanParams
    from avsreplay.replan import Replanning

    given = {name: value for name, value in flags.items() if value is not None}
    of_plan = {f.name for f in fields(PlanParams)}
    params: PlanParams = _usable(lambda: replace(saved.plan, **{k: v for k, v in given.items() if k in of_plan}))
    limits: Limits = _usable(lambda: replace(saved.limits, **{k: v for k, v in given.items() if k not in of_plan}))
    made: Replanning = _usable(lambda: Replanning(saved, params, limits, saved.supervisor, arm))
    return made


def _document(
    planning: Replanning,
    index: int,
    made: Plan,
    spread: Spread | None,
    hindsight: list[tuple[float, Plan, Miss | None]],
    execution: Execution | None,
    flown: Flights | None,
    joints: JointPath | None,
) -> str:
    import json

    from avsreplay import settings

    rows, since_s = planning.saved.rows, planning.saved.rows[index].t_s
    outcome = None if execution is None else execution.outcome(planning.tolerance)
    document = {
        "made_at_s": rows[index].t_s,
        "plan": _plan_record(made, since_s),
        "limits": settings.dump(planning.limits),
        "params": settings.dump(planning.params),
        "robot": settings.dump(planning.robot),
        "robot_line": planning.robot_line,
        "tolerance": settings.dump(planning.tolerance),
        "spread": settings.dump(spread) if spread else None,
        "flights": settings.dump(flown) if flown else None,
        "arm": joints.record() if joints else None,
        "hindsight": [
            {"made_at_s": at_s, **_plan_record(p, at_s), "miss": settings.dump(m) if m else None}
            for at_s, p, m in hindsight
        ],
        "execution": None
        if execution is None
        else {
            "outcome": outcome,
            "miss": settings.dump(execution.miss) if execution.miss else None,
            "actions": [{"t_s": t, "action": a, "rule": r} for t, a, r in execution.actions],
        },
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
        "attitude_s": made.attitude_s,
        "delayed_by": made.delayed_by or None,
    }


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_nan(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_without_nan(v) for v in value]
    return None if isinstance(value, float) and not abs(value) < float("inf") else value


def _print(
    planning: Replanning,
    index: int,
    made: Plan,
    spread: Spread | None,
    hindsight: list[tuple[float, Plan, Miss | None]],
    execution: Execution | None,
    flown: Flights | None,
    joints: JointPath | None,
) -> None:
    from avsreplay.report.table import facts_table, make_console, print_line, print_table

    console = make_console()
    at_s = planning.saved.rows[index].t_s
    facts = _plan_facts(planning, at_s, made)
    for found in (joints, spread, flown):
        facts += found.described() if found else []
    print_table(console, facts_table(f"Plan made at {at_s:.2f} s", facts))
    print_table(console, _hindsight_table(hindsight))
    if execution is not None:
        print_table(console, _execution_table(execution))
        for line in _outcome_lines(execution, planning):
            print_line(console, line)


def _plan_facts(planning: Replanning, at_s: float, made: Plan) -> list[tuple[str, str]]:
    facts = [("robot", planning.robot_line), ("status", _status(made))]
    if made.found:
        facts += [
            ("capture", f"at {at_s + made.t_go_s:.3f} s, {made.t_go_s:.4f} s after planning"),
            ("terminal errors", f"{made.position_error_m:.1e} m, {made.velocity_error_mps:.1e} m/s"),
            ("largest |u|", f"{made.u_max:.6g} of {made.a_max:.6g} m/s2"),
        ]
    if abs(made.attitude_s) < float("inf"):
        facts.append(("gripper", f"attitude and rate of the fixture after {made.attitude_s:.3f} s"))
    if made.found and made.delayed_by:
        facts.append(("delayed by", _DELAYED[made.delayed_by]))
    basis = "certified without the limits" if planning.limits.any else "certified"
    facts.append(("no capture before", f"{made.lower_bound_s:.4f} s after planning ({basis})"))
    if made.binding:
        facts.append(("smallest margin", f"{made.margin_m:.4f} m ({made.binding}); excess {made.violation_m:.1e} m"))
    if abs(made.abort_margin_m) < float("inf"):
        facts.append(("margin of an abort", f"{made.abort_margin_m:.3f} m of clearance, from any instant"))
    return facts


_DELAYED = {
    "attitude": "the turn of the gripper: its end-effector alone could be there earlier",
    "arm": "the joints of the arm: an earlier or faster capture exceeds their limits",
}


def _status(made: Plan) -> str:
    """Return what is known about the plan, in words."""
    words = {
        "optimal": f"optimal within {max(made.gap_s, 0.0):.1e} s",
        "feasible": f"found; at most {made.gap_s:.2f} s later than the earliest possible capture",
        "none_found": f"none found{' that the arm can fly' if made.delayed_by == 'arm' else ''}; a capture may exist",
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
        ("made at\n[s]", "status", "capture\n[s]", "early by\n[s]", "miss\n[mm]", "speed\n[mm/s]", "angle\n[deg]"),
        rows,
        align="rlr",
        note=f"{left_out} further plans end after the log or were not found" if left_out else "",
    )


def _execution_table(execution: Execution) -> Table:
    from avsreplay.report.table import Table

    rows = tuple((f"{t_s:.2f}", action, rule) for t_s, action, rule in execution.actions)
    return Table("Simulated approach under the supervisor", ("from\n[s]", "action", "rule"), rows, align="rl")


def _outcome_lines(execution: Execution, planning: Replanning) -> list[str]:
    lines = [f"outcome: {execution.outcome(planning.tolerance)}"]
    if execution.miss is not None:
        m = execution.miss
        error = f"distance {1e3 * m.distance_m:.2f} mm, {1e3 * m.speed_mps:.2f} mm/s, {m.angle_deg:.3f} deg"
        lines.append(f"gripper closed at {m.at_s:.3f} s: {error}")
    return lines


def _export(planning: Replanning, made: Plan, path: Path) -> None:
    import numpy as np

    from avsreplay.errors import UsageError
    from avsreplay.files import output_text

    if not made.found:
        raise UsageError("there is no plan to export", where=str(path), hint=f"its status is {made.status.value}")
    flown = planning.path(made)
    times = np.append(np.arange(0.0, made.t_go_s, 0.1), made.t_go_s)
    values = np.column_stack([times, *flown.at(times), flown.thrust(times)])
    names = ["t_s", *(f"{q}{c}_{u}" for q, u in (("r", "m"), ("v", "mps"), ("u", "mps2")) for c in "xyz")]
    with output_text(path) as stream:
        lines = [",".join(names), *(",".join(repr(float(v)) for v in row) for row in values)]
        stream.write("\n".join(lines) + "\n")
