"""Small pictures of a run over time, for a terminal that is wide enough."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.text import Text

from avsreplay.rows import Row

__all__ = ["LEAST_WIDTH", "print_sparks", "spark"]

LEAST_WIDTH = 100
_BLOCKS = "▁▂▃▄▅▆▇█"
_LABEL = 32


def spark(values: Sequence[float | None], width: int) -> str:
    """At most ``width`` blocks from 0 to the greatest value, each the greatest of its share; a blank for none."""
    shares = [[v for v in values[a:b] if v is not None] for a, b in _shares(len(values), width)]
    top = max((max(share) for share in shares if share), default=0.0)
    return "".join(_block(max(share), top) if share else " " for share in shares)


def _shares(count: int, width: int) -> list[tuple[int, int]]:
    cells = min(count, width)
    return [(count * k // cells, count * (k + 1) // cells) for k in range(cells)]


def _block(value: float, top: float) -> str:
    return _BLOCKS[min(int(value / top * len(_BLOCKS)), len(_BLOCKS) - 1)] if top > 0 else _BLOCKS[0]


def print_sparks(console: Console, rows: Sequence[Row]) -> None:
    """Pose error and flagged scans over time; nothing off a terminal, on a narrow one or one without Unicode."""
    if not console.is_terminal or console.width < LEAST_WIDTH or "utf" not in console.encoding.lower():
        return
    width = console.width - _LABEL
    for name, unit, column in (("position error", "m", "pos_err_m"), ("attitude error", "deg", "rot_err_deg")):
        values = [getattr(row, column) for row in rows]
        known = [v for v in values if v is not None]
        if known:
            label = f"{name} to {max(known):.3g} {unit}"
            console.print(Text(f"{label:{_LABEL}}").append(spark(values, width), style="#0072B2"))
    flags = "".join("✗" if any(row.gamma == 0 for row in rows[a:b]) else "·" for a, b in _shares(len(rows), width))
    console.print(Text(f"{'flagged':{_LABEL}}").append(flags, style="#D55E00"))
    console.print()
