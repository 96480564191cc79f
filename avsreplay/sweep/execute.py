"""Runs tasks in this process, on worker processes of this machine, or on a Dask cluster."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

from avsreplay.errors import MissingBackend, UnreadableInput
from avsreplay.sweep.expansion import Task
from avsreplay.sweep.worker import RunResult, run_task

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
