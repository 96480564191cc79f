"""A benchmark as a whole: scenarios are prepared, runs are made and kept in a journal, and the
result is written.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avsreplay.benchmark import results
from avsreplay.benchmark.entries import Entry
from avsreplay.benchmark.prepare import prepare
from avsreplay.benchmark.prepared import Prepared
from avsreplay.benchmark.suite import Suite, SuiteScenario
from avsreplay.benchmark.work import BenchmarkTask, run_benchmark_task, task_of
from avsreplay.sweep.campaign import RunResult
from avsreplay.sweep.execute import run_tasks
from avsreplay.sweep.journal import Journal

Progress = Callable[[Iterator[Any], int, str], Iterator[Any]]
"""Shows progress: (items, their number, what they are) -> the same items."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """What is to be run.

    Attributes:
        suite: the suite.
        scenarios: of it.
        entries: rows of the table.
        repeats: motions of every simulated scenario.
        seed: of everything that is drawn.
        n_scans: largest number of scans of a run; None: all.
        data: folder of the recordings of others.
        folder: where logs and results are kept.
    """

    suite: Suite
    scenarios: tuple[SuiteScenario, ...]
    entries: tuple[Entry, ...]
    repeats: int
    seed: int
    n_scans: int | None
    data: Path
    folder: Path


@dataclass(frozen=True, slots=True)
class Plan:
    """The runs of an order: prepared scenarios, and the task of each that can be run."""

    order: Order
    logs: tuple[Prepared, ...]
    tasks: tuple[BenchmarkTask, ...]
    missing: dict[str, str]


def planned(order: Order, progress: Progress) -> Plan:
    """Record the scenarios that are not recorded yet, and return the runs.

    Args:
        order: what is to be run.
        progress: shows the progress of the recordings.

    Raises:
        UsageError: a back end or estimator is unknown.
        UnreadableInput: a log cannot be written.
    """
    missing = {entry.name: entry.missing for entry in order.entries}
    asked = [
        (scenario, repeat)
        for repeat in range(order.repeats)
        for scenario in order.scenarios
        if repeat == 0 or not scenario.data or scenario.data == "cube-tosses"
    ]
    folder = order.folder / "logs"
    logs = tuple(
        prepare(order.suite, scenario, order.seed, repeat, folder, order.data)
        for scenario, repeat in progress(iter(asked), len(asked), "scenarios")
    )
    tasks = tuple(
        task_of(entry, log, order.n_scans)
        for log in logs
        for entry in order.entries
        if not log.missing and not missing[entry.name] and _applies(entry, log, order.entries)
    )
    return Plan(order, logs, tasks, missing)


def _applies(entry: Entry, log: Prepared, entries: Sequence[Entry]) -> bool:
    """Whether a run adds anything: poses need no back end, so that one per estimator is made."""
    first = next(each for each in entries if each.estimator == entry.estimator)
    return not log.poses or entry == first


def run(plan: Plan, journal: Journal, workers: int, progress: Progress) -> None:
    """Make the runs that are not in the journal, and add them to it.

    Args:
        plan: the runs.
        journal: open journal of the folder.
        workers: processes; 0: this one.
        progress: shows the progress.

    Raises:
        MissingBackend: Dask is needed and not installed.
    """
    waiting = [task for task in plan.tasks if task.id not in journal]
    done = run_tasks(waiting, workers, work=run_benchmark_task)
    for result in progress(done, len(waiting), "runs"):
        journal.add(result)


def result(plan: Plan, journal: Journal) -> tuple[results.Record, dict[str, float]]:
    """Return the document of all finished runs, and the milliseconds per scan by entry.

    Args:
        plan: the runs.
        journal: with the runs that are finished.
    """
    order = plan.order
    runs = [_lost(log) for log in plan.logs if log.missing]
    done = [(task, journal.result(task.id)) for task in plan.tasks if task.id in journal]
    runs += [_record(task, found) for task, found in done]
    suite = {
        "name": order.suite.params.name,
        "sha256": order.suite.sha256,
        "seed": order.seed,
        "repeats": order.repeats,
        "n_scans": order.n_scans,
    }
    entries = [{"name": e.name, "missing": plan.missing[e.name]} for e in order.entries]
    return results.document(suite, entries, runs), _times(done)


def _named(log: Prepared) -> dict[str, Any]:
    return {"scenario": log.scenario, "group": log.group, "repeat": log.repeat}


def _lost(log: Prepared) -> results.Record:
    return {**_named(log), "entry": "", "status": "not available", "error": log.missing}


def _record(task: BenchmarkTask, found: RunResult) -> results.Record:
    status = found.status if found.status == "ok" else "failed"
    named = {**_named(task.log), "entry": task.entry.name, "status": status, "error": found.error}
    return {**named, **(found.metrics or {})}


def _times(done: Sequence[tuple[BenchmarkTask, RunResult]]) -> dict[str, float]:
    """Mean time per scan by entry [ms], over its runs."""
    spent: dict[str, list[float]] = {}
    for task, found in done:
        spent.setdefault(task.entry.name, [])
        if found.metrics and not task.log.poses:
            spent[task.entry.name].append(found.metrics["ms_per_scan"])
    return {name: math.fsum(v) / len(v) if v else 0.0 for name, v in spent.items()}
