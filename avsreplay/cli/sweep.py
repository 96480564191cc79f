"""``avsreplay sweep``: runs a campaign of many runs and summarises it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import click

from avsreplay.cli.options import PATH
from avsreplay.errors import DataLost, UsageError

if TYPE_CHECKING:
    from avsreplay.sweep import Journal, Plan
    from avsreplay.sweep.plan import Task
    from avsreplay.sweep.summary import SweepSummary
    from avsreplay.sweep.worker import Outcome

EPILOG = """\b
Examples:
  avsreplay sweep blackouts.toml -o blackouts/ --workers 2
  avsreplay sweep blackouts.toml -o blackouts/               again: only unfinished runs are executed
  avsreplay sweep blackouts.toml -o blackouts/ --scheduler tcp://head:8786
  avsreplay sweep blackouts.toml --plan                      list the runs

\b
Exit codes: 0 ok, 2 usage, 3 unreadable input, 4 finished but some runs failed."""


@click.command("sweep", epilog=EPILOG)
@click.argument("campaign", type=PATH)
@click.option("-o", "--output", type=PATH, help="Directory of the results; an existing one is continued.")
@click.option(
    "--workers",
    type=click.IntRange(0),
    default=2,
    show_default=True,
    help="Number of processes; 0 runs in this process without Dask.",
)
@click.option(
    "--scheduler", metavar="ADDRESS", help="Address of a Dask scheduler (tcp://host:port) instead of --workers."
)
@click.option("--limit", type=click.IntRange(0), help="Largest number of runs to execute now.")
@click.option("--retry-failed", is_flag=True, help="Run failed and crashed runs again.")
@click.option("--plan", "only_plan", is_flag=True, help="List the runs and execute none.")
@click.option("--json", "as_json", is_flag=True, help="One JSON document on stdout.")
def command(
    campaign: Path,
    output: Path | None,
    workers: int,
    scheduler: str | None,
    limit: int | None,
    retry_failed: bool,
    only_plan: bool,
    as_json: bool,
) -> None:
    """Run a CAMPAIGN (a TOML file): a grid, a list of cases or random draws over scenarios, logs and settings.

    Each finished run is saved at once: the same command continues after an interruption. Results are one row per run
    (results.parquet), one row per scan (scans.parquet), summary.json and report.html. They do not depend on the number
    of workers.
    """
    from avsreplay.sweep import Journal, execute, expand, load_campaign, write_results
    from avsreplay.sweep.results import arrow

    plan = expand(load_campaign(campaign))
    if only_plan:
        click.echo(_plan_text(plan))
        return
    if output is None:
        raise UsageError("no directory for the results", where="sweep", hint="add -o DIR, or --plan to list the runs")
    arrow()  # a missing library is reported before the first run
    journal = Journal(output / "journal.txt")
    if retry_failed:
        journal.forget(("failed", "crashed"))
    with journal:
        waiting = list(islice(_waiting(plan, journal), limit))
        for outcome in _tracked(execute(waiting, workers, scheduler), len(waiting)):
            journal.add(outcome)
    summary = write_results(plan, journal, output)
    if as_json:
        click.echo(json.dumps(summary.document(), indent=1, allow_nan=False))
    else:
        _print(summary)
    _report_failures(summary, journal, output)


def _report_failures(summary: SweepSummary, journal: Journal, output: Path) -> None:
    if failed := summary.done - summary.status.get("ok", 0):
        first = next(o for o in journal.outcomes() if o.status != "ok")
        what = f"{failed} of {summary.done} runs failed, for example: {first.error}"
        raise DataLost(what, where=str(output), hint="see the column 'error' of results.parquet")


def _waiting(plan: Plan, journal: Journal) -> Iterator[Task]:
    """The unfinished tasks, each once."""
    seen: set[str] = set()
    for point in plan.points():
        if point.task.id not in journal and point.task.id not in seen:
            seen.add(point.task.id)
            yield point.task


def _tracked(items: Iterator[Outcome], total: int) -> Iterator[Outcome]:
    from avsreplay.cli.progress import tracked

    return tracked(items, total, "runs")


def _plan_text(plan: Plan) -> str:
    campaign = plan.loaded.campaign
    from avsreplay.sweep.page import words

    lines = [f"{campaign.name}: {len(plan)} runs, {len(plan.cells)} combinations x {campaign.repeats} repeats"]
    lines += [f"  {words(cell)}" for cell in plan.cells]
    lines += [f"  drawn for every repeat: {draw.key} ({draw.kind.value})" for draw in campaign.draw]
    return "\n".join(lines)


def _print(summary: SweepSummary) -> None:
    from avsreplay.report.table import make_console, print_line, print_table
    from avsreplay.sweep.page import cell_table, detector_table, kinds_table

    console = make_console(plain_width=120)
    status = ", ".join(f"{count} {word}" for word, count in summary.status.items())
    print_line(console, f"{summary.name}: {summary.done} of {summary.planned} runs done ({status or 'none'})")
    cells = [(number, cell) for number, cell in enumerate(summary.cells) if cell.runs]
    for number, cell in cells:
        print_table(console, cell_table(number, cell))
    if summary.detector is not None and summary.detector.harmful:
        print_table(console, detector_table(summary.detector))
    print_table(console, kinds_table(cells), tight=True)
