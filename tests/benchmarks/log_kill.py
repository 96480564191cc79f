"""kill -9 campaign: recordings killed at random moments are read back to their last full chunk.

``python tests/benchmarks/log_kill.py [--quick] [--kills N] [--seed S]``. Each recorder says, after
every scan it handed over, how many are in closed chunks; the reader must give at least those, bit
for bit, and lose at most the open chunk.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from avsreplay.errors import AvsError
from avsreplay.log import LogWriter, open_source
from avsreplay.records import LogHeader, Scan

SECOND = 1_000_000_000
PER_CHUNK = 5  # 5 Hz and a chunk a second


def cloud(i: int) -> np.ndarray:  # type: ignore[type-arg]
    """Scan i of every recording: so that what is read can be held against what was written."""
    return np.random.Generator(np.random.PCG64(i)).normal(size=(2000, 3)).astype(np.float32)


def record(path: Path, compression: str, streaming: bool) -> None:
    """Record until killed, saying after each scan how many were handed over."""
    with LogWriter(
        path, LogHeader(scenario="x = 1\n"), compression=compression, streaming=streaming
    ) as writer:
        for i in range(100_000):
            t_ns = SECOND + i * SECOND // 5
            writer.write(Scan(i, t_ns, cloud(i), log_ns=t_ns))
            sys.stdout.write(f"{i + 1}\n")
            sys.stdout.flush()


def kill_one(folder: Path, rng: np.random.Generator) -> dict[str, object]:
    """One recording, killed; what was handed over and what came back."""
    path = folder / "x.mcap"
    streaming, compression = bool(rng.random() < 0.5), str(rng.choice(["none", "lz4", "zstd"]))
    args = [sys.executable, __file__, "--record", str(path), "--compression", compression]
    recorder = subprocess.Popen(
        [*args, *(["--streaming"] if streaming else [])], stdout=subprocess.PIPE, text=True
    )
    assert recorder.stdout is not None
    recorder.stdout.readline()
    time.sleep(float(rng.uniform(0.0, 0.25)))
    os.kill(recorder.pid, signal.SIGKILL)
    told = recorder.stdout.read().split()
    recorder.wait()
    handed = int(told[-1]) if told else 1
    left = path if streaming else path.with_name("x.mcap.partial")
    result = {"handed": handed, "streaming": streaming, "compression": compression, **_read(left)}
    left.unlink(missing_ok=True)
    # A chunk closes when the first scan of the next second is handed over, so that the open one
    # holds at most five.
    result["ok"] = bool(result["same"]) and int(result["read"]) >= handed - PER_CHUNK  # type: ignore[call-overload]
    return result


def _read(path: Path) -> dict[str, object]:
    try:
        with open_source(path) as source:
            found = list(source.scans())
            losses = [loss.what for loss in source.losses]
    except AvsError as error:
        return {"read": 0, "same": True, "losses": [str(error)]}
    same = all(s.points.tobytes() == cloud(i).tobytes() for i, s in enumerate(found))
    return {"read": len(found), "same": same, "losses": losses}


def main() -> int:
    """Run the campaign and print one JSON document; exit 1 where a recording lost more than
    its open chunk.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="10 kills")
    parser.add_argument("--record", type=Path)
    parser.add_argument("--compression", default="zstd")
    parser.add_argument("--streaming", action="store_true")
    asked = parser.parse_args()
    if asked.record is not None:
        record(asked.record, asked.compression, asked.streaming)
        return 0
    rng = np.random.Generator(np.random.PCG64(asked.seed))
    with tempfile.TemporaryDirectory() as folder:
        results = [kill_one(Path(folder), rng) for _ in range(10 if asked.quick else asked.kills)]
    bad = [r for r in results if not r["ok"]]
    lost = [int(r["handed"]) - int(r["read"]) for r in results]  # type: ignore[call-overload]
    print(
        json.dumps(
            {
                "kills": len(results),
                "all read back to the last full chunk": not bad,
                "scans handed over": sum(int(r["handed"]) for r in results),  # type: ignore[call-overload]
                "most scans of an open chunk lost": max(lost),
                "with nothing yet on disk": sum(r["read"] == 0 for r in results),
                "bad": bad,
            },
            indent=1,
        )
    )
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
