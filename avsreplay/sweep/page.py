"""A campaign's tables and its page: no script; the figures are inline SVG."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from markupsafe import Markup

from avsreplay.report.episodes import Peak
from avsreplay.report.page import Part, Section, build_html, render
from avsreplay.report.table import Table
from avsreplay.sweep.statistics import NO_HYPOTHESIS, FaultKind, Quantiles, Rate, Roc, Typical
from avsreplay.sweep.summary import CAMPAIGN_METRICS, Cell, Detector, SweepSummary, WorstRun

# Okabe and Ito's colours, distinguishable without colour vision, each with a dash pattern of its
# own
_STYLES = (("#0072B2", ""), ("#D55E00", "7 3"), ("#009E73", "2 3"), ("#CC79A7", "8 3 2 3"))
# The chart fits a telephone without scrolling.
_CHART_LEFT_PX = 12
_CHART_WIDTH_PX = 460
_CHART_ROW_PX = 44
_CHART_HEAD_PX = 52
_NAME_CHARACTERS = 62  # of the name of a combination over its line
_TICK_STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)  # round distances of ticks, times a power of ten
_LEAST_FALSE_RATE = 1e-4  # left end of the ROC's logarithmic axis
# The square of the ROC.
_ROC_LEFT_PX = 60
_ROC_TOP_PX = 20
_ROC_SIZE_PX = 380
_KIND_HEADS = (
    *(
        "fault",
        "no.",
        "strength,\nlength",
        "scans\nflagged",
        "windows\nfound",
        "delay,\nworst",
        "recovery,\nworst",
    ),
    *("lost", "worst\nflagged", "worst\nused", "worst\nafter"),
)
KIND_PARTS = (
    (0, 1, 2, 3, 4, 5, 6, 7),
    (0, 1, 8, 9, 10),
)  # columns: what was found and when; errors
_KINDS_TEXT = """\
No.: the combination. None: the scans outside every window; what is flagged there is a false
alarm. ~: usable by its label. Found: windows with a flagged scan or, without any scan, a gap.
Delay: from a window's first scan to its first flagged one [s], median and worst. Recovery: from
the first scan after it to the first healthy one [s], where there was something to recover from.
Lost: windows after which no scan was healthy. Worst: errors of the estimate [mm, deg] over the
window's flagged scans, over its used ones, and over the used ones after it up to the next
window."""

_WORST_TEXT = """A run is made again, with its own report, by:
avsreplay sweep CAMPAIGN.toml --run ID -o DIR --report"""


def build_sweep_page(summary: SweepSummary) -> str:
    """The page of a campaign's summary; the same summary gives the same bytes."""
    cells = [(number, cell) for number, cell in enumerate(summary.cells) if cell.runs]
    figures = [
        _spans(title, [(_named(n, c), c.metrics.get(name)) for n, c in cells])
        for name, title in CAMPAIGN_METRICS.items()
    ]
    parts: list[Part] = [
        combination_table(cells),
        rate_table(cells),
        Section(
            "Metrics",
            "Dot: median over the runs; thick: its 95 % interval; thin: 5 % to 95 % of the runs.",
        ),
        *(figure for figure in figures if figure is not None),
    ]
    if summary.detector is not None and summary.detector.harmful:
        parts += [Section("Fault tests"), detector_table(summary.detector), _roc(summary.detector)]
    kinds = kinds_table(cells)
    parts += [Section("Faults by kind", _KINDS_TEXT), kinds] if kinds.rows else []
    if summary.worst:
        parts += [Section("Worst runs", _WORST_TEXT), worst_table(summary.worst)]
    return build_html(summary.name, [_status_line(summary)], parts)


