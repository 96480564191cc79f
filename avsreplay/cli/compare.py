"""``avsreplay compare``: compares saved results and applies gate rules."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from avsreplay.cli.config import Command
from avsreplay.cli.options import HTML, PATH, check_outputs, check_suffix, read_result
from avsreplay.errors import DataLost, UsageError, value_class
from avsreplay.files import output_text
from avsreplay.report import gate as gates
from avsreplay.report.compare import METRICS, metrics
from avsreplay.report.conclusion import Conclusion, conclude
from avsreplay.report.result import Result
from avsreplay.settings import dump

if TYPE_CHECKING:
    from avsreplay.report.table import Table

EPILOG = """\b
Examples:
  avsreplay compare baseline/ candidate/
  avsreplay compare baseline/ a/ b/ -o compare.html
  avsreplay compare baseline/ candidate/ --gate rules.toml --junit gate.xml --github
  avsreplay compare baseline/ candidate/ --markdown >> "$GITHUB_STEP_SUMMARY"
  avsreplay compare candidate/ --gate rules.toml          a single run: absolute rules only

\b
A rule:
  [[rule]]
  metric = "pose_pos_rmse_m"
  max = 0.005                    also: min, max_ratio, min_ratio, max_increase, max_decrease
  max_ratio = 1.1                relative to the baseline, which is the first run
'avsreplay compare --metrics' lists the metrics.

