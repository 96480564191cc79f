"""``avsreplay benchmark``: the table of back ends and estimators over a suite of captures."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from avsreplay.cli.config import Command
from avsreplay.cli.options import PATH
from avsreplay.errors import DataLost, UsageError, counted
from avsreplay.files import check_output

if TYPE_CHECKING:
    from avsreplay.benchmark.campaign import Order
    from avsreplay.benchmark.results import Record
    from avsreplay.benchmark.suite import Suite, SuiteScenario

EPILOG = """\b
Examples:
  avsreplay benchmark --list                               the scenarios
  avsreplay benchmark --quick -o quick/                    every entry, one scenario of each group
  avsreplay benchmark -o whole/ --workers 8                again: only what is not finished is run
  avsreplay benchmark --repeats 1 -o mine/ --backend mine --only clean,wrong-wall
  avsreplay compare quick/benchmark.json mine/benchmark.json

\b
Entries: the back ends horn, reference, kiss, gicp and plane (small_gicp), open3d
and every other one that is installed; the estimators own, paper, ekf and others.

\b
Exit codes: 0 ok, 2 usage, 3 unreadable input, 4 finished, but runs failed."""


def _names(_ctx: click.Context, _param: click.Parameter, text: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in text.split(",") if word.strip())


@click.command("benchmark", cls=Command, epilog=EPILOG)
@click.option("--suite", "suite_name", default="capture-1", show_default=True, help="The suite.")
@click.option("--list", "listed", is_flag=True, help="Print the scenarios and exit.")
@click.option(
    "--quick", is_flag=True, help="One motion of one scenario of each group, or of those of --only."
)
@click.option(
    "--repeats",
    type=click.IntRange(1),
    help="Motions of each simulated scenario; without it as many as the suite has.",
)
@click.option(
    "--backend",
    "backends",
    metavar="NAME,...",
    default="",
    callback=_names,
    help="Back ends; without --estimator with the program's own estimator.",
)
@click.option(
    "--estimator",
    "estimators",
    metavar="NAME,...",
    default="",
    callback=_names,
    help="Estimators; without --backend with the back end horn.",
)
@click.option(
    "--only",
    metavar="NAME,...",
    default="",
    callback=_names,
    help="Groups or scenarios that are run.",
)
@click.option(
    "--seed",
    type=click.IntRange(0, 2**63 - 1),
    help="Draw other motions and other noise; without it the public ones of the suite.",
)
@click.option(
    "--workers",
    type=click.IntRange(0),
    default=2,
    show_default=True,
    help="Number of worker processes; 0 runs in this process, without Dask.",
)
@click.option("--n-scans", type=click.IntRange(1), help="At most this number of scans of each run.")
@click.option(
    "--data",
    type=PATH,
    default=Path("../shared/data"),
    show_default=True,
    help="Folder of the recordings that real scenarios need.",
)
@click.option(
    "-o", "--output", type=PATH, help="Directory of the results; an existing one is continued."
)
@click.option(
    "--details",
    is_flag=True,
    help="Also print the table of each group, and every run of each entry.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document and nothing else.")
@click.option("--markdown", "as_markdown", is_flag=True, help="Print Markdown.")
def benchmark_command(
    suite_name: str,
    listed: bool,
    quick: bool,
    repeats: int | None,
    backends: tuple[str, ...],
    estimators: tuple[str, ...],
    only: tuple[str, ...],
    seed: int | None,
    workers: int,
    n_scans: int | None,
    data: Path,
    output: Path | None,
    details: bool,
    as_json: bool,
    as_markdown: bool,
) -> None:
    """Run a suite of captures for every back end and estimator and print one table.

    Each finished run is saved at once: the same command continues after an interruption. The
    directory holds the logs (logs/), benchmark.json with every run and every score, a plot for each
    group (plots/), and the times (times.json). benchmark.json does not depend on the number of
    workers; 'avsreplay compare' reads two of them.

    \f
    Raises:
        UsageError: no output directory is given, or a name is unknown.
        UnreadableInput: a file cannot be read or written.
        MissingBackend: Dask is not installed.
        DataLost: a run failed.
    """  # noqa: D301
    from avsreplay.benchmark.campaign import Order
    from avsreplay.benchmark.entries import entries_of
    from avsreplay.benchmark.suite import load_suite

    suite = load_suite(suite_name)
    chosen = suite.select(only or (suite.params.quick if quick else ()))
    if listed:
        click.echo(_described(suite, chosen))
        return
    if output is None:
        raise UsageError(
            "no directory for the results",
            where="benchmark",
            hint="add -o DIR, or --list to print the scenarios",
        )
    check_output(output, folder=True)
    order = Order(
        suite=suite,
        scenarios=chosen,
        entries=entries_of(backends, estimators),
        repeats=repeats or (1 if quick else suite.params.repeats),
        seed=suite.params.seed if seed is None else seed,
        n_scans=n_scans,
        data=data.absolute(),
        folder=output.absolute(),
    )
    found, times = _made(order, workers)
    if as_json:
        click.echo(json.dumps(found, indent=1, allow_nan=False))
    elif as_markdown:
        click.echo(_markdown(found, times, details))
    else:
        _print(found, times, details)
    _report_failures(found, output)


def _made(order: Order, workers: int) -> tuple[Record, dict[str, float]]:
    """Make the runs that are not finished and write the results."""
    from avsreplay.benchmark import campaign, results
    from avsreplay.benchmark.plots import write_plots
    from avsreplay.sweep.execute import check_workers
    from avsreplay.sweep.journal import Journal

    os.environ.setdefault("OMP_NUM_THREADS", "1")
    check_workers(workers)
    journal = Journal(order.folder)
    with journal:
        plan = campaign.planned(order, _tracked)
        try:
            campaign.run(plan, journal, workers, _tracked)
        except KeyboardInterrupt:
            done = counted(len(journal.status), "run")
            click.echo(
                f"avsreplay: the results of {done} are saved; the same command continues", err=True
            )
            raise
        found, times = campaign.result(plan, journal)
        results.write(order.folder, found, times)
        write_plots(order.folder / "plots", found)
    return found, times


def _tracked(items: Iterator[Any], total: int, what: str) -> Iterator[Any]:
    from avsreplay.cli.options import tracked

    return tracked(items, total, what)


def _described(suite: Suite, chosen: tuple[SuiteScenario, ...]) -> str:
    import textwrap

    params = suite.params
    lines = [f"{params.name}: {len(params.scenario)} scenarios, sha256 {suite.sha256}"]
    for each in chosen:
        about = " ".join(each.about.split())
        if each.data:
            data = suite.data_of(each)
            about += f" Data: {each.data}. {' '.join(data.fetch.split())} sha256 {data.sha256}"
        lines += ["", f"{each.name} ({each.group})", textwrap.fill(about, 80)]
    return "\n".join(lines)


def _print(found: Record, times: dict[str, float], details: bool) -> None:
    from avsreplay.report.table import make_console, print_table

    console = make_console()
    for table in _tables(found, times, details):
        print_table(console, table, tight=True)


def _markdown(found: Record, times: dict[str, float], details: bool) -> str:
    from avsreplay.report.table import markdown

    return "\n".join(markdown(table) for table in _tables(found, times, details) if table.rows)


def _tables(found: Record, times: dict[str, float], details: bool) -> list[Any]:
    from avsreplay.benchmark import results

    tables = [results.score_table(found, times=times)]
    if details:
        names = list(dict.fromkeys(line["group"] for line in found["table"]))
        tables += [results.score_table(found, name) for name in names if name != "all"]
        entries = [entry["name"] for entry in found["entries"] if not entry["missing"]]
        tables += [results.scenario_table(found, name) for name in entries]
    return [*tables, results.missing_table(found)]


def _report_failures(found: Record, output: Path) -> None:
    failed = [run for run in found["runs"] if run["status"] == "failed"]
    if failed:
        first = failed[0]
        what = (
            f"{counted(len(failed), 'run')} failed, for example {first['entry']} on"
            f" {first['scenario']}: {first['error']}"
        )
        raise DataLost(what, where=str(output), hint="see 'error' in benchmark.json")