def worst_table(worst: Sequence[WorstRun], digits: int | None = None) -> Table:
    """A row per run that did not end well or has the largest errors, with ``digits`` of its id (all
    if None).

    Args:
        worst: the runs, worst first.
        digits: characters of an id; None: all.
    """
    rows = tuple(
        (
            run.id[:digits],
            str(run.cell),
            str(run.repeat),
            "" if run.seed is None else str(run.seed),
            run.status,
            run.reason,
        )
        for run in worst
    )
    return Table(
        "Worst runs",
        ("run", "no.", "repeat", "seed", "status", "reason"),
        rows,
        "nrrrnl",
        wide=True,
    )


def words(values: Mapping[str, Any]) -> str:
    """A combination in words, without the prefixes of its keys.

    Args:
        values: key and value of each axis.
    """
    pairs = (
        f"{key.removeprefix('scenario.').removeprefix('run.')}={value}"
        for key, value in values.items()
    )
    return ", ".join(pairs) or "no change"


def _named(number: int, cell: Cell) -> str:
    return f"{number}: {words(cell.values)}"


def _status_line(summary: SweepSummary) -> str:
    ended = ", ".join(f"{count} {word}" for word, count in summary.status.items()) or "none"
    return f"{summary.done} of {summary.planned} runs done: {ended}."


def combination_table(cells: Sequence[tuple[int, Cell]]) -> Table:
    """A row per combination: what was set, runs done, NEES at their ends.

    Args:
        cells: number and content of each combination.
    """
    rows = []
    for number, cell in cells:
        nees = cell.nees
        text = (
            "" if nees is None else f"{nees.mean_per_dof:.3f} ({nees.low:.3f} to {nees.high:.3f})"
        )
        rows.append((_named(number, cell), str(cell.runs), str(cell.status.get("ok", 0)), text))
    heads = ("combination", "runs", "ok", "NEES per state at the end\n(band where consistent)")
    return Table("Combinations", heads, tuple(rows), wide=True)


def rate_table(cells: Sequence[tuple[int, Cell]]) -> Table:
    """A row per combination: share of the runs that meet each criterion, with its 95 % interval.

    Args:
        cells: number and content of each combination.
    """
    names = list(cells[0][1].rates) if cells else []
    rows = tuple(
        (_named(number, cell), *(_share(cell.rates[name]) for name in names))
        for number, cell in cells
    )
    return Table("Success", ("combination", *names), rows, wide=True)


def cell_table(number: int, cell: Cell) -> Table:
    """Metrics and success rates of one combination.

    Args:
        number: number of the combination.
        cell: its runs.
    """
    rows: list[tuple[str, ...]] = []
    for name, found in cell.metrics.items():
        if found is not None:
            points = (f"{v:.3g}" for v in (found.q05, found.median, found.q95))
            rows.append(
                (
                    CAMPAIGN_METRICS[name],
                    str(found.count),
                    *points,
                    _interval(found.median_low, found.median_high, ".3g"),
                )
            )
    for name, share in cell.rates.items():
        if share is not None:
            span = _interval(share.low, share.high, ".1%")
            rows.append(
                (name, f"{share.successes}/{share.count}", "", f"{share.share:.1%}", "", span)
            )
    if cell.nees is not None:
        nees, band = cell.nees, f"{cell.nees.low:.3f} to {cell.nees.high:.3f}"
        rows.append(
            (
                "NEES per state at the end, 1 expected",
                str(nees.count),
                "",
                f"{nees.mean_per_dof:.3f}",
                "",
                band,
            )
        )
    title = f"{_named(number, cell)} ({cell.runs} runs)"
    return Table(title, ("metric", "runs", "5 %", "median", "95 %", "95 % interval"), tuple(rows))


