"""``avsreplay run``: replays a log, prints tables, writes a result directory, compares with a golden file."""

from __future__ import annotations

import sys
import time
from contextlib import nullcontext
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from avsreplay.cli.options import PATH, read_options, source_options
from avsreplay.cli.setting_options import run_settings, take_run_settings
from avsreplay.errors import DataLost, UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from avsreplay.report.golden import GoldenResult
    from avsreplay.report.summary import Summary
    from avsreplay.result_dir import ResultDirectory
    from avsreplay.rows import Row
    from avsreplay.run import Job, Listener, Run

EPILOG = """\b
Examples:
  avsreplay run tumble.mcap
  avsreplay run y.mcap --model m.ply --topic /points --truth-topic /truth/pose --init truth -o results/
  avsreplay run tumble.mcap --golden fixtures/tumble.rows.jsonl
  avsreplay run tumble.mcap --set faults.policy=all --set plan.a_max_mps2=0.02 --json

\b
Exit codes: 0 ok, 1 the rows differ from the golden file, 2 usage,
            3 unreadable input, 4 finished but data was lost."""


class _Start(click.ParamType[str | float]):
    """``cold``, ``near``, ``paper`` (initialisation of the estimate) or a number (seconds after the first scan)."""

    name = "mode|seconds"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value in ("cold", "near", "paper"):
            return value
        try:
            return float(value)
        except ValueError:
            self.fail(f"'{value}' is neither cold, near, paper nor a number of seconds", param, ctx)


@click.command("run", epilog=EPILOG)
@click.argument("log", type=PATH)
@run_settings
@click.option(
    "--start", "starts", type=_Start(), multiple=True, help="Initialisation of the estimate, or start time [s]."
)
@source_options
@click.option("--golden", type=PATH, help="Compare with these rows; exit code 1 if they differ.")
@click.option("--update-golden", type=PATH, help="Write the rows to this golden file.")
@click.option(
    "-o",
    "--output",
    type=PATH,
    help="Write rows, trajectories, beliefs and configuration to this directory.",
)
@click.option("--report", "page", is_flag=True, help="Add the HTML page, report.html, to the result directory.")
@click.option("--overwrite", is_flag=True, help="Replace an existing result directory.")
@click.option("--json", "as_json", is_flag=True, help="One JSON document on stdout and nothing else.")
@click.option("--every", "table_every", type=click.IntRange(1), help="Print every N-th scan.")
@click.option("--all", "table_all", is_flag=True, help="Print every scan.")
@click.option("--plain", is_flag=True, help="Print no curves of error and gamma.")
@click.option("--rerun", "to_rerun", is_flag=True, help="Stream the run to a Rerun viewer (needs the extra 'rerun').")
def command(log: Path, **flags: Any) -> None:
    """Replay LOG through registration, filter, fault detector and planner, and print the tables.

    LOG is an MCAP file, a ROS bag or a folder of scans. A log written by 'avsreplay record' needs no option.
    """
    from avsreplay.result_dir import ResultDirectory
    from avsreplay.run import Run

    wanted = Wanted(**{field.name: flags.pop(field.name) for field in fields(Wanted)})
    wanted.check()
    target = ResultDirectory(wanted.output, overwrite=wanted.overwrite) if wanted.output else None
    with Run(_job(log, flags)) as run:
        rows, summary, record, scans_per_s = _replayed(run, target, wanted.to_rerun)
        _print(wanted, rows, summary, record, scans_per_s)
        if wanted.page and wanted.output:
            _page(wanted.output)
        _gate(wanted, rows)
        _report_losses(run)


@dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """The options that select the outputs of a run."""

    golden: Path | None
    update_golden: Path | None
    output: Path | None
    page: bool
    overwrite: bool
    as_json: bool
    table_every: int | None
    table_all: bool
    plain: bool
    to_rerun: bool

    def check(self) -> None:
        """Raise UsageError if two options contradict each other."""
        if self.golden and self.update_golden:
            raise UsageError("--golden and --update-golden exclude each other", hint="give one of them")
        if self.page and self.output is None:
            raise UsageError("--report needs a result directory", hint="add -o DIR")


