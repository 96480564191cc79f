"""The differences from a golden file, as a table."""

from __future__ import annotations

from typing import Any

from rich.console import Console

from avsreplay.report.golden import GoldenResult
from avsreplay.report.table.console import new_table

__all__ = ["print_golden"]


def print_golden(console: Console, result: GoldenResult) -> None:
    """One line where the rows agree; else the first differences, and how many there are of each column."""
    if result.ok:
        console.print(f"golden: {result.rows} rows agree")
        return
    table = new_table(console, f"Golden: first {len(result.differences)} of {result.count} differences")
    for name in ("scan", "column", "expected", "got", "tolerance"):
        table.add_column(name, justify="left" if name == "column" else "right", overflow="fold")
    for d in result.differences:
        scan = "all" if d.seq is None else str(d.seq)
        table.add_row(scan, d.column, _text(d.expected), _text(d.got), _tolerance(d.tolerance))
    console.print(table)
    counts = sorted(result.by_column.items(), key=lambda item: (-item[1], item[0]))
    console.print("by column: " + ", ".join(f"{name} {count}" for name, count in counts[:12]))


def _text(value: Any) -> str:
    return "null" if value is None else str(value)


def _tolerance(value: float | None) -> str:
    return "exact" if value is None else f"{value:.3g}"
