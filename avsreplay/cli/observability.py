"""``avsreplay observability``: the observability Gramian of a log for three sets of estimated
parameters.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from avsreplay.cli.config import Command
from avsreplay.cli.options import PATH, read_options, report_losses, source_options
from avsreplay.errors import counted

if TYPE_CHECKING:
    from avsreplay.estimate.initialise import PoseFix
    from avsreplay.geometry import Array
    from avsreplay.monitor.gramian import Gramian
    from avsreplay.records import Belief, State
    from avsreplay.rows import Row
    from avsreplay.run import ReplayedScan, Run
    from avsreplay.score import Reference

OBSERVABILITY_WIDTH_CHARACTERS = 100
SIGMA_HEADS = {"two": "two sigma", "three": "three sigma", "known": "all known"}

EPILOG = """\b
Examples:
  avsreplay observability tumble.mcap
  avsreplay observability y.mcap --model m.ply --init truth --json

\b
The log is replayed, one motion is fitted to all healthy poses, and the
observability Gramian is summed along that motion: with sigma1 and sigma2 as
parameters, with three independent sigma, and with all parameters known.
The columns ogm_rank and ogm_log10_cond of 'run' are the same Gramian along
the motion fitted to the poses up to that scan, and agree with these once that
fit has converged. The keys of the JSON document end in _fitted_motion.