def _job(log: Path, flags: dict[str, Any]) -> Job:
    from avsreplay.run import Job

    config_file, assignments = take_run_settings(flags)
    starts = flags.pop("starts")
    assignments += tuple(f"estimator.start={mode}" for mode in starts if isinstance(mode, str))
    flags["start_s"] = next((start for start in reversed(starts) if isinstance(start, float)), None)
    return Job(source=log, options=read_options(flags), config_file=config_file, assignments=assignments)


def _replayed(
    run: Run, target: ResultDirectory | None, to_rerun: bool
) -> tuple[list[Row], Summary, dict[str, Any], float]:
    """Replay, and return rows, summary, run record and scans per second; ``target`` receives all results."""
    from avsreplay.cli.progress import tracked
    from avsreplay.result_dir import RerunStream, ResultWriter

    keeper = ResultWriter(target, run.surface, run.registrar) if target else None
    viewer = RerunStream(run.surface) if to_rerun else None
    listeners: list[Listener] = [viewer] if viewer else []
    with keeper or nullcontext():
        begun = time.perf_counter()
        listeners += keeper.listeners if keeper else ()
        if run.config.reference.value == "fit":
            run.fit_reference(tracked)
        rows = list(run.rows(listeners, tracked))
        seconds = max(time.perf_counter() - begun, 1e-9)
        if viewer:
            viewer.close()
        summary = run.summary()
        record = _record(run, summary)
        if keeper:
            keeper.finish(rows, record)
    return rows, summary, record, len(rows) / seconds


def _page(result: Path) -> None:
    from avsreplay.cli.report import write_page

    click.echo(write_page(result, result / "report.html"), err=True)


def _record(run: Run, summary: Summary) -> dict[str, Any]:
    from avsreplay.cli.version import versions
    from avsreplay.report.result import facts_record

    header = run.source.header
    labels = header.labels if header.labels or header.seed is not None else None
    facts = facts_record(labels=labels, truth=run.truth, counts=dict(summary.counts))
    return {**run.facts(), "facts": facts, "versions": versions()}


def _print(wanted: Wanted, rows: Sequence[Row], summary: Summary, record: dict[str, Any], scans_per_s: float) -> None:
    if wanted.as_json:
        from avsreplay.report.export import dump_document

        click.echo(dump_document(rows, summary, record), nl=False)
        return
    from avsreplay.report.summary_tables import print_tables
    from avsreplay.report.table import make_console

    choice = {"every": wanted.table_every, "show_all": wanted.table_all, "plain": wanted.plain}
    print_tables(make_console(), rows, summary, scans_per_s=scans_per_s, **choice)  # type: ignore[arg-type]


def _gate(wanted: Wanted, rows: Sequence[Row]) -> None:
    from avsreplay.report.golden import compare_golden, update_golden

    if wanted.update_golden:
        update_golden(wanted.update_golden, rows)
        click.echo(f"golden rows written: {wanted.update_golden} ({len(rows)} scans)", err=True)
    if wanted.golden:
        result = compare_golden(wanted.golden, rows)
        if not result.ok:
            _print_differences(result, to_stderr=wanted.as_json)
        result.check(str(wanted.golden))
        click.echo(f"golden rows agree: {wanted.golden} ({result.rows} scans)", err=True)


def _print_differences(result: GoldenResult, *, to_stderr: bool) -> None:
    from avsreplay.report.comparison_tables import golden_table
    from avsreplay.report.table import make_console, print_table

    print_table(make_console(sys.stderr if to_stderr else sys.stdout), golden_table(result))


def _report_losses(run: Run) -> None:
    losses = run.source.losses
    if losses:
        what = f"{len(losses)} damaged places were left out, the first: {losses[0].what}"
        raise DataLost(what, where=str(run.job.source), hint="see 'avsreplay doctor'")
