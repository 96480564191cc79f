"""The summary of a campaign: one entry per combination, the fault tests over all scans, and
the worst runs.
"""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from avsreplay import settings
from avsreplay.records import STATES
from avsreplay.sweep import statistics
from avsreplay.sweep.campaign import SCAN_COLUMNS, RunResult, SuccessCriterion
from avsreplay.sweep.expansion import Expansion, Point

CAMPAIGN_METRICS = {
    "pose_healthy.position_m.rmse": "position error, healthy scans [m]",
    "pose_healthy.rotation_deg.rmse": "rotation error, healthy scans [deg]",
    "worst_coast.pos_err_m": "position error, worst coasting [m]",
    "worst_coast.rot_err_deg": "rotation error, worst coasting [deg]",
    "convergence.t1_s": "t_1 [s]",
    "capture.last_s": "planned capture [s]",
    "faults.false_alarms": "false alarms",
}
CRITERIA = (
    SuccessCriterion("converged", "convergence.t1_s"),
    SuccessCriterion("capture planned", "capture.last_s"),
    SuccessCriterion("no fault missed", "faults.missed", max=0),
    SuccessCriterion("no false alarm", "faults.false_alarms", max=0),
)
SCORE_COLUMNS = {
    "rms_m": "rms_m",
    "alpha_m": "alpha_m",
    "outlier_ratio": "inlier_ratio",
    "nis": "nis",
}  # score: its column
FLIGHT_ENDS = ("captured", "outside", "aborted", "touched")
LISTED_RUNS = 5  # number of runs that are listed
_WORST_RUN_METRICS = {
    "pose_healthy.position_m.max": "healthy scan",
    "worst_coast.pos_err_m": "coasting",
}
_BAD = ("crashed", "failed", "lossy")  # worst status first


@dataclass(frozen=True, slots=True)
class Cell:
    """One combination.

    Attributes:
        values: What was set, by key.
        runs: Number of finished runs.
        status: Number of runs by status.
        metrics: Quantiles of CAMPAIGN_METRICS.
        rates: Share of the finished runs that meet each criterion, and of all their whole flights
            that end in each way.
        nees: NEES at the last scan of each run.
        kinds: Fault detection by kind of fault; "none" for the scans outside every window.
    """

    values: Mapping[str, Any]
    runs: int
    status: Mapping[str, int]
    metrics: Mapping[str, statistics.Quantiles | None]
    rates: Mapping[str, statistics.Rate | None]
    nees: statistics.RunConsistency | None
    kinds: Mapping[str, statistics.FaultKind] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Detector:
    """Fault detection over all scans of all runs.

    Attributes:
        harmful: Number of harmful scans.
        other: Number of other scans.
        detected: Share of the harmful scans that were flagged.
        false: Share of the other scans that were flagged.
        curves: ROC curve of each score alone.
    """

    harmful: int
    other: int
    detected: statistics.Rate | None
    false: statistics.Rate | None
    curves: Mapping[str, statistics.Roc | None]


@dataclass(frozen=True, slots=True)
class WorstRun:
    """A run to look at: its id, combination, repeat, seed, status, and the reason why it is
    listed.
    """

    id: str
    cell: int
    repeat: int
    seed: int | None
    status: str
    reason: str


@dataclass(frozen=True, slots=True)
class SweepSummary:
    """A campaign: planned and finished runs, number of runs by status, combinations, fault
    tests, worst runs.
    """

    name: str
    planned: int
    done: int
    status: Mapping[str, int]
    cells: tuple[Cell, ...]
    detector: Detector | None
    worst: tuple[WorstRun, ...] = ()

    def document(self) -> dict[str, Any]:
        """Plain values for JSON; a number that is not finite is null."""
        plain: dict[str, Any] = without_infinities(settings.dump(self))
        return plain


class CampaignFold:
    """Adds up the runs of a campaign one by one; it keeps a few numbers per run."""

    def __init__(self, plan: Expansion) -> None:
        self._plan = plan
        self._criteria = (*CRITERIA, *plan.loaded.campaign.success)
        self._cells = [_CellFold() for _ in plan.cells]
        self._worst: list[tuple[tuple[float, ...], WorstRun]] = []

    def add(self, point: Point, result: RunResult) -> None:
        """Add one finished run.

        Args:
            point: the combination of the run.
            result: its result.
        """
        self._cells[point.cell].add(result, self._criteria)
        badness, reason = _badness(result)
        run = WorstRun(result.id, point.cell, point.repeat, point.seed, result.status, reason)
        if reason:
            heapq.heappush(self._worst, ((*badness, -point.index), run))
            if len(self._worst) > LISTED_RUNS:
                heapq.heappop(self._worst)

    def result(self, detector: Detector | None) -> SweepSummary:
        """The summary of the runs added.

        Args:
            detector: the curves of the detector; None where no scans are kept.
        """
        status = sum((cell.status for cell in self._cells), Counter[str]())
        return SweepSummary(
            name=self._plan.loaded.campaign.name,
            planned=len(self._plan),
            done=status.total(),
            status=dict(sorted(status.items())),
            cells=tuple(
                c.result(v, self._criteria)
                for c, v in zip(self._cells, self._plan.cells, strict=True)
            ),
            detector=detector,
            worst=tuple(
                run for _, run in sorted(self._worst, reverse=True, key=lambda entry: entry[0])
            ),
        )


