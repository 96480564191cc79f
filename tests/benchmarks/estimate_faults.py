"""The fault campaign as Markdown. ``avsreplay sweep docs/campaigns/faults.toml -o DIR``, then this
with DIR.

``python tests/benchmarks/estimate_faults.py DIR``: one table a setting (policy of the fault rule),
a line a kind of fault and strength, from DIR/summary.json. Any campaign over scenarios will do; a
scenario's file name gives the strength its name.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

HEADS = (
    "fault",
    "strength",
    "scans flagged",
    "windows detected",
    "delay [s] (scans)",
    "recovery [s] (scans)",
    "lost",
    "worst while flagged",
    "worst while used",
    "worst used after it",
)
NONE = "none"


def tables(summary: dict[str, Any]) -> str:
    """All settings' tables, each below its setting."""
    by_setting: dict[str, list[tuple[str, dict[str, Any]]]] = {}
    for cell in summary["cells"]:
        values = dict(cell["values"])
        strength = Path(values.pop("scenario", "")).stem.rpartition("-")[2]
        setting = ", ".join(
            f"`{key.removeprefix('run.')} = {value}`" for key, value in values.items()
        )
        by_setting.setdefault(setting, []).append((strength, cell))
    return "\n\n".join(
        f"{setting}, runs of each strength: {cells[0][1]['runs']}:\n\n{table(cells)}"
        for setting, cells in by_setting.items()
    )


def table(cells: list[tuple[str, dict[str, Any]]]) -> str:
    """One setting: its kinds of fault (false alarms first), each at the strengths in the
    campaign's order.
    """
    names = {name for _, cell in cells for name in cell["kinds"]}
    rows = [HEADS, ("---",) * len(HEADS)]
    for name in sorted(names, key=lambda name: (name != NONE, name)):
        rows += [
            line(name, strength, cell["kinds"][name])
            for strength, cell in cells
            if name in cell["kinds"]
        ]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def line(name: str, strength: str, kind: dict[str, Any]) -> tuple[str, ...]:
    """One kind of fault at one strength."""
    how = [
        *(f"{s:g}" for s in kind["strengths"]),
        *(f"{length:g} s" for length in kind["lengths_s"]),
    ]
    harmless = name != NONE and not kind["harmful"]
    peaks = (kind[f"peak_{when}"] for when in ("flagged", "used", "after"))
    return (
        "none (false alarms)" if name == NONE else f"{name} (harmless)" if harmless else name,
        f"{strength}: {', '.join(how)}" if how else strength,
        share(kind["flagged"]),
        count(kind["detected"]),
        times(kind, "delay"),
        times(kind, "recovery"),
        str(kind["lost"]) if kind["episodes"] else "",
        *(error(peak) for peak in peaks),
    )


def share(rate: dict[str, Any] | None) -> str:
    """Scans flagged of scans."""
    return (
        ""
        if rate is None
        else f"{rate['successes']} of {rate['count']} ({100.0 * rate['share']:.3g} %)"
    )


def count(rate: dict[str, Any] | None) -> str:
    """Windows detected of windows."""
    return "" if rate is None else f"{rate['successes']} of {rate['count']}"


def times(kind: dict[str, Any], what: str) -> str:
    """Median and worst, where any window has it."""
    seconds, scans = kind[f"{what}_s"], kind[f"{what}_scans"]
    if seconds is None:
        return "none"
    return ", ".join(f"{seconds[which]:.3g} ({scans[which]:.3g})" for which in ("median", "worst"))


def error(peak: dict[str, float | None]) -> str:
    """Position and rotation, each its own worst."""
    position, rotation = peak["pos_err_m"], peak["rot_err_deg"]
    return (
        ""
        if position is None or rotation is None
        else f"{short(1000.0 * position)} mm, {short(rotation)}°"
    )


def short(value: float) -> str:
    """Two digits, and no power of ten."""
    return f"{value:.0f}" if value >= 100.0 else f"{value:.2g}" if value >= 0.01 else f"{value:.3f}"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="of the campaign's results")
    found = json.loads((parser.parse_args().folder / "summary.json").read_text())
    print("Delay and recovery: median, worst. ", end="")
    print("Lost: windows after which no scan was healthy. Used: gamma 1.\n")
    print(tables(found))


if __name__ == "__main__":
    main()
