"""Rows to people and files: tables, golden comparison, exports, pages. Names load when first used."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from avsreplay.report.export import row_poses, write_csv, write_kitti, write_parquet, write_tum
    from avsreplay.report.golden import GoldenResult, compare_golden, update_golden
    from avsreplay.report.json_document import document, dump_document
    from avsreplay.report.jsonl import RowWriter, read_rows, write_rows
    from avsreplay.report.layout import write_layout
    from avsreplay.report.result import Result, facts_record, load_result, read_tum
    from avsreplay.report.summary import Summary, SummaryFold
    from avsreplay.report.table import make_console, print_golden, print_tables
    from avsreplay.report.view import (
        CloudView,
        PathView,
        View,
        read_view,
        thin_cloud,
        thin_surface,
        write_view,
    )

_HOME = {
    "CloudView": "view",
    "GoldenResult": "golden",
    "PathView": "view",
    "Result": "result",
    "RowWriter": "jsonl",
    "Summary": "summary",
    "SummaryFold": "summary",
    "View": "view",
    "compare_golden": "golden",
    "document": "json_document",
    "dump_document": "json_document",
    "facts_record": "result",
    "load_result": "result",
    "make_console": "table",
    "print_golden": "table",
    "print_tables": "table",
    "read_rows": "jsonl",
    "read_tum": "result",
    "read_view": "view",
    "row_poses": "export",
    "thin_cloud": "view",
    "thin_surface": "view",
    "update_golden": "golden",
    "write_csv": "export",
    "write_kitti": "export",
    "write_layout": "layout",
    "write_parquet": "export",
    "write_rows": "jsonl",
    "write_tum": "export",
    "write_view": "view",
}

__all__ = [
    "CloudView",
    "GoldenResult",
    "PathView",
    "Result",
    "RowWriter",
    "Summary",
    "SummaryFold",
    "View",
    "compare_golden",
    "document",
    "dump_document",
    "facts_record",
    "load_result",
    "make_console",
    "print_golden",
    "print_tables",
    "read_rows",
    "read_tum",
    "read_view",
    "row_poses",
    "thin_cloud",
    "thin_surface",
    "update_golden",
    "write_csv",
    "write_kitti",
    "write_layout",
    "write_parquet",
    "write_rows",
    "write_tum",
    "write_view",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
