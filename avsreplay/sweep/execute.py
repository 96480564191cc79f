"""Runs tasks in this process, on worker processes of this machine, or on a Dask cluster; writes the
result files.

A task records its scenario, replays the log as ``avsreplay run`` does, and summarises it. An error
of the input is the result of the run; it does not end the campaign.
"""

from __future__ import annotations

import importlib
import json
import logging
import signal
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from avsreplay import __version__, arithmetic, settings, toml_document
from avsreplay.errors import AvsError, MissingBackend, UnreadableInput, UsageError
from avsreplay.files import output_text
from avsreplay.job_file import JobFile, read_job
from avsreplay.log import SourceOptions
from avsreplay.log.options import lost_text
from avsreplay.plan.arm import with_arm
from avsreplay.record import RecordOptions, record_scenario
from avsreplay.records import Belief, Label, Scan
from avsreplay.replan import Replanning
from avsreplay.report.summary import Summary
from avsreplay.rows import Row
from avsreplay.run import Job, Listener, ReplayedScan, Run
from avsreplay.saved_result import of_run
from avsreplay.simulate.scenario import scenario_of
from avsreplay.sweep.campaign import RECORDED_SCORES, RunResult
from avsreplay.sweep.expansion import Expansion, Point, Task
from avsreplay.sweep.journal import Journal, arrow, scan_schema, write_batches
from avsreplay.sweep.page import build_sweep_page
from avsreplay.sweep.statistics import episode_lines
from avsreplay.sweep.summary import CampaignFold, DetectorFold, SweepSummary

RUN_BATCH = 5_000  # runs held in memory while results.parquet is written
SCAN_BATCH = 200_000  # scans held in memory while scans.parquet is written
_FIXED = ("index", "cell", "repeat", "seed", "id", "status", "error")


def run_task(task: Task) -> RunResult:
    """Make one run; equal tasks give equal results, wherever they run."""
    try:
        with tempfile.TemporaryDirectory(prefix="avsreplay-") as folder:
            return _replayed(task, log_of(task, Path(folder)))
    except AvsError as error:
        return RunResult(task.id, "failed", error.what)


def log_of(task: Task, folder: Path) -> Path:
    """The log of a run: the one it names, or its scenario recorded into ``folder``.

    Args:
        task: the run.
        folder: where a scenario is recorded.
    """
    if task.log:
        return Path(task.log)
    scenario = scenario_of(toml_document.parse(task.scenario, "scenario"), folder=Path(task.folder))
    model = Path(task.model) if task.model else None
    record_scenario(scenario, folder / "run.mcap", RecordOptions(model=model, compression="none"))
    return folder / "run.mcap"


def _replayed(task: Task, log: Path) -> RunResult:
    with Run(_job(task, log)) as run:
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
        summary = run.summary()
        metrics = flat_metrics(summary, last) | (_flown(task, run, known) if task.flights else {})
        found = metrics, tuple(lines), episode_lines(summary.faults.episodes), len(lines)
        if what := lost_text(run.source.losses, run.source.damaged, len(run)):
            return RunResult(task.id, "lossy", what, *found)
        return RunResult(task.id, "ok", None, *found)


def _job(task: Task, log: Path) -> Job:
    """The run of a log, or of a job file, whose golden file is not used."""
    job = JobFile(log=log, given={}) if (found := read_job(log)) is None else found
    given = dict(job.given) | ({"model": Path(task.model)} if task.log and task.model else {})
    return Job(
        source=job.log,
        options=SourceOptions(**given),
        config_file=job.config,
        assignments=(*job.assignments, *task.assignments),
    )


