"""A campaign's result files: one row a run, one row a scan, and the summary. Made from the journal, in plan order.

No clock, host, path or order of completion reaches them: 1 worker or 8, taken up again or not, the same bytes.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from avsreplay import __version__
from avsreplay.errors import MissingBackend
from avsreplay.sweep.journal import Journal
from avsreplay.sweep.page import build_sweep_page
from avsreplay.sweep.plan import Plan, Point
from avsreplay.sweep.summary import SweepSummary, summarise
from avsreplay.sweep.worker import SCAN_COLUMNS, Outcome

__all__ = ["arrow", "write_results"]

SCAN_BATCH = 200_000


def write_results(plan: Plan, journal: Journal, folder: Path) -> SweepSummary:
    """Write ``results.parquet``, ``scans.parquet`` (where kept), ``summary.json`` and ``report.html`` into ``folder``.

    Raises MissingBackend where pyarrow is not installed.
    """
    arrow()
    by_id = {outcome.id: _without_scans(outcome) for outcome in journal.outcomes()}
    done = [(point, by_id[point.task.id]) for point in plan.points() if point.task.id in by_id]
    _write(_run_table(done), folder / "results.parquet")
    if plan.loaded.campaign.scans:
        _write_scans(done, journal, folder / "scans.parquet")
    summary = summarise(plan, done, journal.outcomes())
    text = json.dumps({"version": __version__, **summary.document()}, indent=1, allow_nan=False)
    _replace(folder / "summary.json", text.encode() + b"\n")
    _replace(folder / "report.html", build_sweep_page(summary).encode())
    return summary


def arrow() -> tuple[Any, Any]:
    """The modules pyarrow and its Parquet part, which ship no types. Raises MissingBackend without them."""
    try:
        return importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
    except ImportError:
        hint = "pip install 'avsreplay[sweep]'"
        raise MissingBackend("pyarrow is not installed", where="sweep", hint=hint) from None


def _without_scans(outcome: Outcome) -> Outcome:
    return replace(outcome, scans=())


def _run_table(done: Sequence[tuple[Point, Outcome]]) -> Any:
    pa, _ = arrow()

    keys = sorted({key for point, _ in done for key in point.values})
    names = sorted({name for _, outcome in done for name in (outcome.metrics or {})})
    columns: dict[str, Any] = {
        "index": pa.array([p.index for p, _ in done], pa.int64()),
        "cell": pa.array([p.cell for p, _ in done], pa.int64()),
        "repeat": pa.array([p.repeat for p, _ in done], pa.int64()),
        "id": pa.array([o.id for _, o in done], pa.string()),
        "status": pa.array([o.status for _, o in done], pa.string()),
        "error": pa.array([o.error for _, o in done], pa.string()),
    }
    columns |= {f"set:{key}": _column([p.values.get(key) for p, _ in done]) for key in keys}
    columns |= {name: _column([(o.metrics or {}).get(name) for _, o in done]) for name in names}
    return pa.table(columns)


def _column(values: Sequence[Any]) -> Any:
    """Truth values, numbers (float64) or words; anything mixed or nested as JSON text."""
    pa, _ = arrow()

    given = [v for v in values if v is not None]
    if given and all(isinstance(v, bool) for v in given):
        return pa.array(values, pa.bool_())
    if all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in given):
        return pa.array([None if v is None else float(v) for v in values], pa.float64())
    if all(isinstance(v, str) for v in given):
        return pa.array(values, pa.string())
    return pa.array([None if v is None else json.dumps(v) for v in values], pa.string())


def _write_scans(done: Sequence[tuple[Point, Outcome]], journal: Journal, path: Path) -> None:
    """Scans in the order of the runs' names, one batch in memory."""
    pa, pq = arrow()

    types = {"seq": pa.int64(), "fault": pa.string(), "harmful": pa.bool_(), "gamma": pa.int64()}
    schema = pa.schema([("id", pa.string()), *((name, types.get(name, pa.float64())) for name in SCAN_COLUMNS)])
    partial = path.with_name(path.name + ".partial")
    with pq.ParquetWriter(partial, schema, compression="zstd") as writer:
        for outcomes in _batches({o.id for _, o in done}, journal):
            rows = [(o.id, *line) for o in outcomes for line in o.scans]
            columns = zip(*rows, strict=True) if rows else ([] for _ in schema)
            writer.write_table(pa.table([pa.array(c, f.type) for c, f in zip(columns, schema, strict=True)], schema))
    partial.replace(path)


def _batches(wanted: set[str], journal: Journal) -> Iterator[list[Outcome]]:
    batch: list[Outcome] = []
    for run_id in sorted(wanted):
        batch.append(journal.outcome(run_id))
        if sum(len(outcome.scans) for outcome in batch) >= SCAN_BATCH:
            yield batch
            batch = []
    if batch:
        yield batch


def _write(table: Any, path: Path) -> None:
    _, pq = arrow()

    partial = path.with_name(path.name + ".partial")
    pq.write_table(table, partial, compression="zstd")
    partial.replace(path)


def _replace(path: Path, data: bytes) -> None:
    partial = path.with_name(path.name + ".partial")
    partial.write_bytes(data)
    partial.replace(path)
