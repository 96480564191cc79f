"""``avsreplay plan``: plan the capture from the saved beliefs of a result."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from avsreplay.cli.config import Command, robot_option, setting_option
from avsreplay.cli.options import HTML, Numbers, check_outputs, check_suffix

if TYPE_CHECKING:
    from avsreplay.cli.plan_output import Answer, PossibleChange
    from avsreplay.outcome import Plan
    from avsreplay.plan.arm import Arm
    from avsreplay.plan.rendezvous import PlanParams
    from avsreplay.plan.robot import Limits
    from avsreplay.replan import Replanning
    from avsreplay.saved_result import Saved

PLAN = "avsreplay.plan.rendezvous:PlanParams"
LIMITS = "avsreplay.plan.limits:Limits"
# settings changed one at a time where no plan is found, with the factors of their values, and later
# instants, in seconds
CHANGES = (
    ("robot.angular_accel_radps2", (2.0, 8.0, 64.0)),
    ("limits.clearance_sigmas", (2.0 / 3.0, 1.0 / 3.0, 0.0)),
    ("limits.clearance_m", (0.5, 0.25, 0.02)),
    ("robot.radius_m", (0.5,)),
    ("limits.final_range_m", (1.5, 2.0, 3.0)),
    ("limits.final_deg", (1.5,)),
    ("limits.cone_deg", (1.5,)),
    ("limits.cone_range_m", (0.5,)),
    ("limits.keepout_m", (0.75,)),
    ("limits.keepout_release_m", (1.5,)),
    ("robot.reach_max_m", (1.5, 2.0, 3.0)),
    ("limits.reach_max_m", (1.5, 2.0, 3.0)),
    ("limits.speed_max_mps", (2.0, 8.0, 64.0, 1000.0)),
    ("limits.contact_accel_mps2", (2.0,)),
    ("robot.accel_max_mps2", (2.0, 4.0)),
    ("robot.accel_axes_mps2", (2.0, 4.0)),
    ("robot.thrust_max_n", (2.0, 4.0)),
    ("robot.thrust_axes_n", (2.0, 4.0)),
    ("plan.a_max_mps2", (2.0, 4.0)),
    ("plan.horizon_s", (2.0, 4.0)),
)
LATER_BEGINS_S = (1.0, 3.0, 10.0)
MOST_CHANGES = 3  # largest number of settings that are named
EPILOG = """\b
Examples:
  avsreplay plan results/                          from t_1 on, with the run's settings
  avsreplay plan results/ --at 10 --a-max 0.02
  avsreplay plan results/ --cone-deg 30 --final-deg 8 --speed-max 0.4
  avsreplay plan results/ --final-deg 15 --clearance 0.1 \\
      --set supervisor.sigmas=2 --set robot.thrust_noise=0.02
  avsreplay plan results/ --robot robot.toml
  avsreplay plan results/ --export plan.csv --json
  avsreplay plan results/ --animate flight.html    the flight in 3D, with a slider

