"""Limits of one scheduler and one client in a campaign.

python tests/benchmarks/sweep_scale.py [--quick] [--seconds 5] [--runs 100000] [--workers 1000]

1. Measured: what the client spends on a run (unpack the outcome, note it in the journal), and what
   scheduler, client and ten idle workers in one process spend on a run that does nothing: an upper
   bound of the scheduler's cost c.
2. Simulated: Dask's own scheduler state, without network or workers, is fed the campaign event by
   event. It decides who runs what; the clock is a made-up one on which a run takes T seconds and
   each run costs the scheduler c.
3. The law: N runs on W workers take max(N T / W, N c, N j) seconds, j the client's cost; it stops
   scaling at W = T / max(c, j).
"""

from __future__ import annotations

import argparse
import asyncio
import heapq
import json
import logging
import pickle
import tempfile
import time
from pathlib import Path

from sweep_speed import CAMPAIGN

from avsreplay.sweep.campaign import load_campaign
from avsreplay.sweep.execute import TASKS_PER_THREAD, RunResult, run_task
from avsreplay.sweep.expansion import expand
from avsreplay.sweep.journal import Journal

SCANS = 600


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="2,000 runs on at most 100 workers")
    parser.add_argument("--seconds", type=float, default=5.0, help="length of a run")
    parser.add_argument("--runs", type=int, default=100_000)
    parser.add_argument("--workers", type=int, default=1000, help="the most workers")
    args = parser.parse_args()
    runs, most = (2000, 100) if args.quick else (args.runs, args.workers)
    logging.disable(logging.WARNING)
    note, line, wire = client_cost()
    print(f"an outcome of {SCANS} scans: {wire} bytes over the wire, {line} bytes in the journal")
    print(f"client: {1e3 * note:.2f} ms a run to unpack and note it")
    cost = whole_cost(10, 300 if args.quick else 1000)
    print(f"scheduler, client and 10 idle workers together: {1e3 * cost:.2f} ms a run")
    print(f"{runs} runs of {args.seconds} s, {1e3 * cost:.2f} ms each at the scheduler:")
    for workers in [w for w in (10, 100, 1000, 3000) if w <= most]:
        took, cpu, held = asyncio.run(simulated(runs, workers, args.seconds, cost))
        law = max(runs * args.seconds / workers, runs * cost, runs * note)
        print(
            f"  {workers:5d} workers: law {law:8.0f} s, simulated {took:8.0f} s, workers busy"
            f" {runs * args.seconds / workers / took:.0%}, at most {held} tasks at the scheduler,"
            f" its state machine {1e3 * cpu:.3f} ms a run"
        )
    print(
        f"stops scaling at {args.seconds / max(cost, note):.0f} workers; journal"
        f" {runs * line / 1e9:.1f} GB"
    )