def _flown(task: Task, run: Run, known: list[tuple[Row, Belief]]) -> dict[str, Any]:
    """How whole flights from the first converged scan on end, by name; none where the
    estimate did not converge.
    """
    if not any(row.converged for row, _ in known):
        return {"flights.count": 0}
    saved = of_run(run, [row for row, _ in known], [belief for _, belief in known])
    robot, arm = with_arm(saved.robot)
    planning = Replanning(
        replace(saved, robot=robot), saved.plan, saved.limits, saved.supervisor, arm
    )
    seed = 0 if task.log else toml_document.parse(task.scenario, "scenario").table["seed"]
    flights = planning.flights(saved.index_at(None), task.flights, seed)
    ends = [each.outcome(planning.tolerance) for each, _ in flights]
    counts = {"count": len(ends)} | {
        name: ends.count(end)
        for name, end in (("captured", "captured"), ("outside", "outside"), ("aborted", "abort"))
    }
    counts["touched"] = sum(touched for _, touched in flights)
    shares = {f"{name}_share": counts[name] / len(ends) for name in counts if name != "count"}
    return {f"flights.{name}": value for name, value in {**counts, **shares}.items()}


def _line(row: Row, scan: Scan, labels: tuple[Label, ...], length_m: float) -> tuple[Any, ...]:
    harmful = any(
        label.harmful and label.start_ns <= scan.log_ns < label.end_ns for label in labels
    )
    alpha = None
    if row.innov_m is not None and row.innov_deg is not None:
        alpha = float(np.hypot(row.innov_m, length_m * np.radians(row.innov_deg)))
    scores = (alpha if name == "alpha_m" else getattr(row, name) for name in RECORDED_SCORES)
    return (row.seq, row.fault, harmful, row.gamma, *scores)


def flat_metrics(summary: Summary, last: Row | None) -> dict[str, Any]:
    """A summary as flat values by dotted name: its single values, parameter errors, worst
    coasting, last row.
    """
    plain = settings.dump(summary)
    flat = dict(_flat({k: v for k, v in plain.items() if k not in ("parameters", "coasts")}))
    for parameter in plain["parameters"]:
        for what in ("error", "one_sigma"):
            flat[f"parameter.{_word(parameter['name'])}.{what}"] = parameter[what]
    for what in ("duration_s", "pos_err_m", "rot_err_deg"):
        flat[f"worst_coast.{what}"] = max(
            (c[what] for c in plain["coasts"] if c[what] is not None), default=None
        )
    for what in (
        "nees",
        "pos_err_m",
        "rot_err_deg",
        "pos_1s_m",
        "rot_1s_deg",
        "converged",
        "estimator",
    ):
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


TASKS_PER_THREAD = 4  # tasks per worker thread that run or wait; limits the tasks at the scheduler
CONNECT_TIMEOUT_S = 10  # time limit for the answer of a scheduler [s]
WORKER_QUERY_PERIOD = 64  # completions between two queries for the number of workers


class Identified(Protocol):
    """A task of any kind: it can be sent to a worker and has an id."""

    @property
    def id(self) -> str:
        """Name of the run in the results."""


T = TypeVar("T", bound=Identified)


def run_tasks(
    tasks: Iterable[T],
    workers: int = 0,
    scheduler: str | None = None,
    dashboard: str = "127.0.0.1:0",
    work: Callable[[T], RunResult] = run_task,  # type: ignore[assignment]
) -> Iterator[RunResult]:
    """Run tasks; yields one result per task, in order of completion.

    Args:
        tasks: What to run.
        workers: Processes on this machine; 0 runs the tasks in this process, one after the other,
            without Dask.
        scheduler: Address of a Dask scheduler, whose workers must see the files that tasks name.
        dashboard: Address at which the Dask dashboard of ``workers`` listens.
        work: Makes one of them; it is a function of a module, so that workers can import it.

    Raises:
        MissingBackend: Dask is needed and not installed.
        UnreadableInput: The scheduler does not answer, or ended before the runs did.
        UsageError: A worker has another version or arithmetic.
    """
    if workers == 0 and scheduler is None:
        yield from _here(tasks, work)
        return
    with connected(workers, scheduler, dashboard) as client:
        yield from _on(client, iter(tasks), work)