\b
Below the table are the directions that are not observed, each once with its
axis (of the body for attitude, rate and fixture, of the camera for the centre
of mass), and the least observed of the others. A direction of several states
is a combination that the poses do not separate."""


@click.command("observability", cls=Command, epilog=EPILOG)
@click.argument("log", type=PATH)
@click.option(
    "--init",
    metavar="log|truth|auto|POSE",
    help="First pose; POSE is x,y,z,qx,qy,qz,qw of {C} in {A}.",
)
@click.option(
    "--set",
    "assignments",
    multiple=True,
    metavar="A.B=C",
    help="Change one setting; may be repeated.",
)
@source_options
@click.option(
    "--marks", type=click.IntRange(2, 200), default=12, show_default=True, help="Rows of the table."
)
@click.option(
    "--weakest",
    type=click.IntRange(0, 20),
    default=3,
    show_default=True,
    help="Number of weakly observed directions to describe.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document and nothing else.")
def observability_command(log: Path, marks: int, weakest: int, as_json: bool, **flags: Any) -> None:
    """Show which states and parameters the measurements of LOG determine.

    \f
    Raises:
        DataLost: a part of LOG could not be read.
    """  # noqa: D301
    from avsreplay.run import Run

    with Run(_job(log, flags)) as run:
        found = _document(run, marks, weakest)
    if as_json:
        click.echo(json.dumps(found, indent=2))
    else:
        _print(found)
    report_losses(run.source)


def _job(log: Path, flags: dict[str, Any]) -> Any:
    from avsreplay.run import Job
    from avsreplay.toml_document import Assignment, toml_value

    init, assignments = flags.pop("init"), flags.pop("assignments")
    more: tuple[str, ...] = ("plan.enabled=false",)
    if init is not None:
        more = (Assignment(f"init={toml_value(init)}", f"--init {init}"), *more)
    return Job(source=log, options=read_options(flags), assignments=(*assignments, *more))


def _document(run: Run, marks: int, weakest: int) -> dict[str, Any]:
    from avsreplay.score import HealthyPoses

    poses = HealthyPoses(run.estimator)
    beliefs: dict[int, Belief] = {}
    scales: list[Array] = []

    def listen(scan: ReplayedScan) -> None:
        poses.add(scan.state, scan.outcome)
        beliefs[scan.outcome.belief.t_ns] = scan.outcome.belief
        scales.append(scan.state.monitors.gramian.scale)

    rows = list(run.rows([listen]))
    reference = poses.reference()
    inside = [row for row in rows if reference.epoch_ns <= row.t_ns <= reference.end_ns]
    start = run.estimator.frame.state_into(
        _in_axes_of(beliefs[inside[-1].t_ns], reference), reference.epoch_ns
    )
    lines, ends = _summed(
        inside, start, {fix.scan_ns: fix for fix in poses.store.fixes()}, scales[0]
    )
    keep = sorted({round(k * (len(lines) - 1) / (marks - 1)) for k in range(marks)})
    from avsreplay.estimate.measurement import BLOCKS_OF
    from avsreplay.monitor.gramian import unobserved
    from avsreplay.monitor.gramian import weakest as least

    return {
        "log": Path(run.job.source).name,
        "healthy_scans": sum(row.gamma for row in rows),
        "lines": [lines[k] for k in keep],
        "unobserved": {name: list(unobserved(end, BLOCKS_OF[name])) for name, end in ends.items()},
        "weakest": {name: list(least(end, weakest, BLOCKS_OF[name])) for name, end in ends.items()},
    }


def _in_axes_of(belief: Belief, reference: Reference) -> State:
    """The reference motion at its epoch, with the principal axes in the order nearest to that of an
    estimate.
    """
    from avsreplay.estimate.chart import nearest_permutation
    from avsreplay.estimate.dynamics import propagate_state

    end, _ = nearest_permutation(belief, reference.at(belief.t_ns))
    return propagate_state(end, (reference.epoch_ns - belief.t_ns) * 1e-9)[0]


def _summed(
    rows: list[Row], x: State, fixes: dict[int, PoseFix], one_sigma: Array
) -> tuple[list[dict[str, Any]], dict[str, Gramian]]:
    """A record per scan along the motion that begins with ``x`` at the first of them, and the
    Gramians at the end.
    """
    from avsreplay.estimate.measurement import in_camera, prior_1s, step_of_sets
    from avsreplay.monitor.gramian import gramian, measure, observe

    t_ns = rows[0].t_ns
    folds = {name: gramian(scale) for name, scale in prior_1s(one_sigma, x.sigma).items()}
    lines = []
    for row in rows:
        x, steps = step_of_sets(x, (row.t_ns - t_ns) * 1e-9)
        t_ns = row.t_ns
        line: dict[str, Any] = {"t_s": row.t_s, "gamma": row.gamma}
        fix = fixes.get(row.t_ns)
        R = None if fix is None else in_camera(fix.C, fix.T_ac.q, x.q_bc)
        for name, (Phi, H) in steps.items():
            folds[name] = observe(folds[name], Phi, H, R)
            found = measure(folds[name])
            line[name] = {
                "rank_fitted_motion": found.rank,
                "of": found.size,
                "log10_cond_fitted_motion": found.log10_cond,
                "log10_cond_scaled_fitted_motion": found.log10_cond_scaled,
            }
        lines.append(line)
    return lines, folds


def _print(found: dict[str, Any]) -> None:
    from avsreplay.report.table import Table, make_console, print_line, print_table

    motion = f"along one motion fitted to {found['healthy_scans']} scans"
    title = f"Observability Gramian {motion}: rank, log10 of its condition raw and scaled"
    heads = [
        head for name in SIGMA_HEADS.values() for head in (f"{name}\nrank", "\nraw", "\nscaled")
    ]
    rows = tuple(
        (f"{line['t_s']:.1f}", *(cell for name in SIGMA_HEADS for cell in _cells(line[name])))
        for line in found["lines"]
    )
    console = make_console(plain_width=OBSERVABILITY_WIDTH_CHARACTERS)
    note = (
        "ogm_rank and ogm_log10_cond of 'run' are along the motion fitted to the poses up to that"
        " scan"
    )
    print_table(console, Table(title, ("t\n[s]", *heads), rows, align="r", note=note))
    for name, head in SIGMA_HEADS.items():
        lacking, weak = found["unobserved"][name], found["weakest"][name]
        if lacking:
            print_line(
                console,
                f"{head}, {counted(len(lacking), 'direction')} not observed: " + "; ".join(lacking),
            )
        if weak:
            print_line(console, f"{head}, least observed: " + "; ".join(weak))


def _cells(found: dict[str, Any]) -> tuple[str, str, str]:
    from avsreplay.report.table import number

    names = ("log10_cond_fitted_motion", "log10_cond_scaled_fitted_motion")
    raw, scaled = (number(found[name], ".2f") for name in names)
    return f"{found['rank_fitted_motion']}/{found['of']}", raw, scaled
