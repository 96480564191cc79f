"""``avsreplay sweep``: a campaign of many runs."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import click

from avsreplay.errors import DataLost, UsageError

if TYPE_CHECKING:
    from rich.table import Table

    from avsreplay.sweep import Journal, Plan
    from avsreplay.sweep.plan import Task
    from avsreplay.sweep.summary import Cell, Detector, SweepSummary
    from avsreplay.sweep.worker import Outcome

__all__ = ["command"]

EPILOG = """\b
Examples:
  avsreplay sweep blackouts.toml -o blackouts/ --workers 2
  avsreplay sweep blackouts.toml -o blackouts/               again: only what is not done is run
  avsreplay sweep blackouts.toml -o blackouts/ --scheduler tcp://head:8786
  avsreplay sweep blackouts.toml --plan                      what would be run

\b
Exit codes: 0 ok, 2 usage, 3 unreadable input, 4 finished but some runs failed."""


@click.command("sweep", epilog=EPILOG)
@click.argument("campaign", type=click.Path(path_type=Path))
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), help="Directory of the results; taken up again if there."
)
@click.option(
    "--workers", type=click.IntRange(0), default=2, show_default=True, help="Processes; 0: this one, no Dask."
)
@click.option("--scheduler", metavar="ADDRESS", help="A Dask scheduler, as tcp://host:port, in place of --workers.")
@click.option("--limit", type=click.IntRange(0), help="Run at most so many now.")
@click.option("--retry-failed", is_flag=True, help="Run failed and crashed runs again.")
@click.option("--plan", "only_plan", is_flag=True, help="Say what would be run, and run nothing.")
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

    Done runs are kept as they come: the same command takes up where it was stopped or killed. Results are one row a
    run (results.parquet), one row a scan (scans.parquet), summary.json and report.html, and do not depend on the
    workers.
    """
    from avsreplay.sweep import Journal, execute, expand, load_campaign, write_results
    from avsreplay.sweep.results import arrow

    plan = expand(load_campaign(campaign))
    if only_plan:
        click.echo(_plan_text(plan))
        return
    if output is None:
        raise UsageError("no directory for the results", where="sweep", hint="add -o DIR, or --plan to look only")
    arrow()  # said before anything runs, not after
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
    _complain(summary, journal, output)


def _complain(summary: SweepSummary, journal: Journal, output: Path) -> None:
    if failed := summary.done - summary.status.get("ok", 0):
        first = next(o for o in journal.outcomes() if o.status != "ok")
        what = f"{failed} of {summary.done} runs failed, for example: {first.error}"
        raise DataLost(what, where=str(output), hint="see the column 'error' of results.parquet")


def _waiting(plan: Plan, journal: Journal) -> Iterator[Task]:
    """What is not done yet, each task once."""
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
    from rich.console import Console

    console = Console(width=None if sys.stdout.isatty() else 120, highlight=False)
    status = ", ".join(f"{count} {word}" for word, count in summary.status.items())
    console.print(f"{summary.name}: {summary.done} of {summary.planned} runs done ({status or 'none'})")
    for number, cell in enumerate(summary.cells):
        if cell.runs:
            console.print(_cell_table(number, cell))
    if summary.detector is not None and summary.detector.harmful:
        console.print(_detector_table(summary.detector))
    if any(cell.kinds.keys() - {"none"} for cell in summary.cells):
        console.print(_kinds_table(summary))


def _cell_table(number: int, cell: Cell) -> Table:
    from rich.markup import escape
    from rich.table import Table

    from avsreplay.sweep.page import words
    from avsreplay.sweep.summary import HEADLINES

    table = Table(title=escape(f"{number}: {words(cell.values)} ({cell.runs} runs)"), title_justify="left")
    for name in ("", "runs", "5 %", "median", "95 %", "95 % interval"):
        table.add_column(name, justify="left" if not name else "right")
    for name, found in cell.metrics.items():
        if found is not None:
            numbers = (f"{v:.4g}" for v in (found.q05, found.median, found.q95))
            table.add_row(
                escape(HEADLINES[name]),
                str(found.count),
                *numbers,
                f"{found.median_low:.4g} to {found.median_high:.4g}",
            )
    for name, share in cell.rates.items():
        if share is not None:
            span = f"{share.low:.1%} to {share.high:.1%}"
            table.add_row(name, f"{share.successes}/{share.count}", "", f"{share.share:.1%}", "", span)
    if cell.nees is not None:
        nees, band = cell.nees, f"1 is right; {cell.nees.low:.3f} to {cell.nees.high:.3f}"
        table.add_row("NEES per state at the end (mean)", str(nees.count), "", f"{nees.mean_per_dof:.3f}", "", band)
    return table


def _detector_table(detector: Detector) -> Table:
    from rich.table import Table

    heads = ("test", "detected", "others flagged", "area under ROC", "threshold at 1 % false", "detected there")
    table = Table(
        *heads,
        title=f"fault tests over {detector.harmful} harmful and {detector.other} other scans",
        title_justify="left",
    )
    if detector.detected is not None and detector.false is not None:
        table.add_row("rule in force", f"{detector.detected.share:.2%}", f"{detector.false.share:.2%}", "", "", "")
    for name, curve in detector.curves.items():
        if curve is not None:
            threshold, detected = curve.at_one_percent
            table.add_row(f"{name} alone", "", "", f"{curve.area:.4f}", f"{threshold:.4g}", f"{detected:.2%}")
    return table


def _kinds_table(summary: SweepSummary) -> Table:
    """A line a kind of fault and combination; a rule between kinds."""
    from rich.box import SIMPLE
    from rich.table import Table

    from avsreplay.sweep.kinds_table import KIND_HEADS, kind_rows

    title = "by kind of fault: times in s, errors in mm and deg; ~: harmless by its label; none: outside every window"
    table = Table(title=title, title_justify="left", box=SIMPLE, padding=0, pad_edge=False)
    for place, head in enumerate(KIND_HEADS):
        table.add_column(head, justify="right" if place else "left", no_wrap=True)
    last = ""
    for row in kind_rows([(number, cell) for number, cell in enumerate(summary.cells) if cell.runs]):
        if row[0] != last and last:
            table.add_section()
        table.add_row(row[0] if row[0] != last else "", *row[1:])
        last = row[0]
    return table