def check_workers(workers: int, scheduler: str | None = None) -> None:
    """Raise MissingBackend where the processes of ``run_tasks`` need Dask and it is not installed.

    Args:
        workers: processes on this machine.
        scheduler: address of a Dask scheduler.
    """
    if workers or scheduler is not None:
        _distributed()


def _distributed() -> Any:
    """Dask's distributed module, which ships no types."""
    try:
        return importlib.import_module("distributed")
    except ImportError:
        hint = "pip install 'avsreplay[sweep]', or --workers 0 to run in this process"
        raise MissingBackend(
            "Dask (distributed) is not installed", where="--workers", hint=hint
        ) from None


def _here(tasks: Iterable[T], work: Callable[[T], RunResult]) -> Iterator[RunResult]:
    with ThreadPoolExecutor(max_workers=1) as pool:
        for task in tasks:
            future = pool.submit(work, task)
            error = future.exception()
            yield future.result() if error is None else crashed(task.id, error)


@contextmanager
def connected(workers: int, scheduler: str | None, dashboard: str) -> Iterator[Any]:
    """Connect to a Dask scheduler, or start one with workers on this machine, as a context.

    Args:
        workers: number of worker processes, where one is started.
        scheduler: address of a running scheduler; None starts one.
        dashboard: address of the dashboard of one that is started.

    Raises:
        UnreadableInput: the scheduler does not answer.
    """
    dask = _distributed()
    if scheduler is not None:
        try:
            with dask.Client(scheduler, timeout=CONNECT_TIMEOUT_S) as client:
                yield client
        except (OSError, ValueError) as error:
            what = f"the scheduler does not answer: {str(error).splitlines()[0]}"
            raise UnreadableInput(what, where=scheduler, hint="check the address") from None
        return
    options = {
        "threads_per_worker": 1,
        "processes": True,
        "memory_limit": None,
        "silence_logs": logging.CRITICAL,
    }
    with ExitStack() as stack:
        with _no_interrupt():
            cluster = dask.LocalCluster(
                n_workers=workers, host="127.0.0.1", dashboard_address=dashboard, **options
            )
            client = stack.enter_context(dask.Client(stack.enter_context(cluster)))
        yield client


@contextmanager
def _no_interrupt() -> Iterator[None]:
    """Delay SIGINT; threads and processes started meanwhile never receive it.

    A terminal sends Ctrl-C to all processes of a command. Only this one handles it; it then ends
    its workers.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # its start enables SIGINT
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _on(client: Any, tasks: Iterator[T], work: Callable[[T], RunResult]) -> Iterator[RunResult]:
    """Keep a bounded number of tasks at the scheduler, which repeats the tasks of a failed worker
    on another one.
    """
    running = _distributed().as_completed()
    held, count, limit = 0, 0, TASKS_PER_THREAD
    while True:
        if count % WORKER_QUERY_PERIOD == 0:
            limit = TASKS_PER_THREAD * max(1, sum(client.nthreads().values()))
        while held < limit and (task := next(tasks, None)) is not None:
            running.add(
                client.submit(_worked, work, task, software(), key=f"run-{task.id}", pure=False)
            )
            held += 1
        if held == 0:
            return
        future = next(running)
        held, count = held - 1, count + 1
        yield _collected(future)


def software() -> tuple[str, str]:
    """Version and arithmetic of this process; with other ones a run may have other bytes."""
    return __version__, arithmetic.state()


def _worked(work: Callable[[T], RunResult], task: T, expected: tuple[str, str]) -> RunResult:
    """Run a task on a worker whose software is that of the command."""
    found = software()
    if found != expected:
        there, here = (f"version {version}, {how} arithmetic" for version, how in (found, expected))
        hint = "set the variables of 'python -m avsreplay.arithmetic' before it starts"
        raise UsageError(f"has {there}; this command has {here}", where="a Dask worker", hint=hint)
    return work(task)


def _collected(future: Any) -> RunResult:
    if future.status == "finished":
        outcome: RunResult = future.result()
        return outcome
    if future.status != "error":  # cancelled or lost: nothing is known of the run
        hint = "the finished runs are saved; start it and give the same command"
        raise UnreadableInput("it ended before the runs did", where="Dask scheduler", hint=hint)
    error = future.exception()
    if isinstance(error, AvsError):  # of the worker; one of the run is its result
        raise error
    return crashed(str(future.key).removeprefix("run-"), error)


def crashed(task_id: str, error: BaseException | None) -> RunResult:
    """Return the result of a run that raised: kind and first line of the error, without addresses,
    which differ between runs.

    Args:
        task_id: the run.
        error: what it raised.
    """
    if type(error).__name__ == "KilledWorker":
        return RunResult(task_id, "crashed", "the worker process died repeatedly")
    first = (str(error).splitlines() or [""])[0]
    return RunResult(task_id, "crashed", f"{type(error).__name__}: {first}")


def write_results(plan: Expansion, journal: Journal, folder: Path) -> SweepSummary:
    """Write ``results.parquet``, ``scans.parquet`` (where scans are kept), ``summary.json`` and
    ``report.html``.

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
        write_batches(
            folder / "scans.parquet", scan_schema(), _scan_batches(sorted(ids), journal, detector)
        )
    summary = fold.result(detector.result() if detector else None)
    text = json.dumps({"version": __version__, **summary.document()}, indent=1, allow_nan=False)
    for name, content in (
        ("summary.json", text + "\n"),
        ("report.html", build_sweep_page(summary)),
    ):
        with output_text(folder / name) as stream:
            stream.write(content)
    return summary


