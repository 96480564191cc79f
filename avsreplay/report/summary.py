"""The summary of a run: one fold over its rows.

Terms: a scan is *healthy* where gamma is 1 and *coasting* where it is 0. Errors are against the log's truth. Sums are
correctly rounded, so the summary does not depend on their order. The speed in scans per second is not part of it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from avsreplay.records import BLOCKS, Label, State
from avsreplay.report.episodes import Coast, FaultAccount, Mark, account, coasts, gaps
from avsreplay.report.summary_parts import (
    Capture,
    CaptureFold,
    Drifting,
    Parameter,
    Statistics,
    VelocityChange,
    median,
    parameters,
    with_manoeuvre,
)
from avsreplay.rows import Row

NIS_BAND = (1.2373, 14.4494)  # 2.5 % and 97.5 % points of chi-square with 6 degrees of freedom
NIS_LIMIT = 27.8563  # 99.99 % point of chi-square with 6 degrees of freedom, above which a pose gets a smaller weight
BLOCK_BANDS = {2: (0.05064, 7.3778), 3: (0.2158, 9.3484)}  # the same with 2 and 3
NEES_BAND = (9.5908, 34.1696)  # the same with 20


@dataclass(frozen=True, slots=True)
class Errors:
    """Position [m] and rotation [deg] errors over the same scans; None without truth."""

    position_m: Statistics | None
    rotation_deg: Statistics | None


@dataclass(frozen=True, slots=True)
class Share:
    """A chi-square statistic: its median and the share of scans inside the two-sided 95 % band."""

    count: int
    median: float
    inside: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class ObservabilitySummary:
    """The Gramian at the last scan, and the time of the first scan at which its rank was 20 (None: never)."""

    log10_cond: float | None
    log10_cond_scaled: float | None
    rank: int | None
    full_rank_s: float | None


@dataclass(frozen=True, slots=True)
class ConvergenceSummary:
    """t_1: time of the first scan whose estimate the planner may use; whether it holds at the end; times withdrawn."""

    t1_s: float | None
    at_end: bool
    withdrawn: int


@dataclass(frozen=True, slots=True)
class Summary:
    """The results of a run as a whole.

    Attributes:
        pose_all, pose_healthy, pose_coasting: errors of the estimate.
        registration_healthy, registration_flagged: errors of the measured poses.
        reasons: why scans were flagged.  status: scans by the status of their registration.
        counts: losses and clock problems.  acceleration: of the target, in words.  Both are given by the caller.
        manoeuvres: number of those of the target.  velocity_changes: each of them.
        violations: consistency checks that the estimate failed.
        drift: a constant torque or force on the target, None where none was found.
        weighed_down: healthy poses with a Cauchy weight below 1.  reinitialised: reinitialisations of the estimate.
        coasts: intervals of prediction without measurement.  interval_s: median between scans.
        gaps: intervals between scans longer than 1.5 times the median.
    """

    scans: int
    duration_s: float
    interval_s: float | None
    healthy: int
    coasting: int
    gaps: int
    status: Mapping[str, int]
    reasons: Mapping[str, int]
    pose_all: Errors
    pose_healthy: Errors
    pose_coasting: Errors
    registration_healthy: Errors
    registration_flagged: Errors
    fit_error_m: Statistics | None
    iterations: Statistics | None
    faults: FaultAccount
    coasts: tuple[Coast, ...]
    parameters: tuple[Parameter, ...]
    sigma_hits: int | None
    r_floors: int | None
    weighed_down: int
    reinitialised: int | None
    manoeuvres: int | None
    velocity_changes: tuple[VelocityChange, ...]
    drift: Drifting | None
    violations: int | None
    nis: Share | None
    nees: Share | None
    nees_blocks: Mapping[str, Share]
    reference: str | None
    observability: ObservabilitySummary
    convergence: ConvergenceSummary
    capture: Capture
    counts: Mapping[str, int] = field(default_factory=dict)
    acceleration: str | None = None

    @classmethod
    def fold(
        cls,
        rows: Iterable[Row],
        *,
        labels: Sequence[Label] | None = None,
        truth: State | None = None,
        counts: Mapping[str, int] | None = None,
    ) -> Summary:
        """Summarise rows in their order; the arguments are those of SummaryFold."""
        fold = SummaryFold(labels=labels, truth=truth, counts=counts)
        for row in rows:
            fold.add(row)
        return fold.result()

    @property
    def longest_coast(self) -> Coast | None:
        """The longest interval without a measurement (the first of equals)."""
        return max(self.coasts, key=lambda c: c.duration_s, default=None)


class SummaryFold:
    """Takes rows one by one and keeps a few numbers of each.

    Args:
        labels: injected faults; None where the log does not state them.
        truth: the true state, with the principal axes in the order of the estimate's.
        counts: losses and clock problems by name.
    """

    def __init__(
        self,
        *,
        labels: Sequence[Label] | None = None,
        truth: State | None = None,
        counts: Mapping[str, int] | None = None,
    ) -> None:
        self._labels, self._truth, self._counts = labels, truth, dict(counts or {})
        self._marks: list[Mark] = []
        self._values: dict[str, list[float]] = {}
        self._status: Counter[str] = Counter()
        self._reasons: Counter[str] = Counter()
        self._last: Row | None = None
        self._reference: str | None = None
        self._full_rank_s: float | None = None
        self._t1_s: float | None = None
        self._withdrawn = self._weighed_down = 0
        self._changes: tuple[VelocityChange, ...] = ()
        self._capture = CaptureFold()

    def anew(self, rows: Iterable[Row]) -> SummaryFold:
        """A fold with the same labels and truth over other rows."""
        fold = SummaryFold(labels=self._labels, truth=self._truth, counts=self._counts)
        for row in rows:
            fold.add(row)
        return fold

    def add(self, row: Row) -> None:
        """Take the next row."""
        self._marks.append(Mark(row.t_ns, row.gamma, row.fault, row.pos_err_m, row.rot_err_deg))
        self._status[row.status] += 1
        if row.gamma == 0:
            self._reasons[row.reason] += 1
        elif row.cauchy_weight is not None and row.cauchy_weight < 1.0:
            self._weighed_down += 1
        self._add_errors(row)
        self._add_milestones(row)
        self._last = row

    def _add_errors(self, row: Row) -> None:
        state = "healthy" if row.gamma == 1 else "coasting"
        for name in ("pos_err_m", "rot_err_deg", "reg_pos_err_m", "reg_rot_err_deg", "nis", "rms_m", "iterations"):
            self._keep(f"{name}/{state}", getattr(row, name))
        self._keep("nees", row.nees)
        for name, block in BLOCKS.items():
            value = getattr(row, f"nees_{name}")
            self._keep(f"nees_{name}", None if value is None else value / (block.stop - block.start))
        self._reference = row.reference or self._reference

    def _keep(self, name: str, value: float | None) -> None:
        if value is not None and math.isfinite(value):
            self._values.setdefault(name, []).append(float(value))

    def _add_milestones(self, row: Row) -> None:
        if self._full_rank_s is None and row.ogm_rank == 20:
            self._full_rank_s = row.t_s
        if self._t1_s is None and row.converged:
            self._t1_s = row.t_s
        if self._last is not None and self._last.converged and not row.converged:
            self._withdrawn += 1
        self._changes = with_manoeuvre(self._changes, row)
        self._capture.add(row)

    def result(self, truth: State | None = None) -> Summary:
        """The summary of all rows so far; ``truth`` in place of the one given at the start."""
        stamps = [m.t_ns for m in self._marks]
        steps = [b - a for a, b in pairwise(stamps) if b > a]
        last = self._last
        healthy = sum(m.gamma == 1 for m in self._marks)
        return Summary(
            scans=len(stamps),
            duration_s=(max(stamps) - min(stamps)) * 1e-9 if stamps else 0.0,
            interval_s=median(steps) * 1e-9 if steps else None,
            healthy=healthy,
            coasting=len(stamps) - healthy,
            gaps=len(gaps(stamps)),
            status=dict(sorted(self._status.items())),
            reasons=dict(sorted(self._reasons.items())),
            pose_all=self._errors("", "healthy", "coasting"),
            pose_healthy=self._errors("", "healthy"),
            pose_coasting=self._errors("", "coasting"),
            registration_healthy=self._errors("reg_", "healthy"),
            registration_flagged=self._errors("reg_", "coasting"),
            fit_error_m=Statistics.of(self._values.get("rms_m/healthy", [])),
            iterations=Statistics.of(self._values.get("iterations/healthy", [])),
            faults=account(self._marks, self._labels),
            coasts=tuple(coasts(self._marks)),
            parameters=parameters(last, truth or self._truth) if last else (),
            sigma_hits=last.sigma_hits if last else None,
            r_floors=last.r_floors if last else None,
            weighed_down=self._weighed_down,
            reinitialised=last.reinitialised if last else None,
            manoeuvres=last.manoeuvres if last else None,
            velocity_changes=self._changes,
            drift=Drifting.of(last) if last else None,
            violations=last.violations if last else None,
            nis=_share(self._values.get("nis/healthy", []), NIS_BAND),
            nees=_share(self._values.get("nees", []), NEES_BAND),
            nees_blocks=self._blocks(),
            reference=self._reference,
            observability=self._observability(),
            convergence=ConvergenceSummary(self._t1_s, bool(last and last.converged), self._withdrawn),
            capture=self._capture.result(),
            counts=self._counts,
        )

    def _blocks(self) -> dict[str, Share]:
        """NEES of each block of the state and its band, per degree of freedom."""
        out: dict[str, Share] = {}
        for name, block in BLOCKS.items():
            size = block.stop - block.start
            low, high = (bound / size for bound in BLOCK_BANDS[size])
            share = _share(self._values.get(f"nees_{name}", []), (low, high))
            if share is not None:
                out[name] = share
        return out

    def _errors(self, prefix: str, *states: str) -> Errors:
        position, rotation = (
            [v for state in states for v in self._values.get(f"{prefix}{name}/{state}", [])]
            for name in ("pos_err_m", "rot_err_deg")
        )
        return Errors(Statistics.of(position), Statistics.of(rotation))

    def _observability(self) -> ObservabilitySummary:
        row = self._last
        if row is None:
            return ObservabilitySummary(None, None, None, None)
        return ObservabilitySummary(row.ogm_log10_cond, row.ogm_log10_cond_scaled, row.ogm_rank, self._full_rank_s)


def _share(values: Sequence[float], band: tuple[float, float]) -> Share | None:
    if not values:
        return None
    inside = sum(band[0] <= v <= band[1] for v in values) / len(values)
    return Share(len(values), median(values), inside, *band)
