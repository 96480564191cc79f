"""The sentence of a run against what happened, for recorded scenarios with different attitudes.

Each scenario is the built-in target for 90 s with another attitude, rate and seed. Of four, the
first has the limits of the built-in scenario, the second also an occlusion of 6 s, the third random
torques, and the fourth is approached from any side: its plans know no body. Finished runs are
appended to a file and not made again; what was found is printed as a table.

python tests/benchmarks/capture_scenarios.py FILE.jsonl [--count 12] [--seed 1] [--seconds S]
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from operator import itemgetter
from pathlib import Path

import numpy as np
from bodies import body
from finished_runs import continued

SCENARIO = """name = "attitude-{k}"
seed = {k}
duration_s = {span_s}
rate_hz = 2.5

[target]
{target}

[motion]
attitude_xyzw = {q}
rate_radps = {w}
{more}"""
LIMITS = """
[run.limits]
final_deg = 15.0
clearance_m = 0.1
"""
FAULT = """
[[fault]]
kind = "{kind}"
start_s = {start_s}
duration_s = {span_s}
"""
FAULTS = {"occlusion": 6.0, "dropped": 4.0, "frozen": 3.0, "outliers": 30.0}  # durations [s]
PLACE = "position_m = [0.0, 0.0, {z}]\n"  # of the mass centre in {{A}}
PATCH = """
[run.task]
patch = "flat-1"
"""
FREE = """
[run.task]
approach = "free"
"""
KINDS = ("limits", "limits, occlusion", "limits, torques", "free approach")
SPAN_S = 90.0


def command(*words: str) -> str:
    """What a command of the package prints."""
    done = subprocess.run(
        [sys.executable, "-m", "avsreplay", *words], capture_output=True, text=True, check=True
    )
    return done.stdout


def target(name: str, folder: Path) -> tuple[str, str, str]:
    """The lines of a target, those of its place and those of its task: a built-in shape, or
    ``KIND:SEED`` of ``bodies.py`` at one and a half extents, grasped at its largest patch.
    """
    kind, _, number = name.partition(":")
    if not number:
        return f'shape = "{kind}"', "", ""
    mesh = body(kind, int(number))
    mesh.export(folder / "model.obj")
    distance_m = 1.5 * float(np.linalg.norm(mesh.extents))
    return 'model = "model.obj"', PLACE.format(z=round(distance_m, 2)), PATCH


def written(
    k: int, seed: int, folder: Path, kind: str = "", span_s: float = 60.0, name: str = "satellite"
) -> Path:
    """The log of one scenario with the target ``name``, in a folder."""
    rng = np.random.default_rng([seed, k])
    q, w = rng.normal(size=4), rng.normal(size=3)
    q /= np.linalg.norm(q)
    w *= rng.uniform(0.04, 0.1) / np.linalg.norm(w)
    lines, more, task = target(name, folder)
    if "torques" in kind:  # over the trace of the inertia, drawn anew every second
        more += f"torque_std_radps2 = {10.0 ** rng.uniform(-6.0, -4.0):.3g}\n"
    for fault, fault_s in FAULTS.items():
        if fault in kind:
            start_s = round(rng.uniform(20.0, 40.0), 1)
            more += FAULT.format(kind=fault, start_s=start_s, span_s=fault_s)
    more += LIMITS * ("limits" in kind) + FREE * ("free" in kind) + task
    scenario, log = folder / "scenario.toml", folder / "log.mcap"
    text = SCENARIO.format(k=k, target=lines, q=q.tolist(), w=w.tolist(), span_s=span_s, more=more)
    scenario.write_text(text)
    command("record", str(scenario), "-o", str(log))
    return log


def made(k: int, seed: int) -> dict[str, object]:
    """The assessment of one scenario."""
    with tempfile.TemporaryDirectory() as folder:
        log = written(k, seed, Path(folder), kind := KINDS[k % len(KINDS)], SPAN_S)
        capture = json.loads(command("run", str(log), "--json"))["verdict"]["capture"]
    names = ("chance", "probability", "at_s", "contact", "sentence", "in_fact")
    return {"k": k, "seed": seed, "kind": kind, **{name: capture[name] for name in names}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--count", type=int, default=12)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=600.0)
    given = parser.parse_args()
    keys = [(k, given.seed) for k in range(given.count)]
    key_of = itemgetter("k", "seed")
    rows = continued(given.file, keys, key_of, lambda key: [made(*key)], given.seconds)
    print("| scenario | what it has | sentence | what happened |\n|---|---|---|---|")
    for row in rows:
        sentence, _, happened = row["sentence"].partition("; in fact ")
        happened = happened.split(". ")[0] or "the flight did not end"
        print(f"| {row['k']} | {row['kind']} | {sentence} | {happened} |")
    known = [row for row in rows if row["in_fact"] is not None]
    right = sum((row["chance"] == "likely") == row["in_fact"]["captured"] for row in known)
    print(f"{len(rows)} scenarios, {len(known)} flights that ended, {right} answers as it happened")


if __name__ == "__main__":
    main()