def _finished(plan: Expansion, journal: Journal) -> Iterator[tuple[Point, RunResult]]:
    return (
        (point, journal.result(point.task.id))
        for point in plan.points()
        if point.task.id in journal
    )


def _values(point: Point, result: RunResult) -> dict[str, Any]:
    """The columns of a run that depend on the campaign: what was set, and its metrics."""
    return {
        **{f"set:{key}": value for key, value in point.values.items()},
        **(result.metrics or {}),
    }


def _kind(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "bool"
    return (
        "number"
        if isinstance(value, (int, float))
        else "text"
        if isinstance(value, str)
        else "mixed"
    )


def _write_runs(
    plan: Expansion, journal: Journal, kinds: Mapping[str, set[str]], path: Path
) -> None:
    """One row per run; a column is of truth values, float64 or text, anything mixed or nested
    as JSON text.
    """
    pa, _ = arrow()
    types = {"bool": pa.bool_(), "number": pa.float64(), "text": pa.string()}
    columns = [*sorted(name for name in kinds if name.startswith("set:"))]
    columns += sorted(name for name in kinds if not name.startswith("set:"))
    only = {name: "".join(kinds[name] - {"none"}) for name in columns}
    integers = {"index", "cell", "repeat", "seed"}
    fixed = [(name, pa.int64() if name in integers else pa.string()) for name in _FIXED]
    schema = pa.schema(
        [*fixed, *((name, types.get(only[name] or "number", pa.string())) for name in columns)]
    )

    def row(point: Point, result: RunResult) -> tuple[Any, ...]:
        found = _values(point, result)
        place = (
            point.index,
            point.cell,
            point.repeat,
            point.seed,
            result.id,
            result.status,
            result.error,
        )
        return (*place, *(_plain(found.get(name), only[name]) for name in columns))

    runs = (row(*found) for found in _finished(plan, journal))
    write_batches(path, schema, iter(lambda: list(islice(runs, RUN_BATCH)), []))


def _plain(value: Any, kind: str) -> Any:
    if value is None or kind in ("bool", "text"):
        return value
    return float(value) if kind == "number" else json.dumps(value)


def _scan_batches(
    ids: list[str], journal: Journal, detector: DetectorFold
) -> Iterator[list[tuple[Any, ...]]]:
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
