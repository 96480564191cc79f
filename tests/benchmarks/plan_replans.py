"""Planning in a whole run: its share of the processor time, the number of replans, and what one
costs.

python tests/benchmarks/plan_replans.py LOG [LOG ...] [--set KEY=VALUE]

A replan is a call of the planner for a capture; it is "searched" where all initial paths were
iterated, and "warm" where the latest plan sufficed. The built-in log is that of ``avsreplay
record``.
"""

from __future__ import annotations

import argparse
import importlib
import time
from pathlib import Path

import numpy as np

from avsreplay.plan.guidance import Guidance
from avsreplay.run import Job, Run

module = importlib.import_module("avsreplay.plan.constrained")


def measured(log: Path, assignments: list[str]) -> tuple[list, float, float, int]:
    """For each replan (time [s], milliseconds, searched); processor time of guidance and of
    the run [s]; scans.
    """
    replans, spent, searched = [], [0.0], [False]
    plan, step, references = Guidance._capture_plan, Guidance.step, module.initial_references

    def noted(*args):
        searched[0] = True
        return references(*args)

    def planned(self, state, known):
        searched[0], begun = False, time.thread_time()
        found = plan(self, state, known)
        took_ms = 1e3 * (time.thread_time() - begun)
        replans.append(
            (known.t_ns * 1e-9, took_ms, searched[0], found[0], state.decision.action.value)
        )
        return found

    def stepped(*args):
        begun = time.thread_time()
        found = step(*args)
        spent[0] += time.thread_time() - begun
        return found

    Guidance._capture_plan, Guidance.step, module.initial_references = planned, stepped, noted
    try:
        begun = time.process_time()
        with Run(Job(source=log, assignments=tuple(assignments), prefetch=0)) as run:
            scans = sum(1 for _ in run.rows())
        return replans, spent[0], time.process_time() - begun, scans
    finally:
        Guidance._capture_plan, Guidance.step, module.initial_references = plan, step, references


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("logs", nargs="+", type=Path)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--list", action="store_true", help="print every replan")
    args = parser.parse_args()
    for log in args.logs:
        replans, guided, whole, scans = measured(log, args.set)
        if args.list:
            for t_s, took_ms, searched, made, action in replans:
                word = "searched" if searched else "warm"
                print(
                    f"{t_s:.2f} s {took_ms:6.1f} ms {word:8s} {made.status.value:10s}"
                    f" {made.t_go_s:7.3f} s, {action}"
                )
        print(
            f"{log.name}: {scans} scans, {whole:.1f} s of processor time, guidance {guided:.2f} s",
            end="",
        )
        print(f" ({100.0 * guided / whole:.1f} %), {len(replans)} replans")
        for word, chosen in (("searched", True), ("warm", False)):
            values = [took for _, took, searched, *_ in replans if searched is chosen]
            if values:
                print(
                    f"  {word:9s} {len(values):4d}: median {np.median(values):6.1f} ms, most"
                    f" {max(values):6.1f} ms"
                )


if __name__ == "__main__":
    main()
