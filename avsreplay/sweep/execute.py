"""Tasks to outcomes, as they come: in this process, on worker processes of this machine, or on a Dask cluster."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

from avsreplay.errors import MissingBackend, UnreadableInput
from avsreplay.sweep.plan import Task
from avsreplay.sweep.worker import Outcome, run_task

__all__ = ["execute"]

IN_FLIGHT = 4  # tasks a worker thread has in hand or in wait; keeps the scheduler's list short
CONNECT_S = 10  # how long a scheduler has to answer
LOOK_EVERY = 64  # completions between looks at how many workers there are


def execute(tasks: Iterable[Task], workers: int = 0, scheduler: str | None = None) -> Iterator[Outcome]:
    """Run ``tasks``; outcomes come in any order, one for each.

    Args:
        tasks: what to run.
        workers: processes of this machine; 0 runs here, one after the other, without Dask.
        scheduler: address of a Dask scheduler; its workers must see the files that tasks name.

    Raises:
        MissingBackend: Dask is asked for and not installed.  UnreadableInput: the scheduler does not answer.
    """
    if workers == 0 and scheduler is None:
        yield from _here(tasks)
        return
    with _client(workers, scheduler) as client:
        yield from _on(client, iter(tasks))


def _distributed() -> Any:
    """Dask's distributed module, which ships no types."""
    try:
        return importlib.import_module("distributed")
    except ImportError:
        hint = "pip install 'avsreplay[sweep]', or --workers 0 to run in this process"
        raise MissingBackend("Dask (distributed) is not installed", where="sweep", hint=hint) from None


def _here(tasks: Iterable[Task]) -> Iterator[Outcome]:
    with ThreadPoolExecutor(max_workers=1) as pool:
        for task in tasks:
            future = pool.submit(run_task, task)
            error = future.exception()
            yield future.result() if error is None else _crashed(task.id, error)


@contextmanager
def _client(workers: int, scheduler: str | None) -> Iterator[Any]:
    dask = _distributed()
    if scheduler is not None:
        try:
            with dask.Client(scheduler, timeout=CONNECT_S) as client:
                yield client
        except (OSError, ValueError) as error:
            what = f"the scheduler does not answer: {str(error).splitlines()[0]}"
            raise UnreadableInput(what, where=scheduler, hint="check the address") from None
        return
    with (
        dask.LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=":0", memory_limit=None
        ) as cluster,
        dask.Client(cluster) as client,
    ):
        yield client


def _on(client: Any, tasks: Iterator[Task]) -> Iterator[Outcome]:
    """A bounded number in flight; a worker that dies has its tasks run elsewhere by the scheduler."""
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


def _collected(future: Any) -> Outcome:
    if future.status == "finished":
        outcome: Outcome = future.result()
        return outcome
    return _crashed(str(future.key).removeprefix("run-"), future.exception())


def _crashed(task_id: str, error: BaseException | None) -> Outcome:
    """A run that broke: its kind and first line, free of addresses, so that the row is the same everywhere."""
    if type(error).__name__ == "KilledWorker":
        return Outcome(task_id, "crashed", "the worker process died on it, again and again")
    first = (str(error).splitlines() or [""])[0]
    return Outcome(task_id, "crashed", f"{type(error).__name__}: {first}")
