"""The tables of a page as HTML; every word that came from a file is escaped."""

from __future__ import annotations

import html
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from avsreplay.report.episodes import Episode
from avsreplay.report.parameters import Parameter
from avsreplay.report.spread import Spread
from avsreplay.report.summary import Summary
from avsreplay.report.words import fact_lines
from avsreplay.rows import Row

__all__ = ["config_section", "error_table", "escape", "fact_table", "fault_table", "parameter_table", "table"]


def escape(value: object) -> str:
    """Text that is safe in an element and in a quoted attribute."""
    return html.escape(str(value), quote=True)


def table(caption: str, heads: Sequence[str], lines: Iterable[Sequence[str]], *, numeric: int = 1) -> str:
    """A table whose cells are HTML already; columns from ``numeric`` on are right-aligned. Empty without lines."""
    body = "".join(f"<tr>{''.join(_cell(cell, k, numeric) for k, cell in enumerate(line))}</tr>" for line in lines)
    if not body:
        return ""
    head = "".join(f'<th scope="col"{_class(k, numeric)}>{escape(h)}</th>' for k, h in enumerate(heads))
    name = f"<caption>{escape(caption)}</caption>"
    inner = f"<table>{name}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    return f'<div class="scroll" tabindex="0" role="region" aria-label="{escape(caption)}">{inner}</div>'


def _cell(cell: str, k: int, numeric: int) -> str:
    return f'<th scope="row">{cell}</th>' if k == 0 else f"<td{_class(k, numeric)}>{cell}</td>"


def _class(k: int, numeric: int) -> str:
    return ' class="n"' if k >= numeric else ""


def error_table(summary: Summary) -> str:
    """Errors: of, unit, count and six statistics."""
    groups = (
        ("pose, healthy", summary.pose_healthy),
        ("pose, coasting", summary.pose_coasting),
        ("registration", summary.registration_healthy),
    )
    found: list[tuple[str, str, Spread | None]] = []
    for name, errors in groups:
        found += [(name, "mm", _scaled(errors.position_m, 1000.0)), (name, "deg", errors.rotation_deg)]
    found.append(("fit error rms", "mm", _scaled(summary.fit_error_m, 1000.0)))
    lines = [[name, unit, str(s.count), *_statistics(s)] for name, unit, s in found if s is not None]
    return table("Errors", ("of", "unit", "n", "rmse", "mean", "median", "std", "min", "max"), lines, numeric=2)


def _scaled(spread: Spread | None, factor: float) -> Spread | None:
    if spread is None:
        return None
    numbers = (spread.rmse, spread.mean, spread.median, spread.std, spread.min, spread.max)
    return Spread(spread.count, *(factor * v for v in numbers))


def _statistics(s: Spread) -> list[str]:
    return [f"{v:.4g}" for v in (s.rmse, s.mean, s.median, s.std, s.min, s.max)]


def fault_table(summary: Summary, rows: Sequence[Row]) -> str:
    """Injected faults, each with a button that jumps to its first scan."""
    heads = ("kind", "verdict", "from [s]", "to [s]", "scans", "flagged", "delay [s]", "recovered after [s]")
    lines = []
    for e in summary.faults.episodes:
        delay = "" if e.delay_s is None else f"{e.delay_s:.2f}"
        after = "never" if e.lost else "" if e.recover_s is None else f"{e.recover_s:.2f}"
        kind = f'<button class="jump" data-scan="{_place(e, rows)}">{escape(e.kind)}</button>'
        counts = [str(e.scans), str(e.flagged)]
        lines.append([kind, _verdict(e), f"{e.start_s:.1f}", f"{e.end_s:.1f}", *counts, delay, after])
    return table("Injected faults", heads, lines, numeric=2)


def _place(episode: Episode, rows: Sequence[Row]) -> int:
    """The row nearest to the start of an episode."""
    return min(range(len(rows)), key=lambda k: abs(rows[k].t_s - episode.start_s), default=0)


def _verdict(e: Episode) -> str:
    if e.detected:
        return '<span class="good">● detected</span>' + ("" if e.scans else " as a gap")
    return '<span class="bad">✗ missed</span>' if e.harmful else '<span class="so">~ harmless, used</span>'


def parameter_table(summary: Summary) -> str:
    """Estimated constants against truth."""
    heads = ("parameter", "unit", "estimate", "truth", "error", "1 sigma")
    return table("Parameters at the last scan", heads, (_parameter(p) for p in summary.parameters), numeric=2)


def _parameter(p: Parameter) -> list[str]:
    vectors = ["" if v is None else " ".join(f"{x:.4f}" for x in v) for v in (p.estimate, p.truth)]
    return [escape(p.name), p.unit, *vectors, *("" if v is None else f"{v:.4f}" for v in (p.error, p.one_sigma))]


def fact_table(summary: Summary) -> str:
    """The rest, one line a fact."""
    lines = [[escape(name), escape(value)] for name, value in fact_lines(summary)]
    return table("Run", ("what", "value"), lines, numeric=9)


def config_section(header: Mapping[str, Any]) -> str:
    """The run's header (effective configuration, versions, checksums), folded away."""
    if not header:
        return ""
    text = json.dumps(header, indent=2, ensure_ascii=False, default=str)
    return f"<details><summary>Configuration and versions</summary><pre tabindex='0'>{escape(text)}</pre></details>"
