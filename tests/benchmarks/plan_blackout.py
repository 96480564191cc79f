"""Approaches of the whole chain with vision lost before the capture; prints the table of docs/planning.md.

python tests/benchmarks/plan_blackout.py
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from avsreplay import replay
from avsreplay.record import record

SCENARIO = """\
name = "blackout-before-capture"
seed = 1
duration_s = 55.0
rate_hz = 4.0

[target]
shape = "satellite"

[motion]
attitude_xyzw = [0.1, 0.7, -0.1, 0.7]
rate_radps = [0.060, 0.064, -0.048]
position_m = [0.15, -0.10, 5.0]
velocity_mps = [-0.002, 0.001, 0.001]

[scanner]
fov_deg = [48.0, 48.0]
rays = [90, 90]
noise_m = 0.008
engine = "exact"

[[fault]]
kind = "occlusion"
start_s = {start_s}
duration_s = 12.0

[run.limits]
final_deg = 15.0
clearance_m = 0.1
"""
STARTS_S = (14.0, 24.0)
HEAD = "| occlusion from | actions | closed at | miss | relative speed | angle |\n|---|---|---|---|---|---|"


def approach(start_s, folder):
    """Rows of the run with vision lost from ``start_s`` on."""
    scenario, log = folder / f"{start_s}.toml", folder / f"{start_s}.mcap"
    scenario.write_text(SCENARIO.format(start_s=start_s), encoding="utf-8")
    record(scenario, log)
    return list(replay(log))


def line(start_s, rows):
    """One line of the table."""
    changes = [b for a, b in zip([None, *rows], rows, strict=False) if a is None or a.action != b.action]
    actions = ", ".join(f"{row.action} from {row.t_s:.1f} s" for row in changes)
    end = next((row for row in rows if row.capture_miss_m is not None), None)
    if end is None:
        return f"| {start_s:g} s | {actions} | no capture | | | |"
    closed = rows[rows.index(end) - 1].capture_time_s
    errors = (
        f"{1e3 * end.capture_miss_m:.1f} mm | {1e3 * end.capture_miss_mps:.2f} mm/s | {end.capture_miss_deg:.2f} deg"
    )
    return f"| {start_s:g} s | {actions} | {closed:.1f} s | {errors} |"


def table():
    """The lines of the table."""
    with tempfile.TemporaryDirectory() as folder:
        return [line(start_s, approach(start_s, Path(folder))) for start_s in STARTS_S]


if __name__ == "__main__":
    print(HEAD)
    print("\n".join(table()))
