"""One table type for terminal, HTML page and Markdown. Cells are text and never interpreted as markup.

This module and ``scan_table`` are the only ones that import rich. States have a sign as well as a colour (Okabe and
Ito's colours), so that a table can be read without colour.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import IO, Literal

from rich import box
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

PLAIN_WIDTH = 80
_SIGNS = {"good": ("●", "o"), "bad": ("✗", "x"), "warn": ("~", "~"), "faint": ("", "")}
_COLOURS = {"good": "#009E73", "bad": "bold #D55E00", "warn": "#E69F00", "faint": "dim"}


@dataclass(frozen=True, slots=True)
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
        """The text after the sign of its mark."""
        sign = _SIGNS[self.mark][ascii_only] if self.mark else ""
        return " ".join(part for part in (sign, self.text) if part)


@dataclass(frozen=True, slots=True)
class Table:
    """A table as data.

    Attributes:
        title: one line.
        heads: column headings; a line end in one is kept.
        rows: cells in the order of the headings.
        align: a letter per column, "l" (text, may wrap), "n" (names, one line) or "r" (numbers); the last letter holds
            for all further ones.
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
    """A plain string as a cell without a mark."""
    return cell if isinstance(cell, TableCell) else TableCell(cell)


def make_console(stream: IO[str] | None = None, *, width: int | None = None, plain_width: int = PLAIN_WIDTH) -> Console:
    """Return a console that interprets no markup.

    Args:
        stream: where to print; standard output by default.
        width: fixed width in columns; by default that of the terminal.
        plain_width: width where ``stream`` is not a terminal; there is no colour there, nor under ``NO_COLOR``.
    """
    stream = stream or sys.stdout
    if width is None and not stream.isatty():
        width = plain_width
    return Console(file=stream, width=width, highlight=False, markup=False, emoji=False, soft_wrap=False)


def ascii_only(console: Console) -> bool:
    """Whether the console cannot write Unicode signs."""
    return "utf" not in console.encoding.lower()


def print_table(console: Console, table: Table, *, tight: bool = False) -> None:
    """Print a table and an empty line; nothing for a table without rows. ``tight``: one blank between columns."""
    if table.rows:
        console.print(_rich(console, table, tight))
        console.print()


def print_line(console: Console, text: str) -> None:
    """Print one line of text as it is."""
    console.print(Text(text))


def _rich(console: Console, table: Table, tight: bool) -> RichTable:
    drawn = RichTable(
        title=Text(table.title, style="bold"),
        title_justify="left",
        caption=Text(table.note, style="dim") if table.note else None,
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
        drawn.add_column(Text(head), justify=justify, no_wrap=one_line, overflow="fold", vertical="top")
    for row in table.rows:
        drawn.add_row(*(_text(as_cell(cell), console) for cell in row))
    return drawn


def _text(cell: TableCell, console: Console) -> Text:
    return Text(cell.signed(ascii_only=ascii_only(console)), style=_COLOURS.get(cell.mark, ""))


def markdown(table: Table) -> str:
    """The table in GitHub's Markdown; "" for a table without rows."""
    if not table.rows:
        return ""
    heads = [escaped(head.replace("\n", " ")) for head in table.heads]
    rules = ["---:" if table.right(k) else "---" for k in range(len(heads))]
    rows = [[escaped(as_cell(cell).signed()) for cell in row] for row in table.rows]
    lines = [f"| {' | '.join(cells)} |" for cells in (heads, rules, *rows)]
    note = ["", escaped(table.note)] if table.note else []
    return "\n".join([f"**{escaped(table.title)}**", "", *lines, *note]) + "\n"


def escaped(text: str) -> str:
    """Text that Markdown shows as it is, on one line."""
    for sign in "\\`*_[]<>|#":
        text = text.replace(sign, "\\" + sign)
    return " ".join(text.split())


def facts_table(title: str, facts: Iterable[tuple[str, str]], heads: tuple[str, str] = ("what", "value")) -> Table:
    """A table of names and values."""
    return Table(title, heads, tuple(facts), align="l")


def number(value: float | None, spec: str = ".5g", none: str = "-") -> str:
    """A number as text, ``none`` where there is no value."""
    return none if value is None else format(value, spec)


def decimals(values: Iterable[float], least: int, *, figures: int = 3) -> int:
    """Number of decimals, ``least`` to 8, that show ``figures`` significant figures of the middle value."""
    sizes: Sequence[float] = sorted(abs(v) for v in values if v)
    if not sizes:
        return least
    wanted = figures - 1 - math.floor(math.log10(sizes[len(sizes) // 2]))
    return min(max(least, wanted), 8)
