"""Tables of several runs: their conclusion and metrics, a gate's outcomes, differences from a golden file."""

from __future__ import annotations

from collections.abc import Sequence

from avsreplay.report.compare import METRICS
from avsreplay.report.conclusion import HEADLINES, Change, Conclusion
from avsreplay.report.gate import RuleOutcome
from avsreplay.report.golden import GoldenResult
from avsreplay.report.table import Table, TableCell, facts_table, number

_MARKS = {"better": "good", "worse": "bad"}


def settings_table(conclusion: Conclusion) -> Table:
    """The settings in which a run differs from the baseline."""
    texts = conclusion.settings or ("none",)
    return facts_table(f"Settings of {conclusion.name} that differ", [("setting", text) for text in texts])


def changes_table(baseline: str, conclusion: Conclusion, *, show_all: bool = False) -> Table:
    """The metrics of a run against those of the baseline, with a word on each.

    Without ``show_all`` the table has the main metrics and those that changed.
    """
    shown = [c for c in conclusion.changes if show_all or c.metric in HEADLINES or c.word != "equal"]
    meaning = {m.name: m.doc for m in METRICS}
    rows = tuple(
        (
            change.metric,
            *((meaning[change.metric],) if show_all else ()),
            number(change.base, ".4g"),
            number(change.other, ".4g"),
            change.note or _relative(change),
            "" if change.low is None else f"{change.low:+.2g} to {change.high:+.2g}",
            TableCell(change.word, _MARKS.get(change.word, "")),
        )
        for change in shown
    )
    runs = f", means of {conclusion.pairs} pairs" if conclusion.pairs > 1 else ""
    left_out = len(conclusion.changes) - len(shown)
    return Table(
        f"{conclusion.name} against {baseline}{runs}",
        ("metric", *(("meaning",) if show_all else ()), "baseline", "this", "change", "95 % interval", "conclusion"),
        rows,
        align="llrrrrl" if show_all else "lrrrrl",
        note=f"{left_out} equal metrics are not shown" if left_out else "",
    )


def metrics_table(name: str, figures: Sequence[tuple[str, float | None]]) -> Table:
    """The metrics of a single run."""
    meaning = {m.name: m.doc for m in METRICS}
    rows = tuple((metric, meaning[metric], number(value)) for metric, value in figures if value is not None)
    return Table(name, ("metric", "meaning", "value"), rows, align="llr")


def _relative(change: Change) -> str:
    base, value = change.base, change.other
    if base is None or value is None or base == value:
        return ""
    if base == 0:
        return f"{value - base:+.3g}"
    times = value / base
    return f"x {times:.3g}" if times >= 10.0 else f"{100 * (value - base) / abs(base):+.1f} %"


def divergence_line(baseline: str, other: str, found: GoldenResult) -> str:
    """Where the rows of two runs first differ, in one line."""
    if found.ok:
        return f"{other}: all {found.rows} rows agree with {baseline} within the columns' tolerances"
    first = found.differences[0]
    scan = "every scan" if first.seq is None else f"scan {first.seq}"
    line = f"{other}: {found.count} cells differ from {baseline}, first at {scan}, column {first.column}"
    return f"{line} ({first.expected} against {first.got})"


def gate_table(outcomes: Sequence[RuleOutcome]) -> Table:
    """Every rule and its outcome."""
    rows = tuple(
        (
            TableCell("holds", "good") if o.ok else TableCell("broken", "bad"),
            o.run,
            o.rule.text,
            number(o.value),
            o.why,
        )
        for o in outcomes
    )
    return Table("Gate", ("outcome", "run", "rule", "value", "why"), rows, align="lllrl")


def golden_table(result: GoldenResult) -> Table:
    """The first differences from a golden file, and in the note how many there are in each column."""
    counts = sorted(result.by_column.items(), key=lambda item: (-item[1], item[0]))
    return Table(
        f"Golden: first {len(result.differences)} of {result.count} differences",
        ("scan", "column", "expected", "got", "tolerance"),
        tuple(
            (
                "all" if d.seq is None else str(d.seq),
                d.column,
                "null" if d.expected is None else str(d.expected),
                "null" if d.got is None else str(d.got),
                number(d.tolerance, ".3g", "exact"),
            )
            for d in result.differences
        ),
        align="rlrrr",
        note="by column: " + ", ".join(f"{name} {count}" for name, count in counts[:12]),
    )
