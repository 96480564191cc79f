"""Many short runs on one worker and on two: speed-up, and the overhead beside the runs.

python tests/benchmarks/sweep_speed.py [--runs 500] [--quick] [--pretend 0.2]

With ``--pretend S`` a run only waits S seconds and hands back an outcome of the usual size: what is
then lost is the machinery's own, whatever else the processor is doing. Overhead is the wall time of
one worker beyond the runs' own.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

from avsreplay.sweep.campaign import RunResult, load_campaign
from avsreplay.sweep.execute import run_task, run_tasks, write_results
from avsreplay.sweep.expansion import expand
from avsreplay.sweep.journal import Journal

CAMPAIGN = """
name = "speed"
seed = 1
repeats = {runs}
[set]
"scenario.duration_s" = 6.0
"scenario.rate_hz" = 2.0
"scenario.scanner.rays" = [72, 72]
"scenario.fault" = []
[[draw]]
key = "scenario.motion.attitude_xyzw"
kind = "attitude"
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=500)
    parser.add_argument("--quick", action="store_true", help="40 runs")
    parser.add_argument(
        "--pretend", type=float, metavar="S", help="wait S seconds in place of a run"
    )
    args = parser.parse_args()
    runs = 40 if args.quick else args.runs
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "c.toml").write_text(CAMPAIGN.format(runs=runs))
        plan = expand(load_campaign(folder / "c.toml"))
        act = _waiting(args.pretend, plan) if args.pretend else run_task
        sys.modules["avsreplay.sweep.execute"].run_task = act
        direct = _direct(act, plan, min(runs, 30))
        print(f"one run by itself: {1e3 * direct:.1f} ms")
        took = {workers: _swept(plan, workers, folder / str(workers)) for workers in (1, 2)}
    for workers, (up, seconds, results) in took.items():
        print(
            f"{workers} workers: {runs} runs in {seconds:.2f} s (start {up:.2f} s, results"
            f" {results:.2f} s)"
        )
    print(f"speed-up of 2 over 1: {took[1][1] / took[2][1]:.2f}")
    print(
        f"overhead of the machinery at 1 worker: {took[1][1] / (runs - 1) / direct - 1.0:.1%} of"
        " run time"
    )


def _waiting(seconds: float, plan):
    """A stand-in for a run, with a true run's outcome in size."""
    like = run_task(next(plan.points()).task)

    def act(task):
        time.sleep(seconds)
        return RunResult(task.id, like.status, like.error, like.metrics, like.scans)

    return act


def _direct(act, plan, count: int) -> float:
    tasks = [point.task for point, _ in zip(plan.points(), range(count), strict=False)]
    act(tasks[0])
    start = time.perf_counter()
    for task in tasks:
        act(task)
    return (time.perf_counter() - start) / count


def _swept(plan, workers: int, folder: Path) -> tuple[float, float, float]:
    """Seconds to the first outcome, from it to the last, and for the result files."""
    start = time.perf_counter()
    first = 0.0
    with Journal(folder) as journal:
        for outcome in run_tasks((p.task for p in plan.points()), workers):
            first = first or time.perf_counter()
            journal.add(outcome)
        last = time.perf_counter()
    write_results(plan, journal, folder)
    return first - start, last - first, time.perf_counter() - last


if __name__ == "__main__":
    main()
