"""A plot of each group: a line per entry, a panel per score, each with its 95 % interval."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from avsreplay.benchmark.results import Record
from avsreplay.errors import UnreadableInput
from avsreplay.files import output_text

LABELS_PX = 130
PANEL_PX = 170
GAP_PX = 34
ROW_PX = 22
HEAD_PX = 60
PANELS = (  # key, heading, colour (Okabe and Ito), whether the axis is logarithmic
    ("wrong", "runs with a wrong pose", "#D55E00", False),
    ("captured", "captured", "#009E73", False),
    ("used", "usable scans used", "#0072B2", False),
    ("position_permille", "position error [1e-3 extent]", "#CC79A7", True),
)


def write_plots(folder: Path, found: Record) -> None:
    """Write one SVG file per group, and one over all.

    Args:
        folder: where to write; it is created.
        found: a document (``results.document``).

    Raises:
        UnreadableInput: a file cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        what = error.strerror or "cannot be made"
        raise UnreadableInput(what, where=str(folder), hint="check the folder") from None
    groups = list(dict.fromkeys(line["group"] for line in found["table"]))
    for group in groups:
        lines = [line for line in found["table"] if line["group"] == group]
        with output_text(folder / f"{group}.svg") as stream:
            stream.write(plot(f"{found['suite']['name']}, {group}", lines))


def plot(title: str, lines: list[Mapping[str, Any]]) -> str:
    """Return a plot as SVG.

    Args:
        title: its heading.
        lines: rows of the table of a document.
    """
    from avsreplay.report.page import render

    foot = HEAD_PX + ROW_PX * len(lines)
    names = [(line["entry"], HEAD_PX + ROW_PX * k) for k, line in enumerate(lines)]
    panels = [_panel(k, lines, *panel) for k, panel in enumerate(PANELS)]
    context = {
        "title": title,
        "names": names,
        "panels": panels,
        "foot": foot,
        "label_x": LABELS_PX - 12,
        "width": LABELS_PX + len(PANELS) * (PANEL_PX + GAP_PX),
        "height": foot + 30,
    }
    return str(render("benchmark.svg", **context))


def _panel(
    number: int, lines: list[Mapping[str, Any]], key: str, head: str, colour: str, log: bool
) -> dict[str, Any]:
    left = LABELS_PX + number * (PANEL_PX + GAP_PX)
    known = [(k, line["scores"][key]) for k, line in enumerate(lines) if key in line["scores"]]
    low, high = _span([score for _, score in known]) if log else (0.0, 1.0)

    def x(value: float) -> float:
        part = (
            (math.log10(max(value, low)) - math.log10(low)) / math.log10(high / low)
            if log
            else value
        )
        return round(left + PANEL_PX * min(max(part, 0.0), 1.0), 1)

    marks = [
        {
            "y": HEAD_PX + ROW_PX * k,
            "x": x(score["value"]),
            "low": None if score["low"] is None else x(score["low"]),
            "high": None if score["high"] is None else x(score["high"]),
        }
        for k, score in known
    ]
    ticks = [low, math.sqrt(low * high), high] if log else [0.0, 0.5, 1.0]
    return {
        "head": head,
        "colour": colour,
        "left": left,
        "right": left + PANEL_PX,
        "middle": left + PANEL_PX / 2,
        "marks": marks,
        "ticks": [(x(value), f"{value:.3g}") for value in ticks],
    }


def _span(scores: list[Mapping[str, Any]]) -> tuple[float, float]:
    """The decades that contain all values above 0."""
    values = [s[name] for s in scores for name in ("value", "low", "high") if s[name]]
    if not values:
        return 0.1, 1.0
    low, high = math.floor(math.log10(min(values))), math.ceil(math.log10(max(values)))
    return 10.0**low, 10.0 ** max(high, low + 1)
