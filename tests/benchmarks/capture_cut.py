"""The assessment of a log that is cut, against the flight of the whole log.

Each scenario is one of ``capture_scenarios.py``, with other targets, faults, settings and a
deadline. The whole log is replayed, and the capture is assessed after its last scan and at
instants before the end of the flight (``--before``): with the same scans a shorter log has the
same answer. Where the answer for a part is "likely", "unlikely" or "no", the flight of the whole
log has to end so, and "contact" or "no contact" has to be what happens. A part that ends while
the estimate does not suffice is "not yet decided". A capture that is likely at an instant of the
log has to happen in it. The arithmetic is that of the command only where its variables are set
(``avsreplay.arithmetic``). Finished runs are appended to a file and not made again.

python tests/benchmarks/capture_cut.py FILE.jsonl [--count 4] [--seed 1] [--seconds S]
    [--bodies satellite,stage,truss:3] [--kinds ,occlusion,outliers] [--before 0.3,1.5,6]
    [--span 60] [--deadline S] [--set A.B=VALUE]
"""

from __future__ import annotations

import argparse
import copy
import tempfile
from dataclasses import replace
from operator import itemgetter
from pathlib import Path

import numpy as np
from capture_scenarios import written
from finished_runs import continued

from avsreplay.assess import FlightLog
from avsreplay.assessment import Assessment
from avsreplay.run import Job, Run

KEY = ("k", "seed", "name", "kind")
FIRST_S = 5.0  # no part ends before
LATE_S = 3.0  # a likely capture that is later than stated by more is contradicted


def cut(flight: FlightLog) -> FlightLog:
    """The flight so far, which further scans do not change."""
    kept = copy.copy(flight)
    for name in ("legs", "gammas", "stamps", "noises"):
        setattr(kept, name, [*getattr(flight, name)])
    return kept


def answers(
    log: Path, before: list[float], deadline: float | None, words: list[str]
) -> list[tuple[float | None, float, Assessment]]:
    """The assessments of the whole log and of its parts, with the ends of the parts and the
    instants of their last scans [s].

    Args:
        log: the log.
        before: ends of the parts before the end of the flight [s].
        deadline: of the task, after the end of the flight [s]; None: that of the settings.
        words: settings of the run.
    """
    with Run(Job(source=log, assignments=tuple(words))) as run:
        flights = [cut(run.flight) for _ in run.rows()]
        whole = run.assessment
        if deadline is not None and whole.at_s is not None:
            run.task = replace(run.task, deadline_s=whole.at_s + deadline)
        instants = np.array([flight.stamps[-1] - flight.stamps[0] for flight in flights]) * 1e-9
        parts = [] if whole.at_s is None else [whole.at_s - each for each in before]
        found: list[tuple[float | None, float, Assessment]] = []
        for end_s in [*(each for each in parts if each >= FIRST_S), None]:
            last = len(flights) if end_s is None else int(np.searchsorted(instants, end_s))
            run.flight, run.done = flights[last - 1], last
            found.append((end_s, float(instants[last - 1]), run.assessment))
        return found


def made(key: tuple[int, int, str, str], given: argparse.Namespace) -> list[dict[str, object]]:
    """The assessments of one scenario: of its parts, and of the whole log."""
    k, seed, name, kind = key
    fields = ("probability", "probability_95", "contact", "at_s", "sentence")
    with tempfile.TemporaryDirectory() as folder:
        log = written(k, seed, Path(folder), kind, given.span, name)
        return [
            {
                **dict(zip(KEY, key, strict=True)),
                "end_s": end_s,
                "last_s": last_s,
                "chance": found.chance.value,
                **{field: getattr(found, field) for field in fields},
                "captured": None if found.in_fact is None else found.in_fact.captured,
                "touched": None if found.in_fact is None else found.in_fact.touched,
            }
            for end_s, last_s, found in answers(log, given.before, given.deadline, given.set)
        ]


def contradicted(row: dict[str, object], fact: dict[str, object]) -> str:
    """What the flight of the whole log contradicts in the answer for a part, "" where nothing."""
    if fact["captured"] is None:
        late = row["chance"] == "likely" and row["at_s"] < fact["last_s"] - LATE_S
        return "likely, but not captured until the end of the log" if late else ""
    said = {"likely": True, "unlikely": False, "none": False}.get(row["chance"])
    if said is not None and said != fact["captured"]:
        return f"{row['chance']}, but {'' if fact['captured'] else 'not '}captured"
    if None not in (row["contact"], fact["touched"]):
        if not fact["touched"] and row["contact"] > 0.9:
            return "contact, but none in fact"
        if fact["touched"] and row["contact"] < 0.1:
            return "no contact, but contact in fact"
    return ""


def report(rows: list[dict[str, object]]) -> None:
    """Print each answer and the number that the flight of the whole log contradicts."""
    of = itemgetter(*KEY)
    facts = {of(r): r for r in rows if r["end_s"] is None}
    square, moved, wrong, parts = [], [], 0, 0
    for row in rows:
        end = "whole" if row["end_s"] is None else f"{row['end_s']:.2f}"
        print(f"{row['k']:3d} {row['name']} {row['kind']} {end:>6}  {row['sentence']}")
        fact = facts.get(of(row))
        if fact is None or row["end_s"] is None or row["probability"] is None:
            continue
        parts += 1
        if fact["captured"] is not None:
            square.append((row["probability"] - fact["captured"]) ** 2)
        if None not in (row["at_s"], fact["at_s"]):
            moved.append(abs(row["at_s"] - fact["at_s"]))
        if reason := contradicted(row, fact):
            wrong += 1
            print(f"    contradicted: {reason}")
    mean, most = np.mean(square or [np.nan]), np.quantile(moved or [np.nan], (0.5, 1.0))
    ended = sum(fact["captured"] is not None for fact in facts.values())
    print(f"{ended} flights that ended, {parts} parts, Brier score {mean:.3f}")
    print(f"instant of the capture moved by {most[0]:.2f} s (median), {most[1]:.2f} s (most)")
    print(f"{wrong} answers contradicted by the flight")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--count", type=int, default=4)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=1200.0)
    parser.add_argument("--bodies", default="satellite", help="shapes, or KIND:SEED of bodies.py")
    parser.add_argument("--kinds", default="", help="of capture_scenarios.py, or faults")
    parser.add_argument("--before", default="0.3,0.8,1.5,3,6,12", help="ends of the parts [s]")
    parser.add_argument("--span", type=float, default=60.0, help="length of the log [s]")
    parser.add_argument("--deadline", type=float, help="after the end of the flight [s]")
    parser.add_argument("--set", action="append", default=[], help="a setting of the run")
    given = parser.parse_args()
    given.before = [float(each) for each in given.before.split(",")]
    keys = [
        (k, given.seed, name, kind)
        for name in given.bodies.split(",")
        for kind in given.kinds.split(",")
        for k in range(given.count)
    ]
    key_of = itemgetter(*KEY)
    report(continued(given.file, keys, key_of, lambda key: made(key, given), given.seconds))


if __name__ == "__main__":
    main()
