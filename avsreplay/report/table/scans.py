"""The per-scan table: decimated to be read, cut to the width there is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from avsreplay.report.table.console import Palette, decimals, head, new_table
from avsreplay.rows import Column, Row, columns

__all__ = ["choose_rows", "scan_table"]

FEW = 24
_ORDER = (  # what is kept first where the width is short
    "seq",
    "t_s",
    "reason",
    "fault",
    "pos_err_m",
    "rot_err_deg",
    "rms_m",
    "iterations",
    "nis",
    "capture_time_s",
    "inlier_ratio",
    "ogm_rank",
    "sigma1",
    "sigma2",
    "action",
    "converged",
    "ogm_log10_cond",
    "status",
)


def choose_rows(rows: Sequence[Row], *, every: int | None = None, all: bool = False) -> tuple[list[Row], str]:
    """The rows to show, and how they were chosen in words.

    With neither flag: every k-th so that about 24 are left, the last one, and the first of each run of flagged or
    healthy scans.
    """
    if all or (every is None and len(rows) <= FEW):
        return list(rows), f"all {len(rows)} scans"
    if every is not None:
        return list(rows[:: max(every, 1)]), f"every {_ordinal(max(every, 1))} of {len(rows)} scans"
    step = -(-len(rows) // FEW)
    turns = {k for k in range(1, len(rows)) if rows[k].gamma != rows[k - 1].gamma}
    turns = turns if len(turns) <= FEW else set()
    kept = sorted(set(range(0, len(rows), step)) | {len(rows) - 1} | turns)
    words = f"every {_ordinal(step)} of {len(rows)} scans" + (" and where gamma changes" if turns else "")
    return [rows[k] for k in kept], words


def _ordinal(n: int) -> str:
    ending = "th" if n % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(n % 10, "th")
    return f"{n}{ending}"


def scan_table(console: Console, rows: Sequence[Row], *, every: int | None = None, all: bool = False) -> Table:
    """The table of chosen rows; columns that do not fit the console are left out and named below."""
    chosen, words = choose_rows(rows, every=every, all=all)
    palette = Palette.of(console)
    cells = {c.name: [_cell(row, c, _format(c, chosen), palette) for row in chosen] for c in _shown(chosen)}
    declared = {c.name: c for c in columns()}
    fitting = _fit(cells, declared, console.width)
    table = new_table(console, f"Scans: {words}", tight=True)
    for name in fitting:
        justify = "left" if name in ("reason", "fault", "action", "status") else "right"
        label = "state" if name == "reason" else head(declared[name])
        if name in ("pos_err_m", "rot_err_deg") and chosen[0].reference == "fit":
            label = label.replace("err", "vs fit")
        table.add_column(label, justify=justify, no_wrap=True, vertical="bottom")  # type: ignore[arg-type]
    for k in range(len(chosen)):
        table.add_row(*(cells[name][k] for name in fitting))
    left_out = [name for name in cells if name not in fitting]
    if left_out:
        table.caption = Text(f"not shown at this width: {', '.join(left_out)}", style="dim")
        table.caption_justify = "left"
    return table


def _shown(rows: Sequence[Row]) -> list[Column]:
    """Columns of the default table that say anything in these rows; gamma and reason are one."""
    wanted = [c for c in columns() if c.table and c.name != "gamma"]
    return [c for c in wanted if any(getattr(row, c.name) is not None for row in rows)]


def _format(column: Column, rows: Sequence[Row]) -> str:
    if column.unit != "m" or not column.fmt.endswith("f"):
        return column.fmt
    values = (getattr(row, column.name) for row in rows)
    return f".{decimals((v for v in values if v is not None), int(column.fmt[1:-1]), figures=2)}f"


def _cell(row: Row, column: Column, fmt: str, palette: Palette) -> Text:
    value: Any = getattr(row, column.name)
    if column.name == "reason":
        return palette.state(row.gamma, row.reason)
    if value is None:
        return Text(palette.dash, style="dim")
    if isinstance(value, bool):
        return Text("yes" if value else "no")
    return Text(format(value, fmt))


def _fit(cells: dict[str, list[Text]], declared: dict[str, Column], width: int) -> list[str]:
    """Names in row order, as many as fit, in the order of preference."""
    kept: list[str] = []
    used = 0
    for name in [n for n in (*_ORDER, *cells) if n in cells]:
        if name in kept:
            continue
        label = "state" if name == "reason" else head(declared[name])
        wide = max([*(len(t.plain) for t in cells[name]), *(len(line) for line in label.split("\n"))]) + 1
        if used + wide <= width:
            kept.append(name)
            used += wide
    return [name for name in cells if name in kept]