def detector_table(detector: Detector) -> Table:
    """The rule in force, and each score as the only test at 1 % false alarms.

    Args:
        detector: the fault detector of a campaign.
    """
    rows = []
    if detector.detected is not None and detector.false is not None:
        rows.append(("rule in force", _share(detector.detected), _share(detector.false), "", ""))
    for name, curve in detector.curves.items():
        if curve is not None:
            threshold, detected = curve.at_one_percent
            rows.append(
                (
                    f"{name} alone",
                    f"{detected:.2%}",
                    "at most 1 %",
                    f"{threshold:.4g}",
                    f"{curve.area:.4f}",
                )
            )
    return Table(
        f"Fault tests over {detector.harmful} unusable and {detector.other} other scans",
        (
            "test",
            "unusable scans flagged",
            "other scans flagged",
            "threshold",
            "area under\nthe ROC curve",
        ),
        tuple(rows),
        wide=True,
    )


def _share(share: Rate | None) -> str:
    if share is None:
        return ""
    span = _interval(share.low, share.high, ".1%")
    return f"{share.share:.1%} ({span})" if span else f"{share.share:.1%}"


def _interval(low: float | None, high: float | None, style: str) -> str:
    """An interval in words, "" where there are too few runs for one."""
    return "" if low is None or high is None else f"{low:{style}} to {high:{style}}"


def round_ticks(low: float, high: float) -> list[float]:
    """Return two to seven multiples of a round number; the first is at most ``low``, the last at
    least ``high``.
    """
    span = high - low or abs(high) or 1.0
    power = 10.0 ** math.floor(math.log10(span / 5.0))
    step = next(s * power for s in _TICK_STEPS if s * power >= span / 5.0)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [float(f"{k * step:.12g}") for k in range(first, max(last, first + 1) + 1)]


def _spans(title: str, entries: Sequence[tuple[str, Quantiles | None]]) -> Markup | None:
    """One line per combination under its name, on one axis from 0 (or the least value) up."""
    known = [(name, q) for name, q in entries if q is not None]
    if not known:
        return None
    least = min([0.0, *(q.q05 for _, q in known)])
    ticks = round_ticks(least, max(max(q.q95, q.median_high or q.q95) for _, q in known))
    low, high = ticks[0], ticks[-1]
    scale = (_CHART_WIDTH_PX - _CHART_LEFT_PX - 30) / (high - low or 1.0)

    def x(value: float) -> str:
        return f"{_CHART_LEFT_PX + (value - low) * scale:.1f}"

    lines = [
        {
            "label": textwrap.shorten(name, _NAME_CHARACTERS, placeholder=" ..."),
            "title": (
                f"{name}: median {q.median:.4g}, 5 % {q.q05:.4g}, 95 % {q.q95:.4g}, {q.count} runs"
            ),
            "y": _CHART_HEAD_PX + _CHART_ROW_PX * (k + 1) - 10,
            "x": {
                **{name: x(getattr(q, name)) for name in ("q05", "q95", "median")},
                "median_low": x(q.median if q.median_low is None else q.median_low),
                "median_high": x(q.median if q.median_high is None else q.median_high),
            },
        }
        for k, (name, q) in enumerate(known)
    ]
    return render(
        "spans.svg",
        title=title,
        width=_CHART_WIDTH_PX,
        height=_CHART_HEAD_PX + _CHART_ROW_PX * len(known) + 8,
        title_y=18,
        head_y=_CHART_HEAD_PX - 12,
        label_x=_CHART_LEFT_PX - 8,
        ticks=[(x(v), f"{v:.6g}") for v in ticks],
        top=_CHART_HEAD_PX - 6,
        lines=lines,
    )


def _roc(detector: Detector) -> Markup:
    """Detected against false alarms; the axis of false alarms is logarithmic, since what
    matters is below 1 %.
    """
    curves = [
        {"name": name, "colour": colour, "dash": dash, "points": _points(curve)}
        for (colour, dash), (name, curve) in zip(_STYLES, detector.curves.items(), strict=False)
        if curve is not None
    ]
    rule = None
    if detector.detected is not None and detector.false is not None:
        rule = [f"{v:.1f}" for v in _place(detector.false.share, detector.detected.share)]
    ticks = [(f"{_place(v, 0.0)[0]:.1f}", f"{100 * v:g} %") for v in (1e-4, 1e-3, 1e-2, 1e-1, 1.0)]
    return render(
        "roc.svg",
        x0=_ROC_LEFT_PX,
        y0=_ROC_TOP_PX,
        size=_ROC_SIZE_PX,
        width=_CHART_WIDTH_PX,
        ticks=ticks,
        curves=curves,
        rule=rule,
    )


