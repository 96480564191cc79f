"""Tables of several runs: their figures, a gate's outcomes, differences from a golden file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from avsreplay.report.compare import METRICS
from avsreplay.report.gate import RuleOutcome
from avsreplay.report.golden import GoldenResult
from avsreplay.report.table import Table, TableCell, number

_ABREAST = 3
Figures = tuple[str, Mapping[str, float | None]]
"""A run's name and its metrics by name."""


def comparison_tables(runs: Sequence[Figures]) -> list[Table]:
    """Metrics of the baseline (the first run) and of the others with their change, at most three runs per table."""
    base, others = runs[0], runs[1:]
    starts = range(0, max(len(others), 1), _ABREAST - 1)
    return [comparison_table([base, *others[k : k + _ABREAST - 1]]) for k in starts]


def comparison_table(runs: Sequence[Figures], *, meaning: bool = False) -> Table:
    """One table of all ``runs``; with ``meaning`` a column says what each metric is."""
    base, others = runs[0], runs[1:]
    heads = ["metric", *(["meaning"] if meaning else []), base[0]]
    heads += [head for name, _ in others for head in (name, "change")]
    rows = []
    for metric in METRICS:
        values = [figures.get(metric.name) for _, figures in runs]
        if any(v is not None for v in values):
            cells = [cell for v in values[1:] for cell in (number(v), _change(values[0], v))]
            rows.append((metric.name, *([metric.doc] if meaning else []), number(values[0]), *cells))
    title = "Runs, change against the first" if others else "Runs"
    return Table(title, tuple(heads), tuple(rows), align="llr" if meaning else "lr")


def _change(base: float | None, value: float | None) -> str:
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
        (TableCell("holds", "good") if o.ok else TableCell("broken", "bad"), o.run, o.rule.text, number(o.value), o.why)
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