def client_cost() -> tuple[float, int, int]:
    """Seconds to take in a true outcome, bytes of its line, bytes of its pickle."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "c.toml").write_text(CAMPAIGN.format(runs=1))
        like = run_task(next(expand(load_campaign(folder / "c.toml")).points()).task)
        many = json.loads(
            json.dumps(like.scans * (SCANS // len(like.scans)))
        )  # no number shared, as in a true run
        data = pickle.dumps(
            RunResult(like.id, like.status, None, like.metrics, tuple(tuple(scan) for scan in many))
        )
        with Journal(folder) as journal:
            start = time.process_time()
            for k in range(200):
                outcome = pickle.loads(data)
                journal.add(
                    RunResult(
                        f"{k:024x}", outcome.status, outcome.error, outcome.metrics, outcome.scans
                    )
                )
            took = (time.process_time() - start) / 200
        return took, (folder / "journal.txt").stat().st_size // 200, len(data)


def whole_cost(workers: int, tasks: int) -> float:
    """Processor seconds a run of nothing, all parts in this process."""
    import dask
    from distributed import Client, LocalCluster, as_completed

    options = {
        "threads_per_worker": 1,
        "processes": False,
        "dashboard_address": ":0",
        "memory_limit": None,
    }
    with (
        dask.config.set({"distributed.worker.profile.enabled": False}),
        LocalCluster(n_workers=workers, **options) as cluster,
        Client(cluster) as client,
    ):
        client.gather(client.map(abs, range(workers), pure=False))
        start, running = time.process_time(), as_completed()
        sent = iter(range(tasks))
        for number, _ in zip(sent, range(TASKS_PER_THREAD * workers), strict=False):
            running.add(client.submit(abs, number, pure=False))
        for _ in running:
            if (number := next(sent, None)) is not None:
                running.add(client.submit(abs, number, pure=False))
        return (time.process_time() - start) / tasks


async def simulated(
    runs: int, workers: int, seconds: float, cost: float
) -> tuple[float, float, int]:
    """Made-up seconds until all is done, processor seconds a run in the state machine, most tasks
    it held.
    """
    state = State(workers)
    begun, now, held, sent = time.process_time(), 0.0, 0, 0
    free = dict.fromkeys(state.addresses, 0.0)
    events: list[tuple[float, str, str]] = []
    waiting = runs
    while waiting:
        while sent < runs and len(state.scheduler.tasks) < TASKS_PER_THREAD * workers:
            state.submit(sent)
            sent += 1
        held = max(held, len(state.scheduler.tasks))
        for address, key in state.handed_out():
            free[address] = max(free[address], now) + seconds
            heapq.heappush(events, (free[address], address, key))
        end, address, key = heapq.heappop(events)
        now = max(now, end) + cost
        state.finish(address, key, end - seconds, end)
        waiting -= 1
    return now, (time.process_time() - begun) / runs, held


class State:
    """Dask's scheduler with made-up workers: its state machine, and none of its network."""

    def __init__(self, workers: int) -> None:
        from dask._task_spec import Task
        from distributed.core import Status
        from distributed.scheduler import ClientState, Scheduler, WorkerState

        self.scheduler = Scheduler(dashboard=False, host="127.0.0.1", port=0)
        self._client = self.scheduler.clients["client"] = ClientState("client")
        self._spec = Task("x", abs, 1)
        self._messages: list[tuple[str, str]] = []
        self.scheduler.send_all = lambda _client, worker: self._keep(worker)
        for k in range(workers):
            address = f"tcp://10.{k // 62500}.{k // 250 % 250}.{k % 250}:1"
            worker = WorkerState(
                address=address,
                status=Status.running,
                pid=k,
                name=k,
                nthreads=1,
                memory_limit=1 << 34,
                local_directory="",
                nanny=None,
                server_id=address,
                scheduler=self.scheduler,
            )
            self.scheduler.workers[address] = worker
            self.scheduler.total_nthreads += 1
            self.scheduler.running.add(worker)
            self.scheduler.check_idle_saturated(worker)
        self.addresses = list(self.scheduler.workers)

    def submit(self, number: int) -> None:
        task = self.scheduler.new_task(f"run-{number}", self._spec, "released")
        task.priority = (0, number, 0)
        task.who_wants = {self._client}
        self._client.wants_what.add(task)
        self.scheduler.transitions({task.key: "waiting"}, "submit")

    def finish(self, address: str, key: str, start: float, stop: float) -> None:
        done = {"nbytes": 46_000, "type": b"", "typename": "RunResult", "worker": address}
        spans = [{"action": "compute", "start": start, "stop": stop}]
        next_, _, messages = self.scheduler._transition(
            key, "memory", "finish", startstops=spans, **done
        )
        self._keep(messages)
        self.scheduler.transitions(next_, "finish")
        task = self.scheduler.tasks[key]
        self._client.wants_what.discard(task)
        task.who_wants = set()
        self.scheduler.transitions({key: "forgotten"}, "release")
        self.scheduler.stimulus_queue_slots_maybe_opened(stimulus_id="slots")

    def handed_out(self) -> list[tuple[str, str]]:
        """Tasks given to workers since the last call."""
        out, self._messages = self._messages, []
        return out

    def _keep(self, messages: dict) -> None:
        for address, notes in messages.items():
            self._messages += [
                (address, note["key"]) for note in notes if note["op"] == "compute-task"
            ]


if __name__ == "__main__":
    main()
