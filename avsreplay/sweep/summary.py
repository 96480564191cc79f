"""A campaign in a few tables: a line a combination, and the detector's curves over all scans."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from avsreplay import settings
from avsreplay.sweep.campaign import Criterion
from avsreplay.sweep.kinds import KindOfFault, kinds_of_fault
from avsreplay.sweep.plan import Plan, Point
from avsreplay.sweep.statistics import (
    Consistency,
    Quantiles,
    Rate,
    Roc,
    ScoreHistogram,
    consistency,
    quantiles,
    rate,
)
from avsreplay.sweep.worker import SCAN_COLUMNS, Outcome

__all__ = ["HEADLINES", "Cell", "Detector", "SweepSummary", "summarise"]

HEADLINES = {
    "pose_healthy.position_m.rmse": "position error, healthy scans [m]",
    "pose_healthy.rotation_deg.rmse": "rotation error, healthy scans [deg]",
    "worst_coast.pos_err_m": "position error, worst coasting [m]",
    "worst_coast.rot_err_deg": "rotation error, worst coasting [deg]",
    "convergence.t1_s": "t_1 [s]",
    "capture.last_s": "planned capture [s]",
    "faults.false_alarms": "false alarms",
}
CRITERIA = (
    Criterion("converged", "convergence.t1_s"),
    Criterion("capture planned", "capture.last_s"),
    Criterion("no fault missed", "faults.missed", max=0),
    Criterion("no false alarm", "faults.false_alarms", max=0),
)
SCORES = {"rms_m": "rms_m", "alpha_m": "alpha_m", "outlier_ratio": "inlier_ratio", "nis": "nis"}  # score: its column
STATES = 20


@dataclass(frozen=True, slots=True)
class Cell:
    """One combination.

    Attributes:
        values: what was set.  runs: done.  status: how many ended how.  metrics: HEADLINES' quantiles.
        rates: of the runs done, by criterion.  nees: at the last scan of each run.
        kinds: the fault rule by kind of fault, "none" for the scans outside every window.
    """

    values: Mapping[str, Any]
    runs: int
    status: Mapping[str, int]
    metrics: Mapping[str, Quantiles | None]
    rates: Mapping[str, Rate | None]
    nees: Consistency | None
    kinds: Mapping[str, KindOfFault] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Detector:
    """The fault rule over all scans of all runs.

    Attributes:
        harmful, other: scans.  detected, false: shares flagged by the rule in force.  curves: each score by itself.
    """

    harmful: int
    other: int
    detected: Rate | None
    false: Rate | None
    curves: Mapping[str, Roc | None]


@dataclass(frozen=True, slots=True)
class SweepSummary:
    """The whole campaign: planned and done runs, how they ended, a Cell each combination, the detector."""

    name: str
    planned: int
    done: int
    status: Mapping[str, int]
    cells: tuple[Cell, ...]
    detector: Detector | None

    def document(self) -> dict[str, Any]:
        """Plain values for JSON; what is not finite is null."""
        plain: dict[str, Any] = _finite(settings.dump(self))
        return plain


def summarise(plan: Plan, done: Sequence[tuple[Point, Outcome]], outcomes: Iterable[Outcome]) -> SweepSummary:
    """Sum up what is ``done``; ``outcomes`` (any order) bring the scans."""
    campaign = plan.loaded.campaign
    criteria = (*CRITERIA, *campaign.success)
    by_cell: dict[int, list[Outcome]] = {k: [] for k in range(len(plan.cells))}
    for point, outcome in done:
        by_cell[point.cell].append(outcome)
    used = {outcome.id for _, outcome in done}
    return SweepSummary(
        name=campaign.name,
        planned=len(plan),
        done=len(done),
        status=_status([outcome for _, outcome in done]),
        cells=tuple(_cell(plan.cells[k], found, criteria) for k, found in by_cell.items()),
        detector=_detector(o for o in outcomes if o.id in used) if campaign.scans else None,
    )


def _cell(values: Mapping[str, Any], found: Sequence[Outcome], criteria: Sequence[Criterion]) -> Cell:
    return Cell(
        values=values,
        runs=len(found),
        status=_status(found),
        metrics={name: quantiles(_numbers(found, name)) for name in HEADLINES},
        rates={c.name: rate(sum(_meets(c, o) for o in found), len(found)) for c in criteria},
        nees=consistency(_numbers(found, "end.nees"), STATES),
        kinds=kinds_of_fault((line for o in found for line in o.episodes), [o.metrics for o in found if o.metrics]),
    )


def _status(found: Sequence[Outcome]) -> dict[str, int]:
    return dict(sorted(Counter(outcome.status for outcome in found).items()))


def _numbers(found: Sequence[Outcome], name: str) -> list[float]:
    values = ((outcome.metrics or {}).get(name) for outcome in found)
    return [float(v) for v in values if v is not None and math.isfinite(v)]


def _meets(criterion: Criterion, outcome: Outcome) -> bool:
    value = (outcome.metrics or {}).get(criterion.metric)
    return isinstance(value, (int, float)) and criterion.min <= value <= criterion.max


class _DetectorFold:
    """Counts over scans, in any order."""

    PLACE: ClassVar[dict[str, int]] = {name: place for place, name in enumerate(SCAN_COLUMNS)}

    def __init__(self) -> None:
        self._curves = {name: ScoreHistogram() for name in SCORES}
        self._flagged: Counter[tuple[bool, bool]] = Counter()

    def add(self, line: Sequence[Any]) -> None:
        harmful, flagged = bool(line[self.PLACE["harmful"]]), line[self.PLACE["gamma"]] == 0
        self._flagged[harmful, flagged] += 1
        for name, column in SCORES.items():
            self._curves[name].add(_score(name, line[self.PLACE[column]]), harmful)

    def result(self) -> Detector:
        counts = {kind: self._flagged[kind, True] + self._flagged[kind, False] for kind in (True, False)}
        return Detector(
            harmful=counts[True],
            other=counts[False],
            detected=rate(self._flagged[True, True], counts[True]),
            false=rate(self._flagged[False, True], counts[False]),
            curves={name: histogram.roc() for name, histogram in self._curves.items()},
        )


def _detector(outcomes: Iterable[Outcome]) -> Detector:
    """The fault rule over all scans; a run that stands twice in the plan counts once."""
    fold = _DetectorFold()
    for outcome in outcomes:
        for line in outcome.scans:
            fold.add(line)
    return fold.result()


def _score(name: str, value: float | None) -> float | None:
    """Larger is worse: the share of inliers counts by what it lacks to 1."""
    return 1.0 - value if value is not None and name == "outlier_ratio" else value


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
