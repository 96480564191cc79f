"""One self-contained HTML page of a run: no network, opens from disk.

Charts are drawn by uPlot (50 kB, bundled, MIT) and the 3D view by plain WebGL: a page is a few hundred kilobytes and
ready in a fraction of a second, where a general plotting bundle alone weighs 4.8 MB.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from typing import Any

from avsreplay.records import State
from avsreplay.report.export import StampedPose
from avsreplay.report.page.charts import charts, derived, spans
from avsreplay.report.page.html import (
    config_section,
    error_table,
    escape,
    fact_table,
    fault_table,
    parameter_table,
)
from avsreplay.report.page.packing import embed, pack, values
from avsreplay.report.page.scene import scene
from avsreplay.report.summary import Summary
from avsreplay.report.view import View
from avsreplay.report.words import verdict
from avsreplay.rows import Row

__all__ = ["build_page", "frame"]

_ASSETS = files("avsreplay.report.page") / "assets"


def build_page(
    rows: Sequence[Row],
    summary: Summary,
    header: Mapping[str, Any] | None = None,
    *,
    title: str = "run",
    truth: State | None = None,
    poses: Iterable[StampedPose] = (),
    view: View | None = None,
) -> str:
    """The page as text.

    Args:
        rows: one a scan.
        summary: of the same rows.
        header: shown as it stands, folded away.
        title: what the run is called.
        truth: true parameters, drawn as levels.
        poses: true poses of {C} in {A}.
        view: model, clouds and paths for the 3D part.
    """
    columns = derived(rows)
    data = {
        "runs": [{"name": title, "t": pack(values(rows, "t_s"), "f8"), "columns": _packed(columns)}],
        "charts": charts(columns, truth),
        "spans": spans(rows, summary.faults.episodes),
        "marks": _marks(summary),
        "states": [[row.gamma, row.reason, row.fault or ""] for row in rows],
        "scans": [row.seq for row in rows],
        "scene": scene(rows, dict(poses), view),
    }
    aside = (
        error_table(summary),
        fault_table(summary, rows),
        parameter_table(summary),
        fact_table(summary),
        config_section(header or {}),
    )
    return frame(title, verdict(summary), data, "".join(aside))


def _packed(columns: Mapping[str, Any]) -> dict[str, Any]:
    return {name: pack(column, "f4") for name, column in columns.items()}


def _marks(summary: Summary) -> list[dict[str, Any]]:
    t1 = summary.convergence.t1_s
    return [] if t1 is None else [{"t": t1, "label": "t_1"}]


def frame(title: str, line: str, data: Mapping[str, Any], tables: str) -> str:
    """A whole page around its data: style, scripts and the few elements the scripts fill."""
    template = _asset("page.html")
    parts = {
        "TITLE": escape(title),
        "VERDICT": escape(line),
        "TABLES": tables,
        "STYLE": _asset("uPlot.min.css") + _asset("page.css"),
        "DATA": embed(data),
        "SCRIPT": "\n".join(_asset(n) for n in ("uPlot.iife.min.js", "charts.js", "scene.js", "page.js")),
    }
    pieces = template.split("@@")
    return "".join(piece if k % 2 == 0 else parts[piece] for k, piece in enumerate(pieces))


def _asset(name: str) -> str:
    return (_ASSETS / name).read_text(encoding="utf-8")
