"""The summary of a run, computed in one pass over its rows.

A scan is *healthy* where gamma is 1 and *coasting* where it is 0. Errors are relative to the truth
of the log. Sums are correctly rounded, so that the summary does not depend on their order. The
speed in scans per second is not part of it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import field
from itertools import compress, pairwise
from operator import not_

import numpy as np
from numpy.typing import NDArray

from avsreplay.assessment import Assessment
from avsreplay.errors import value_class
from avsreplay.geometry import Array
from avsreplay.records import BLOCKS, STATES, UNLIKELY, Label, State
from avsreplay.report.episodes import Coast, FaultAccount, Mark, account, coasts, gaps
from avsreplay.report.parameters import Parameter, parameters
from avsreplay.report.summary_parts import (
    Capture,
    Drifting,
    Statistics,
    VelocityChange,
    median,
)
from avsreplay.rows import Row
from avsreplay.tables import Columns

NIS_BAND = (1.2373, 14.4494)  # 2.5 % and 97.5 % points of chi-square with 6 degrees of freedom
# 99.99 % point of chi-square with 6 degrees of freedom, above which a pose gets a smaller weight
NIS_LIMIT = UNLIKELY[6]
BLOCK_BANDS = {
    2: (0.05064, 7.3778),
    3: (0.2158, 9.3484),
}  # the same points with 2 and 3 degrees of freedom
NEES_BAND = (9.5908, 34.1696)  # the same points with 20 degrees of freedom
_ADAPTING_SCANS = 30  # used scans to which the noise is adapted (default of estimator.window)
_LEAST_SCANS_AFTER = 20  # used scans after them of whose innovations shares are stated
_BY_STATE = (
    "pos_err_m",
    "rot_err_deg",
    "reg_pos_err_m",
    "reg_rot_err_deg",
    "nis",
    "rms_m",
    "iterations",
)
_OF_ALL = ("nees", *(f"nees_{name}" for name in BLOCKS))


@value_class(eq=True)
class Errors:
    """Position [m] and rotation [deg] errors over the same scans; None without truth."""

    position_m: Statistics | None
    rotation_deg: Statistics | None


@value_class(eq=True)
class Share:
    """A chi-square statistic: its median and the shares of scans inside and above the
    two-sided 95 % band.
    """

    count: int
    median: float
    inside: float
    above: float
    low: float
    high: float


@value_class(eq=True)
class ObservabilitySummary:
    """The Gramian at the last scan, and the time of the first scan at which its rank was 20, None
    if that did not happen.
    """

    log10_cond: float | None
    log10_cond_scaled: float | None
    rank: int | None
    full_rank_s: float | None


@value_class(eq=True)
class ConvergenceSummary:
    """When the estimate converged: the time of the first scan whose estimate the planner may use
    (t_1), whether this holds at the end, and how often it was withdrawn.
    """

    t1_s: float | None
    at_end: bool
    withdrawn: int


@value_class(eq=True)
class Summary:
    """The results of a run as a whole.

    Attributes:
        pose_all, pose_healthy, pose_coasting: errors of the estimate.
        registration_healthy, registration_flagged: errors of the measured poses.
        reasons: why scans were flagged.
        status: scans by the status of their registration.
        counts: losses and clock problems.
        acceleration: of the target, in words.  Both are given by the caller.
        manoeuvres: number of those of the target.
        velocity_changes: each of them.
        violations: consistency checks that the estimate failed.
        drift: a constant torque or force on the target, None where none was found.
        weighed_down: healthy poses with a Cauchy weight below 1.
        reinitialised: reinitialisations of the estimate.
        coasts: intervals of prediction without measurement.
        assessment: of the capture, which is not computed from the rows; None where there is none.
        interval_s: median between scans.
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
    assessment: Assessment | None = None

    @classmethod
    def fold(
        cls,
        rows: Sequence[Row],
        *,
        labels: Sequence[Label] | None = None,
        truth: State | None = None,
        counts: Mapping[str, int] | None = None,
    ) -> Summary:
        """Summarise rows, column by column.

        Args:
            rows: one per scan, in their order.
            labels: injected faults; None where the log does not state them.
            truth: the true state, with the principal axes in the order of the estimate's.
            counts: losses and clock problems by name.
        """
        taken = Columns(rows)
        names = ("t_ns", "gamma", "fault", "pos_err_m", "rot_err_deg")
        marks = list(map(Mark, *(taken[name] for name in names)))
        stamps, times_s, gammas = taken["t_ns"], taken["t_s"], taken["gamma"]
        flagged = [gamma == 0 for gamma in gammas]
        steps = [b - a for a, b in pairwise(stamps) if b > a]
        full = [rank == STATES for rank in taken["ogm_rank"]]
        last, healthy, converged = rows[-1] if rows else None, gammas.count(1), taken["converged"]
        figures = _figures(taken)
        return cls(
            scans=len(stamps),
            duration_s=(max(stamps) - min(stamps)) * 1e-9 if stamps else 0.0,
            interval_s=median(steps) * 1e-9 if steps else None,
            healthy=healthy,
            coasting=len(stamps) - healthy,
            gaps=len(gaps(stamps)),
            status=dict(sorted(Counter(taken["status"]).items())),
            reasons=dict(sorted(Counter(compress(taken["reason"], flagged)).items())),
            pose_all=_errors(figures, "", "healthy", "coasting"),
            pose_healthy=_errors(figures, "", "healthy"),
            pose_coasting=_errors(figures, "", "coasting"),
            registration_healthy=_errors(figures, "reg_", "healthy"),
            registration_flagged=_errors(figures, "reg_", "coasting"),
            fit_error_m=Statistics.of(figures["rms_m/healthy"]),
            iterations=Statistics.of(figures["iterations/healthy"]),
            faults=account(marks, labels),
            coasts=tuple(coasts(marks)),
            parameters=parameters(last, truth) if last else (),
            **{name: getattr(last, name, None) for name in _COUNTED},
            weighed_down=sum(
                w is not None and w < 1.0
                for w in compress(taken["cauchy_weight"], map(not_, flagged))
            ),
            velocity_changes=VelocityChange.of(taken),
            drift=Drifting.of(last) if last else None,
            nis=_share(figures["nis/healthy"], NIS_BAND),
            nees=_share(figures["nees"], NEES_BAND),
            nees_blocks=_blocks(figures),
            reference=next(filter(None, reversed(taken["reference"])), None),
            observability=_observability(last, next(compress(times_s, full), None)),
            convergence=ConvergenceSummary(
                t1_s=next(compress(times_s, converged), None),
                at_end=bool(last and last.converged),
                withdrawn=sum(a and not b for a, b in pairwise(converged)),
            ),
            capture=Capture.of(taken),
            counts=dict(counts or {}),
        )

    @property
    def longest_coast(self) -> Coast | None:
        """The longest interval without a measurement (the first of equals)."""
        return max(self.coasts, key=lambda c: c.duration_s, default=None)


