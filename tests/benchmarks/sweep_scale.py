"""How far one scheduler and one client carry a campaign: cost a run, measured with up to 1,000 workers that only wait.

python tests/benchmarks/sweep_scale.py [--quick] [--seconds 5] [--runs 100000]

Workers live in this process and do nothing, so all processor time is the scheduler's and the client's, and even the
workers' own bookkeeping is counted against them: an upper bound. The law: with W workers and runs of T seconds the
campaign takes max(N T / W, N c, N j) seconds, c the scheduler's and j the client's cost of a run; it stops scaling
at W = T / max(c, j). A queue of one server is simulated beside the law.
"""

from __future__ import annotations

import argparse
import heapq
import json
import pickle
import tempfile
import time
from pathlib import Path

from sweep_speed import CAMPAIGN

from avsreplay.sweep import Journal, expand, load_campaign
from avsreplay.sweep.worker import Outcome, run_task


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="10 and 50 workers, 500 tasks")
    parser.add_argument("--seconds", type=float, default=5.0, help="length of a run in the forecast")
    parser.add_argument("--runs", type=int, default=100_000, help="runs in the forecast")
    args = parser.parse_args()
    like, line_s, size, pickled = _client_cost()
    print(f"an outcome: {pickled} bytes over the wire, {size} bytes in the journal")
    print(f"client: {1e3 * line_s:.3f} ms a run to unpack and note it")
    costs = {}
    for workers, tasks in (
        ((10, 500), (50, 500)) if args.quick else ((10, 1000), (100, 1000), (300, 2000), (1000, 3000))
    ):
        costs[workers] = _scheduler_cost(workers, tasks)
        print(f"{workers} workers: {1e3 * costs[workers]:.3f} ms a run (scheduler, client and idle workers, one core)")
    worst = max(costs.values())
    _forecast(args.runs, args.seconds, worst, line_s, size, like)


def _client_cost() -> tuple[Outcome, float, int, int]:
    """A true outcome of 600 scans' size, seconds to take it in, bytes of its line and of its pickle."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "c.toml").write_text(CAMPAIGN.format(runs=1))
        like = run_task(next(expand(load_campaign(folder / "c.toml")).points()).task)
        many = json.loads(json.dumps(like.scans * (600 // len(like.scans))))  # no number shared, as in a true run
        like = Outcome(like.id, like.status, like.error, like.metrics, tuple(tuple(scan) for scan in many))
        data = pickle.dumps(like)
        with Journal(folder / "journal.txt") as journal:
            start = time.process_time()
            for k in range(200):
                outcome = pickle.loads(data)
                journal.add(Outcome(f"{k:024x}", outcome.status, outcome.error, outcome.metrics, outcome.scans))
            took = (time.process_time() - start) / 200
        return like, took, (folder / "journal.txt").stat().st_size // 200, len(data)


def _scheduler_cost(workers: int, tasks: int) -> float:
    import dask
    from distributed import Client, LocalCluster, as_completed

    quiet = {
        "distributed.comm.timeouts.connect": "600s",
        "distributed.scheduler.worker-ttl": None,
        "distributed.worker.profile.enabled": False,  # a sampling thread a worker: not what is measured
        "distributed.admin.system-monitor.interval": "60s",
    }
    with (
        dask.config.set(quiet),
        LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=False, dashboard_address=":0", memory_limit=None
        ) as cluster,
        Client(cluster) as client,
    ):
        client.gather(client.map(_nothing, range(workers), pure=False))
        start, running, sent = time.process_time(), as_completed(), 0
        for _ in range(min(tasks, 4 * workers)):
            running.add(client.submit(_nothing, sent, pure=False))
            sent += 1
        for _ in running:
            if sent < tasks:
                running.add(client.submit(_nothing, sent, pure=False))
                sent += 1
        return (time.process_time() - start) / tasks


def _nothing(value: int) -> int:
    return value


def _forecast(runs: int, seconds: float, cost: float, line: float, size: int, like: Outcome) -> None:
    print(f"forecast for {runs} runs of {seconds} s with {1e3 * cost:.3f} ms a run at the scheduler:")
    for workers in (2, 10, 100, 1000, 3000, 10000):
        law = max(runs * seconds / workers, runs * cost, runs * line)
        queue = _queue(runs, workers, seconds, max(cost, line))
        share = runs * seconds / workers / queue
        print(f"  {workers:6d} workers: law {law:9.0f} s, queue {queue:9.0f} s, efficiency {share:.0%}")
    print(f"  stops scaling at {seconds / max(cost, line):.0f} workers")
    print(f"  journal {runs * size / 1e9:.1f} GB, of {len(like.scans)} scans a run; tasks held at once: 4 a worker")


def _queue(runs: int, workers: int, seconds: float, cost: float) -> float:
    """Seconds until the last run is in: one server, ``cost`` a run, first come first served."""
    free = [0.0] * min(workers, runs)
    server = end = 0.0
    for _ in range(runs):
        server = max(server, heapq.heappop(free)) + cost
        end = max(end, server + seconds)
        heapq.heappush(free, server + seconds)
    return end


if __name__ == "__main__":
    main()
