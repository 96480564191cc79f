"""One run, in a worker: record the scenario, replay it through the same job as the command line, sum up.

An error that a user can mend is the run's result, not the end of the campaign.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from avsreplay import toml_document
from avsreplay.errors import AvsError
from avsreplay.log import SourceOptions
from avsreplay.record import RecordOptions, record_scenario
from avsreplay.records import Label, Scan
from avsreplay.rows import Row
from avsreplay.run import Job, ReplayedScan, Run
from avsreplay.simulate import scenario_of
from avsreplay.sweep.kinds import episode_lines
from avsreplay.sweep.metrics import metrics
from avsreplay.sweep.plan import Task

__all__ = ["SCAN_COLUMNS", "Outcome", "run_task"]

SCAN_COLUMNS = (
    "seq",
    "fault",
    "harmful",
    "gamma",
    "rms_m",
    "alpha_m",
    "inlier_ratio",
    "nis",
    "nees",
    "pos_err_m",
    "rot_err_deg",
)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a run came to.

    Attributes:
        id: of its task.  status: ``ok``, ``failed`` (an error of the input) or ``crashed``.  error: its one line.
        metrics: numbers, truth values and words by name.  scans: a list a scan in the order of SCAN_COLUMNS.
        episodes: a list a window of a fault in the order of EPISODE_COLUMNS.
    """

    id: str
    status: str
    error: str | None = None
    metrics: Mapping[str, Any] | None = None
    scans: tuple[tuple[Any, ...], ...] = ()
    episodes: tuple[tuple[Any, ...], ...] = ()


def run_task(task: Task) -> Outcome:
    """Run ``task``; equal tasks give equal outcomes, wherever they run."""
    try:
        with tempfile.TemporaryDirectory(prefix="avsreplay-") as folder:
            return _replayed(task, _log(task, Path(folder)))
    except AvsError as error:
        return Outcome(task.id, "failed", error.what)


def _log(task: Task, folder: Path) -> Path:
    """The log to replay: the task's own, or its scenario recorded into ``folder``."""
    if task.log:
        return Path(task.log)
    scenario = scenario_of(toml_document.parse(task.scenario, "scenario"), folder=Path(task.folder))
    model = Path(task.model) if task.model else None
    record_scenario(scenario, folder / "run.mcap", RecordOptions(model=model, compression="none"))
    return folder / "run.mcap"


def _replayed(task: Task, log: Path) -> Outcome:
    options = SourceOptions(model=Path(task.model)) if task.log and task.model else SourceOptions()
    with Run(Job(source=log, options=options, assignments=task.assignments, prefetch=0)) as run:
        length_m = run.config.faults.resolved(run.surface.extent).length_m or 0.0
        lines: list[tuple[Any, ...]] = []

        def keep(scan: ReplayedScan) -> None:
            lines.append(_line(scan.row, scan.outcome.scan, run.source.header.labels, length_m))

        last = None
        for row in run.rows([keep] if task.scans else []):
            last = row
        summary = run.summary()
        episodes = episode_lines(summary.faults.episodes)
        return Outcome(task.id, "ok", None, metrics(summary, last), tuple(lines), episodes)


def _line(row: Row, scan: Scan, labels: tuple[Label, ...], length_m: float) -> tuple[Any, ...]:
    harmful = any(label.harmful and label.start_ns <= scan.log_ns < label.end_ns for label in labels)
    alpha = None
    if row.innov_m is not None and row.innov_deg is not None:
        alpha = float(np.hypot(row.innov_m, length_m * np.radians(row.innov_deg)))
    scores = (row.rms_m, alpha, row.inlier_ratio, row.nis, row.nees, row.pos_err_m, row.rot_err_deg)
    return (row.seq, row.fault, harmful, row.gamma, *scores)
