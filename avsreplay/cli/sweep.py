"""``avsreplay sweep``: runs a campaign of many runs and summarises it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import click

from avsreplay.cli.config import Command
from avsreplay.cli.options import PATH
from avsreplay.errors import DataLost, UsageError, counted
from avsreplay.files import check_output

if TYPE_CHECKING:
    from avsreplay.sweep.campaign import RunResult
    from avsreplay.sweep.expansion import Expansion, Task
    from avsreplay.sweep.journal import Journal
    from avsreplay.sweep.summary import SweepSummary

EPILOG = """\b
Examples:
  avsreplay sweep blackouts.toml -o blackouts/ --workers 2
  avsreplay sweep blackouts.toml -o blackouts/               again: only what is not finished is run
  avsreplay sweep blackouts.toml -o blackouts/ --scheduler tcp://head:8786
  avsreplay sweep blackouts.toml --plan                      list the runs
  avsreplay sweep blackouts.toml --run 3f2a91 -o worst/ --report

\b
Exit codes: 0 ok, 2 usage, 3 unreadable input, 4 finished, but runs failed or data was lost."""


@click.command("sweep", cls=Command, epilog=EPILOG)
@click.argument("campaign", type=PATH)
@click.option(
    "-o", "--output", type=PATH, help="Directory of the results; an existing one is continued."
)
@click.option(
    "--workers",
    type=click.IntRange(0),
    default=2,
    show_default=True,
    help="Number of worker processes; 0 runs in this process, without Dask.",
)
@click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Use this Dask scheduler (tcp://host:port) in place of --workers.",
)
@click.option(
    "--dashboard",
    metavar="HOST:PORT",
    default="127.0.0.1:0",
    show_default=True,
    help="Address of the Dask dashboard of --workers; port 0: any free port.",
)
@click.option(
    "--limit", type=click.IntRange(0, 2**63 - 1), help="Make at most this number of runs now."
)
@click.option("--retry-failed", is_flag=True, help="Repeat failed and crashed runs.")
@click.option("--plan", "only_plan", is_flag=True, help="List the runs without starting them.")
@click.option(
    "--run",
    "run_id",
    metavar="ID",
    help="Repeat one run, as 'avsreplay run' does; the first characters of its id suffice.",
)
@click.option(
    "--report",
    "page",
    is_flag=True,
    help="With --run: add the HTML report to the result directory.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document and nothing else.")
def sweep_command(
    campaign: Path,
    output: Path | None,
    workers: int,
    scheduler: str | None,
    dashboard: str,
    limit: int | None,
    retry_failed: bool,
    only_plan: bool,
    run_id: str | None,
    page: bool,
    as_json: bool,
) -> None:
    """Run a CAMPAIGN (a TOML file): a grid, cases or random draws over scenarios, logs and
    settings.

    Each finished run is saved at once: the same command continues after an interruption. Results
    are one row per run (results.parquet), one row per scan (scans.parquet), summary.json and
    report.html; they do not depend on the number of workers.

    \f
    Raises:
        UsageError: no output directory is given, or the campaign is invalid.
        UnreadableInput: a file cannot be read or written.
        MissingBackend: pyarrow or Dask is not installed.
        DataLost: a run failed, crashed or lost data.
    """  # noqa: D301
    from avsreplay.sweep.campaign import load_campaign
    from avsreplay.sweep.execute import check_workers, run_tasks, write_results
    from avsreplay.sweep.expansion import expand
    from avsreplay.sweep.journal import Journal, arrow

    plan = expand(load_campaign(campaign))
    if only_plan:
        click.echo(_plan_text(plan))
        return
    if output is None:
        raise UsageError(
            "no directory for the results",
            where="sweep",
            hint="add -o DIR, or --plan to list the runs",
        )
    if run_id is not None:
        _make_again(plan, run_id, output, page)
        return
    check_output(output, folder=True)
    arrow()  # raises before anything runs, not after
    check_workers(workers, scheduler)
    journal = Journal(output)
    with journal:
        _report_damage(journal)
        if retry_failed:
            journal.forget(("failed", "crashed"))
        waiting = list(islice(_waiting(plan, journal), limit))
        try:
            for result in _tracked(run_tasks(waiting, workers, scheduler, dashboard), len(waiting)):
                journal.add(result)
        except KeyboardInterrupt:
            done = counted(len(journal.status), "run")
            click.echo(
                f"avsreplay: the results of {done} are saved; the same command continues", err=True
            )
            raise
        summary = write_results(plan, journal, output)
    if as_json:
        click.echo(json.dumps(summary.document(), indent=1, allow_nan=False))
    else:
        _print(summary, campaign)
    _report_failures(summary, journal, output)


def _report_damage(journal: Journal) -> None:
    """Print which runs are made again because their results were damaged."""
    again = journal.check_scans()
    if count := len(journal.damaged):
        what = (
            "1 damaged line of the journal was"
            if count == 1
            else f"{count} damaged lines of the journal were"
        )
        where = journal.folder / "journal.damaged"
        click.echo(f"avsreplay: {what} moved to {where}; what they held is made again", err=True)
    if again:
        runs = (
            "1 run are damaged or missing; it is"
            if again == 1
            else f"{again} runs are damaged or missing; they are"
        )
        click.echo(f"avsreplay: the scans of {runs} made again", err=True)


def _report_failures(summary: SweepSummary, journal: Journal, output: Path) -> None:
    if bad := summary.done - summary.status.get("ok", 0):
        worst = next(
            run_id
            for status in ("crashed", "failed", "lossy")
            for run_id, s in journal.status.items()
            if s == status
        )
        parts = ", ".join(
            f"{count} {status}" for status, count in summary.status.items() if status != "ok"
        )
        what = (
            f"{bad} of {counted(summary.done, 'run')} not ok ({parts}), for example:"
            f" {journal.result(worst).error}"
        )
        raise DataLost(
            what, where=str(output), hint="see the columns 'status' and 'error' of results.parquet"
        )


def _make_again(plan: Expansion, run_id: str, output: Path, page: bool) -> None:
    """Make one run as ``avsreplay run`` does, with a result directory."""
    import tempfile

    from avsreplay.cli.run import run_command
    from avsreplay.sweep.execute import log_of

    found = {
        point.task.id: point.task for point in plan.points() if point.task.id.startswith(run_id)
    }
    if len(found) != 1:
        what = f"{len(found)} runs of the campaign have an id that begins with '{run_id}'"
        raise UsageError(what, where="--run", hint="take the id from results.parquet, in full")
    (task,) = found.values()
    with tempfile.TemporaryDirectory(prefix="avsreplay-") as folder:
        arguments = [
            str(log_of(task, Path(folder))),
            "-o",
            str(output),
            *(["--report"] if page else []),
        ]
        arguments += ["--model", task.model] if task.log and task.model else []
        arguments += [word for assignment in task.assignments for word in ("--set", assignment)]
        run_command.main(arguments, standalone_mode=False)


def _waiting(plan: Expansion, journal: Journal) -> Iterator[Task]:
    """The runs that are not finished, each task once."""
    seen: set[str] = set()
    for point in plan.points():
        if point.task.id not in journal and point.task.id not in seen:
            seen.add(point.task.id)
            yield point.task


def _tracked(items: Iterator[RunResult], total: int) -> Iterator[RunResult]:
    from avsreplay.cli.options import tracked

    return tracked(items, total, "runs")


def _plan_text(plan: Expansion) -> str:
    campaign = plan.loaded.campaign
    from avsreplay.sweep.page import words

    lines = [
        f"{campaign.name}: {len(plan)} runs, {len(plan.cells)} combinations x {campaign.repeats}"
        " repeats"
    ]
    lines += [f"  {words(cell)}" for cell in plan.cells]
    lines += [f"  drawn for every repeat: {draw.key} ({draw.kind.value})" for draw in campaign.draw]
    return "\n".join(lines)


def _print(summary: SweepSummary, campaign: Path) -> None:
    from avsreplay.report.table import make_console, print_line, print_table
    from avsreplay.sweep.page import (
        KIND_PARTS,
        cell_table,
        columns_of,
        detector_table,
        kinds_table,
        worst_table,
    )

    console = make_console()
    status = ", ".join(f"{count} {word}" for word, count in summary.status.items())
    print_line(
        console,
        f"{summary.name}: {summary.done} of {summary.planned} runs done ({status or 'none'})",
    )
    cells = [(number, cell) for number, cell in enumerate(summary.cells) if cell.runs]
    for number, cell in cells:
        print_table(console, cell_table(number, cell))
    if summary.detector is not None and summary.detector.harmful:
        print_table(console, detector_table(summary.detector))
    kinds = kinds_table(cells)
    for part in KIND_PARTS:  # side by side they are wider than 80 columns
        print_table(console, columns_of(kinds, part), tight=True)
    if summary.worst:
        print_table(console, worst_table(summary.worst, digits=8))
        run = summary.worst[0].id[:8]
        click.echo(f"to make one again: avsreplay sweep {campaign} --run {run} -o worst/ --report")
