"""Tables for the terminal: the only place in the report that knows rich."""

from __future__ import annotations

from avsreplay.report.table.console import Palette, make_console
from avsreplay.report.table.golden import print_golden
from avsreplay.report.table.scans import choose_rows, scan_table
from avsreplay.report.table.sparks import print_sparks, spark
from avsreplay.report.table.summary import print_summary, print_tables

__all__ = [
    "Palette",
    "choose_rows",
    "make_console",
    "print_golden",
    "print_sparks",
    "print_summary",
    "print_tables",
    "scan_table",
    "spark",
]
