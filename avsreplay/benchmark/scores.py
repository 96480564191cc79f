"""The scores of an entry over many runs, each with its 95 % interval, and the differences of two.

Shares of runs have Wilson's interval, means that of a bootstrap with a fixed seed, medians that of
the order statistics. The scans of one run are not independent; intervals are therefore over runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from avsreplay.errors import value_class
from avsreplay.report.intervals import interval_of_mean
from avsreplay.sweep.statistics import quantiles, rate

ALL = "all"
Metrics = Mapping[str, Any]
"""What one run gave, by name (see ``work``)."""


@value_class(eq=True)
class Estimate:
    """A score.

    Attributes:
        value: the score.
        low, high: its 95 % interval; None with too few runs.
        count: number of runs.
        total: what was counted over all runs, for scores that count; otherwise None.
    """

    value: float
    low: float | None
    high: float | None
    count: int
    total: int | None = None


@value_class(eq=True)
class Measure:
    """A column of the table.

    Attributes:
        key: its name in the results.
        head: heading.
        doc: meaning.
        better: 1 where a larger value is better, -1 where a smaller one is, 0 where neither.
        of: value of one run, None where it has none.
        pool: how values of runs become a score.
        digits: format of a value.
    """

    key: str
    head: str
    doc: str
    better: int
    of: Callable[[Metrics], float | None]
    pool: Callable[[Sequence[float]], Estimate]
    digits: str = ".2f"

    def score(self, runs: Sequence[Metrics]) -> Estimate | None:
        """Return the score over some runs; None where no run has a value.

        Args:
            runs: what each of them gave.
        """
        values = [v for v in map(self.of, runs) if v is not None]
        return self.pool(values) if values else None


def _plain(name: str) -> Callable[[Metrics], float | None]:
    def get(run: Metrics) -> float | None:
        value = run.get(name)
        return None if value is None else float(value)

    return get


def _share(part: str, whole: str) -> Callable[[Metrics], float | None]:
    def get(run: Metrics) -> float | None:
        return run[part] / run[whole] if run.get(whole) else None

    return get


def _any(values: Sequence[float]) -> Estimate:
    """The share of runs with a value above 0, and the sum."""
    found = rate(sum(v > 0 for v in values), len(values))
    assert found is not None
    return Estimate(found.share, found.low, found.high, found.count, round(math.fsum(values)))


def _mean(values: Sequence[float]) -> Estimate:
    mean = math.fsum(values) / len(values)
    if len(set(values)) < 2:  # of equal values the bootstrap would say that there is no doubt
        return Estimate(mean, None, None, len(values))
    low, high = interval_of_mean(np.asarray(values, dtype=np.float64))
    return Estimate(mean, low, high, len(values))


def _median(values: Sequence[float]) -> Estimate:
    found = quantiles(values)
    assert found is not None
    return Estimate(found.median, found.median_low, found.median_high, found.count)


def _failed(run: Metrics) -> float:
    return float(run.get("status", "ok") != "ok")


MEASURES = (
    Measure(
        *("wrong", "runs with a\nwrong pose", "used poses beyond 2 deg or 2 % of the extent", -1),
        _plain("wrong"),
        _any,
    ),
    Measure(
        *("wrong_claims", "runs with a\nwrong claim", "converged, beyond the tolerance", -1),
        _plain("wrong_claims"),
        _any,
    ),
    Measure("captured", "captured", "in fact, within the log", 1, _plain("captured"), _any),
    Measure("brier", "Brier", "of the predicted probability", -1, _plain("brier"), _mean, ".3f"),
    Measure("nees", "NEES/6", "of the pose, median", 0, _plain("nees"), _median),
    Measure(
        *("position_permille", "position\n[1e-3 extent]", "rms, second half", -1),
        _plain("position_permille"),
        _median,
        ".3g",
    ),
    Measure(
        *("attitude_deg", "attitude\n[deg]", "rms, second half", -1),
        _plain("attitude_deg"),
        _median,
        ".3g",
    ),
    Measure(*("used", "usable\nscans used", "share", 1), _share("used_usable", "usable"), _mean),
    Measure("named", "events\nnamed", "share", 1, _share("named", "events"), _mean),
    Measure("invented", "runs with an\ninvented event", "share", -1, _plain("invented"), _any),
    Measure("failed", "failed", "runs that ended with an error", -1, _failed, _any),
)


def scores(runs: Sequence[Metrics]) -> dict[str, Estimate]:
    """Return every score over some runs, by key.

    Args:
        runs: what each of them gave.
    """
    found = {measure.key: measure.score(runs) for measure in MEASURES}
    return {key: value for key, value in found.items() if value is not None}


@value_class(eq=True)
class Difference:
    """A measure of two results over the runs that both have.

    Attributes:
        entry: the row, or both where they differ.
        measure: the measure.
        base, other: means over these runs.
        low, high: 95 % interval of the difference of the means; None with a single run.
        word: "better", "worse" or "same".
    """

    entry: str
    measure: Measure
    base: float
    other: float
    low: float | None
    high: float | None
    word: str

    @property
    def record(self) -> dict[str, Any]:
        """The difference as plain data."""
        names = ("entry", "base", "other", "low", "high", "word")
        return {"measure": self.measure.key} | {name: getattr(self, name) for name in names}


def difference(
    entry: str, measure: Measure, base: Sequence[Metrics], other: Sequence[Metrics]
) -> Difference | None:
    """Return how a measure differs; None where no pair of runs has it.

    Args:
        entry: the row.
        measure: the measure.
        base: runs of the baseline.
        other: the same runs of the other result.
    """
    pairs = [(measure.of(a), measure.of(b)) for a, b in zip(base, other, strict=True)]
    both = [(a, b) for a, b in pairs if a is not None and b is not None]
    if not both:
        return None
    steps = np.array([b - a for a, b in both])
    means = [math.fsum(side) / len(both) for side in zip(*both, strict=True)]
    low, high = interval_of_mean(steps) if len(both) > 1 else (None, None)
    word = "same" if not steps.any() else "no evidence"
    if low is not None and high is not None and measure.better and (low > 0.0 or high < 0.0):
        word = "better" if (low > 0.0) == (measure.better > 0) else "worse"
    return Difference(entry, measure, means[0], means[1], low, high, word)
