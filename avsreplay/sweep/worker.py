"""One run, in a worker: record the scenario, replay the log as ``avsreplay run`` does, and summarise it.

An error of the input is the result of the run; it does not end the campaign.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from avsreplay import settings, toml_document
from avsreplay.errors import AvsError
from avsreplay.log import SourceOptions
from avsreplay.record import RecordOptions, record_scenario
from avsreplay.records import Label, Scan
from avsreplay.report.summary import Summary
from avsreplay.rows import Row
from avsreplay.run import Job, ReplayedScan, Run
from avsreplay.simulate import scenario_of
from avsreplay.sweep.expansion import Task
from avsreplay.sweep.fault_kinds import episode_lines

_SCORES = ("rms_m", "alpha_m", "inlier_ratio", "nis", "nees", "pos_err_m", "rot_err_deg")
SCAN_COLUMNS = ("seq", "fault", "harmful", "gamma", *_SCORES)


@dataclass(frozen=True, slots=True)
class RunResult:
    """The result of one run.

    Attributes:
        id: Id of its task.
        status: ``ok``; ``lossy``: part of the log could not be read; ``failed``: an error of the input; ``crashed``.
        error: One line of text, None where the status is ``ok``.
        metrics: Numbers, truth values and words by name.
        scans: One tuple per scan, in the order of SCAN_COLUMNS.
        episodes: One tuple per fault window, in the order of EPISODE_COLUMNS.
        scan_count: Number of scans that are kept.
    """

    id: str
    status: str
    error: str | None = None
    metrics: Mapping[str, Any] | None = None
    scans: tuple[tuple[Any, ...], ...] = ()
    episodes: tuple[tuple[Any, ...], ...] = ()
    scan_count: int = 0


def run_task(task: Task) -> RunResult:
    """Make one run; equal tasks give equal results, wherever they run."""
    try:
        with tempfile.TemporaryDirectory(prefix="avsreplay-") as folder:
            return _replayed(task, log_of(task, Path(folder)))
    except AvsError as error:
        return RunResult(task.id, "failed", error.what)


def log_of(task: Task, folder: Path) -> Path:
    """The log of a run: the one it names, or its scenario recorded into ``folder``."""
    if task.log:
        return Path(task.log)
    scenario = scenario_of(toml_document.parse(task.scenario, "scenario"), folder=Path(task.folder))
    model = Path(task.model) if task.model else None
    record_scenario(scenario, folder / "run.mcap", RecordOptions(model=model, compression="none"))
    return folder / "run.mcap"


def _replayed(task: Task, log: Path) -> RunResult:
    options = SourceOptions(model=Path(task.model)) if task.log and task.model else SourceOptions()
    with Run(Job(source=log, options=options, assignments=task.assignments, prefetch=0)) as run:
        length_m = settings.given(run.config.faults.resolved(run.surface.extent).length_m)
        lines: list[tuple[Any, ...]] = []

        def keep(scan: ReplayedScan) -> None:
            lines.append(_line(scan.row, scan.outcome.scan, run.source.header.labels, length_m))

        last = None
        for row in run.rows([keep] if task.scans else []):
            last = row
        summary, losses = run.summary(), run.source.losses
        found = flat_metrics(summary, last), tuple(lines), episode_lines(summary.faults.episodes), len(lines)
        if losses:
            what = f"{len(losses)} damaged places were left out, the first: {losses[0].what}"
            return RunResult(task.id, "lossy", what, *found)
        return RunResult(task.id, "ok", None, *found)


def _line(row: Row, scan: Scan, labels: tuple[Label, ...], length_m: float) -> tuple[Any, ...]:
    harmful = any(label.harmful and label.start_ns <= scan.log_ns < label.end_ns for label in labels)
    alpha = None
    if row.innov_m is not None and row.innov_deg is not None:
        alpha = float(np.hypot(row.innov_m, length_m * np.radians(row.innov_deg)))
    scores = (alpha if name == "alpha_m" else getattr(row, name) for name in _SCORES)
    return (row.seq, row.fault, harmful, row.gamma, *scores)


def flat_metrics(summary: Summary, last: Row | None) -> dict[str, Any]:
    """A summary as flat values by dotted name: its single values, parameter errors, worst coasting, last row."""
    plain = settings.dump(summary)
    flat = dict(_flat({k: v for k, v in plain.items() if k not in ("parameters", "coasts")}))
    for parameter in plain["parameters"]:
        for what in ("error", "one_sigma"):
            flat[f"parameter.{_word(parameter['name'])}.{what}"] = parameter[what]
    for what in ("duration_s", "pos_err_m", "rot_err_deg"):
        flat[f"worst_coast.{what}"] = max((c[what] for c in plain["coasts"] if c[what] is not None), default=None)
    for what in ("nees", "pos_err_m", "rot_err_deg", "pos_1s_m", "rot_1s_deg", "converged", "estimator"):
        flat[f"end.{what}"] = getattr(last, what) if last is not None else None
    return flat


def _flat(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{_word(key)}.")
        elif not isinstance(value, list):
            yield f"{prefix}{_word(key)}", value


def _word(name: str) -> str:
    return "".join(c if c.isalnum() or c == "_" else "_" for c in name).strip("_")
