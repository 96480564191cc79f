"""One table type for terminal, HTML page and Markdown, and the table of the scans, cut to the width
of the console.

Cells are text and never interpreted as markup. States have a sign as well as a colour (Okabe and
Ito's colours), so that a table can be read without colour.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import IO, Any, Literal

from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from avsreplay.errors import printable, value_class
from avsreplay.rows import Column, Row, columns
from avsreplay.tables import column_of

PLAIN_WIDTH_CHARACTERS = 80
_WRAPPED_CHARACTERS = 12  # least width of a column of wrapped text, with its margin
_SIGNS = {"good": ("●", "o"), "bad": ("✗", "x"), "warn": ("~", "~"), "faint": ("", "")}
_COLOURS = {"good": "#009E73", "bad": "bold #D55E00", "warn": "#E69F00", "faint": "dim"}


@value_class(eq=True)
class TableCell:
    """A cell with a text and a style that states its meaning.

    Attributes:
        text: as it is to be read.
        mark: "good", "bad", "warn" (each printed with a sign and a colour), "faint", or "".
        scan: row number of the run that the page shows when the cell is clicked.
    """

    text: str
    mark: str = ""
    scan: int | None = None

    def signed(self, *, ascii_only: bool = False) -> str:
        """Return the text after the sign of its mark.

        Args:
            ascii_only: whether the sign is ASCII.
        """
        sign = _SIGNS[self.mark][ascii_only] if self.mark else ""
        return " ".join(part for part in (sign, self.text) if part)


@value_class(eq=True)
class Table:
    """A table as data.

    Attributes:
        title: one line.
        heads: column headings; a line end in one is kept.
        rows: cells in the order of the headings.
        align: a letter per column, "l" (text, may wrap), "n" (names, one line) or "r" (numbers);
            the last letter holds for all further ones.
        note: one line under the table.
        wide: whether a page gives it the whole width.
    """

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str | TableCell, ...], ...]
    align: str = "lr"
    note: str = ""
    wide: bool = False

    def right(self, column: int) -> bool:
        """Whether a column is aligned to the right."""
        return self.letter(column) == "r"

    def letter(self, column: int) -> str:
        """The letter of a column in ``align``."""
        return self.align[min(column, len(self.align) - 1)]


def as_cell(cell: str | TableCell) -> TableCell:
    """Return a plain string as a cell without a mark."""
    return cell if isinstance(cell, TableCell) else TableCell(cell)


def make_console(
    stream: IO[str] | None = None,
    *,
    width: int | None = None,
    plain_width: int = PLAIN_WIDTH_CHARACTERS,
) -> Console:
    """Return a console that interprets no markup.

    Args:
        stream: where to print; standard output by default.
        width: fixed width in columns; by default that of the terminal.
        plain_width: width where ``stream`` is not a terminal; there is no colour there, nor under
            ``NO_COLOR``.
    """
    stream = stream or sys.stdout
    if width is None and not stream.isatty():
        width = plain_width
    return Console(
        file=stream, width=width, highlight=False, markup=False, emoji=False, soft_wrap=False
    )


def ascii_only(console: Console) -> bool:
    """Whether the console cannot write Unicode signs."""
    return "utf" not in console.encoding.lower()


def print_table(console: Console, table: Table, *, tight: bool = False) -> None:
    """Print a table and an empty line; nothing for a table without rows.

    Numbers and names are never cut; lines are longer than the console is wide where they need it.

    Args:
        console: where to print.
        table: the table.
        tight: leave one blank between columns in any case, not only where two do not fit.
    """
    if table.rows:
        tight = tight or _least_width(table, 2) > console.width
        width, console.width = (
            console.width,
            max(console.width, _least_width(table, 1 if tight else 2)),
        )
        console.print(_rich(console, table, tight))
        console.width = width
        console.print()


def _least_width(table: Table, gap: int) -> int:
    """Width at which no column of one line is cut; all columns have one where the gap between
    them is 1.
    """
    columns_of_text = zip(
        table.heads, *([as_cell(c).signed() for c in row] for row in table.rows), strict=True
    )
    return sum(
        _WRAPPED_CHARACTERS
        if gap > 1 and table.letter(k) == "l"
        else gap + max(map(cell_len, "\n".join(texts).split("\n")))
        for k, texts in enumerate(columns_of_text)
    )


def print_line(console: Console, text: str) -> None:
    """Print one line of text as it is.

    Args:
        console: where it is printed.
        text: the line.
    """
    console.print(Text(printable(text, "\n")))


def _rich(console: Console, table: Table, tight: bool) -> RichTable:
    drawn = RichTable(
        title=Text(printable(table.title), style="bold"),
        title_justify="left",
        min_width=min(cell_len(table.title), console.width),  # of a short table
        caption=Text(printable(table.note, "\n"), style="dim") if table.note else None,
        caption_justify="left",
        box=box.ASCII2 if ascii_only(console) else box.SIMPLE_HEAD,
        show_edge=False,
        pad_edge=False,
        padding=0 if tight else (0, 1, 0, 0),
        header_style="",
    )
    for k, head in enumerate(table.heads):
        one_line = tight or table.letter(k) != "l"
        justify: Literal["left", "right"] = "right" if table.right(k) else "left"
        drawn.add_column(
            Text(printable(head, "\n")),
            justify=justify,
            no_wrap=one_line,
            overflow="fold",
            vertical="top",
        )
    for row in table.rows:
        drawn.add_row(*(_text(as_cell(cell), console) for cell in row))
    return drawn


def _text(cell: TableCell, console: Console) -> Text:
    text = cell.signed(ascii_only=ascii_only(console))
    return Text(printable(text, "\n"), style=_COLOURS.get(cell.mark, ""))


def markdown(table: Table) -> str:
    """Return a table in the Markdown of GitHub; "" for a table without rows."""
    if not table.rows:
        return ""
    heads = [escaped(head.replace("\n", " ")) for head in table.heads]
    rules = ["---:" if table.right(k) else "---" for k in range(len(heads))]
    rows = [[escaped(as_cell(cell).signed()) for cell in row] for row in table.rows]
    lines = [f"| {' | '.join(cells)} |" for cells in (heads, rules, *rows)]
    note = ["", escaped(table.note)] if table.note else []
    return "\n".join([f"**{escaped(table.title)}**", "", *lines, *note]) + "\n"


def escaped(text: str) -> str:
    """Return a text on one line that Markdown shows as it is."""
    for sign in "\\`*_[]<>|#":
        text = text.replace(sign, "\\" + sign)
    return " ".join(text.split())


def facts_table(title: str, facts: Iterable[tuple[str, str]]) -> Table:
    """Return a table of names and values.

    Args:
        title: title of the table.
        facts: name and value of each line.
    """
    return Table(title, ("what", "value"), tuple(facts), align="l")


def number(value: float | None, spec: str = ".5g", none: str = "-") -> str:
    """Return a number as text, or ``none`` where there is no value.

    Args:
        value: the number.
        spec: its format specification.
        none: the text for None.
    """
    return none if value is None else format(value, spec)


def decimals(values: Iterable[float], least: int, *, figures: int = 3) -> int:
    """Return the number of decimals, from ``least`` to 8, that show ``figures`` significant figures
    of the middle value.

    Args:
        values: the numbers of a column.
        least: fewest decimals.
        figures: significant figures of the middle value.
    """
    sizes: Sequence[float] = sorted(abs(v) for v in values if v)
    wanted = figures - 1 - math.floor(math.log10(sizes[len(sizes) // 2])) if sizes else least
    return min(max(least, wanted), 8)


SHOWN_ROWS = 24  # rows of a table that are shown unless more are requested
_HEADS = {  # a line end stands where the heading may break
    "seq": "scan",
    "t_s": "time",
    "reason": "state",
    "fault": "injected fault",
    "nis": "NIS",
    "inlier_ratio": "inlier\nratio",
    "converged": "con-\nverged",
    "capture_time_s": "planned\ncapture",
    "ogm_log10_cond": "Gramian\nlog10 cond.",
    "ogm_rank": "Gramian\nrank",
    "pos_err_m": "position\nerror",
    "rot_err_deg": "attitude\nerror",
}
_ORDER = (  # which columns are kept first where the width is short
    *(
        "seq",
        "t_s",
        "reason",
        "fault",
        "pos_err_m",
        "rot_err_deg",
        "rms_m",
        "nis",
        "capture_time_s",
        "iterations",
    ),
    *(
        "inlier_ratio",
        "action",
        "converged",
        "sigma1",
        "sigma2",
        "ogm_rank",
        "ogm_log10_cond",
        "status",
    ),
)
_TEXT_COLUMNS = ("reason", "fault", "action", "status")


def choose_rows(
    rows: Sequence[Row], *, every: int | None = None, show_all: bool = False
) -> tuple[list[Row], str]:
    """Return the rows to show and a description of the choice.

    With neither flag: every k-th row so that about 24 are left, the last one, and those at which
        gamma changes.

    Args:
        rows: the rows of a run.
        every: show every k-th row; None leaves the choice to the function.
        show_all: whether all rows are shown.
    """
    if show_all or (every is None and len(rows) <= SHOWN_ROWS):
        return list(rows), f"all {len(rows)} scans" if len(rows) != 1 else "1 scan"
    if every is not None:
        return list(rows[:: max(every, 1)]), f"every {_ordinal(max(every, 1))} of {len(rows)} scans"
    step = -(-len(rows) // SHOWN_ROWS)
    turns = {k for k, (a, b) in enumerate(pairwise(column_of(rows, "gamma")), 1) if a != b}
    turns = turns if len(turns) <= SHOWN_ROWS else set()
    kept = sorted(set(range(0, len(rows), step)) | {len(rows) - 1} | turns)
    words = f"every {_ordinal(step)} of {len(rows)} scans" + (
        " and where gamma changes" if turns else ""
    )
    return [rows[k] for k in kept], words


def _ordinal(n: int) -> str:
    ending = "th" if n % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(n % 10, "th")
    return f"{n}{ending}"


def scan_table(
    console: Console, rows: Sequence[Row], *, every: int | None = None, show_all: bool = False
) -> Table:
    """Return the table of the chosen rows; columns that do not fit the console are left out and
    named in the note.

    Args:
        console: where it is printed.
        rows: the rows of a run.
        every: show every k-th row; None leaves the choice to the function.
        show_all: whether all rows are shown.
    """
    chosen, words = choose_rows(rows, every=every, show_all=show_all)
    plain = ascii_only(console)
    shown = {c.name: c for c in _shown(chosen)}
    cells = {name: _cells(c, chosen) for name, c in shown.items()}
    heads = {name: _head(c, chosen) for name, c in shown.items()}
    widths = {
        name: max(
            [
                *(len(c.signed(ascii_only=plain)) for c in cells[name]),
                *map(len, heads[name].split("\n")),
            ]
        )
        + 1
        for name in cells
    }
    fitting = _fit(widths, console.width)
    left_out = [name for name in cells if name not in fitting]
    return Table(
        f"Scans: {words}",
        tuple(heads[name] for name in fitting),
        tuple(tuple(cells[name][k] for name in fitting) for k in range(len(chosen))),
        align="".join("l" if name in _TEXT_COLUMNS else "r" for name in fitting),
        note=f"not shown at this width: {', '.join(left_out)}" if left_out else "",
    )


def head(column: Column, shown: str = "") -> str:
    """Return a heading of whole words with the unit on the last line; ``shown`` is the unit of the
    printed numbers.

    Args:
        column: the column.
        shown: unit of the printed numbers.
    """
    unit = column.unit or ("s" if column.name == "capture_time_s" else "")
    name = column.name.removesuffix("_" + unit.replace("/", "p")) if unit else column.name
    name = _HEADS.get(column.name, name.replace("_", " "))
    return f"{name}\n[{shown or unit}]" if unit else name


def _head(column: Column, rows: Sequence[Row]) -> str:
    said = head(column, _unit(column, rows))
    fitted = column.name in ("pos_err_m", "rot_err_deg") and rows[0].reference == "fit"
    return said.replace("error", "from fit") if fitted else said


def _shown(rows: Sequence[Row]) -> list[Column]:
    """Columns of the default table that have a value in these rows; gamma and reason share one."""
    wanted = [c for c in columns() if c.table and c.name != "gamma"]
    return [c for c in wanted if any(getattr(row, c.name) is not None for row in rows)]


def _unit(column: Column, rows: Sequence[Row]) -> str:
    """Lengths are printed in millimetres where most are below 1 m."""
    if column.unit != "m" or not column.fmt.endswith("f"):
        return column.unit
    sizes = sorted(abs(v) for row in rows if (v := getattr(row, column.name)) is not None)
    return "mm" if sizes and sizes[len(sizes) // 2] < 1.0 else "m"


def _cells(column: Column, rows: Sequence[Row]) -> list[TableCell]:
    """The cells of one column."""
    values: list[Any] = [getattr(row, column.name) for row in rows]
    if column.name == "reason":
        return [state_cell(row.gamma, row.reason) for row in rows]
    fmt = column.fmt
    if _unit(column, rows) == "mm":
        values = [None if v is None else 1000.0 * v for v in values]
        fmt = f".{decimals((v for v in values if v is not None), 1, figures=2)}f"
    elif column.unit == "m" and fmt.endswith("f"):
        fmt = f".{decimals((v for v in values if v is not None), int(fmt[1:-1]), figures=2)}f"
    return [_cell(value, fmt) for value in values]


def _cell(value: Any, fmt: str) -> TableCell:
    if value is None:
        return TableCell("-", "faint")
    return TableCell(("no", "yes")[value] if isinstance(value, bool) else format(value, fmt))


def state_cell(gamma: int, reason: str) -> TableCell:
    """Return the cell of a state: healthy, coasting because there was no scan, or flagged with the
    reason.

    Args:
        gamma: 1 for a healthy scan, 0 for another one.
        reason: why a scan is not healthy.
    """
    if gamma == 1:
        return TableCell("ok", "good")
    return TableCell(reason, "warn" if reason == "no_scan" else "bad")


def _fit(widths: dict[str, int], width: int) -> list[str]:
    """Column names in row order: as many as fit, chosen in the order of preference."""
    kept: list[str] = []
    for name in dict.fromkeys(n for n in (*_ORDER, *widths) if n in widths):
        if sum(widths[other] for other in (*kept, name)) <= width:
            kept.append(name)
    return [name for name in widths if name in kept]


LEAST_WIDTH_CHARACTERS = 100
_SPARK_BLOCKS = "▁▂▃▄▅▆▇█"
_LABEL_CHARACTERS = 32


def spark(values: Sequence[float | None], width: int) -> str:
    """Return at most ``width`` blocks, whose heights from 0 to the largest value show the largest
    value of each part; a blank where a part has none.

    Args:
        values: the values in order, None where there is none.
        width: largest number of blocks.
    """
    parts = [[v for v in values[a:b] if v is not None] for a, b in _parts(len(values), width)]
    top = max((max(part) for part in parts if part), default=0.0)
    return "".join(
        _SPARK_BLOCKS[min(int(max(p) / top * 8.0), 7) if top > 0 else 0] if p else " "
        for p in parts
    )


def _parts(count: int, width: int) -> list[tuple[int, int]]:
    cells = min(count, width)
    return [(count * k // cells, count * (k + 1) // cells) for k in range(cells)]


def print_sparks(console: Console, rows: Sequence[Row]) -> None:
    """Print pose errors and flagged scans over time; only on a wide terminal with Unicode.

    Args:
        console: where it is printed.
        rows: the rows of a run.
    """
    if not console.is_terminal or console.width < LEAST_WIDTH_CHARACTERS or ascii_only(console):
        return
    width = console.width - _LABEL_CHARACTERS
    shown = (
        ("position error", "mm", "pos_err_m", 1000.0),
        ("attitude error", "deg", "rot_err_deg", 1.0),
    )
    for name, unit, wanted, scale in shown:
        values = [None if v is None else scale * v for v in column_of(rows, wanted)]
        if known := [v for v in values if v is not None]:
            label = f"{name} to {max(known):.3g} {unit}"
            console.print(
                Text(f"{label:{_LABEL_CHARACTERS}}").append(spark(values, width), style="#0072B2")
            )
    gammas = column_of(rows, "gamma")
    flags = "".join("✗" if 0 in gammas[a:b] else "·" for a, b in _parts(len(rows), width))
    console.print(Text(f"{'flagged':{_LABEL_CHARACTERS}}").append(flags, style="#D55E00"))
    console.print()