class _CellFold:
    def __init__(self) -> None:
        self.status: Counter[str] = Counter()
        self._numbers: dict[str, list[float]] = {
            name: [] for name in (*CAMPAIGN_METRICS, "end.nees")
        }
        self._met: Counter[str] = Counter()
        self._kinds = statistics.FaultKinds()
        self._flights: Counter[str] = Counter()

    def add(self, result: RunResult, criteria: Sequence[SuccessCriterion]) -> None:
        self.status[result.status] += 1
        metrics = result.metrics or {}
        for name, values in self._numbers.items():
            value = metrics.get(name)
            values += [float(value)] if value is not None and math.isfinite(value) else []
        self._met.update(c.name for c in criteria if _meets(c, metrics))
        self._kinds.add(result.episodes, metrics)
        self._flights.update(
            {name: metrics.get(f"flights.{name}") or 0 for name in ("count", *FLIGHT_ENDS)}
        )

    def result(self, values: Mapping[str, Any], criteria: Sequence[SuccessCriterion]) -> Cell:
        runs, count = self.status.total(), self._flights["count"]
        rates = {c.name: statistics.rate(self._met[c.name], runs) for c in criteria}
        flown = {
            f"flights {name}": statistics.rate(self._flights[name], count) for name in FLIGHT_ENDS
        }
        return Cell(
            values=values,
            runs=runs,
            status=dict(sorted(self.status.items())),
            metrics={name: statistics.quantiles(self._numbers[name]) for name in CAMPAIGN_METRICS},
            rates=rates | (flown if count else {}),
            nees=statistics.consistency(self._numbers["end.nees"], STATES),
            kinds=self._kinds.result(),
        )


def _meets(criterion: SuccessCriterion, metrics: Mapping[str, Any]) -> bool:
    value = metrics.get(criterion.metric)
    return isinstance(value, (int, float)) and criterion.min <= value <= criterion.max


def _badness(result: RunResult) -> tuple[tuple[float, float], str]:
    """Sort key, larger for a worse run, and the reason in words."""
    metrics = result.metrics or {}
    known = [
        (metrics[name], what)
        for name, what in _WORST_RUN_METRICS.items()
        if metrics.get(name) is not None
    ]
    error, what = max(known, default=(0.0, ""))
    rank = len(_BAD) - _BAD.index(result.status) if result.status in _BAD else 0
    reason = result.error or (f"position error {error:.4g} m ({what})" if what else "")
    return (float(rank), error), reason


class DetectorFold:
    """Adds up the scans of all runs, in any order."""

    PLACE: ClassVar[dict[str, int]] = {name: place for place, name in enumerate(SCAN_COLUMNS)}

    def __init__(self) -> None:
        self._curves = {name: statistics.ScoreHistogram() for name in SCORE_COLUMNS}
        self._flagged: Counter[tuple[bool, bool]] = Counter()

    def add(self, scans: Iterable[Sequence[Any]]) -> None:
        """Add the scans of one run, in the order of SCAN_COLUMNS."""
        for line in scans:
            harmful, flagged = bool(line[self.PLACE["harmful"]]), line[self.PLACE["gamma"]] == 0
            self._flagged[harmful, flagged] += 1
            for name, column in SCORE_COLUMNS.items():
                self._curves[name].add(_score(name, line[self.PLACE[column]]), harmful)

    def result(self) -> Detector:
        """Fault detection over the scans added."""
        counts = {
            kind: self._flagged[kind, True] + self._flagged[kind, False] for kind in (True, False)
        }
        return Detector(
            harmful=counts[True],
            other=counts[False],
            detected=statistics.rate(self._flagged[True, True], counts[True]),
            false=statistics.rate(self._flagged[False, True], counts[False]),
            curves={name: histogram.roc() for name, histogram in self._curves.items()},
        )


def _score(name: str, value: float | None) -> float | None:
    """The score of a test, larger for a worse scan: the share of inliers is replaced by that
    of outliers.
    """
    return 1.0 - value if value is not None and name == "outlier_ratio" else value


def without_infinities(value: Any) -> Any:
    """Return a JSON value with null in place of every number that is not finite.

    Args:
        value: a number, a text, None, or lists and tables of these.
    """
    if isinstance(value, dict):
        return {k: without_infinities(v) for k, v in value.items()}
    if isinstance(value, list):
        return [without_infinities(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
