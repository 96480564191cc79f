"""A console of stable width, and signs that need no colour to be told apart."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from typing import IO

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from avsreplay.rows import Column

__all__ = ["PLAIN_WIDTH", "Palette", "decimals", "head", "make_console", "new_table"]

PLAIN_WIDTH = 80
_SHORT = {
    "seq": "scan",
    "iterations": "iter",
    "inlier_ratio": "inl",
    "converged": "conv",
    "capture_time_s": "capt",
    "ogm_log10_cond": "cond log10",
    "ogm_rank": "rank",
    "pos_err_m": "pos err",
    "rot_err_deg": "rot err",
}


@dataclass(frozen=True, slots=True)
class Palette:
    """Signs and colours (Okabe-Ito, told apart without red against green) of the three states of a scan."""

    healthy: str
    flagged: str
    coasting: str
    dash: str

    @classmethod
    def of(cls, console: Console) -> Palette:
        """Unicode signs where the console can write them, ASCII where not."""
        if "utf" in console.encoding.lower():
            return cls("●", "✗", "~", "-")
        return cls("o", "x", "~", "-")

    def state(self, gamma: int, reason: str) -> Text:
        """Healthy, coasting for want of a scan, or flagged with its reason."""
        if gamma == 1:
            return Text(f"{self.healthy} ok", style="#009E73")
        if reason == "no_scan":
            return Text(f"{self.coasting} {reason}", style="#E69F00")
        return Text(f"{self.flagged} {reason}", style="bold #D55E00")


def make_console(stream: IO[str] | None = None, *, width: int | None = None) -> Console:
    """A console on ``stream`` (stdout); 80 columns off a terminal, no colour there nor under NO_COLOR."""
    stream = stream or sys.stdout
    if width is None and not stream.isatty():
        width = PLAIN_WIDTH
    return Console(file=stream, width=width, highlight=False, markup=False, emoji=False, soft_wrap=False)


def new_table(console: Console, title: str, *, tight: bool = False) -> Table:
    """An empty table in the house style; ``tight``: one blank between columns, not two."""
    style = box.SIMPLE_HEAD if "utf" in console.encoding.lower() else box.ASCII2
    return Table(
        title=Text(title, style="bold"),
        title_justify="left",
        box=style,
        show_edge=False,
        pad_edge=False,
        padding=0 if tight else (0, 1, 0, 0),
        header_style="",
    )


def decimals(values: Iterable[float], least: int, *, figures: int = 3) -> int:
    """Decimals that leave some figures of the middle value: a 0.2 m target needs more than an 8 m one."""
    sizes = sorted(abs(v) for v in values if v)
    if not sizes:
        return least
    wanted = figures - 1 - math.floor(math.log10(sizes[len(sizes) // 2]))
    return min(max(least, wanted), 8)


def head(column: Column) -> str:
    """A head of short words with the unit on the last line."""
    name = _SHORT.get(column.name, column.name)
    unit = column.unit or ("s" if column.name == "capture_time_s" else "")
    suffix = "_" + unit.replace("/", "p")
    name = name.removesuffix(suffix) if unit else name
    lines = name.replace("_", " ").split(" ")
    return "\n".join([*lines, f"[{unit}]"] if unit else lines)