\b
Exit codes: 0 ok, 1 a rule was broken, 2 usage, 3 unreadable input,
            4 the rules hold, but a result cannot be verified or its log was damaged."""


def _list_metrics(ctx: click.Context, _param: click.Parameter, wanted: bool) -> None:
    if not wanted or ctx.resilient_parsing:
        return
    for metric in METRICS:
        click.echo(f"{metric.name:22} {metric.doc}")
    ctx.exit()


@click.command("compare", cls=Command, epilog=EPILOG)
@click.argument("results", nargs=-1, required=True, type=PATH)
@click.option(
    "--gate",
    type=PATH,
    help="TOML file with the rules that a run must satisfy; exit code 1 if one is broken.",
)
@click.option("--junit", type=PATH, help="Write the outcomes of the rules as JUnit XML.")
@click.option(
    "--github", is_flag=True, help="Print the outcomes of the rules as GitHub annotations."
)
@click.option(
    "-o",
    "--output",
    type=PATH,
    help="Write an HTML page with the charts of the runs on common axes.",
)
@click.option("--overwrite", is_flag=True, help="Replace an existing page.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document and nothing else.")
@click.option(
    "--markdown", "as_markdown", is_flag=True, help="Print Markdown, for the summary of a CI job."
)
@click.option("--all", "show_all", is_flag=True, help="Also print the metrics that are equal.")
@click.option(
    "--metrics",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_list_metrics,
    help="List the metrics and exit.",
)
def compare_command(
    results: tuple[Path, ...],
    gate: Path | None,
    junit: Path | None,
    github: bool,
    output: Path | None,
    overwrite: bool,
    as_json: bool,
    as_markdown: bool,
    show_all: bool,
) -> None:
    """Compare saved RESULTS: a conclusion, the settings that differ, and every metric.

    RESULTS are directories written by 'avsreplay run -o' or their rows.jsonl; the first is the
    baseline. A folder of several results (one per seed) is compared run by run with the baseline's
    runs of the same names. Two files benchmark.json are compared run by run.

    Errors cover all scans, coasting included; a missing value counts as worse. Intervals are 95 %
    bootstrap intervals of the paired difference. A figure of two runs that has no interval is
    neither better nor worse.

    \f
    Raises:
        UsageError: an option needs --gate, an output cannot be written, or a run has no partner in
            the baseline.
        UnreadableInput: a result or the rules cannot be read.
        CheckFailed: a rule of the gate is broken.
    """  # noqa: D301
    if all(path.suffix == ".json" for path in results):
        _compare_benchmarks(results, as_json, as_markdown)
        return
    _check_options(gate, junit or github, output, overwrite)
    rules = gates.load_rules(gate) if gate else ()
    groups = _with_distinct_names([_group(path) for path in results])
    pairs = [(other, _paired(groups[0], other)) for other in groups[1:]]
    conclusions = [conclude(other.name, listed) for other, listed in pairs]
    outcomes = _outcomes(rules, groups[0], pairs)
    if as_json:
        click.echo(_document(groups, conclusions, outcomes))
    elif as_markdown:
        click.echo("\n".join(_markdown(groups, conclusions, outcomes)))
    else:
        _print(groups, conclusions, outcomes, show_all=show_all)
    _write(junit, output, groups, conclusions, outcomes)
    for line in gates.github_lines(outcomes) if github else ():
        click.echo(line, err=as_json or as_markdown)
    gates.check_gate(outcomes)
    if gate:
        _check_sources([run for group in groups for run in group.runs])


def _check_options(
    gate: Path | None, needs_gate: object, output: Path | None, overwrite: bool
) -> None:
    """Raise UsageError where options do not fit to one another or an output cannot be written."""
    if needs_gate and not gate:
        raise UsageError(
            "--junit and --github need --gate", hint="name the rules with --gate rules.toml"
        )
    check_outputs("junit")
    check_outputs("output", overwrite=overwrite)
    if output:
        check_suffix(output, *HTML)


def _compare_benchmarks(paths: Sequence[Path], as_json: bool, as_markdown: bool) -> None:
    """Compare the first of some results of 'avsreplay benchmark' with each other one."""
    from avsreplay.benchmark import results
    from avsreplay.report.table import make_console, markdown, print_line, print_table

    if len(paths) < 2:
        raise UsageError("a single benchmark.json", where="compare", hint="name two of them")
    base, *others = map(results.read, paths)
    for other in others:
        found, (agreeing, count) = results.compared(base, other)
        table = results.difference_table(found)
        sentence = f"{agreeing} of {count} runs agree within {100 * results.AGREE:g} %"
        if as_json:
            click.echo(
                json.dumps(
                    {"agreeing": agreeing, "runs": count, "rows": [each.record for each in found]}
                )
            )
        elif as_markdown:
            click.echo(f"{sentence}\n\n{markdown(table)}")
        else:
            console = make_console()
            print_line(console, sentence)
            print_table(console, table, tight=True)


def _write(
    junit: Path | None,
    page: Path | None,
    groups: Sequence[_Group],
    conclusions: Sequence[Conclusion],
    outcomes: Sequence[gates.RuleOutcome],
) -> None:
    """Write the files that are wanted: the outcomes of the rules, and the page."""
    if junit:
        with output_text(junit) as stream:
            stream.write(gates.junit(outcomes))
    if page:
        from avsreplay.report.page import build_comparison

        first = [group.runs[0] for group in groups]
        with output_text(page) as stream:
            stream.write(build_comparison(first, conclusions, outcomes))


def _check_sources(runs: Sequence[Result]) -> None:
    """Raise DataLost if a run whose rules hold cannot be verified, was interrupted, or rests on a
    damaged log.
    """
    for run in runs:
        if run.losses:
            what = f"the rules hold, but the log of {run.name} was damaged at {run.losses} places"
            raise DataLost(
                what, where="--gate", hint="record it again, or repair it with 'avsreplay doctor'"
            )
        if "interrupted_after" in run.header:
            raise DataLost(
                f"the rules hold, but {run.name} was interrupted", where="--gate", hint="run again"
            )
        if run.unverified and run.whole:
            what = f"the rules hold, but {run.name} cannot be verified: {run.unverified}"
            raise DataLost(what, where="--gate", hint="run again")


@value_class(eq=True)
class _Group:
    """A result, or several (one per seed or log) in a folder."""

    name: str
    runs: tuple[Result, ...]


def _group(path: Path) -> _Group:
    """The result at ``path``, or all results in its subfolders."""
    inside = (
        sorted(found.parent for found in path.glob("*/rows.jsonl"))
        if not (path / "rows.jsonl").is_file()
        else []
    )
    runs = tuple(read_result(folder) for folder in inside or [path])
    return _Group(path.resolve().name if inside else runs[0].name, runs)


def _with_distinct_names(groups: list[_Group]) -> list[_Group]:
    """Runs or groups of the same name get a number."""
    names = [group.name for group in groups]
    so_far: Counter[str] = Counter()
    out = []
    for group in groups:
        so_far[group.name] += 1
        if names.count(group.name) == 1:
            out.append(group)
            continue
        name = f"{group.name}#{so_far[group.name]}"
        out.append(
            _Group(
                name, group.runs if len(group.runs) > 1 else (replace(group.runs[0], name=name),)
            )
        )
    return out


def _paired(base: _Group, other: _Group) -> list[tuple[Result, Result]]:
    """Runs of two groups by name. Raises UsageError if a run has no partner."""
    if len(base.runs) == len(other.runs) == 1:
        return [(base.runs[0], other.runs[0])]
    ours, theirs = ({run.name: run for run in group.runs} for group in (other, base))
    alone = sorted(ours.keys() ^ theirs.keys())
    if alone:
        what = f"the runs cannot be paired by name: {', '.join(alone[:3])} without a partner"
        raise UsageError(
            what, where=f"{base.name}, {other.name}", hint="give both folders the same subfolders"
        )
    return [(theirs[name], ours[name]) for name in sorted(ours)]


def _outcomes(
    rules: Sequence[gates.GateRule],
    base: _Group,
    pairs: Sequence[tuple[_Group, list[tuple[Result, Result]]]],
) -> list[gates.RuleOutcome]:
    """The rules on every run against its own baseline; on the runs themselves where there is
    only one group.
    """
    if not rules:
        return []
    if not pairs:
        return gates.judge(
            rules, [(run.name, metrics(run.summary)) for run in base.runs], baseline=False
        )
    out = []
    for group, listed in pairs:
        for left, right in listed:
            name = group.name if len(listed) == 1 else f"{group.name}/{right.name}"
            out += gates.judge(
                rules, [(base.name, metrics(left.summary)), (name, metrics(right.summary))]
            )
    return out


def _tables(
    groups: Sequence[_Group],
    conclusions: Sequence[Conclusion],
    outcomes: Sequence[gates.RuleOutcome],
    *,
    show_all: bool = False,
) -> list[Table]:
    from avsreplay.report.compare import metrics_table
    from avsreplay.report.conclusion import changes_table, settings_table

    found = [settings_table(c) for c in conclusions]
    found += [changes_table(groups[0].name, c, show_all=show_all) for c in conclusions]
    if not conclusions:
        found += [
            metrics_table(run.name, list(metrics(run.summary).items())) for run in groups[0].runs
        ]
    return [*found, gates.gate_table(outcomes)]


def _print(
    groups: Sequence[_Group],
    conclusions: Sequence[Conclusion],
    outcomes: Sequence[gates.RuleOutcome],
    *,
    show_all: bool,
) -> None:
    from avsreplay.report.golden import divergence_line
    from avsreplay.report.table import make_console, print_line, print_table

    console = make_console()
    for conclusion in conclusions:
        print_line(console, conclusion.sentence)
    console.print()
    for table in _tables(groups, conclusions, outcomes, show_all=show_all):
        print_table(console, table)
    for group, conclusion in zip(groups[1:], conclusions, strict=True):
        if conclusion.divergence and not conclusion.divergence.ok:
            print_line(console, divergence_line(groups[0].name, group.name, conclusion.divergence))


def _markdown(
    groups: Sequence[_Group],
    conclusions: Sequence[Conclusion],
    outcomes: Sequence[gates.RuleOutcome],
) -> list[str]:
    from avsreplay.report.table import escaped, markdown

    signs = {"better": "✅", "same": "✅", "worse": "❌", "mixed": "⚠️", "no evidence": "❔"}
    lines = [f"### {signs[c.word]} {escaped(c.sentence)}\n" for c in conclusions]
    return lines + [
        markdown(table) for table in _tables(groups, conclusions, outcomes) if table.rows
    ]


def _document(
    groups: Sequence[_Group],
    conclusions: Sequence[Conclusion],
    outcomes: Sequence[gates.RuleOutcome],
) -> str:
    records: list[dict[str, Any]] = [
        {
            "name": group.name,
            "runs": [{"name": run.name, "metrics": metrics(run.summary)} for run in group.runs],
        }
        for group in groups
    ]
    for record, conclusion in zip(records[1:], conclusions, strict=True):
        record["conclusion"] = {k: v for k, v in dump(conclusion).items() if k != "divergence"}
        if found := conclusion.divergence:
            first = dump(found.differences[0]) if found.differences else None
            record["divergence"] = {
                "cells": found.count,
                "by_column": dict(found.by_column),
                "first": first,
            }
    whole = {"format": "avsreplay-compare/2", "results": records, "gate": dump(list(outcomes))}
    return json.dumps(whole, ensure_ascii=False, allow_nan=False, indent=1)
