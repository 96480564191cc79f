"""The conclusion of a comparison: better, worse or no evidence, metric by metric and in one
sentence.

A value that is missing in one run counts as worse; it is never skipped. A difference is better or
worse only where its 95 % interval excludes zero. For two runs, means over scans (RMSE, shares) get
an interval by a paired bootstrap over blocks of consecutive scans, because successive errors are
correlated. For groups of at least five runs, paired by name, every metric gets the interval of its
mean paired difference. Counts of events need no interval; any other figure without one is reported
as changed. Scans of different logs cannot be paired: every difference of such runs is reported as
changed, and the sentence begins with the names of the logs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from avsreplay.errors import value_class
from avsreplay.geometry import Array
from avsreplay.report.compare import METRICS, different_inputs, different_logs, metrics
from avsreplay.report.golden import GoldenResult, compare_rows
from avsreplay.report.intervals import interval_of_mean, interval_of_roots
from avsreplay.report.summary import NEES_BAND, NIS_BAND, Summary
from avsreplay.report.table import Table, TableCell, facts_table, number
from avsreplay.rows import Row
from avsreplay.tables import column_of, numbers

COMPARED_METRICS = {  # the metrics of the conclusion: words, unit and factor
    "healthy_ratio": ("scans used", " %", 100.0),
    "all_pos_rmse_m": ("rms position error of all scans", " mm", 1000.0),
    "all_rot_rmse_deg": ("rms attitude error of all scans", " deg", 1.0),
    "faults_missed": ("missed faults", "", 1.0),
    "false_alarm_rate": ("false alarms", " %", 100.0),
    "nees_inside": ("NEES inside its band", " %", 100.0),
    "t1_s": ("time of convergence", " s", 1.0),
    "capture_probability": ("probability of a capture", "", 1.0),
    "capture_s": ("time of capture", " s", 1.0),
    "capture_miss_m": ("miss at capture", " mm", 1000.0),
    "losses": ("lost parts of the log", "", 1.0),
}
_MORE_IS_BETTER = {
    "capture_probability",
    "captured",
    "scans",
    "healthy",
    "healthy_ratio",
    "nis_inside",
    "nees_inside",
    "ogm_rank",
}
_NEUTRAL = {
    "nis_median",
    "nees_median",
    "sigma_hits",
    "ogm_log10_cond",
    "iterations_median",
    "weighed_down",
}
_MAY_BE_MISSING = ("coast_", "recovery_s")  # absent also where nothing went wrong
_COUNTS = {
    "scans",
    "healthy",
    "faults_missed",
    "scans_missed",
    "false_alarms",
    "reinitialised",
    "withdrawn",
    "gaps",
    "losses",
    "ogm_rank",
}
# relative change of a main metric without an interval that the sentence mentions
_MENTIONED_CHANGE = 0.1
_MARKS = {"better": "good", "worse": "bad"}
_MAX_BLOCKS = 10  # of scans in a row, from which the interval of one log follows
_LEAST_BLOCK_SCANS = 5
_LEAST_BLOCKS = 5
_LEAST_PAIRED_RUNS = 5


def _scanwise(
    column: str, band: tuple[float, float] | None = None, *, healthy: bool = False
) -> Callable[[Sequence[Row]], Array]:
    """A column squared, or whether it is inside a band; NaN where a scan has no value or is
    not to count.
    """

    def value(rows: Sequence[Row]) -> Array:
        found = numbers(rows, column)
        known = np.isfinite(found) & (numbers(rows, "gamma") == 1.0 if healthy else True)
        figures = np.square(found) if band is None else (band[0] <= found) & (found <= band[1])
        return np.where(known, figures, np.nan)

    return value


_ROOTS = {  # metrics that are the root of a mean over scans
    "all_pos_rmse_m": _scanwise("pos_err_m"),
    "all_rot_rmse_deg": _scanwise("rot_err_deg"),
    "pose_pos_rmse_m": _scanwise("pos_err_m", healthy=True),
    "pose_rot_rmse_deg": _scanwise("rot_err_deg", healthy=True),
    "reg_pos_rmse_m": _scanwise("reg_pos_err_m", healthy=True),
    "reg_rot_rmse_deg": _scanwise("reg_rot_err_deg", healthy=True),
}
_MEANS = {  # metrics that are a mean over scans
    "healthy_ratio": lambda rows: numbers(rows, "gamma"),
    "false_alarm_rate": lambda rows: np.where(
        list(map(bool, column_of(rows, "fault"))), np.nan, 1.0 - numbers(rows, "gamma")
    ),
    "nis_inside": _scanwise("nis", NIS_BAND, healthy=True),
    "nees_inside": _scanwise("nees", NEES_BAND),
}


class ComparedRun(Protocol):
    """What a comparison needs of a saved result: its name, rows (one per scan), their summary
    and ``run.json``.
    """

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def rows(self) -> Sequence[Row]: ...  # noqa: D102
    @property
    def summary(self) -> Summary: ...  # noqa: D102
    @property
    def header(self) -> Mapping[str, Any]: ...  # noqa: D102


@value_class(eq=True)
class Change:
    """One metric in the comparison of two runs or groups of runs.

    Attributes:
        metric: name of the metric.
        base, other: its value in the baseline and in the other run. For a group this is the mean
            over the runs that have a value; None where none has.
        low, high: 95 % interval of the difference other - base; None without enough pairs.
        word: "better", "worse", "no evidence" (the interval contains 0, or there are too few
            pairs), "equal", or "changed" for a metric without a direction or without an interval,
            and for runs of different logs.
        note: "lost" where only the baseline has a value, "new" where only the other run has one.
    """

    metric: str
    base: float | None
    other: float | None
    low: float | None
    high: float | None
    word: str
    note: str = ""


@value_class(eq=True)
class Conclusion:
    """The comparison of a run (or a group of runs) with the baseline.

    Attributes:
        name: name of the run or group that is compared with the baseline.
        word: "better", "worse", "mixed", "no evidence" or "same" (all rows agree).
        sentence: the conclusion in one line.
        changes: every metric that one of the two has.
        settings: log, model, reading options and settings that differ, as ``key = value (baseline
            ...)``.
        pairs: number of paired runs.
        divergence: where the rows of a single pair first differ; None for several pairs or
            different logs.
    """

    name: str
    word: str
    sentence: str
    changes: tuple[Change, ...]
    settings: tuple[str, ...]
    pairs: int
    divergence: GoldenResult | None


def conclude(name: str, pairs: Sequence[tuple[ComparedRun, ComparedRun]]) -> Conclusion:
    """Compare runs with their baselines.

    Args:
        name: name of the run or group that is compared with the baseline.
        pairs: (baseline, other) runs, paired by seed or by log; at least one.

    Returns:
        The conclusion; the same runs give the same result (the bootstrap has a fixed seed).
    """
    figures = [(metrics(base.summary), metrics(other.summary)) for base, other in pairs]
    apart = [named for base, other in pairs if (named := different_logs(base.header, other.header))]
    paired = not apart or len(pairs) >= _LEAST_PAIRED_RUNS
    changes = tuple(
        change for m in METRICS if (change := _change(m.name, figures, pairs, paired)) is not None
    )
    settings = dict.fromkeys(
        text for base, other in pairs for text in different_inputs(base.header, other.header)
    )
    found = [compare_rows(base.rows, other.rows, first=1) for base, other in pairs]
    rows = sum(len(other.rows) for _, other in pairs)
    word, sentence = _overall(changes, same=all(f.ok for f in found), rows=rows, paired=paired)
    divergence = found[0] if len(found) == 1 and not apart else None
    if apart:
        sentence = f"{_apart(apart, len(pairs), comparable=paired or word == 'same')}{sentence}"
    return Conclusion(
        name, word, f"{name}: {sentence}", changes, tuple(settings), len(pairs), divergence
    )


def _apart(apart: Sequence[tuple[str, str]], pairs: int, *, comparable: bool) -> str:
    """The words before the conclusion where the logs of runs differ."""
    which = "the logs differ" if pairs == 1 else f"the logs of {len(apart)} of {pairs} pairs differ"
    names = f"{which} ('{apart[0][1]}', baseline '{apart[0][0]}')"
    return (
        f"{names}: "
        if comparable
        else f"{names}, so that a comparison scan by scan does not apply: "
    )


def _change(
    name: str,
    figures: Sequence[tuple[Mapping[str, float | None], Mapping[str, float | None]]],
    pairs: Sequence[tuple[ComparedRun, ComparedRun]],
    paired: bool,
) -> Change | None:
    values = [(base[name], other[name]) for base, other in figures]
    base, other = (_mean([pair[side] for pair in values]) for side in (0, 1))
    if base is None and other is None:
        return None
    missing = [(a is None, b is None) for a, b in values]
    lost, new = missing.count((False, True)), missing.count((True, False))
    if lost or new:
        word = _word_of_loss(name, lost - new) if paired else "changed"
        return Change(name, base, other, None, None, word, "lost" if lost else "new")
    differences = [b - a for a, b in values if a is not None and b is not None]
    if not paired:
        return Change(name, base, other, None, None, "changed" if any(differences) else "equal")
    interval = _interval(name, pairs, differences) if any(differences) else None
    low, high = interval or (None, None)
    return Change(name, base, other, low, high, _word(name, differences, interval))


def _mean(values: Sequence[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return math.fsum(known) / len(known) if known else None


def _word_of_loss(name: str, lost: int) -> str:
    if name in _NEUTRAL or name.startswith(_MAY_BE_MISSING):
        return "changed"
    return "worse" if lost > 0 else "better" if lost < 0 else "no evidence"


def _word(name: str, differences: Sequence[float], interval: tuple[float, float] | None) -> str:
    mean = math.fsum(differences) / len(differences)
    if not any(differences):
        return "equal"
    if name in _NEUTRAL:
        return "changed"
    if interval is None and len(differences) == 1 and name not in _COUNTS:
        return "changed"
    sure = len(differences) == 1 if interval is None else interval[0] > 0.0 or interval[1] < 0.0
    if not sure:
        return "no evidence"
    return "better" if (mean > 0.0) == (name in _MORE_IS_BETTER) else "worse"


def _interval(
    name: str, pairs: Sequence[tuple[ComparedRun, ComparedRun]], differences: Sequence[float]
) -> tuple[float, float] | None:
    """95 % interval of the mean difference; None with too few pairs of runs or of scans."""
    if len(pairs) >= _LEAST_PAIRED_RUNS:
        return interval_of_mean(np.array(differences))
    if len(pairs) > 1 or not (name in _ROOTS or name in _MEANS):
        return None
    found = _blocks(pairs[0], _ROOTS.get(name) or _MEANS[name])
    if found is None:
        return None
    return (
        interval_of_roots(*found)
        if name in _ROOTS
        else interval_of_mean(found[1] - found[0], correlated=True)
    )


def _blocks(
    pair: tuple[ComparedRun, ComparedRun], value: Callable[[Sequence[Row]], Array]
) -> tuple[Array, Array] | None:
    """Means of both runs in blocks of consecutive scans that both have; None for too few scans."""
    stamps: list[Array] = []
    found: list[Array] = []
    for run in pair:
        figures = value(run.rows)
        known = np.flatnonzero(np.isfinite(figures))
        stamps.append(np.array(column_of(run.rows, "t_ns"))[known])
        found.append(figures[known])
    shared, *places = np.intersect1d(stamps[0], stamps[1], return_indices=True)
    count = min(_MAX_BLOCKS, len(shared) // _LEAST_BLOCK_SCANS)
    if count < _LEAST_BLOCKS:
        return None
    parts = [np.array_split(figures[at], count) for figures, at in zip(found, places, strict=True)]
    base, other = (np.array([part.mean() for part in blocks]) for blocks in parts)
    return base, other


def _overall(changes: Sequence[Change], *, same: bool, rows: int, paired: bool) -> tuple[str, str]:
    if same:
        return (
            "same",
            f"no difference; all {rows} rows agree within the tolerances of their columns",
        )
    found = {
        word: [c for c in changes if c.word == word and c.metric in COMPARED_METRICS]
        for word in ("worse", "better")
    }
    said = [
        f"{word} in {', '.join(map(_said, listed))}" for word, listed in found.items() if listed
    ]
    word = "no evidence"
    if said:
        word = "mixed" if len(said) == 2 else "worse" if found["worse"] else "better"
    changed = ", ".join(
        _said(c)
        for c in changes
        if c.metric in COMPARED_METRICS and c.word == "changed" and _mentioned(c)
    )
    if not paired:
        differ = f"in {changed}" if changed else "by less than 10 %"
        return word, f"the main metrics differ {differ}"
    said = said or ["no evidence of a difference in the main metrics"]
    if changed:
        said.append(f"changed, without an interval: {changed}")
    return word, "; ".join(said)


def _mentioned(change: Change) -> bool:
    base, other = change.base or 0.0, change.other or 0.0
    return abs(other - base) > _MENTIONED_CHANGE * abs(base)


def _said(change: Change) -> str:
    words, unit, factor = COMPARED_METRICS[change.metric]
    if change.note or change.base is None or change.other is None:
        return f"{words} ({change.note or 'no value'})"
    return f"{words} ({factor * change.base:.4g} to {factor * change.other:.4g}{unit})"


def settings_table(conclusion: Conclusion) -> Table:
    """Return the table of the settings in which a run differs from the baseline.

    Args:
        conclusion: the comparison with the baseline.
    """
    texts = conclusion.settings or ("none",)
    return facts_table(
        f"Settings of {conclusion.name} that differ", [("setting", text) for text in texts]
    )


def changes_table(baseline: str, conclusion: Conclusion, *, show_all: bool = False) -> Table:
    """Return the table of the metrics of a run against those of the baseline, with the conclusion
    on each.

    Args:
        baseline: name of the baseline.
        conclusion: the comparison.
        show_all: also show the metrics that are equal and not among the main ones.
    """
    shown = [
        c
        for c in conclusion.changes
        if show_all or c.metric in COMPARED_METRICS or c.word != "equal"
    ]
    meaning = {m.name: m.doc for m in METRICS}
    rows = tuple(
        (
            change.metric,
            number(change.base, ".4g"),
            number(change.other, ".4g"),
            change.note or _relative(change),
            _interval_text(change),
            TableCell(change.word, _MARKS.get(change.word, "")),
            *((meaning[change.metric],) if show_all else ()),
        )
        for change in shown
    )
    runs = f", means of {conclusion.pairs} pairs" if conclusion.pairs > 1 else ""
    left_out = len(conclusion.changes) - len(shown)
    return Table(
        f"{conclusion.name} against {baseline}{runs}",
        (
            "metric",
            "baseline",
            "this",
            "change",
            "95 % interval",
            "conclusion",
            *(("meaning",) if show_all else ()),
        ),
        rows,
        align="nrrrrnl" if show_all else "nrrrrn",
        note=f"{left_out} equal metrics are not shown" if left_out else "",
        wide=True,
    )


def _interval_text(change: Change) -> str:
    """The interval of a difference in percent of the baseline, where that is not zero."""
    if change.low is None or change.high is None:
        return ""
    if not change.base:
        return f"{change.low:+.2g} to {change.high:+.2g}"
    low, high = (100.0 * end / abs(change.base) for end in (change.low, change.high))
    return (
        f"{low:+.0f} to {high:+.0f} %"
        if max(abs(low), abs(high)) >= 10.0
        else f"{low:+.1f} to {high:+.1f} %"
    )


def _relative(change: Change) -> str:
    base, value = change.base, change.other
    if base is None or value is None or base == value:
        return ""
    if base == 0:
        return f"{value - base:+.3g}"
    times = value / base
    return f"x {times:.3g}" if times >= 10.0 else f"{100 * (value - base) / abs(base):+.1f} %"
