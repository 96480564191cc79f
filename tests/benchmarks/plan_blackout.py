"""Approaches of the whole chain with vision lost before the capture; writes the table of
docs/results.md.

python tests/benchmarks/plan_blackout.py [--check]

The built-in scenario is recorded for 60 s with one occlusion of 12 s in place of its faults, and
replayed with its own settings. ``--check`` compares the table with the page and writes nothing.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import tomli_w

from avsreplay import replay, toml_document
from avsreplay.record import record
from avsreplay.simulate.scenario import load_scenario

PAGE = Path(__file__).parents[2] / "docs" / "results.md"
LENGTH_S, DURATION_S = 12.0, 60.0
STARTS_S = (10.0, 14.0)
HEAD = (
    "| occlusion from | actions | closed at | miss | relative speed | angle"
    " |\n|---|---|---|---|---|---|"
)


def approach(start_s, folder):
    """Rows of the run with vision lost from ``start_s`` on."""
    table = dict(toml_document.parse(load_scenario(None).text, "built-in scenario").table)
    fault = {"kind": "occlusion", "start_s": start_s, "duration_s": LENGTH_S}
    scenario, log = folder / f"{start_s}.toml", folder / f"{start_s}.mcap"
    scenario.write_text(
        tomli_w.dumps(table | {"duration_s": DURATION_S, "fault": [fault]}), encoding="utf-8"
    )
    record(scenario, log)
    return list(replay(log))


def line(start_s, rows):
    """One line of the table."""
    changes = [
        b for a, b in zip([None, *rows], rows, strict=False) if a is None or a.action != b.action
    ]
    actions = ", ".join(f"{row.action} from {row.t_s:.1f} s" for row in changes)
    end = next((row for row in rows if row.capture_miss_m is not None), None)
    if end is None:
        return f"| {start_s:g} s | {actions} | no capture | | | |"
    closed = rows[rows.index(end) - 1].capture_time_s
    errors = (
        f"{1e3 * end.capture_miss_m:.1f} mm | {1e3 * end.capture_miss_mps:.1f} mm/s |"
        f" {end.capture_miss_deg:.2f} deg"
    )
    return f"| {start_s:g} s | {actions} | {closed:.1f} s | {errors} |"


def table(starts_s=STARTS_S):
    """The lines of the table."""
    with tempfile.TemporaryDirectory() as folder:
        return [line(start_s, approach(start_s, Path(folder))) for start_s in starts_s]


def written(lines, page):
    """The page with the lines under the head of the table, in place of those that are there."""
    before, after = page.split(HEAD + "\n")
    rest = after.split("\n")
    count = next(k for k, text in enumerate(rest) if not text.startswith("|"))
    return "\n".join([before + HEAD, *lines, *rest[count:]])


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="compare with the page only")
    args, page = parser.parse_args(), PAGE.read_text(encoding="utf-8")
    lines = table()
    print("\n".join([HEAD, *lines]))
    if args.check:
        return 0 if written(lines, page) == page else 1
    PAGE.write_text(written(lines, page), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
