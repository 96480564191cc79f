"""The conclusion of a comparison: better, worse or no evidence, metric by metric and in one sentence.

A value that is missing in one run counts as worse; it is never skipped. Where both runs have errors at the same
instants, the difference of their RMSE gets a 95 % interval by a paired bootstrap over blocks of consecutive scans
(successive errors are correlated). For groups of at least five runs, paired by name, every metric gets the interval of
its mean paired difference.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from avsreplay.report.compare import METRICS, changed_settings, first_divergence, metrics
from avsreplay.report.summary import Summary
from avsreplay.report.table import Table, TableCell, facts_table, number
from avsreplay.rows import Row

HEADLINES = {  # the metrics of the conclusion: words, unit and factor
    "healthy_ratio": ("scans used", " %", 100.0),
    "all_pos_rmse_m": ("rms position error of all scans", " mm", 1000.0),
    "all_rot_rmse_deg": ("rms attitude error of all scans", " deg", 1.0),
    "faults_missed": ("missed faults", "", 1.0),
    "false_alarm_rate": ("false alarms", " %", 100.0),
    "nees_inside": ("NEES inside its band", " %", 100.0),
    "t1_s": ("time of convergence", " s", 1.0),
    "capture_s": ("time of capture", " s", 1.0),
    "capture_miss_m": ("miss at capture", " mm", 1000.0),
    "losses": ("lost parts of the log", "", 1.0),
}
_MORE = {"scans", "healthy", "healthy_ratio", "nis_inside", "nees_inside", "ogm_rank"}
_NEUTRAL = {"nis_median", "nees_median", "sigma_hits", "ogm_log10_cond", "iterations_median", "weighed_down"}
_MAY_BE_MISSING = ("coast_", "recovery_s")  # absent also where nothing went wrong
_PAIRED = {"all_pos_rmse_m": "pos_err_m", "all_rot_rmse_deg": "rot_err_deg"}
_UNCERTAIN = 0.1  # relative change of a metric without an interval that is no evidence
_MARKS = {"better": "good", "worse": "bad"}
_BLOCKS, _LEAST_BLOCKS, _LEAST_RUNS, _RESAMPLES = 20, 5, 5, 2000


class ComparedRun(Protocol):
    """What a comparison needs of a saved result."""

    @property
    def name(self) -> str:
        """What the run is called."""

    @property
    def rows(self) -> Sequence[Row]:
        """One per scan."""

    @property
    def summary(self) -> Summary:
        """Of the same rows."""

    @property
    def header(self) -> Mapping[str, Any]:
        """``run.json``."""


@dataclass(frozen=True, slots=True)
class Change:
    """One metric of two runs or groups of runs.

    Attributes:
        metric: its name.
        base, other: values; means over the runs of a group that have one; None where none has.
        low, high: 95 % interval of the difference other - base; None without enough pairs.
        word: "better", "worse", "no evidence", "equal", or "changed" for a metric without a direction.
        note: "lost" or "new" where one side has no value.
    """

    metric: str
    base: float | None
    other: float | None
    low: float | None
    high: float | None
    word: str
    note: str = ""


@dataclass(frozen=True, slots=True)
class Conclusion:
    """The comparison of a run (or a group of runs) with the baseline.

    Attributes:
        name: of the other run or group.
        word: "better", "worse", "mixed", "no evidence" or "same" (all rows agree).
        sentence: the conclusion in one line.
        changes: of every metric that one of them has.
        settings: settings that differ, as ``key = value (baseline ...)``.
        pairs: number of paired runs.
    """

    name: str
    word: str
    sentence: str
    changes: tuple[Change, ...]
    settings: tuple[str, ...]
    pairs: int


def conclude(name: str, pairs: Sequence[tuple[ComparedRun, ComparedRun]]) -> Conclusion:
    """Compare runs with their baselines.

    Args:
        name: of the other run or group.
        pairs: (baseline, other) runs, paired by seed or by log; at least one.

    Returns:
        The conclusion; the same runs give the same result (the bootstrap has a fixed seed).
    """
    figures = [(metrics(base.summary), metrics(other.summary)) for base, other in pairs]
    changes = tuple(change for m in METRICS if (change := _change(m.name, figures, pairs)) is not None)
    settings = dict.fromkeys(text for base, other in pairs for text in _settings(base, other))
    same = all(first_divergence(base.rows, other.rows, first=1).ok for base, other in pairs)
    word, sentence = _overall(changes, same=same, rows=sum(len(other.rows) for _, other in pairs))
    return Conclusion(name, word, f"{name}: {sentence}", changes, tuple(settings), len(pairs))


def _settings(base: ComparedRun, other: ComparedRun) -> list[str]:
    """Settings that differ; the log and the model too, since they are inputs."""
    found = []
    for part in ("log", "model"):
        ours, theirs = (run.header.get(part) or {} for run in (other, base))
        if ours.get("sha256") != theirs.get("sha256"):
            found.append(f"{part} = {ours.get('name', 'unknown')} (baseline {theirs.get('name', 'unknown')})")
    config, reference = (run.header.get("config") for run in (other, base))
    return found + (changed_settings(config, reference, "baseline") if config and reference else [])


def _change(
    name: str,
    figures: Sequence[tuple[Mapping[str, float | None], Mapping[str, float | None]]],
    pairs: Sequence[tuple[ComparedRun, ComparedRun]],
) -> Change | None:
    values = [(base[name], other[name]) for base, other in figures]
    if all(base is None and other is None for base, other in values):
        return None
    base, other = (_mean([pair[side] for pair in values]) for side in (0, 1))
    lost = sum(a is not None and b is None for a, b in values)
    new = sum(a is None and b is not None for a, b in values)
    if lost or new:
        return Change(name, base, other, None, None, _word_of_loss(name, lost - new), "lost" if lost else "new")
    differences = [b - a for a, b in values if a is not None and b is not None]
    interval = _interval(name, pairs, differences)
    low, high = interval or (None, None)
    return Change(name, base, other, low, high, _word(name, base or 0.0, differences, interval))


def _mean(values: Sequence[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return math.fsum(known) / len(known) if known else None


def _word_of_loss(name: str, lost: int) -> str:
    if name in _NEUTRAL or name.startswith(_MAY_BE_MISSING):
        return "changed"
    return "worse" if lost > 0 else "better" if lost < 0 else "no evidence"


def _word(name: str, base: float, differences: Sequence[float], interval: tuple[float, float] | None) -> str:
    mean = math.fsum(differences) / len(differences)
    if not any(differences):
        return "equal"
    if name in _NEUTRAL:
        return "changed"
    if interval is not None:
        sure = interval[0] > 0.0 or interval[1] < 0.0
    else:
        whole = all(float(d).is_integer() for d in differences) and float(base).is_integer()
        sure = len(differences) == 1 and (whole or abs(mean) > _UNCERTAIN * abs(base))
    if not sure:
        return "no evidence"
    return "better" if (mean > 0.0) == (name in _MORE) else "worse"


def _interval(
    name: str, pairs: Sequence[tuple[ComparedRun, ComparedRun]], differences: Sequence[float]
) -> tuple[float, float] | None:
    if len(pairs) >= _LEAST_RUNS:
        return _bootstrap(np.array(differences), np.zeros(len(differences)), np.mean) if any(differences) else None
    if len(pairs) == 1 and name in _PAIRED:
        blocks = _blocks(pairs[0], _PAIRED[name])
        if blocks is not None and not np.array_equal(*blocks):
            return _bootstrap(blocks[1], blocks[0], lambda squares, axis: np.sqrt(np.mean(squares, axis=axis)))
    return None


def _blocks(
    pair: tuple[ComparedRun, ComparedRun], column: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Mean squares over blocks of consecutive scans that both runs have; None for too few."""
    base, other = ({row.t_ns: v for row in run.rows if (v := getattr(row, column)) is not None} for run in pair)
    shared = sorted(base.keys() & other.keys())
    count = min(_BLOCKS, len(shared) // 5)
    if count < _LEAST_BLOCKS:
        return None
    found = [
        np.array([np.mean(np.square(part)) for part in np.array_split([side[t] for t in shared], count)])
        for side in (base, other)
    ]
    return found[0], found[1]


def _bootstrap(other: NDArray[np.float64], base: NDArray[np.float64], statistic: Any) -> tuple[float, float]:
    """95 % interval of ``statistic(other) - statistic(base)`` by a paired bootstrap with a fixed seed."""
    from scipy.stats import bootstrap

    found = bootstrap(
        (other, base),
        lambda a, b, axis=-1: statistic(a, axis=axis) - statistic(b, axis=axis),
        paired=True,
        n_resamples=_RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(0),
    )
    return float(found.confidence_interval.low), float(found.confidence_interval.high)


def _overall(changes: Sequence[Change], *, same: bool, rows: int) -> tuple[str, str]:
    if same:
        return "same", f"no difference; all {rows} rows agree within the tolerances of their columns"
    found = {word: [c for c in changes if c.word == word and c.metric in HEADLINES] for word in ("worse", "better")}
    said = [f"{word} in {', '.join(map(_said, listed))}" for word, listed in found.items() if listed]
    if not said:
        return "no evidence", "no evidence of a difference in the main metrics"
    word = "mixed" if len(said) == 2 else "worse" if found["worse"] else "better"
    return word, "; ".join(said)


def _said(change: Change) -> str:
    words, unit, factor = HEADLINES[change.metric]
    if change.note or change.base is None or change.other is None:
        return f"{words} ({change.note or 'no value'})"
    return f"{words} ({factor * change.base:.4g} to {factor * change.other:.4g}{unit})"


def settings_table(conclusion: Conclusion) -> Table:
    """The settings in which a run differs from the baseline."""
    texts = conclusion.settings or ("none",)
    return facts_table(f"Settings of {conclusion.name} that differ", [("setting", text) for text in texts])


def changes_table(baseline: str, conclusion: Conclusion, *, show_all: bool = False) -> Table:
    """The metrics of a run against those of the baseline, with a word on each.

    Without ``show_all`` the table has the main metrics and those that changed.
    """
    shown = [c for c in conclusion.changes if show_all or c.metric in HEADLINES or c.word != "equal"]
    meaning = {m.name: m.doc for m in METRICS}
    rows = tuple(
        (
            change.metric,
            *((meaning[change.metric],) if show_all else ()),
            number(change.base, ".4g"),
            number(change.other, ".4g"),
            change.note or _relative(change),
            "" if change.low is None else f"{change.low:+.2g} to {change.high:+.2g}",
            TableCell(change.word, _MARKS.get(change.word, "")),
        )
        for change in shown
    )
    runs = f", means of {conclusion.pairs} pairs" if conclusion.pairs > 1 else ""
    left_out = len(conclusion.changes) - len(shown)
    return Table(
        f"{conclusion.name} against {baseline}{runs}",
        ("metric", *(("meaning",) if show_all else ()), "baseline", "this", "change", "95 % interval", "conclusion"),
        rows,
        align="llrrrrl" if show_all else "lrrrrl",
        note=f"{left_out} equal metrics are not shown" if left_out else "",
    )


def _relative(change: Change) -> str:
    base, value = change.base, change.other
    if base is None or value is None or base == value:
        return ""
    if base == 0:
        return f"{value - base:+.3g}"
    times = value / base
    return f"x {times:.3g}" if times >= 10.0 else f"{100 * (value - base) / abs(base):+.1f} %"
