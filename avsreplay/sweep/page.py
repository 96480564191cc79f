"""A campaign on one page: self-contained HTML with inline SVG, no script and no network; light and dark."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

from avsreplay.sweep.kinds import NONE
from avsreplay.sweep.kinds_table import KIND_HEADS, kind_rows
from avsreplay.sweep.statistics import Quantiles, Rate, Roc
from avsreplay.sweep.summary import HEADLINES, Cell, Detector, SweepSummary

__all__ = ["build_page", "words"]

# Okabe and Ito's colours, told apart without colour vision, each with a dash pattern of its own
_STYLES = (("#0072B2", ""), ("#D55E00", "7 3"), ("#009E73", "2 3"), ("#CC79A7", "8 3 2 3"))
_LEFT, _WIDTH, _ROW = 260, 760, 26
_FALSE_MIN = 1e-4  # left end of the ROC's logarithmic axis
_KINDS_SAID = """No.: the combination. None: the scans outside every window; what is flagged there is a false
alarm. ~: harmless by its label. Found: windows with a flagged scan or, without any scan, a gap. Delay: from a
window's first scan to its first flagged one [s], median and worst. Recovery: from the first scan after it to the
first healthy one [s], where there was something to recover from. Lost: windows after which no scan was healthy.
Worst: errors of the estimate [mm, deg] over the window's flagged scans, over its used ones, and over the used ones
after it up to the next window."""
_CSS = """
:root{color-scheme:light dark;--ink:#1b1b1b;--paper:#fff;--line:#c9c9c9;--soft:#f2f2f2;--mark:#0072B2}
@media(prefers-color-scheme:dark){:root{--ink:#eaeaea;--paper:#16181b;--line:#4a4f55;--soft:#22262a;--mark:#56B4E9}}
body{font:15px/1.45 system-ui,sans-serif;color:var(--ink);background:var(--paper)}
body{max-width:1080px;margin:auto;padding:1rem}
h1{font-size:1.4rem}h2{font-size:1.1rem;margin-top:2rem}
.scroll{overflow-x:auto}table{border-collapse:collapse;font-variant-numeric:tabular-nums}
th,td{border-bottom:1px solid var(--line);padding:.25rem .7rem;text-align:right;white-space:nowrap}
th:first-child,td:first-child{text-align:left}thead th{background:var(--soft);white-space:pre-line}
svg{max-width:100%;height:auto}svg text{fill:var(--ink);font-size:13px}
.axis{stroke:var(--line)}.span{stroke:var(--mark);stroke-width:2}.band{stroke:var(--mark);stroke-width:7;opacity:.45}
.dot{fill:var(--mark)}
"""


def build_page(summary: SweepSummary) -> str:
    """The page of a campaign's summary: the same summary gives the same bytes."""
    cells = [(number, cell) for number, cell in enumerate(summary.cells) if cell.runs]
    parts = [
        f"<h1>{escape(summary.name)}</h1>",
        f"<p>{escape(_verdict(summary))}</p>",
        "<h2>Combinations</h2>",
        _key_table(cells),
        "<h2>Success</h2>",
        _rate_table(cells),
        "<h2>Figures</h2><p>Dot: median over the runs; thick: its 95 % interval; thin: 5 % to 95 % of the runs.</p>",
        *(_spans(title, [(n, c.metrics.get(name)) for n, c in cells]) for name, title in HEADLINES.items()),
    ]
    if summary.detector is not None and summary.detector.harmful:
        parts += ["<h2>Fault tests</h2>", _detector(summary.detector)]
    parts.append(_kinds(cells))
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width">'
    head += f"<title>{escape(summary.name)}</title>"
    body = "\n".join(parts)
    return f'<!doctype html>\n<html lang="en"><head>{head}<style>{_CSS}</style></head><body>\n{body}\n</body></html>\n'


def words(values: Mapping[str, Any]) -> str:
    """A combination in words, without the prefixes of its keys."""
    pairs = (f"{key.removeprefix('scenario.').removeprefix('run.')}={value}" for key, value in values.items())
    return ", ".join(pairs) or "as it is"


def _verdict(summary: SweepSummary) -> str:
    ended = ", ".join(f"{count} {word}" for word, count in summary.status.items()) or "none"
    return f"{summary.done} of {summary.planned} runs done: {ended}."


def _key_table(cells: Sequence[tuple[int, Cell]]) -> str:
    rows = []
    for number, cell in cells:
        nees = cell.nees
        text = "" if nees is None else f"{nees.mean_per_dof:.3f} ({nees.low:.3f} to {nees.high:.3f})"
        rows.append([f"{number}: {words(cell.values)}", str(cell.runs), str(cell.status.get("ok", 0)), text])
    return _table(["combination", "runs", "ok", "NEES per state at the end (band of a right one)"], rows)


def _rate_table(cells: Sequence[tuple[int, Cell]]) -> str:
    names = list(cells[0][1].rates) if cells else []
    rows = [[str(number), *(_share(cell.rates[name]) for name in names)] for number, cell in cells]
    return _table(["combination", *names], rows)


def _share(share: Rate | None) -> str:
    return "" if share is None else f"{share.share:.1%} ({share.low:.1%} to {share.high:.1%})"


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    head = "".join(f'<th scope="col">{escape(h)}</th>' for h in heads)
    body = "".join("<tr>" + "".join(f"<td>{escape(c)}</td>" for c in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _spans(title: str, entries: Sequence[tuple[int, Quantiles | None]]) -> str:
    """One line a combination, on one axis from 0 (or the least value) up."""
    known = [(number, q) for number, q in entries if q is not None]
    if not known:
        return ""
    low = min(0.0, *(q.q05 for _, q in known)) if len(known) > 1 else min(0.0, known[0][1].q05)
    high = max(max(q.q95, q.median_high) for _, q in known)
    scale = (_WIDTH - _LEFT - 20) / (high - low or 1.0)
    height = _ROW * (len(known) + 2)
    lines = [_span(number, q, low, scale, _ROW * (k + 2)) for k, (number, q) in enumerate(known)]
    marks = "".join(
        f'<text x="{_LEFT + (v - low) * scale:.1f}" y="{_ROW + 6}" text-anchor="middle">{v:.4g}</text>'
        for v in (low, 0.5 * (low + high), high)
    )
    return (
        f'<svg viewBox="0 0 {_WIDTH + 40} {height}" role="img" aria-label="{escape(title)}">'
        f'<text x="0" y="{_ROW + 6}">{escape(title)}</text>{marks}{"".join(lines)}</svg>'
    )


def _span(number: int, q: Quantiles, low: float, scale: float, y: int) -> str:
    q05, q95, left, right, dot = (
        f"{_LEFT + (v - low) * scale:.1f}" for v in (q.q05, q.q95, q.median_low, q.median_high, q.median)
    )
    said = f"{number}: median {q.median:.4g}, 5 % {q.q05:.4g}, 95 % {q.q95:.4g}, {q.count} runs"
    return (
        f'<g><title>{said}</title><text x="{_LEFT - 20}" y="{y + 4}" text-anchor="end">{number}</text>'
        f'<line class="span" x1="{q05}" x2="{q95}" y1="{y}" y2="{y}"/>'
        f'<line class="band" x1="{left}" x2="{right}" y1="{y}" y2="{y}"/>'
        f'<circle class="dot" cx="{dot}" cy="{y}" r="5"/></g>'
    )


def _detector(detector: Detector) -> str:
    rows = []
    if detector.detected is not None and detector.false is not None:
        rows.append(["rule in force", _share(detector.detected), _share(detector.false), "", ""])
    for name, curve in detector.curves.items():
        if curve is not None:
            threshold, detected = curve.at_one_percent
            rows.append([f"{name} alone", f"{detected:.2%}", "at most 1 %", f"{threshold:.4g}", f"{curve.area:.4f}"])
    heads = ["test", "harmful scans flagged", "other scans flagged", "threshold", "area under the curve"]
    said = f"<p>{detector.harmful} harmful scans, {detector.other} others, of all runs together.</p>"
    return said + _table(heads, rows) + _roc(detector)


def _kinds(cells: Sequence[tuple[int, Cell]]) -> str:
    """Faults by kind, with what the columns mean; empty where nothing was injected and nothing flagged."""
    rows = list(kind_rows(cells))
    if not any(cell.kinds.keys() - {NONE} for _, cell in cells):
        return ""
    return f"<h2>By kind of fault</h2><p>{escape(_KINDS_SAID)}</p>{_table(KIND_HEADS, rows)}"


def _roc(detector: Detector) -> str:
    """Detected against false alarms; the axis of false alarms is logarithmic, since what matters is under 1 %."""
    x0, y0, size = 60, 20, 420
    lines: list[str] = []
    legend: list[str] = []
    for (colour, dash), (name, curve) in zip(_STYLES, detector.curves.items(), strict=False):
        if curve is None:
            continue
        row = y0 + 20 + 22 * len(legend)
        style = f'fill="none" stroke="{colour}" stroke-width="2.5" stroke-dasharray="{dash}"'
        lines.append(f'<polyline {style} points="{_curve(curve, x0, y0, size)}"/>')
        legend.append(
            f'<path {style} d="M{x0 + size + 20} {row}h40"/>'
            f'<text x="{x0 + size + 70}" y="{row + 4}">{escape(name)}</text>'
        )
    if detector.detected is not None and detector.false is not None:
        x, y = _place(detector.false.share, detector.detected.share, x0, y0, size)
        lines.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="6" class="dot"><title>rule in force</title></circle>')
    ticks = "".join(
        f'<text x="{_place(v, 0.0, x0, y0, size)[0]:.1f}" y="{y0 + size + 18}" text-anchor="middle">{v:.2%}</text>'
        for v in (1e-4, 1e-3, 1e-2, 1e-1, 1.0)
    )
    frame = f'<rect x="{x0}" y="{y0}" width="{size}" height="{size}" fill="none" class="axis"/>'
    sides = (
        f'<text x="{x0 - 8}" y="{y0 + 6}" text-anchor="end">100 %</text>'
        f'<text x="{x0 - 8}" y="{y0 + size}" text-anchor="end">0 %</text>'
        f'<text x="{x0 + size / 2}" y="{y0 + size + 40}" text-anchor="middle">other scans flagged</text>'
    )
    label = 'role="img" aria-label="harmful scans flagged against other scans flagged"'
    return f'<svg viewBox="0 0 {_WIDTH} {y0 + size + 50}" {label}>{frame}{ticks}{sides}{"".join(lines + legend)}</svg>'


def _curve(curve: Roc, x0: int, y0: int, size: int) -> str:
    places = (_place(f, d, x0, y0, size) for f, d in zip(curve.false, curve.detected, strict=True))
    return " ".join(dict.fromkeys(f"{x:.1f},{y:.1f}" for x, y in places))


def _place(false: float, detected: float, x0: int, y0: int, size: int) -> tuple[float, float]:
    along = math.log10(max(false, _FALSE_MIN) / _FALSE_MIN) / -math.log10(_FALSE_MIN)
    return x0 + size * along, y0 + size * (1.0 - detected)