\b
Exit codes: 0 ok (also where no plan was found; the status says so),
            2 usage, 3 unreadable input."""


# parameters that do not change the approach that is assessed
_OF_THE_SAME_FLIGHT = frozenset(
    ("result", "samples", "every_s", "export", "animate", "overwrite", "as_json")
)


@click.command("plan", cls=Command, epilog=EPILOG)
@click.argument("result", type=click.Path(path_type=Path))
@click.option(
    "--at", "at_s", type=float, help="Plan from this time [s]; default: from convergence."
)
@setting_option("--a-max", "a_max_mps2", type=float, owner=PLAN)
@setting_option("--horizon", "horizon_s", type=float, owner=PLAN)
@setting_option("--latency", "latency_s", type=float, owner=PLAN, common=False)
@setting_option("--period", "replan_period_s", type=float, owner=PLAN, common=False)
@setting_option("--from", "robot_position_m", type=Numbers(3), metavar="X,Y,Z", owner=PLAN)
@setting_option("--cone-deg", type=float, owner=LIMITS)
@setting_option("--cone-range", "cone_range_m", type=float, owner=LIMITS, common=False)
@setting_option("--final-deg", type=float, owner=LIMITS)
@setting_option("--final-range", "final_range_m", type=float, owner=LIMITS, common=False)
@setting_option("--speed-max", "speed_max_mps", type=float, owner=LIMITS)
@setting_option("--contact-accel", "contact_accel_mps2", type=float, owner=LIMITS, common=False)
@setting_option("--keepout", "keepout_m", type=float, owner=LIMITS)
@setting_option("--keepout-release", "keepout_release_m", type=float, owner=LIMITS, common=False)
@setting_option("--clearance", "clearance_m", type=float, owner=LIMITS)
@robot_option()
@click.option(
    "--set",
    "assignments",
    multiple=True,
    metavar="KEY=VALUE",
    help="Change a setting of plan, limits, robot or supervisor.",
)
@click.option(
    "--samples",
    type=click.IntRange(1),
    default=64,
    show_default=True,
    help="Number of draws from the belief.",
)
@click.option(
    "--flights",
    type=click.IntRange(1),
    default=16,
    show_default=True,
    help=(
        "Number of simulated flights, to targets drawn from the belief, where RESULT ends before"
        " the capture."
    ),
)
@click.option(
    "--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of the draws."
)
@click.option(
    "--every",
    "every_s",
    type=float,
    help="Interval of the plans compared with ground truth [s]; default: 2, with limits 10.",
)
@click.option(
    "--extent",
    "extent_m",
    type=float,
    help="Extent of the target [m], if the result does not contain it.",
)
@click.option(
    "--export", type=click.Path(path_type=Path), help="Write t, r, v, u of the plan as CSV."
)
@click.option(
    "--animate", type=click.Path(path_type=Path), help="Write a page with the flight in 3D as HTML."
)
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document and nothing else.")
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
    animate: Path | None,
    overwrite: bool,
    as_json: bool,
    **flags: Any,
) -> None:
    """Plan the capture from RESULT, a directory written by 'avsreplay run -o'.

    The saved beliefs are used and nothing is replayed. The output contains the plan, its
    distribution over the belief, the decisions of the supervisor and, if the log has ground truth,
    the errors of plans made at regular intervals. \f Raises:
        UsageError: an option or setting is invalid, or --export has no plan.  UnreadableInput:
            RESULT cannot be read.
    """  # noqa: D301
    from dataclasses import replace

    from avsreplay.cli.plan_output import Answer, document, print_answer
    from avsreplay.config import robot_settings
    from avsreplay.errors import UsageError
    from avsreplay.plan.arm import with_arm
    from avsreplay.saved_result import load_saved, with_settings

    for name, value in (("--every", every_s), ("--extent", extent_m)):
        if value is not None and not 1e-6 <= value <= 1e6:
            raise UsageError(
                f"{value:g} is not in the range 1e-6 to 1e6", where=name, hint="correct the option"
            )
    check_outputs("export", "animate", overwrite=overwrite)
    if export:
        check_suffix(export, ".csv", ".txt")
    if animate:
        check_suffix(animate, *HTML)
    of_robot = () if robot_file is None else robot_settings(robot_file)
    saved = with_settings(load_saved(result, extent_m), (*of_robot, *assignments))
    for line in saved.warnings:
        click.echo(f"avsreplay: warning: {line}", err=True)
    robot, arm = with_arm(saved.robot)
    planning = _planning(replace(saved, robot=robot), flags, arm)
    index = saved.index_at(at_s)
    made = _usable(lambda: planning.stated(index, planning.plan_at(index)))
    changes = [] if made.found else _changes(planning, saved, flags, index)
    spread = _usable(lambda: planning.spread_at(index, made, samples, seed)) if made.found else None
    flown, actions = (None, ()) if _asked() else planning.recorded()
    if flown is None:
        flown, actions = _usable(lambda: planning.assess(index, flights, seed))
    joints = _usable(lambda: planning.joints(index, made))
    period_s = every_s or (10.0 if planning.limits.any else 2.0)
    hindsight = _usable(lambda: planning.hindsight(period_s))
    if export:
        _export(planning, made, export)
    at_s = saved.rows[index].t_s
    answer = Answer(planning, at_s, made, flown, spread, joints, hindsight, actions, changes)
    if animate:
        click.echo(_animate(answer, index, animate), err=True)
    if as_json:
        click.echo(document(answer), nl=False)
    else:
        print_answer(answer)


def _asked() -> bool:
    """Whether an option is given that changes the flight, whose assessment the run has made."""
    from click.core import ParameterSource

    context = click.get_current_context()
    given = {
        name
        for name in context.params
        if context.get_parameter_source(name) is not ParameterSource.DEFAULT
    }
    return bool(given - _OF_THE_SAME_FLIGHT)


def _usable(action: Any) -> Any:
    """Return the result of an action; a value that the planner rejects is an error of the user."""
    from avsreplay.errors import UsageError

    try:
        return action()
    except ValueError as error:
        context, name = click.get_current_context(), getattr(error, "name", "")
        if context.params.get(name) is not None:  # the option that the user gave
            option = next(param.opts[0] for param in context.command.params if param.name == name)
            raise UsageError(
                str(error).replace(name, option, 1), hint="correct the option"
            ) from None
        raise UsageError(
            str(error), hint="correct the option, or the setting in run.json"
        ) from None


def _planning(saved: Saved, flags: dict[str, Any], arm: Arm | None) -> Replanning:
    from avsreplay.replan import Replanning

    params, limits = _usable(lambda: _given(saved, flags))
    made: Replanning = _usable(lambda: Replanning(saved, params, limits, saved.supervisor, arm))
    return made


def _given(saved: Saved, flags: dict[str, Any]) -> tuple[PlanParams, Limits]:
    """Return the settings of the result with the options of the command, which take precedence."""
    from dataclasses import fields, replace

    from avsreplay.plan.rendezvous import PlanParams

    given = {name: value for name, value in flags.items() if value is not None}
    of_plan = {f.name for f in fields(PlanParams)}
    params = replace(saved.plan, **{k: v for k, v in given.items() if k in of_plan})
    return params, replace(saved.limits, **{k: v for k, v in given.items() if k not in of_plan})


def _changes(
    planning: Replanning, saved: Saved, flags: dict[str, Any], index: int
) -> list[PossibleChange]:
    """Return single changes with which a plan is found: of settings, then of the instant."""
    return [*_other_settings(planning, saved, flags, index), *_later_begin(planning, saved, index)]


def _other_settings(
    planning: Replanning, saved: Saved, flags: dict[str, Any], index: int
) -> list[PossibleChange]:
    """At most MOST_CHANGES single settings with another value, with each of which a plan is
    found.
    """
    from dataclasses import replace

    from avsreplay.cli.plan_output import PossibleChange
    from avsreplay.errors import UsageError
    from avsreplay.saved_result import with_settings

    options = {p.name: p.opts[0] for p in click.get_current_context().command.params}
    params, limits = _given(saved, flags)
    tables = {"plan": params, "limits": limits.resolved(saved.extent_m), "robot": planning.robot}
    out: list[PossibleChange] = []
    for key, factors in CHANGES:
        table, name = key.split(".")
        before = getattr(tables[table], name)
        for factor in factors if before and len(out) < MOST_CHANGES else ():
            value, number = _scaled(before, factor)
            given: dict[str, Any] = {name: number} if table == "robot" else {}
            others = {k: v for k, v in flags.items() if k != name}
            try:
                robot = replace(planning.robot, **given)
                settings = () if table == "robot" else (f"{key}={value}",)
                changed = replace(with_settings(saved, settings), robot=robot)
                made = _planning(changed, others, planning.arm).plan_at(index)
            except (ValueError, UsageError):  # the changed value contradicts another one
                continue
            if made.found:
                option = f"{options[name]} {value}" if name in options else f"--set {key}={value}"
                out.append(PossibleChange(key, option, saved.rows[index].t_s, made))
                break
    return out


def _later_begin(planning: Replanning, saved: Saved, index: int) -> list[PossibleChange]:
    """The first later instant at which a plan is found, if there is one."""
    from itertools import islice

    from avsreplay.cli.plan_output import PossibleChange
    from avsreplay.tables import column_of

    for later_s in LATER_BEGINS_S:
        at_s = saved.rows[index].t_s + later_s
        known = zip(column_of(saved.rows, "t_s"), column_of(saved.rows, "converged"), strict=True)
        later_ones = (k for k, (t_s, flag) in enumerate(known) if t_s >= at_s and flag)
        for later in islice(later_ones, 1):
            made = planning.plan_at(later)
            if made.found:
                at_s = saved.rows[later].t_s
                return [PossibleChange("--at", f"--at {at_s:.2f}", at_s, made)]
    return []


def _scaled(value: Any, factor: float) -> tuple[str, Any]:
    """Return a number, or each number of a tuple, times a factor with two digits, as a text and as
    a value.
    """
    if isinstance(value, tuple):
        texts = [f"{factor * x:.2g}" for x in value]
        return f"[{','.join(texts)}]", tuple(float(text) for text in texts)
    return f"{factor * value:.2g}", float(f"{factor * value:.2g}")


def _export(planning: Replanning, made: Plan, path: Path) -> None:
    import numpy as np

    from avsreplay.errors import UsageError
    from avsreplay.files import output_text

    if not made.found:
        raise UsageError(
            "there is no plan to export", where=str(path), hint=f"its status is {made.status.value}"
        )
    flown = planning.path(made)
    times = np.append(np.arange(0.0, made.t_go_s, 0.1), made.t_go_s)
    values = np.column_stack([times, *flown.at(times), flown.thrust(times)])
    names = [
        "t_s",
        *(f"{q}{c}_{u}" for q, u in (("r", "m"), ("v", "mps"), ("u", "mps2")) for c in "xyz"),
    ]
    with output_text(path) as stream:
        lines = [",".join(names), *(",".join(repr(float(v)) for v in row) for row in values)]
        stream.write("\n".join(lines) + "\n")


def _animate(answer: Answer, index: int, path: Path) -> str:
    """Write the page of the flight; return one line with the file and its size."""
    from avsreplay.cli.plan_output import plan_facts
    from avsreplay.errors import UsageError
    from avsreplay.files import output_text
    from avsreplay.report.page import build_flight_page

    planning, made = answer.planning, answer.made
    if not made.found:
        raise UsageError(
            "there is no plan to show", where=str(path), hint=f"its status is {made.status.value}"
        )
    facts = plan_facts(planning, answer.at_s, made)
    title = f"{planning.saved.name}: flight planned at {answer.at_s:.2f} s"
    named = dict(facts)
    lines = [f"Capture {named['capture']}: {named['status']}.", f"Robot {planning.robot_line}"]
    page = build_flight_page(title, lines, planning.flight(index, made), facts)
    with output_text(path) as stream:
        stream.write(page)
    return f"{path} ({len(page) / 1e6:.2f} MB)"
