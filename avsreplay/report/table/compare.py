"""Runs side by side in the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.console import Console
from rich.text import Text

from avsreplay.report.compare import METRICS
from avsreplay.report.gate import Outcome
from avsreplay.report.golden import GoldenResult
from avsreplay.report.table.console import Palette, new_table

__all__ = ["print_comparison", "print_divergence", "print_gate"]

_ABREAST = 3


def print_comparison(console: Console, runs: Sequence[tuple[str, Mapping[str, float | None]]]) -> None:
    """Figures of the baseline (the first run) and of the others with their change, three runs at a time."""
    base, others = runs[0], runs[1:]
    for start in range(0, max(len(others), 1), _ABREAST - 1):
        _print_block(console, base, others[start : start + _ABREAST - 1])


def _print_block(
    console: Console,
    base: tuple[str, Mapping[str, float | None]],
    others: Sequence[tuple[str, Mapping[str, float | None]]],
) -> None:
    table = new_table(console, "Runs" if not others else "Runs, change against the first")
    table.add_column("metric", no_wrap=True)
    table.add_column(Text(base[0]), justify="right", overflow="ellipsis", no_wrap=True)
    for name, _ in others:
        table.add_column(Text(name), justify="right", overflow="ellipsis", no_wrap=True)
        table.add_column("change", justify="right", no_wrap=True)
    for metric in METRICS:
        values = [figures.get(metric.name) for _, figures in (base, *others)]
        if any(v is not None for v in values):
            cells = [cell for v in values[1:] for cell in (_figure(v), _change(values[0], v))]
            table.add_row(metric.name, _figure(values[0]), *cells)
    console.print(table)
    console.print()


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.5g}"


def _change(base: float | None, value: float | None) -> str:
    if base is None or value is None or base == value:
        return ""
    if base == 0:
        return f"{value - base:+.3g}"
    times = value / base
    return f"x {times:.3g}" if times >= 10.0 else f"{100 * (value - base) / abs(base):+.1f} %"


def print_divergence(console: Console, baseline: str, other: str, found: GoldenResult) -> None:
    """Where two runs first part, in one line."""
    if found.ok:
        line = f"{other}: all {found.rows} rows agree with {baseline} within the columns' tolerances"
    else:
        first = found.differences[0]
        scan = "every scan" if first.seq is None else f"scan {first.seq}"
        line = f"{other}: {found.count} cells differ from {baseline}, first at {scan}, column {first.column}"
        line += f" ({first.expected} against {first.got})"
    console.print(Text(line))


def print_gate(console: Console, outcomes: Sequence[Outcome]) -> None:
    """Every rule and what it says."""
    palette = Palette.of(console)
    table = new_table(console, "Gate")
    table.add_column("", no_wrap=True)
    for name in ("run", "rule", "value", "why"):
        table.add_column(name, overflow="fold", justify="right" if name == "value" else "left")
    for o in outcomes:
        mark = Text(palette.healthy, style="#009E73") if o.ok else Text(palette.flagged, style="bold #D55E00")
        table.add_row(mark, Text(o.run), Text(o.rule.text), _figure(o.value), Text(o.why))
    console.print(table)
