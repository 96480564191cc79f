"""What many runs say: quantiles, success rates with their intervals, consistency, and the detector's curves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "Consistency",
    "Quantiles",
    "Rate",
    "Roc",
    "ScoreHistogram",
    "Typical",
    "consistency",
    "quantiles",
    "rate",
    "typical",
]

Z95 = 1.959963984540054  # two-sided 95 % point of the normal distribution


@dataclass(frozen=True, slots=True)
class Quantiles:
    """Of the runs that have the metric: 5 %, 50 % and 95 % points, and a 95 % interval of the median."""

    count: int
    q05: float
    median: float
    q95: float
    median_low: float
    median_high: float


def quantiles(values: Sequence[float]) -> Quantiles | None:
    """Quantiles by linear interpolation; the median's interval by order statistics (binomial, normal ranks).

    None where there is no value.
    """
    if not len(values):
        return None
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    n = len(ordered)
    reach = 0.5 * Z95 * math.sqrt(n)
    low, high = math.floor(0.5 * n - reach), math.ceil(0.5 * n + reach)
    q05, median, q95 = (float(np.quantile(ordered, q)) for q in (0.05, 0.5, 0.95))
    return Quantiles(n, q05, median, q95, float(ordered[max(low, 0)]), float(ordered[min(high, n - 1)]))


@dataclass(frozen=True, slots=True)
class Typical:
    """Of the windows that have the figure: how many, the median and the largest."""

    count: int
    median: float
    worst: float


def typical(values: Sequence[float]) -> Typical | None:
    """Median (the mean of the middle two of an even count) and worst. None where there is no value."""
    if not len(values):
        return None
    return Typical(len(values), float(np.median(values)), float(max(values)))


@dataclass(frozen=True, slots=True)
class Rate:
    """A share with its 95 % interval."""

    successes: int
    count: int
    share: float
    low: float
    high: float


def rate(successes: int, count: int) -> Rate | None:
    """Wilson's score interval: right for few runs and for shares of 0 and 1. None for no run."""
    if count == 0:
        return None
    share, z2 = successes / count, Z95 * Z95
    centre = (share + z2 / (2 * count)) / (1 + z2 / count)
    half = Z95 / (1 + z2 / count) * math.sqrt(share * (1 - share) / count + z2 / (4 * count * count))
    low = 0.0 if successes == 0 else max(0.0, centre - half)
    high = 1.0 if successes == count else min(1.0, centre + half)
    return Rate(successes, count, share, low, high)


@dataclass(frozen=True, slots=True)
class Consistency:
    """Mean normalised error squared per degree of freedom over independent runs, and the 95 % band of a right one."""

    count: int
    mean_per_dof: float
    low: float
    high: float
    median_per_dof: float


def consistency(nees: Sequence[float], dof: int) -> Consistency | None:
    """From one NEES a run. None without any."""
    if not len(nees):
        return None
    from scipy.stats import chi2

    n = len(nees)
    low, high = (float(chi2.ppf(share, dof * n)) / (dof * n) for share in (0.025, 0.975))
    return Consistency(n, math.fsum(nees) / (dof * n), low, high, float(np.median(nees)) / dof)


@dataclass(frozen=True, slots=True)
class Roc:
    """A curve of one score as the only test.

    Attributes:
        thresholds, detected, false: at each threshold, shares of the harmful and of the other scans flagged by it.
        area: under the curve.  at_one_percent: threshold and detected share where at most 1 % is falsely flagged.
    """

    thresholds: tuple[float, ...]
    detected: tuple[float, ...]
    false: tuple[float, ...]
    area: float
    at_one_percent: tuple[float, float]


class ScoreHistogram:
    """Scores of harmful and of other scans in fixed bins, so that any number of scans takes the same room.

    Bins are even in the logarithm of the score, 100 a decade from 1e-9 to 1e6: thresholds are known to 2.4 %. A scan
    without a score (nothing measured) counts as flagged at every threshold.
    """

    EDGES: NDArray[np.float64] = np.logspace(-9.0, 6.0, 1501)

    def __init__(self) -> None:
        self._counts = np.zeros((2, len(self.EDGES) + 1), dtype=np.int64)

    def add(self, score: float | None, harmful: bool) -> None:
        """One scan; a larger score is a worse one."""
        place = (
            len(self.EDGES) if score is None or math.isnan(score) else int(np.searchsorted(self.EDGES, score, "right"))
        )
        self._counts[int(harmful), place] += 1

    @property
    def totals(self) -> tuple[int, int]:
        """Other scans, harmful scans."""
        other, harmful = self._counts.sum(axis=1)
        return int(other), int(harmful)

    def roc(self) -> Roc | None:
        """The curve over thresholds at which something changes, lenient to strict. None where one kind is missing."""
        other, harmful = self.totals
        if not other or not harmful:
            return None
        above = np.cumsum(self._counts[:, ::-1], axis=1)[:, ::-1]  # at or above the lower edge of each bin
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
