"""The assessment of a log that is cut, against the flight of the whole log.

Each scenario is one of ``capture_scenarios.py``. The whole log is replayed, then the same log up to
instants before the capture. Where the answer for a part is "likely" or "unlikely", the flight of
the whole log has to end so. Finished runs are appended to a file and not made again.

python tests/benchmarks/capture_cut.py FILE.jsonl [--count 4] [--seed 1] [--seconds S]
"""

from __future__ import annotations

import argparse
import json
import tempfile
from operator import itemgetter
from pathlib import Path

import numpy as np
from capture_scenarios import command, written
from finished_runs import continued

BEFORE_S = (0.3, 0.8, 1.5, 3.0, 6.0, 12.0)  # ends of the parts before the end of the flight


def capture(log: Path, *words: str) -> dict[str, object]:
    """The assessment of a run."""
    return json.loads(command("run", str(log), "--json", *words))["verdict"]["capture"]


def made(k: int, seed: int) -> list[dict[str, object]]:
    """The assessments of one scenario: of the whole log, and of its parts."""
    names = ("chance", "probability", "contact", "at_s", "sentence", "in_fact")
    with tempfile.TemporaryDirectory() as folder:
        log = written(k, seed, Path(folder))
        whole = capture(log)
        rows = [{"k": k, "seed": seed, "end_s": None, **{name: whole[name] for name in names}}]
        if whole["in_fact"] is None:
            return rows
        for before in BEFORE_S:
            end_s = float(np.round(whole["at_s"] - before, 2))
            if end_s < 10.0:
                continue
            part = capture(log, "--duration", str(end_s))
            rows.append(
                {"k": k, "seed": seed, "end_s": end_s, **{name: part[name] for name in names}}
            )
    return rows


def report(rows: list[dict[str, object]]) -> None:
    """Print each answer and the number that the flight of the whole log contradicts."""
    ended = {(r["k"], r["seed"]): r["in_fact"] for r in rows if r["end_s"] is None and r["in_fact"]}
    answers, wrong, square = 0, 0, []
    for row in rows:
        print(f"{row['k']:3d} {row['end_s'] or 'whole':>6}  {row['sentence']}")
        fact = ended.get((row["k"], row["seed"]))
        if fact is None or row["end_s"] is None or row["probability"] is None:
            continue
        square.append((row["probability"] - fact["captured"]) ** 2)
        if row["chance"] in ("likely", "unlikely"):
            answers += 1
            wrong += (row["chance"] == "likely") != fact["captured"]
    mean = np.mean(square) if square else np.nan
    print(f"{len(ended)} flights, {len(square)} parts with a probability (Brier score {mean:.3f})")
    print(f"{answers} answers likely or unlikely, {wrong} contradicted by the flight")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--count", type=int, default=4)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=1200.0)
    given = parser.parse_args()
    keys = [(k, given.seed) for k in range(given.count)]
    key_of = itemgetter("k", "seed")
    report(continued(given.file, keys, key_of, lambda key: made(*key), given.seconds))


if __name__ == "__main__":
    main()
