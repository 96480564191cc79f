"""``avsreplay compare``: compares saved results and applies gate rules."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import click

from avsreplay.cli.options import PATH
from avsreplay.errors import UsageError
from avsreplay.report import gate as gates
from avsreplay.report.atomic import atomic_text
from avsreplay.report.compare import METRICS, first_divergence, metrics
from avsreplay.report.result import Result, load_result
from avsreplay.settings import dump

EPILOG = """\b
Examples:
  avsreplay compare baseline/ candidate/
  avsreplay compare baseline/ a/ b/ -o compare.html
  avsreplay compare baseline/ candidate/ --gate rules.toml --junit gate.xml --github
  avsreplay compare candidate/ --gate rules.toml          a single run: absolute rules only

\b
A rule:
  [[rule]]
  metric = "pose_pos_rmse_m"
  max = 0.005                    also: min, max_ratio, min_ratio, max_increase, max_decrease
  max_ratio = 1.1                relative to the baseline, which is the first run
'avsreplay compare --metrics' lists the metrics.

\b
Exit codes: 0 ok, 1 a rule was broken, 2 usage, 3 unreadable input."""


def _list_metrics(ctx: click.Context, _param: click.Parameter, wanted: bool) -> None:
    if not wanted or ctx.resilient_parsing:
        return
    for metric in METRICS:
        click.echo(f"{metric.name:22} {metric.doc}")
    ctx.exit()


@click.command("compare", epilog=EPILOG)
@click.argument("results", nargs=-1, required=True, type=PATH)
@click.option(
    "--gate",
    type=PATH,
    help="TOML file with the rules that a run must satisfy; exit code 1 if one is broken.",
)
@click.option("--junit", type=PATH, help="Write the outcomes of the rules as JUnit XML.")
@click.option("--github", is_flag=True, help="Print the outcomes of the rules as GitHub annotations.")
@click.option(
    "-o",
    "--output",
    type=PATH,
    help="Write an HTML page with the charts of the runs over each other.",
)
@click.option("--overwrite", is_flag=True, help="Replace an existing page.")
@click.option("--json", "as_json", is_flag=True, help="One JSON document on stdout and nothing else.")
@click.option(
    "--metrics",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_list_metrics,
    help="List the metrics and exit.",
)
def command(
    results: tuple[Path, ...],
    gate: Path | None,
    junit: Path | None,
    github: bool,
    output: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Compare saved RESULTS: metrics, changes, and the first scan and column at which they differ.

    RESULTS are directories written by 'avsreplay run -o' or their rows.jsonl; the first is the baseline.
    """
    if (junit or github) and not gate:
        raise UsageError("--junit and --github need --gate", hint="name the rules with --gate rules.toml")
    if output and output.exists() and not overwrite:
        raise UsageError("already exists", where=str(output), hint="name another with -o, or add --overwrite")
    runs = _with_distinct_names([load_result(path) for path in results])
    figures = [(run.name, metrics(run.summary)) for run in runs]
    outcomes = gates.judge(gates.load_rules(gate), figures) if gate else []
    if as_json:
        click.echo(_document(runs, outcomes))
    else:
        _print(runs, outcomes)
    _write(runs, outcomes, junit, output)
    for line in gates.github_lines(outcomes) if github else ():
        click.echo(line, err=as_json)
    gates.check_gate(outcomes)


def _with_distinct_names(runs: list[Result]) -> list[Result]:
    """Runs of the same name get a number."""
    names = [run.name for run in runs]
    so_far: Counter[str] = Counter()
    out = []
    for run in runs:
        so_far[run.name] += 1
        out.append(replace(run, name=f"{run.name}#{so_far[run.name]}") if names.count(run.name) > 1 else run)
    return out


def _print(runs: Sequence[Result], outcomes: Sequence[gates.RuleOutcome]) -> None:
    from avsreplay.report.comparison_tables import comparison_tables, divergence_line, gate_table
    from avsreplay.report.table import make_console, print_line, print_table

    console, base = make_console(), runs[0]
    for table in comparison_tables([(run.name, metrics(run.summary)) for run in runs]):
        print_table(console, table)
    for other in runs[1:]:
        print_line(console, divergence_line(base.name, other.name, first_divergence(base.rows, other.rows)))
    print_table(console, gate_table(outcomes))


def _document(runs: Sequence[Result], outcomes: Sequence[gates.RuleOutcome]) -> str:
    records = [{"name": run.name, "metrics": metrics(run.summary)} for run in runs]
    for record, run in zip(records[1:], runs[1:], strict=True):
        found = first_divergence(runs[0].rows, run.rows, first=1)
        first = dump(found.differences[0]) if found.differences else None
        record["divergence"] = {"cells": found.count, "by_column": dict(found.by_column), "first": first}
    whole = {"format": "avsreplay-compare/1", "runs": records, "gate": dump(list(outcomes))}
    return json.dumps(whole, ensure_ascii=False, allow_nan=False, indent=1)


def _write(
    runs: Sequence[Result], outcomes: Sequence[gates.RuleOutcome], junit: Path | None, output: Path | None
) -> None:
    if junit:
        with atomic_text(junit) as stream:
            stream.write(gates.junit(outcomes))
    if output:
        from avsreplay.report.page import build_comparison

        with atomic_text(output) as stream:
            stream.write(build_comparison(runs, outcomes))
