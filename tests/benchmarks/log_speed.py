"""Speed and memory of reading: ``python tests/benchmarks/log_speed.py [--quick] [--gib G]``.

Time per scan of 10,000 points (x y z float32 and a per-point time), checksums on, for the survey
(every checksum of the file) and for the reading, apart and together, best of three. Memory: the
peak of a process that reads a log of the stated size from end to end, less what the same process
takes for a log of a few scans.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from avsreplay.log import LogWriter, open_source
from avsreplay.records import LogHeader, Scan

SECOND = 1_000_000_000


def scan(i: int) -> Scan:
    """A scan as a sensor gives it: a surface with noise, so that it does not compress to
    nothing.
    """
    rng = np.random.Generator(np.random.PCG64(i % 16))
    points = (rng.normal(size=(10_000, 3)) * 2.0).astype(np.float32)
    times = np.linspace(0.0, 0.1, 10_000, dtype=np.float32)
    return Scan(
        i, SECOND + i * SECOND // 10, points, times_s=times, log_ns=SECOND + i * SECOND // 10
    )


def make(path: Path, count: int, compression: str) -> None:
    """Write a log of so many scans."""
    made = [scan(i) for i in range(16)]
    with LogWriter(path, LogHeader(), compression=compression, overwrite=True) as writer:
        for i in range(count):
            t_ns = SECOND + i * SECOND // 10
            s = made[i % 16]
            writer.write(Scan(i, t_ns, s.points, times_s=s.times_s, log_ns=t_ns))


def timed(path: Path) -> tuple[float, float, int]:
    """Processor seconds of the survey and of the reading (the machine may be shared), and scans."""
    start = time.process_time()
    with open_source(path) as source:
        surveyed = time.process_time()
        count = sum(len(s.points) > 0 for s in source.scans())
        return surveyed - start, time.process_time() - surveyed, count


def peak_of(path: Path) -> int:
    """Peak MiB of a process that reads a log to its end."""
    code = f"import log_speed, pathlib; print(log_speed.peak(pathlib.Path({str(path)!r})))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=Path(__file__).parent, capture_output=True, check=True
    )
    return int(done.stdout)


def peak(path: Path) -> int:
    """Read a log to its end; the peak of this process in MiB."""
    timed(path)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024


def main() -> int:
    """Measure and print one JSON document."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gib", type=float, default=4.0)
    parser.add_argument("--quick", action="store_true", help="300 scans and a log of 0.25 GiB")
    asked = parser.parse_args()
    count, gib = (300, 0.25) if asked.quick else (1000, asked.gib)
    out: dict[str, object] = {}
    with tempfile.TemporaryDirectory() as folder:
        for compression in ("none", "lz4", "zstd"):
            path = Path(folder) / f"{compression}.mcap"
            make(path, count, compression)
            best = min((timed(path) for _ in range(3)), key=lambda t: t[0] + t[1])
            out[compression] = {
                "survey_ms_a_scan": round(1e3 * best[0] / best[2], 3),
                "read_ms_a_scan": round(1e3 * best[1] / best[2], 3),
                "together_ms_a_scan": round(1e3 * (best[0] + best[1]) / best[2], 3),
                "mib": round(path.stat().st_size / 2**20, 1),
            }
            path.unlink()
        small, large = Path(folder) / "small.mcap", Path(folder) / "large.mcap"
        make(small, 30, "none")
        make(large, int(gib * 2**30 / 160_200), "none")
        out["memory"] = {
            "log_gib": round(large.stat().st_size / 2**30, 2),
            "peak_mib": peak_of(large),
            "peak_mib_of_30_scans": peak_of(small),
        }
    print(json.dumps(out, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
