"""The sentence of a run against what happened, for recorded scenarios with different attitudes.

Each scenario is the built-in one for 60 s with another attitude, direction of the rate and seed.
Finished runs are appended to a file and not made again.

python tests/benchmarks/capture_scenarios.py FILE.jsonl [--count 12] [--seed 1] [--seconds S]
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

SCENARIO = """name = "attitude-{k}"
seed = {k}
duration_s = 60.0
rate_hz = 2.5

[target]
shape = "satellite"

[motion]
attitude_xyzw = {q}
rate_radps = {w}
"""


def command(*words: str) -> str:
    """What a command of the package prints."""
    done = subprocess.run(
        [sys.executable, "-m", "avsreplay", *words], capture_output=True, text=True, check=True
    )
    return done.stdout


def written(k: int, seed: int, folder: Path) -> Path:
    """The log of one scenario, in a folder."""
    rng = np.random.default_rng([seed, k])
    q, w = rng.normal(size=4), rng.normal(size=3)
    q /= np.linalg.norm(q)
    w *= rng.uniform(0.04, 0.1) / np.linalg.norm(w)
    scenario, log = folder / "scenario.toml", folder / "log.mcap"
    scenario.write_text(SCENARIO.format(k=k, q=q.tolist(), w=w.tolist()))
    command("record", str(scenario), "-o", str(log))
    return log


def made(k: int, seed: int) -> dict[str, object]:
    """The assessment of one scenario."""
    with tempfile.TemporaryDirectory() as folder:
        log = written(k, seed, Path(folder))
        capture = json.loads(command("run", str(log), "--json"))["verdict"]["capture"]
    names = ("chance", "probability", "at_s", "contact", "sentence", "in_fact")
    return {"k": k, "seed": seed, **{name: capture[name] for name in names}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--count", type=int, default=12)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=600.0)
    given = parser.parse_args()
    text = given.file.read_text() if given.file.exists() else ""
    rows = [json.loads(line) for line in text.splitlines()]
    done, until = {(row["k"], row["seed"]) for row in rows}, time.monotonic() + given.seconds
    for k in range(given.count):
        if (k, given.seed) in done or time.monotonic() > until:
            continue
        rows.append(made(k, given.seed))
        with given.file.open("a") as stream:
            stream.write(json.dumps(rows[-1]) + "\n")
    for row in rows:
        print(f"{row['k']:3d}  {row['sentence']}")
    known = [row for row in rows if row["in_fact"] is not None]
    right = sum((row["chance"] == "likely") == row["in_fact"]["captured"] for row in known)
    print(f"{len(rows)} scenarios, {len(known)} flights that ended, {right} answers as it happened")


if __name__ == "__main__":
    main()
