"""Many runs in one process through the Python API: ``python tests/benchmarks/many_runs.py [--quick]
[--runs N]``.

Replays a scan of a small log again and again; every 50th run has a blackout and a global search,
every tenth is closed after its first row, and every hundredth is given a damaged log. Memory, open
files and threads must not grow: they are sampled twenty times, and the largest value of the second
half must not exceed that of the first half by more than the stated margin. Prints one JSON
document; exit code 1 if anything grows.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import sys
import tempfile
import threading
from pathlib import Path

from fuzz_commands import SCENARIO

import avsreplay
from avsreplay.errors import AvsError
from avsreplay.record import RecordOptions, record_scenario
from avsreplay.simulate.scenario import load_scenario

MARGINS = {"memory_mib": 4.0, "open_files": 0, "threads": 0}
SAMPLES = 20


def sample() -> dict[str, float]:
    """Memory that this process holds now, its open files, its threads."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    mib = pages * os.sysconf("SC_PAGE_SIZE") / 2**20
    return {
        "memory_mib": round(mib, 1),
        "open_files": len(os.listdir("/proc/self/fd")),  # noqa: PTH208
        "threads": threading.active_count(),
    }


def grown(samples: list[dict[str, float]]) -> dict[str, list[float]]:
    """What is larger in the second half than in the first half by more than its margin."""
    half = len(samples) // 2
    ends = {
        name: [max(s[name] for s in part) for part in (samples[:half], samples[half:])]
        for name in MARGINS
    }
    return {name: pair for name, pair in ends.items() if pair[1] > pair[0] + MARGINS[name]}


def replay_once(number: int, log: Path, folder: Path) -> int:
    """One run of one scan; some runs are of another kind. Returns the number of rows."""
    if number % 100 == 99:
        try:
            list(avsreplay.replay(folder / "damaged.mcap", "init=truth"))
        except AvsError:
            return 0
        raise AssertionError("a damaged log was replayed")
    rows = avsreplay.replay(log, "init=truth", n_scans=3 if number % 50 == 0 else 1)
    if number % 10 == 9:
        next(rows)
        rows.close()
        return 1
    return len(list(rows))


def main() -> int:
    """Run, sample, compare the halves."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--quick", action="store_true", help="200 runs")
    asked = parser.parse_args()
    runs = 200 if asked.quick else asked.runs
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "scenario.toml").write_text(SCENARIO, encoding="utf-8")
        log = folder / "log.mcap"
        record_scenario(load_scenario(folder / "scenario.toml"), log, RecordOptions())
        (folder / "damaged.mcap").write_bytes(log.read_bytes()[:100])
        samples, rows = [], 0
        for number in range(runs):
            rows += replay_once(number, log, folder)
            if (number + 1) % max(runs // SAMPLES, 1) == 0:
                samples.append(sample())
                print(f"{number + 1} runs: {samples[-1]}", file=sys.stderr, flush=True)
    growth = grown(samples)
    print(json.dumps({"runs": runs, "rows": rows, "samples": samples, "grown": growth}, indent=1))
    return 1 if growth else 0


if __name__ == "__main__":
    raise SystemExit(main())
