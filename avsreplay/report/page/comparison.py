"""One page of several runs: their figures in a table, their charts one over the other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from avsreplay.report.compare import METRICS, metrics
from avsreplay.report.gate import Outcome
from avsreplay.report.page import frame
from avsreplay.report.page.charts import Chart, Columns, charts, derived, spans
from avsreplay.report.page.html import escape, table
from avsreplay.report.page.packing import pack, values
from avsreplay.report.result import Result

__all__ = ["build_comparison"]


def build_comparison(results: Sequence[Result], outcomes: Sequence[Outcome] = ()) -> str:
    """The page as text. The first run is the baseline; shaded are its flagged scans."""
    columns = [derived(r.rows) for r in results]
    data = {
        "runs": [
            {
                "name": result.name,
                "t": pack(values(result.rows, "t_s"), "f8"),
                "columns": {name: pack(column, "f4") for name, column in own.items()},
            }
            for result, own in zip(results, columns, strict=True)
        ],
        "charts": _overlaid(results, columns),
        "spans": spans(results[0].rows),
        "marks": [],
        "states": None,
        "scene": None,
    }
    names = ", ".join(result.name for result in results)
    return frame("Comparison", f"{len(results)} runs: {names}.{_word(outcomes)}", data, _tables(results, outcomes))


def _word(outcomes: Sequence[Outcome]) -> str:
    if not outcomes:
        return ""
    broken = sum(not o.ok for o in outcomes)
    return f" {broken} of {len(outcomes)} rules broken." if broken else f" All {len(outcomes)} rules hold."


def _overlaid(results: Sequence[Result], columns: Sequence[Columns]) -> list[Chart]:
    """One chart for each line of the single-run charts, a line a run."""
    everything: Columns = {name: column for own in reversed(columns) for name, column in own.items()}
    out = []
    for chart in charts(everything):
        for line in chart["series"]:
            series = [_series(k, r.name, line) for k, r in enumerate(results) if line["column"] in columns[k]]
            title = chart["title"] if len(chart["series"]) == 1 else f"{chart['title']}: {line['label']}"
            levels = chart["levels"] if len(chart["series"]) == 1 else []
            out.append(chart | {"key": line["column"], "title": title, "series": series, "bands": [], "levels": levels})
    return out


def _series(run: int, name: str, line: dict[str, Any]) -> dict[str, Any]:
    return {**line, "run": run, "label": name, "colour": run, "dash": run % 2 == 1}


def _tables(results: Sequence[Result], outcomes: Sequence[Outcome]) -> str:
    figures = [metrics(result.summary) for result in results]
    lines = [
        [escape(m.name), escape(m.doc), *("" if f[m.name] is None else f"{f[m.name]:.5g}" for f in figures)]
        for m in METRICS
        if any(f[m.name] is not None for f in figures)
    ]
    heads = ("metric", "meaning", *(result.name for result in results))
    return table("Figures", heads, lines, numeric=2) + _gate_table(outcomes)


def _gate_table(outcomes: Sequence[Outcome]) -> str:
    lines = [
        [
            escape(o.run),
            '<span class="good">● holds</span>' if o.ok else '<span class="bad">✗ broken</span>',
            escape(o.rule.text),
            escape(o.why),
        ]
        for o in outcomes
    ]
    return table("Gate", ("run", "outcome", "rule", "why"), lines, numeric=9)