def _points(curve: Roc) -> str:
    places = (_place(f, d) for f, d in zip(curve.false, curve.detected, strict=True))
    return " ".join(dict.fromkeys(f"{x:.1f},{y:.1f}" for x, y in places))


def _place(false: float, detected: float) -> tuple[float, float]:
    along = math.log10(max(false, _LEAST_FALSE_RATE) / _LEAST_FALSE_RATE) / -math.log10(
        _LEAST_FALSE_RATE
    )
    return _ROC_LEFT_PX + _ROC_SIZE_PX * along, _ROC_TOP_PX + _ROC_SIZE_PX * (1.0 - detected)


def kinds_table(cells: Sequence[tuple[int, Cell]]) -> Table:
    """A row per kind of fault and combination; without rows where nothing was injected.

    Times are in s; errors are position [mm] and rotation [deg] of the estimate. The rows of kind
    "none" come first: flagged scans in these rows are false alarms.

    Args:
        cells: number and content of each combination.
    """
    title = (
        "By kind of fault: times in s, errors in mm and deg; ~: usable by its label; none:"
        " outside every window"
    )
    injected = any(cell.kinds.keys() - {NO_HYPOTHESIS} for _, cell in cells)
    return Table(title, _KIND_HEADS, tuple(_kind_rows(cells)) if injected else (), wide=True)


def columns_of(table: Table, kept: Sequence[int]) -> Table:
    """Some columns of a table.

    Args:
        table: the table.
        kept: numbers of the columns, in order.
    """
    heads, align = tuple(table.heads[k] for k in kept), "".join(table.letter(k) for k in kept)
    return replace(
        table,
        heads=heads,
        align=align,
        rows=tuple(tuple(row[k] for k in kept) for row in table.rows),
    )


def _kind_rows(cells: Sequence[tuple[int, Cell]]) -> Iterator[tuple[str, ...]]:
    names = {name for _, cell in cells for name in cell.kinds}
    for name in sorted(names, key=lambda name: (name != NO_HYPOTHESIS, name)):
        for number, cell in cells:
            if name in cell.kinds:
                yield _kind_row(name, number, cell.kinds[name])


def _kind_row(name: str, number: int, kind: FaultKind) -> tuple[str, ...]:
    harmless = name != NO_HYPOTHESIS and not kind.harmful
    return (
        f"{name} ~" if harmless else name,
        str(number),
        ", ".join(
            [*(f"{s:g}" for s in kind.strengths), *(f"{length:g} s" for length in kind.lengths_s)]
        ),
        _percent(kind.flagged),
        _count(kind.detected),
        _typical(kind.delay_s),
        _typical(kind.recovery_s),
        str(kind.lost) if kind.episodes else "",
        *(_peak(peak) for peak in (kind.peak_flagged, kind.peak_used, kind.peak_after)),
    )


def _percent(found: Rate | None) -> str:
    return "" if found is None else f"{found.share:.1%}"


def _count(found: Rate | None) -> str:
    return "" if found is None else f"{found.successes}/{found.count}"


def _typical(found: Typical | None) -> str:
    return "" if found is None else f"{found.median:.3g}, {found.worst:.3g}"


def _peak(peak: Peak) -> str:
    if peak.pos_err_m is None or peak.rot_err_deg is None:
        return ""
    return f"{_short(1000.0 * peak.pos_err_m)}, {_short(peak.rot_err_deg)}"


def _short(value: float) -> str:
    return f"{value:.0f}" if value >= 100.0 else f"{value:.2g}" if value >= 0.01 else f"{value:.3f}"
