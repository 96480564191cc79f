"""Runs tasks in this process, on worker processes of this machine, or on a Dask cluster.

A task records its scenario, replays the log as ``avsreplay run`` does, and summarises it. An error of the input is the
result of the run; it does not end the campaign.
"""

from __future__ import annotations

import importlib
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from avsreplay import settings, toml_document
from avsreplay.errors import AvsError, MissingBackend, UnreadableInput
from avsreplay.log import SourceOptions
from avsreplay.plan.arm import with_arm
from avsreplay.record import RecordOptions, record_scenario
from avsreplay.records import Belief, Label, Scan
from avsreplay.replan import Replanning
from avsreplay.report.summary import Summary
from avsreplay.rows import Row
from avsreplay.run import Job, Listener, ReplayedScan, Run
from avsreplay.saved_result import of_run
from avsreplay.simulate import scenario_of
from avsreplay.sweep.expansion import Task
from avsreplay.sweep.statistics import episode_lines

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

        known: list[tuple[Row, Belief]] = []
        listeners: list[Listener] = [keep] if task.scans else []
        if task.flights:
            listeners.append(lambda scan: known.append((scan.row, scan.outcome.belief)))
        last = None
        for row in run.rows(listeners):
            last = row
        summary, losses = run.summary(), run.source.losses
        metrics = flat_metrics(summary, last) | (_flown(task, run, known) if task.flights else {})
        found = metrics, tuple(lines), episode_lines(summary.faults.episodes), len(lines)
        if losses:
            what = f"{len(losses)} damaged places were left out, the first: {losses[0].what}"
            return RunResult(task.id, "lossy", what, *found)
        return RunResult(task.id, "ok", None, *found)


def _flown(task: Task, run: Run, known: list[tuple[Row, Belief]]) -> dict[str, Any]:
    """How whole flights from the first converged scan on end, by name; none where the estimate did not converge."""
    if not any(row.converged for row, _ in known):
        return {"flights.count": 0}
    saved = of_run(run, [row for row, _ in known], [belief for _, belief in known])
    robot, arm = with_arm(saved.robot)
    planning = Replanning(replace(saved, robot=robot), saved.plan, saved.limits, saved.supervisor, arm)
    seed = 0 if task.log else toml_document.parse(task.scenario, "scenario").table["seed"]
    flights = planning.flights(saved.index_at(None), task.flights, seed)
    counts = settings.dump(flights)
    shares = {f"{name}_share": flights.share(name)[0] for name in counts if name != "count"}
    return {f"flights.{name}": value for name, value in {**counts, **shares}.items()}


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


IN_FLIGHT = 4  # tasks per worker thread that run or wait; limits the tasks at the scheduler
CONNECT_S = 10  # time limit for the answer of a scheduler [s]
LOOK_EVERY = 64  # completions between two queries for the number of workers


def run_tasks(
    tasks: Iterable[Task], workers: int = 0, scheduler: str | None = None, dashboard: str = "127.0.0.1:0"
) -> Iterator[RunResult]:
    """Run tasks; yields one result per task, in order of completion.

    Args:
        tasks: What to run.
        workers: Processes on this machine; 0 runs the tasks in this process, one after the other, without Dask.
        scheduler: Address of a Dask scheduler, whose workers must see the files that tasks name.
        dashboard: Address at which the Dask dashboard of ``workers`` listens.

    Raises:
        MissingBackend: Dask is needed and not installed.
        UnreadableInput: The scheduler does not answer.
    """
    if workers == 0 and scheduler is None:
        yield from _here(tasks)
        return
    with _client(workers, scheduler, dashboard) as client:
        yield from _on(client, iter(tasks))


def _distributed() -> Any:
    """Dask's distributed module, which ships no types."""
    try:
        return importlib.import_module("distributed")
    except ImportError:
        hint = "pip install 'avsreplay[sweep]', or --workers 0 to run in this process"
        raise MissingBackend("Dask (distributed) is not installed", where="sweep", hint=hint) from None


def _here(tasks: Iterable[Task]) -> Iterator[RunResult]:
    with ThreadPoolExecutor(max_workers=1) as pool:
        for task in tasks:
            future = pool.submit(run_task, task)
            error = future.exception()
            yield future.result() if error is None else _crashed(task.id, error)


@contextmanager
def _client(workers: int, scheduler: str | None, dashboard: str) -> Iterator[Any]:
    dask = _distributed()
    if scheduler is not None:
        try:
            with dask.Client(scheduler, timeout=CONNECT_S) as client:
                yield client
        except (OSError, ValueError) as error:
            what = f"the scheduler does not answer: {str(error).splitlines()[0]}"
            raise UnreadableInput(what, where=scheduler, hint="check the address") from None
        return
    options = {"threads_per_worker": 1, "processes": True, "memory_limit": None}
    with (
        dask.LocalCluster(n_workers=workers, host="127.0.0.1", dashboard_address=dashboard, **options) as cluster,
        dask.Client(cluster) as client,
    ):
        yield client


def _on(client: Any, tasks: Iterator[Task]) -> Iterator[RunResult]:
    """Keep a bounded number of tasks at the scheduler, which repeats the tasks of a failed worker on another one."""
    running = _distributed().as_completed()
    held, count, limit = 0, 0, IN_FLIGHT
    while True:
        if count % LOOK_EVERY == 0:
            limit = IN_FLIGHT * max(1, sum(client.nthreads().values()))
        while held < limit and (task := next(tasks, None)) is not None:
            running.add(client.submit(run_task, task, key=f"run-{task.id}", pure=False))
            held += 1
        if held == 0:
            return
        future = next(running)
        held, count = held - 1, count + 1
        yield _collected(future)


def _collected(future: Any) -> RunResult:
    if future.status == "finished":
        outcome: RunResult = future.result()
        return outcome
    return _crashed(str(future.key).removeprefix("run-"), future.exception())


def _crashed(task_id: str, error: BaseException | None) -> RunResult:
    """The result of a run that raised: kind and first line of the error, without addresses that differ between runs."""
    if type(error).__name__ == "KilledWorker":
        return RunResult(task_id, "crashed", "the worker process died repeatedly")
    first = (str(error).splitlines() or [""])[0]
    return RunResult(task_id, "crashed", f"{type(error).__name__}: {first}")
