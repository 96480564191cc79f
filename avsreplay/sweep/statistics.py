"""Statistics over many runs: quantiles, success rates, consistency, ROC curves of the fault tests,
kinds of fault.

The figures by kind of fault (windows detected, delay, recovery, largest errors of the estimate) are
computed from the fault accounts of the runs (report/episodes), without their scans. Two windows of
one kind in a run count as two. Kind "none" stands for the scans outside every window; those flagged
there are false alarms.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import settings
from avsreplay.report.episodes import Episode, Peak

CONFIDENCE_LEVEL = 0.95  # confidence level of every interval


@dataclass(frozen=True, slots=True)
class Quantiles:
    """5 %, 50 % and 95 % quantiles over the runs that have the metric, and a 95 % interval of the
    median.

    The interval is None where there are too few runs for one with this coverage (fewer than 6).
    """

    count: int
    q05: float
    median: float
    q95: float
    median_low: float | None
    median_high: float | None


def quantiles(values: Sequence[float]) -> Quantiles | None:
    """Quantiles by linear interpolation, the interval of the median by order statistics; None
    without a value.

    Args:
        values: the values of the runs.
    """
    if not len(values):
        return None
    from scipy.stats import quantile_test

    ordered = np.sort(np.asarray(values, dtype=np.float64))
    q05, median, q95 = (float(np.quantile(ordered, q)) for q in (0.05, 0.5, 0.95))
    interval: Any = quantile_test(ordered, p=0.5).confidence_interval(
        confidence_level=CONFIDENCE_LEVEL
    )
    low, high = (float(b) if math.isfinite(b) else None for b in (interval.low, interval.high))
    whole = low is not None and high is not None
    return Quantiles(len(values), q05, median, q95, low if whole else None, high if whole else None)


@dataclass(frozen=True, slots=True)
class Typical:
    """Number, median and largest of the values that exist."""

    count: int
    median: float
    worst: float


def typical(values: Sequence[float]) -> Typical | None:
    """Median and largest value; None without a value.

    Args:
        values: the values of the runs.
    """
    return (
        Typical(len(values), float(np.median(values)), float(max(values))) if len(values) else None
    )


@dataclass(frozen=True, slots=True)
class Rate:
    """A share and its 95 % interval, which is None for a single run."""

    successes: int
    count: int
    share: float
    low: float | None
    high: float | None


def rate(successes: int, count: int) -> Rate | None:
    """The share of successes with Wilson's score interval; None for no run.

    Args:
        successes: number of successes.
        count: number of runs.
    """
    if count == 0:
        return None
    if count == 1:
        return Rate(successes, 1, float(successes), None, None)
    from scipy.stats import binomtest

    interval = binomtest(successes, count).proportion_ci(CONFIDENCE_LEVEL, method="wilson")
    return Rate(successes, count, successes / count, float(interval.low), float(interval.high))


@dataclass(frozen=True, slots=True)
class RunConsistency:
    """Mean NEES per state over independent runs, and the 95 % band of a consistent estimator."""

    count: int
    mean_per_dof: float
    low: float
    high: float
    median_per_dof: float


def consistency(nees: Sequence[float], dof: int) -> RunConsistency | None:
    """The consistency of one NEES of ``dof`` states per run; None without a value.

    Args:
        nees: normalised errors squared at the ends of the runs.
        dof: number of states in each.
    """
    if not len(nees):
        return None
    from scipy.stats import chi2

    n = len(nees)
    low, high = (float(bound) / (dof * n) for bound in chi2.interval(CONFIDENCE_LEVEL, dof * n))
    return RunConsistency(n, math.fsum(nees) / (dof * n), low, high, float(np.median(nees)) / dof)


@dataclass(frozen=True, slots=True)
class Roc:
    """The receiver operating characteristic of one score as the only fault test.

    Attributes:
        thresholds: Thresholds from strict to lenient.
        detected: Share of the harmful scans that are flagged at each threshold.
        false: Share of the other scans that are flagged at each threshold.
        area: Area under the curve.
        at_one_percent: Threshold at which at most 1 % of the other scans are flagged, and the share
            it detects.
    """

    thresholds: tuple[float, ...]
    detected: tuple[float, ...]
    false: tuple[float, ...]
    area: float
    at_one_percent: tuple[float, float]


class ScoreHistogram:
    """Histogram of the scores of harmful and of other scans; its size does not depend on the number
    of scans.

    Bins are uniform in the logarithm of the score, 100 per decade from 1e-9 to 1e6, so that
    thresholds are known to 2.4 %. A scan without a score (nothing measured) counts as flagged at
    every threshold.
    """

    EDGES: NDArray[np.float64] = np.logspace(-9.0, 6.0, 1501)

    def __init__(self) -> None:
        self._counts = np.zeros((2, len(self.EDGES) + 1), dtype=np.int64)

    def add(self, score: float | None, harmful: bool) -> None:
        """Count one scan; a larger score is worse.

        Args:
            score: the score; None where the scan has none.
            harmful: whether a harmful fault was injected.
        """
        place = (
            len(self.EDGES)
            if score is None or math.isnan(score)
            else int(np.searchsorted(self.EDGES, score, "right"))
        )
        self._counts[int(harmful), place] += 1

    @property
    def totals(self) -> tuple[int, int]:
        """Number of other and of harmful scans."""
        other, harmful = self._counts.sum(axis=1)
        return int(other), int(harmful)

    def roc(self) -> Roc | None:
        """The curve over the thresholds at which it changes; None without harmful or without
        other scans.
        """
        other, harmful = self.totals
        if not other or not harmful:
            return None
        above = np.cumsum(self._counts[:, ::-1], axis=1)[
            :, ::-1
        ]  # at or above the lower edge of each bin
        used = np.flatnonzero(self._counts.sum(axis=0)[1:]) + 1
        places = np.unique(np.concatenate([[1], used, np.minimum(used + 1, len(self.EDGES))]))[::-1]
        false, detected = above[0, places] / other, above[1, places] / harmful
        steps = np.concatenate([[0.0], false, [1.0]]), np.concatenate([[0.0], detected, [1.0]])
        area = math.fsum(np.diff(steps[0]) * 0.5 * (steps[1][1:] + steps[1][:-1]))
        thresholds = self.EDGES[places - 1]
        allowed = np.flatnonzero(false <= 0.01)
        best = int(allowed[-1]) if len(allowed) else 0
        at = (float(thresholds[best]), float(detected[best])) if len(allowed) else (math.inf, 0.0)
        return Roc(_floats(thresholds), _floats(detected), _floats(false), area, at)


def _floats(values: NDArray[np.float64]) -> tuple[float, ...]:
    return tuple(float(v) for v in values)


NO_HYPOTHESIS = "none"
_PLAIN_FIGURES = tuple(
    f.name for f in dataclasses.fields(Episode) if not f.name.startswith("peak_")
)
_PEAKS = ("flagged", "used", "after")
_ERROR_FIGURES = tuple(f.name for f in dataclasses.fields(Peak))
EPISODE_COLUMNS = (
    *_PLAIN_FIGURES,
    *(f"peak_{when}.{error}" for when in _PEAKS for error in _ERROR_FIGURES),
)
_TIME_FIGURES = ("delay_s", "delay_scans", "recover_s", "recover_scans")


@dataclass(frozen=True, slots=True)
class FaultKind:
    """All windows of one kind of fault in one combination.

    Attributes:
        harmful: Whether a label says that its scans must not be used.
        strengths: Strengths of the windows, each value once.
        lengths_s: Lengths of the windows, each value once [s].
        scans: Number of scans in the windows.
        flagged: Share of them with gamma 0; for "none" the false alarms.
        episodes: Number of windows.
        detected: Share of the windows with a flagged scan or, without any scan, a gap.
        delay_s: From the first scan of a window to the first flagged one, where there was one [s].
        delay_scans: The same in scans.
        recovery_s: From the first scan after a window to the first healthy one, where recovery was
            needed [s].
        recovery_scans: The same in scans.
        lost: Windows after which no scan was healthy.
        peak_flagged: Largest errors of the estimate over its scans with gamma 0; None without
            truth.
        peak_used: The same over its scans with gamma 1.
        peak_after: The same over the healthy scans after a window, up to the next one.
    """

    harmful: bool
    strengths: tuple[float, ...]
    lengths_s: tuple[float, ...]
    scans: int
    flagged: Rate | None
    episodes: int = 0
    detected: Rate | None = None
    delay_s: Typical | None = None
    delay_scans: Typical | None = None
    recovery_s: Typical | None = None
    recovery_scans: Typical | None = None
    lost: int = 0
    peak_flagged: Peak = field(default_factory=Peak)
    peak_used: Peak = field(default_factory=Peak)
    peak_after: Peak = field(default_factory=Peak)


def episode_lines(episodes: Iterable[Episode]) -> tuple[tuple[Any, ...], ...]:
    """One tuple of plain values per window, in the order of EPISODE_COLUMNS.

    Args:
        episodes: the windows of injected faults.
    """
    return tuple(tuple(_at(settings.dump(e), name) for name in EPISODE_COLUMNS) for e in episodes)


def _at(plain: Mapping[str, Any], name: str) -> Any:
    for key in name.split("."):
        plain = plain[key]
    return plain


class _Windows:
    """Sums over the windows of one kind, or over the scans outside every window."""

    def __init__(self) -> None:
        self.harmful = False
        self.strengths, self.lengths = set[float](), set[float]()
        self.scans = self.flagged = self.episodes = self.detected = self.lost = 0
        self.times: dict[str, list[float]] = {name: [] for name in _TIME_FIGURES}
        self.peaks: dict[str, float] = {}

    def add(self, window: Mapping[str, Any]) -> None:
        self.harmful |= window["harmful"]
        self.strengths |= {window["strength"]} - {None}
        self.lengths.add(round(window["end_s"] - window["start_s"], 6))
        self.scans += window["scans"]
        self.flagged += window["flagged"]
        self.episodes += 1
        self.detected += window["detected"]
        self.lost += window["lost"]
        for name, values in self.times.items():
            values += [] if window[name] is None else [window[name]]
        self.take_peaks(window)

    def take_peaks(self, found: Mapping[str, Any], prefix: str = "") -> None:
        for name in (f"peak_{when}.{error}" for when in _PEAKS for error in _ERROR_FIGURES):
            value = found.get(prefix + name)
            if value is not None:
                self.peaks[name] = max(value, self.peaks.get(name, value))

    def result(self) -> FaultKind:
        delay_s, delay_scans, recovery_s, recovery_scans = (
            typical(self.times[name]) for name in _TIME_FIGURES
        )
        flagged, used, after = (
            Peak(*(self.peaks.get(f"peak_{when}.{e}") for e in _ERROR_FIGURES)) for when in _PEAKS
        )
        return FaultKind(
            harmful=self.harmful,
            strengths=tuple(sorted(self.strengths)),
            lengths_s=tuple(sorted(self.lengths)),
            scans=self.scans,
            flagged=rate(self.flagged, self.scans),
            episodes=self.episodes,
            detected=rate(self.detected, self.episodes),
            delay_s=delay_s,
            delay_scans=delay_scans,
            recovery_s=recovery_s,
            recovery_scans=recovery_scans,
            lost=self.lost,
            peak_flagged=flagged,
            peak_used=used,
            peak_after=after,
        )


class FaultKinds:
    """Adds up the runs of one combination, in any order."""

    def __init__(self) -> None:
        self._kinds: dict[str, _Windows] = {}

    def add(self, episodes: Iterable[Sequence[Any]], metrics: Mapping[str, Any]) -> None:
        """Add one run.

        Args:
            episodes: Its windows, in the order of EPISODE_COLUMNS.
            metrics: Its metrics; where its log does not say what was injected, they are left out.
        """
        for line in episodes:
            window = dict(zip(EPISODE_COLUMNS, line, strict=True))
            self._kinds.setdefault(window["kind"], _Windows()).add(window)
        if metrics.get("faults.known"):
            none = self._kinds.setdefault(NO_HYPOTHESIS, _Windows())
            none.scans += metrics["faults.unlabelled"]
            none.flagged += metrics["faults.false_alarms"]
            none.take_peaks(metrics, "faults.")

    def result(self) -> dict[str, FaultKind]:
        """The kinds in alphabetical order."""
        return {kind: windows.result() for kind, windows in sorted(self._kinds.items())}
