"""How much of a whole replay is registration: process time of a run over that of its registrations, in one process.

python tests/benchmarks/whole_run.py LOG [--repeats N] [--quick]

A log of 600 scans with 10,000 points each is the built-in scenario with more rays:
sed 's/^rays.*/rays = [235, 235]/' avsreplay/simulate/builtin.toml > dense.toml
avsreplay record dense.toml -o dense.mcap
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path

from avsreplay.register import Registrar
from avsreplay.run import Job, Run


def timed(log: Path, n_scans: int | None) -> tuple[int, float, float]:
    """Scans, process time of the whole replay [s], of its registrations [s]."""
    from avsreplay.log import SourceOptions

    spent = [0.0]
    register = Registrar.register

    def counted(self, *args):
        begun = time.process_time()
        found = register(self, *args)
        spent[0] += time.process_time() - begun
        return found

    Registrar.register = counted
    try:
        with Run(Job(source=log, options=SourceOptions(n_scans=n_scans), prefetch=0)) as run:
            begun = time.process_time()
            count = sum(1 for _ in run.rows())
            return count, time.process_time() - begun, spent[0]
    finally:
        Registrar.register = register


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("log", type=Path)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="100 scans, once")
    args = parser.parse_args()
    runs = [timed(args.log, 100 if args.quick else None) for _ in range(1 if args.quick else args.repeats)]
    count = runs[0][0]
    whole, registration = (statistics.median(run[k] for run in runs) for k in (1, 2))
    ratio = statistics.median(run[1] / run[2] for run in runs)
    print(f"{count} scans: {1e3 * whole / count:.2f} ms a scan, {1e3 * registration / count:.2f} of it registration")
    print(f"whole run over its registrations: {ratio:.2f}")


if __name__ == "__main__":
    main()