_COUNTED = ("sigma_hits", "r_floors", "reinitialised", "manoeuvres", "violations")
"""Columns that count since the first scan: those of the last row are those of the run."""


def _figures(taken: Columns) -> dict[str, Array]:
    """The finite values of each figure, of those in ``_BY_STATE`` apart for healthy and coasting
    scans.
    """
    healthy, out = np.equal(taken["gamma"], 1), {}
    claimed = _since_convergence(taken["converged"])
    for name in (*_BY_STATE, *_OF_ALL):
        column = taken.numbers(name)
        known = np.isfinite(column)
        if name in _OF_ALL:
            known = known & claimed
        if name == "nis":
            known = _adapted(known & claimed, healthy)
        if name in _BY_STATE:
            out[f"{name}/healthy"], out[f"{name}/coasting"] = (
                column[known & healthy],
                column[known & ~healthy],
            )
        else:
            out[name] = column[known]
    return out


def _adapted(known: NDArray[np.bool_], healthy: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The scans after those to which the noise of the poses is adapted first, where enough
    remain.

    Before, the innovations show how good the noise was that was assumed, and not the estimate.
    """
    later = known & (np.cumsum(healthy) > _ADAPTING_SCANS)
    return later if np.count_nonzero(later & healthy) >= _LEAST_SCANS_AFTER else known


def _since_convergence(converged: Sequence[bool]) -> NDArray[np.bool_]:
    """The scans from convergence on, all of them without it.

    No plan relies on the covariance before.
    """
    flags = np.array(converged, dtype=bool)
    return np.logical_or.accumulate(flags) if flags.any() else np.ones(len(flags), dtype=bool)


def _observability(last: Row | None, full_rank_s: float | None) -> ObservabilitySummary:
    if last is None:
        return ObservabilitySummary(None, None, None, None)
    return ObservabilitySummary(
        last.ogm_log10_cond, last.ogm_log10_cond_scaled, last.ogm_rank, full_rank_s
    )


def _errors(figures: Mapping[str, Array], prefix: str, *states: str) -> Errors:
    position, rotation = (
        np.concatenate([figures[f"{prefix}{name}/{state}"] for state in states])
        for name in ("pos_err_m", "rot_err_deg")
    )
    return Errors(Statistics.of(position), Statistics.of(rotation))


def _blocks(figures: Mapping[str, Array]) -> dict[str, Share]:
    """NEES of each block of the state and its band, per degree of freedom."""
    out: dict[str, Share] = {}
    for name, block in BLOCKS.items():
        size = block.stop - block.start
        low, high = (bound / size for bound in BLOCK_BANDS[size])
        share = _share(figures[f"nees_{name}"] / size, (low, high))
        if share is not None:
            out[name] = share
    return out


def _share(values: Array, band: tuple[float, float]) -> Share | None:
    if not len(values):
        return None
    above = int(np.count_nonzero(values > band[1])) / len(values)
    inside = int(np.count_nonzero((band[0] <= values) & (values <= band[1]))) / len(values)
    return Share(len(values), median(values), inside, above, *band)
