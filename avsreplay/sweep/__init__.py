"""Campaigns: many runs from one file, on one machine or a Dask cluster; they resume and give the same results.

The result files are made from the journal in the order of the plan. No clock, host, path or order of completion reaches
them: any number of workers, interrupted or not, gives the same bytes. Runs are read one by one, so that the memory
needed hardly depends on their number.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

from avsreplay import __version__
from avsreplay.files import output_text
from avsreplay.sweep.campaign import Campaign, load_campaign
from avsreplay.sweep.execute import RunResult, run_tasks
from avsreplay.sweep.expansion import Expansion, Point, expand
from avsreplay.sweep.journal import Journal, arrow, scan_schema, write_batches
from avsreplay.sweep.page import build_sweep_page
from avsreplay.sweep.summary import CampaignFold, DetectorFold, SweepSummary

__all__ = ["Campaign", "Expansion", "Journal", "Point", "expand", "load_campaign", "run_tasks", "write_results"]


BATCH = 5_000  # runs held in memory while results.parquet is written
SCAN_BATCH = 200_000  # scans held in memory while scans.parquet is written
_FIXED = ("index", "cell", "repeat", "seed", "id", "status", "error")


def write_results(plan: Expansion, journal: Journal, folder: Path) -> SweepSummary:
    """Write ``results.parquet``, ``scans.parquet`` (where scans are kept), ``summary.json`` and ``report.html``.

    Args:
        plan: The runs of the campaign.
        journal: Journal of the finished runs; runs that are not finished are left out.
        folder: Folder to write to.

    Returns:
        The summary that ``summary.json`` and ``report.html`` show.

    Raises:
        MissingBackend: pyarrow is not installed.
        UnreadableInput: A file cannot be read or written.
    """
    arrow()
    fold, kinds, ids = CampaignFold(plan), dict[str, set[str]](), set[str]()
    for point, result in _finished(plan, journal):
        fold.add(point, result)
        ids.add(result.id)
        for name, value in _values(point, result).items():
            kinds.setdefault(name, set()).add(_kind(value))
    _write_runs(plan, journal, kinds, folder / "results.parquet")
    detector = None
    if plan.loaded.campaign.scans:
        detector = DetectorFold()
        write_batches(folder / "scans.parquet", scan_schema(), _scan_batches(sorted(ids), journal, detector))
    summary = fold.result(detector.result() if detector else None)
    text = json.dumps({"version": __version__, **summary.document()}, indent=1, allow_nan=False)
    for name, content in (("summary.json", text + "\n"), ("report.html", build_sweep_page(summary))):
        with output_text(folder / name) as stream:
            stream.write(content)
    return summary


def _finished(plan: Expansion, journal: Journal) -> Iterator[tuple[Point, RunResult]]:
    return ((point, journal.result(point.task.id)) for point in plan.points() if point.task.id in journal)


def _values(point: Point, result: RunResult) -> dict[str, Any]:
    """The columns of a run that depend on the campaign: what was set, and its metrics."""
    return {**{f"set:{key}": value for key, value in point.values.items()}, **(result.metrics or {})}


def _kind(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "bool"
    return "number" if isinstance(value, (int, float)) else "text" if isinstance(value, str) else "mixed"


def _write_runs(plan: Expansion, journal: Journal, kinds: Mapping[str, set[str]], path: Path) -> None:
    """One row per run; a column is of truth values, float64 or text, anything mixed or nested as JSON text."""
    pa, _ = arrow()
    types = {"bool": pa.bool_(), "number": pa.float64(), "text": pa.string()}
    columns = [*sorted(name for name in kinds if name.startswith("set:"))]
    columns += sorted(name for name in kinds if not name.startswith("set:"))
    only = {name: "".join(kinds[name] - {"none"}) for name in columns}
    integers = {"index", "cell", "repeat", "seed"}
    fixed = [(name, pa.int64() if name in integers else pa.string()) for name in _FIXED]
    schema = pa.schema([*fixed, *((name, types.get(only[name] or "number", pa.string())) for name in columns)])

    def row(point: Point, result: RunResult) -> tuple[Any, ...]:
        found = _values(point, result)
        place = (point.index, point.cell, point.repeat, point.seed, result.id, result.status, result.error)
        return (*place, *(_plain(found.get(name), only[name]) for name in columns))

    runs = (row(*found) for found in _finished(plan, journal))
    write_batches(path, schema, iter(lambda: list(islice(runs, BATCH)), []))


def _plain(value: Any, kind: str) -> Any:
    if value is None or kind in ("bool", "text"):
        return value
    return float(value) if kind == "number" else json.dumps(value)


def _scan_batches(ids: list[str], journal: Journal, detector: DetectorFold) -> Iterator[list[tuple[Any, ...]]]:
    """The scans in the order of the runs' ids; each run counts once for the fault tests."""
    batch: list[tuple[Any, ...]] = []
    for run_id in ids:
        scans = journal.scans(run_id)
        detector.add(scans)
        batch += [(run_id, *line) for line in scans]
        if len(batch) >= SCAN_BATCH:
            yield batch
            batch = []
    yield batch
