"""``avsreplay compare``: saved results side by side, and a gate."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from avsreplay.report.gate import Outcome
    from avsreplay.report.result import Result

__all__ = ["command"]

EPILOG = """\b
Examples:
  avsreplay compare baseline/ candidate/
  avsreplay compare baseline/ a/ b/ -o compare.html
  avsreplay compare baseline/ candidate/ --gate rules.toml --junit gate.xml --github
  avsreplay compare candidate/ --gate rules.toml          absolute rules need no baseline

\b
A rule:
  [[rule]]
  metric = "pose_pos_rmse_m"
  max = 0.005                    also: min, max_ratio, min_ratio, max_increase, max_decrease
  max_ratio = 1.1                to the baseline, which is the first run
'avsreplay compare --metrics' lists the metrics.

\b
Exit codes: 0 ok, 1 a rule was broken, 2 usage, 3 unreadable input."""


def _list_metrics(ctx: click.Context, _param: click.Parameter, wanted: bool) -> None:
    if not wanted or ctx.resilient_parsing:
        return
    from avsreplay.report.compare import METRICS

    for metric in METRICS:
        click.echo(f"{metric.name:22} {metric.doc}")
    ctx.exit()


@click.command("compare", epilog=EPILOG)
@click.argument("results", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--gate", type=click.Path(path_type=Path), help="TOML with the rules a run must keep; exit 1 if not.")
@click.option("--junit", type=click.Path(path_type=Path), help="Write the gate's outcomes as JUnit XML.")
@click.option("--github", is_flag=True, help="Print the gate's outcomes as GitHub annotations.")
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Write a page with the runs' charts overlaid.")
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
    """Set saved RESULTS side by side: figures, changes, the first scan and column at which they part.

    RESULTS are directories written by 'avsreplay run -o' or their rows.jsonl; the first is the baseline.
    """
    from avsreplay.errors import UsageError
    from avsreplay.report import load_result, make_console
    from avsreplay.report.gate import check_gate

    if (junit or github) and not gate:
        raise UsageError("--junit and --github need --gate", hint="name the rules with --gate rules.toml")
    if output and output.exists() and not overwrite:
        raise UsageError("is already there", where=str(output), hint="name another with -o, or add --overwrite")
    found = _named([load_result(path) for path in results])
    outcomes = _judged(found, gate) if gate else []
    if as_json:
        click.echo(_document(found, outcomes))
    else:
        _print(make_console(), found, outcomes)
    _write(found, outcomes, junit, output)
    if github:
        _annotate(outcomes, to_stderr=as_json)
    check_gate(outcomes)


def _named(found: list[Result]) -> list[Result]:
    """Runs of one name are told apart by a number."""
    from dataclasses import replace

    names = [result.name for result in found]
    return [
        replace(r, name=f"{r.name}#{names[: k + 1].count(r.name)}") if names.count(r.name) > 1 else r
        for k, r in enumerate(found)
    ]


def _judged(found: Sequence[Result], gate: Path) -> list[Outcome]:
    from avsreplay.report.compare import metrics
    from avsreplay.report.gate import judge, load_rules

    return judge(load_rules(gate), [(result.name, metrics(result.summary)) for result in found])


def _print(console: Console, found: Sequence[Result], outcomes: Sequence[Outcome]) -> None:
    from avsreplay.report.compare import first_divergence, metrics
    from avsreplay.report.table.compare import print_comparison, print_divergence, print_gate

    print_comparison(console, [(result.name, metrics(result.summary)) for result in found])
    for other in found[1:]:
        print_divergence(console, found[0].name, other.name, first_divergence(found[0].rows, other.rows))
    if outcomes:
        print_gate(console, outcomes)


def _document(found: Sequence[Result], outcomes: Sequence[Outcome]) -> str:
    import json

    from avsreplay.report.compare import first_divergence, metrics
    from avsreplay.settings import dump

    runs = [{"name": result.name, "metrics": metrics(result.summary)} for result in found]
    for run, result in zip(runs[1:], found[1:], strict=True):
        parted = first_divergence(found[0].rows, result.rows, first=1)
        first = dump(parted.differences[0]) if parted.differences else None
        run["divergence"] = {"cells": parted.count, "by_column": dict(parted.by_column), "first": first}
    whole = {"format": "avsreplay-compare/1", "runs": runs, "gate": dump(list(outcomes))}
    return json.dumps(whole, ensure_ascii=False, allow_nan=False, indent=1)


def _write(found: Sequence[Result], outcomes: Sequence[Outcome], junit: Path | None, output: Path | None) -> None:
    from avsreplay.report.atomic import atomic_text

    if junit:
        from avsreplay.report.gate import junit as junit_xml

        with atomic_text(junit) as stream:
            stream.write(junit_xml(outcomes))
    if output:
        from avsreplay.report.page.comparison import build_comparison

        with atomic_text(output) as stream:
            stream.write(build_comparison(found, outcomes))


def _annotate(outcomes: Sequence[Outcome], *, to_stderr: bool) -> None:
    from avsreplay.report.gate import github_lines

    for line in github_lines(outcomes):
        click.echo(line, err=to_stderr)
